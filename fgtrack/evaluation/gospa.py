"""GOSPA, the distance between the set of the tracks and the set of the true objects.

Rahmathullah, Garcia-Fernandez, Svensson: Generalized optimal sub-pattern assignment metric, Fusion 2017, with p = 2
and alpha = 2. There it is the best assignment of tracks to objects nearer than c,

    GOSPA^2 = sum of squared distances of the pairs + c^2 / 2 (number of missed objects + number of false tracks).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.optimize import linear_sum_assignment

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import contested
from fgtrack.evaluation.scenes import Scenes


@dataclass(frozen=True)
class GospaParts:
    """Squared parts at every tick, shape (t,) each; they add up to the square of GOSPA."""

    localisation_m2: FloatArray
    missed_m2: FloatArray
    false_m2: FloatArray

    @property
    def total_m(self) -> FloatArray:
        """GOSPA at every tick, shape (t,)."""
        return np.sqrt(self.localisation_m2 + self.missed_m2 + self.false_m2)


@dataclass(frozen=True)
class Gospa:
    """GOSPA of a run; NaN without a tick."""

    c_m: float
    """Cut-off distance: a missed object or a false track costs c^2 / 2."""
    ticks: int
    mean_m: float
    """Mean over the ticks."""
    rms_m: float
    """Root of the mean square over the ticks; its square is the sum of the three parts."""
    localisation_m2: float
    """Mean squared part of the pairs."""
    missed_m2: float
    false_m2: float

    @classmethod
    def of(cls, parts: GospaParts, c_m: float) -> Self:
        """Averages of `parts` over the ticks."""
        total_m, ticks = parts.total_m, len(parts.total_m)
        if not ticks:
            return cls(c_m, 0, *[np.nan] * 5)
        squares = (parts.localisation_m2, parts.missed_m2, parts.false_m2)
        rms_m = float(np.sqrt(np.square(total_m).mean()))
        return cls(c_m, ticks, float(total_m.mean()), rms_m, *(float(part.mean()) for part in squares))


def gospa(scenes: Scenes, c_m: float) -> GospaParts:
    """GOSPA with the cut-off distance `c_m`, as its parts at every tick.

    A pair at c or beyond costs as much as a missed object and a false track, and counts as these.
    """
    inside = scenes.distances_m < c_m
    squares = np.where(inside, scenes.distances_m, c_m) ** 2
    unclear = contested(inside, scenes.tick_index, scenes.num_ticks)
    clear = inside & ~unclear[scenes.tick_index, None]
    localisation_m2 = scenes.per_tick(np.where(clear, squares, 0.0).sum(axis=1))
    pairs = scenes.per_tick(clear.sum(axis=1))
    rows_of = list(scenes)
    for tick in np.flatnonzero(unclear).tolist():
        cost = squares[rows_of[tick]]
        rows, columns = linear_sum_assignment(cost)
        chosen = inside[rows_of[tick]][rows, columns]
        localisation_m2[tick] = cost[rows, columns][chosen].sum()
        pairs[tick] = chosen.sum()
    single_m2 = c_m**2 / 2.0
    return GospaParts(
        localisation_m2=localisation_m2,
        missed_m2=single_m2 * (scenes.present.sum(axis=1) - pairs),
        false_m2=single_m2 * (scenes.per_tick(np.ones(len(squares))) - pairs),
    )

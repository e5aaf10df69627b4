"""Chooses the ego among several topics or tables: its poses must agree with its speed, and fused poses come first."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import EgoState, FloatArray
from fgtrack.meaning.guess import words_of
from fgtrack.meaning.parts import InputPart

__all__ = ["EgoConsistency", "consistency", "with_consistent_ego"]

#: Number of states of each candidate that are read.
_MOST = 5_000
#: Time over which the distance and the speed are compared.
_STEP_S = 1.0
#: Largest share of the distance by which poses and speeds of one vehicle differ, and the least distance.
_TOLERANCE = 0.15
_LEAST_M = 0.5
#: Words of poses that several sources are fused into, and of those of a single source.
_FUSED = frozenset(
    (
        "filtered",
        "fused",
        "fusion",
        "ekf",
        "ukf",
        "localization",
        "localisation",
        "kinematic",
        "global",
        "slam",
        "ins",
        "state",
    )
)
_SINGLE = frozenset(
    ("wheel", "wheels", "raw", "can", "encoder", "encoders", "visual", "imu", "local")
)


@dataclass(frozen=True)
class EgoConsistency:
    """Comparison of the distance that poses travel with the distance that their speeds give."""

    misfit: float
    """Median difference over a second, as a share of the typical distance; infinite for too few states."""
    distance_m: float
    """Distance between the poses over the states that were read."""
    by_speed_m: float
    """Distance by the speeds over the same time."""

    @property
    def is_consistent(self) -> bool:
        """True if poses and speeds are consistent: one vehicle can have both."""
        return self.misfit <= _TOLERANCE


def consistency(states: Sequence[EgoState]) -> EgoConsistency:
    """Return the comparison of poses and speeds of `states`."""
    rows = np.array(
        [
            (
                (each.stamp_ns - states[0].stamp_ns) / NS_PER_S,
                each.x_m,
                each.y_m,
                abs(each.speed_mps),
            )
            for each in states
        ]
    ).reshape(-1, 4)
    rows = rows[np.isfinite(rows).all(axis=1)]
    _, first = np.unique(rows[:, 0], return_index=True)
    rows = rows[first]
    if len(rows) < 3 or rows[-1, 0] < _STEP_S:
        return EgoConsistency(math.inf, 0.0, 0.0)
    times_s = np.arange(rows[0, 0], rows[-1, 0], _STEP_S)
    steps_s = np.diff(rows[:, 0])
    travelled_m = _sums(0.5 * (rows[1:, 3] + rows[:-1, 3]) * steps_s)
    path_m = _sums(np.hypot(*np.diff(rows[:, 1:3], axis=0).T))
    by_speed_m = np.diff(np.interp(times_s, rows[:, 0], travelled_m))
    moved = [np.diff(np.interp(times_s, rows[:, 0], axis)) for axis in rows[:, 1:3].T]
    distances_m = np.hypot(*moved)
    typical_m = float(max(np.median(distances_m), np.median(by_speed_m), _LEAST_M))
    misfit = float(np.median(np.abs(distances_m - by_speed_m))) / typical_m
    return EgoConsistency(misfit, float(path_m[-1]), float(travelled_m[-1]))


def _sums(values: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(values)])


def with_consistent_ego(
    parts: Sequence[InputPart], read: Callable[[InputPart], Iterable[EgoState]]
) -> list[InputPart]:
    """Return `parts` with the best ego before the other egos; `read` returns the states of a candidate.

    Poses that move as their speeds are better than poses that do not. Among these, fused
    poses are better than poses from wheels or from a single sensor; the order of `parts`
    decides the rest.
    """
    egos = [part for part in parts if part.role == "ego"]
    if len(egos) < 2:
        return list(parts)
    results = [consistency(list(islice(read(part), _MOST))) for part in egos]
    order = sorted(
        range(len(egos)),
        key=lambda k: (not results[k].is_consistent, _preference(egos[k]), k),
    )
    best = order[0]
    texts = [
        f"{egos[k].label} moves by {results[k].distance_m:.4g} m, by its speed {results[k].by_speed_m:.4g} m"
        for k in order
    ]
    reason = f"{egos[best].label} is read as ego of {len(egos)} candidates: {'; '.join(texts)}"
    chosen = replace(egos[best], role_reason=reason)
    rest = [egos[k] for k in order[1:]]
    return [chosen, *rest, *(part for part in parts if part.role != "ego")]


def _preference(part: InputPart) -> tuple[int, int]:
    """Rank of a candidate by the completeness of its type, and by the words of its name; lower is better."""
    words = set(words_of(part.label))
    return part.rank, len(words & _SINGLE) - len(words & _FUSED)

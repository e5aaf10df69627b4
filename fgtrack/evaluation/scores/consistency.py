"""Consistency of the covariances: NEES and NIS with their chi-square bands."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, by_stamp, mean_square
from fgtrack.evaluation.matching import Matching
from fgtrack.evaluation.scores.innovations import Autocorrelation, autocorrelation, by_sensor, num_measured
from fgtrack.evaluation.scores.statistics import ChiSquareMean
from fgtrack.io.run import Run, Table

_SEED = 1  # of the bootstrap: the same run gives the same interval


@dataclass(frozen=True)
class Consistency:
    """Normalised squared errors and innovations of one run, and the whiteness of the innovations.

    Bands are those of independent samples; errors along a run are not, see `position_nees_interval`.
    """

    position_nees: ChiSquareMean
    """NEES of the present position; empty without truth."""
    nis: Mapping[str, ChiSquareMean]
    """By sensor."""
    autocorrelation: Mapping[str, Autocorrelation | None]
    """By sensor."""
    position_nees_interval: Estimate = UNKNOWN
    """Mean of `position_nees` with the interval of correlated errors, see `mean_square`."""


def consistency(run: Run, matching: Matching | None) -> Consistency:
    """NEES of the evaluated rows of `run`, NIS and whiteness of its innovations."""
    sensors = dict(by_sensor(run.tables["updates"]))
    nis = {name: ChiSquareMean.of(mine["nis"], num_measured(mine)) for name, mine in sensors.items()}
    white = {name: autocorrelation(mine) for name, mine in sensors.items()}
    if matching is None or not matching.paired.any():
        return Consistency(ChiSquareMean(), nis, white)
    squares = position_nees(matching)
    ticks = by_stamp(matching.tracks["stamp_ns"][matching.paired], squares[:, None])
    interval = mean_square(ticks, np.random.default_rng(_SEED))
    return Consistency(ChiSquareMean.of(squares, np.full(len(squares), 2)), nis, white, interval)


def position_nees(matching: Matching) -> FloatArray:
    """Return the NEES of the position of every paired row, shape (p,); NaN where there is none."""
    return position_squares(matching.tracks.where(matching.paired), matching.true_states[matching.paired])


def position_squares(states: Table, truth: FloatArray) -> FloatArray:
    """Return the normalised error squared e' P^-1 e of x and y, shape (n,), 2 on average if consistent.

    NaN where the covariance is not positive definite or an error is NaN.
    """
    x, y = states["x_m"] - truth[:, 0], states["y_m"] - truth[:, 1]
    P_x, P_xy, P_y = (states[name] for name in ("p_x_x", "p_x_y", "p_y_y"))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # of indefinite covariances
        gain = P_xy / P_x
        rest = P_y - gain * P_xy  # variance of y given x
        squares = x**2 / P_x + (y - gain * x) ** 2 / rest
    return np.where((P_x > 0.0) & (rest > 0.0) & np.isfinite(squares), squares, np.nan)

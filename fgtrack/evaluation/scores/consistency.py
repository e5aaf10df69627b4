"""Consistency of the covariances: NEES and NIS with their chi-square bands."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.types import YAW, FloatArray, IntArray
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, by_stamp, mean_square
from fgtrack.evaluation.matching import Matching, state_errors
from fgtrack.evaluation.scores.innovations import Autocorrelation, autocorrelation, num_measured
from fgtrack.evaluation.scores.statistics import ChiSquareMean
from fgtrack.evaluation.truth import TRUE_STATE
from fgtrack.io.run import Run, Table

#: Components of a state in the order of the covariance columns; a part of them is always a leading one.
_COMPONENTS = ("x", "y", "yaw", "speed", "yaw_rate")

_SEED = 1  # of the bootstrap: the same run gives the same interval

_POSITION, _POSE_AND_SPEED, _WITH_YAW_RATE = 2, 4, 5


@dataclass(frozen=True)
class Consistency:
    """Normalised squared errors and innovations of one run, and the whiteness of the innovations.

    The bands are those of independent samples. Innovations of a consistent estimator are independent, errors along a
    run are not: a single run may leave the band of its NEES, see `position_nees_interval`.
    """

    position_nees: ChiSquareMean
    """Of the present position; empty without truth."""
    state_nees: ChiSquareMean
    """Of the present x, y, yaw, speed and yaw rate; without the yaw rate where truth or the model has none."""
    nis: Mapping[str, ChiSquareMean]
    """By sensor."""
    autocorrelation: Mapping[str, Autocorrelation | None]
    """By sensor."""
    position_nees_interval: Estimate = UNKNOWN
    """Mean of `position_nees` with the interval of correlated errors, see `mean_square`."""


def consistency(run: Run, matching: Matching | None) -> Consistency:
    """NEES of the evaluated rows of `run`, NIS and whiteness of its innovations."""
    updates = run.tables["updates"]
    measured = num_measured(updates)
    sensors = {name: updates["sensor"] == name for name in np.unique(updates["sensor"]).tolist()}
    found = Consistency(
        position_nees=ChiSquareMean(),
        state_nees=ChiSquareMean(),
        nis={name: ChiSquareMean.of(updates["nis"][mine], measured[mine]) for name, mine in sensors.items()},
        autocorrelation={name: autocorrelation(updates.where(mine)) for name, mine in sensors.items()},
    )
    if matching is None or not matching.paired.any():
        return found
    position, (state, dof) = position_nees(matching), state_nees(matching)
    ticks = by_stamp(matching.tracks["stamp_ns"][matching.paired], position[:, None])
    return replace(
        found,
        position_nees=ChiSquareMean.of(position, np.full(len(position), _POSITION)),
        state_nees=ChiSquareMean.of(state, dof),
        position_nees_interval=mean_square(ticks, np.random.default_rng(_SEED)),
    )


def position_nees(matching: Matching) -> FloatArray:
    """NEES of the position of every paired row, shape (p,); NaN where there is none."""
    return _nees(matching, _POSITION)


def state_nees(matching: Matching) -> tuple[FloatArray, IntArray]:
    """NEES of x, y, yaw, speed and yaw rate of every paired row with known true yaw and speed, and its dof, shape (p,).

    The yaw rate is left out where the truth or the model has none (its variance is 0).
    """
    variance = matching.tracks["p_yaw_rate_yaw_rate"][matching.paired]
    full = np.isfinite(matching.true_states[matching.paired, _WITH_YAW_RATE - 1]) & (variance > 0.0)
    values = np.where(full, _nees(matching, _WITH_YAW_RATE), _nees(matching, _POSE_AND_SPEED))
    return values, np.where(full, _WITH_YAW_RATE, _POSE_AND_SPEED)


def normalised_squares(states: Table, errors: FloatArray) -> FloatArray:
    """Normalised error squared e' P^-1 e of the leading components of `states`, shape (n,).

    `errors` are those of x, y, yaw, speed, yaw rate or a leading part of them, shape (n, k). A consistent estimator
    has a mean of k. NaN where the covariance of these components is not positive definite or an error is NaN.
    """
    names = _COMPONENTS[: errors.shape[1]]
    e = list(errors.T)
    P = [[states[f"p_{a}_{b}"] for b in names[i:]] for i, a in enumerate(names)]
    total = np.zeros(len(errors))
    # One component after the other is taken out of all rows at once: the others keep their error and covariance given
    # this one (Schur complement), so the squares add up.
    with np.errstate(over="ignore", invalid="ignore"):  # of what is not definite
        while P:
            (variance, *covs), *P = P
            variance = np.where(variance > 0.0, variance, np.nan)
            first, *e = e
            total += first**2 / variance
            gains = [cov / variance for cov in covs]
            e = [error - gain * first for error, gain in zip(e, gains, strict=True)]
            P = [[entry - gains[i] * cov for entry, cov in zip(row, covs[i:], strict=True)] for i, row in enumerate(P)]
    return np.where(np.isfinite(total), total, np.nan)


def _nees(matching: Matching, size: int) -> FloatArray:
    """NEES of the first `size` components of every paired row; NaN where there is none."""
    tracks, truth = matching.tracks.where(matching.paired), matching.true_states[matching.paired]
    errors = np.stack([tracks[name] for name in TRUE_STATE], axis=-1) - truth
    errors[:, YAW] = state_errors(tracks, truth)["yaw_rad"]
    return normalised_squares(tracks, errors[:, :size])

"""Consistency of the covariances: NEES and NIS with their chi-square bands."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fgtrack.core.types import YAW, FloatArray, IntArray
from fgtrack.evaluation.innovations import Autocorrelation, autocorrelations, num_measured
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, by_stamp, mean_square
from fgtrack.evaluation.matching import Matching, state_errors
from fgtrack.evaluation.statistics import ChiSquareMean, Moments, chi_square_band
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
    run are not: a single run may leave the band of its NEES, see `nees_over_runs`.

    Attributes
    ----------
    position_nees
        Of the present position; empty without truth.
    state_nees
        Of the present x, y, yaw, speed and yaw rate; without the yaw rate where truth or the model has none.
    nis
        By sensor.
    autocorrelation
        By sensor and innovation, see `autocorrelations`.
    position_nees_interval
        Mean of `position_nees` with the interval of correlated errors, see `mean_square`.
    """

    position_nees: ChiSquareMean
    state_nees: ChiSquareMean
    nis: Mapping[str, ChiSquareMean]
    autocorrelation: Mapping[str, Mapping[str, Autocorrelation]]
    position_nees_interval: Estimate = UNKNOWN


@dataclass(frozen=True)
class Nees:
    """NEES of n present states.

    Attributes
    ----------
    stamps_ns, object_ids, values
        Of each state, shape (n,).
    dof
        Degrees of freedom of each value: what a consistent estimator has on average.
    """

    stamps_ns: IntArray
    object_ids: IntArray
    values: FloatArray
    dof: IntArray


@dataclass(frozen=True)
class NeesOverRuns:
    """NEES averaged over Monte-Carlo runs: at m objects and stamps, each with at most one value of a run.

    Attributes
    ----------
    object_ids, stamps_ns
        Shape (m,).
    num_runs
        Runs with a value there, shape (m,).
    mean, low, high
        Mean over them and its 95 % band, shape (m,).
    run_means
        Average of every run's own values, shape (runs,); these are independent. NaN for a run without any.
    """

    object_ids: IntArray
    stamps_ns: IntArray
    num_runs: IntArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    run_means: FloatArray = field(repr=False)

    @property
    def share_inside(self) -> float:
        """Share of the objects and stamps inside the band; 0.95 on average for a consistent estimator."""
        return float(((self.mean >= self.low) & (self.mean <= self.high)).mean()) if len(self.mean) else np.nan

    @property
    def overall(self) -> Moments:
        """Moments of `run_means`: std / sqrt(count - 1) is the standard error of the mean, without any assumption."""
        return Moments.of(self.run_means)


def consistency(run: Run, matching: Matching | None) -> Consistency:
    """NEES of the evaluated rows of `run`, NIS and whiteness of its innovations."""
    updates = run.tables["updates"]
    measured = num_measured(updates)
    sensors = {name: updates["sensor"] == name for name in np.unique(updates["sensor"]).tolist()}
    found = Consistency(
        position_nees=ChiSquareMean(),
        state_nees=ChiSquareMean(),
        nis={name: ChiSquareMean.of(updates["nis"][mine], measured[mine]) for name, mine in sensors.items()},
        autocorrelation={name: autocorrelations(updates.where(mine)) for name, mine in sensors.items()},
    )
    if matching is None or not matching.paired.any():
        return found
    position, state = position_nees(matching), state_nees(matching)
    ticks = by_stamp(position.stamps_ns, position.values[:, None])
    return replace(
        found,
        position_nees=ChiSquareMean.of(position.values, position.dof),
        state_nees=ChiSquareMean.of(state.values, state.dof),
        position_nees_interval=mean_square(ticks, np.random.default_rng(_SEED)),
    )


def position_nees(matching: Matching) -> Nees:
    """NEES of the position of every paired row."""
    return _nees(matching, _POSITION)


def state_nees(matching: Matching) -> Nees:
    """NEES of x, y, yaw, speed and yaw rate of every paired row with known true yaw and speed.

    The yaw rate is left out where the truth or the model has none (its variance is 0).
    """
    with_yaw_rate, without = _nees(matching, _WITH_YAW_RATE), _nees(matching, _POSE_AND_SPEED)
    variance = matching.tracks["p_yaw_rate_yaw_rate"][matching.paired]
    full = np.isfinite(matching.true_states[matching.paired, _WITH_YAW_RATE - 1]) & (variance > 0.0)
    values = np.where(full, with_yaw_rate.values, without.values)
    return replace(without, values=values, dof=np.where(full, with_yaw_rate.dof, without.dof))


def nees_over_runs(samples: Sequence[Nees]) -> NeesOverRuns:
    """NEES averaged over runs that differ in their seeds, an entry of `samples` for each: `position_nees(match(run))`.

    Errors along one run are correlated, those of different runs are not. So at every object and stamp the values of
    N runs are averaged, and N times this mean is chi-square with N times the degrees of freedom. Runs must have the
    same ticks (`clock.node_hz`); where some have no value, N is the number of the others. Of several values of a
    run at one stamp the last counts. The objects and stamps themselves remain correlated, so `share_inside` scatters
    more than the share of as many independent draws.

    Raises
    ------
    ValueError
        There is no run.
    """
    if not samples:
        raise ValueError("at least one run is needed")
    kept = [_one_each(sample) for sample in samples]
    keys = np.concatenate([np.stack([one.object_ids, one.stamps_ns], axis=-1) for one in kept])
    distinct, inverse, num_runs = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    values, dof = (np.concatenate([getattr(one, name) for one in kept]) for name in ("values", "dof"))
    total, total_dof = (np.bincount(inverse, part, len(distinct)).astype(np.float64) for part in (values, dof))
    run_means = np.array([Moments.of(one.values).mean for one in kept])
    band = chi_square_band(total_dof, num_runs)
    return NeesOverRuns(distinct[:, 0], distinct[:, 1], num_runs, total / num_runs, *band, run_means)


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


def _nees(matching: Matching, size: int) -> Nees:
    """NEES of the first `size` components of every paired row; NaN where there is none."""
    tracks, truth = matching.tracks.where(matching.paired), matching.true_states[matching.paired]
    errors = np.stack([tracks[name] for name in TRUE_STATE], axis=-1) - truth
    errors[:, YAW] = state_errors(tracks, truth)["yaw_rad"]
    return Nees(
        stamps_ns=tracks["stamp_ns"],
        object_ids=np.array(matching.object_ids)[matching.object_index[matching.paired]],
        values=normalised_squares(tracks, errors[:, :size]),
        dof=np.full(tracks.num_rows, size),
    )


def _one_each(nees: Nees) -> Nees:
    """The finite values, the last one of each object and stamp."""
    rows = np.flatnonzero(np.isfinite(nees.values))[::-1]
    keys = np.stack([nees.object_ids[rows], nees.stamps_ns[rows]], axis=-1)
    rows = rows[np.unique(keys, axis=0, return_index=True)[1]]
    return Nees(nees.stamps_ns[rows], nees.object_ids[rows], nees.values[rows], nees.dof[rows])

"""A bank that outlives the failures of its estimators: a track that fails ends, is counted, and may be born again."""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import TypeVar

import numpy as np
from scipy.special import chdtri

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.linalg import kernels
from fgtrack.core.types import BoolArray, FloatArray, SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, TrackBank, UpdateResult, UpdateStatus
from fgtrack.estimation.failures import EstimatorError, Failure, Failures
from fgtrack.estimation.present import PresentStates

_T = TypeVar("_T")


class GuardedBank:
    """Guards a bank: what it raises, and states that cannot be published (see `faults`), end the track concerned.

    Where it cannot be told which track failed, all tracks of that call end. A `DataError` is an answer, not a failure,
    and propagates; so does a `CallError` until a first track could be started: the estimator cannot be made as it is
    configured.

    Parameters
    ----------
    make
        Makes an empty bank.
    failures
        Counts.
    """

    def __init__(self, make: Callable[[], TrackBank], failures: Failures | None = None) -> None:
        self._make, self._bank = make, make()
        self._now_ns = 0
        self._alive: dict[int, None] = {}  # track ids in order of birth
        self._can_start = False
        self._divergence = Divergence()
        self.failures = failures or Failures()
        """Counts of failures and of the tracks that they have ended."""

    @property
    def present_ns(self) -> int:
        """See `TrackBank.present_ns`."""
        return self._bank.present_ns

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`."""
        return self._bank.window_start_ns

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return tuple(self._alive)

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self._now_ns = now_ns
        self._ask(lambda bank: bank.advance(now_ns))

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`; states that are not finite are left out."""
        states = self._ask(lambda bank: _states_at(bank, stamp_ns))
        if math.isfinite(states.means.sum() + states.covariances.sum()):
            return states
        finite = are_finite(states.means, states.covariances)
        track_ids = tuple(track_id for track_id, kept in zip(states.track_ids, finite, strict=True) if kept)
        return StatesAt(track_ids, states.means[finite], states.covariances[finite])

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`; a measurement whose update raises has failed, and its track ends."""
        results = [UpdateResult(UpdateStatus.FAILED)] * len(track_ids)
        try:
            results = self._bank.update(stamp_ns, track_ids, measurements)
            diverged = self._divergence.count(track_ids, measurements, results)
            if diverged:
                self.failures.add(Failure.DIVERGED, diverged)
        except DataError:
            raise
        except EstimatorError as error:
            results = [error.answers.get(track_id, results[0]) for track_id in track_ids]
            self._end_all(error.causes, Failure.UPDATE_FAILED)
        except Exception as error:
            self._end_all(dict.fromkeys(track_ids, error), Failure.UPDATE_FAILED)
        failed = sum(result.nis is None and result.status is UpdateStatus.FAILED for result in results)
        if failed:
            self.failures.add(Failure.UPDATE_FAILED, failed)
        return results

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`; where it fails, there is no such track afterwards."""
        try:
            self._bank.birth(track_id, prior)
        except Exception as error:
            if isinstance(error, CallError) and not self._can_start:
                raise
            self.failures.note(error)
            self.failures.add(Failure.BIRTH_FAILED)
            if track_id in self._bank.track_ids:
                self._bank.remove(track_id)
        else:
            self._alive[track_id] = None
            self._can_start = True

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`. A track that a failure has ended need not be there."""
        if track_id not in self._alive:
            return
        del self._alive[track_id]
        self._divergence.forget(track_id)
        try:
            self._bank.remove(track_id)
        except Exception as error:
            self.failures.add(Failure.ESTIMATOR_RAISED)
            if isinstance(error, EstimatorError):
                self.failures.note(error)
            else:
                self._start_over(error)

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; all are sound."""
        while True:
            states, unsound = self._ask(self._present)
            if not unsound:
                return states
            for track_id, fault in [(self.track_ids[row], fault) for row, fault in unsound.items()]:
                self.failures.add(fault)
                self._end(track_id, fault, f"the state of track {track_id} is {fault.value}")

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`; those that are not sound are left out."""
        reports, unsound = self._ask(_smoothed)
        for fault in unsound.values():
            self.failures.add(fault)
        return [report for row, report in enumerate(reports) if row not in unsound]

    def _ask(self, question: Callable[[TrackBank], _T]) -> _T:
        """Return the bank's answer to what concerns all tracks, when those that prevent one have ended."""
        while True:
            try:
                return question(self._bank)
            except DataError:
                raise
            except Exception as error:
                self.failures.add(Failure.ESTIMATOR_RAISED)
                if isinstance(error, EstimatorError) and error.causes.keys() & self._alive.keys():
                    self._end_all(error.causes, Failure.ESTIMATOR_RAISED)
                elif self._alive:
                    self._start_over(error)
                else:
                    text = f"the estimator fails even without tracks ({type(error).__name__}: {error})"
                    raise DataError(text) from error

    def _present(self, bank: TrackBank) -> tuple[list[TrackState], dict[int, Failure]]:
        states = bank.present()
        if tuple(bank.track_ids) != self.track_ids or len(states) != len(self._alive):
            raise ValueError(f"{len(self._alive)} tracks have {len(states)} states")
        return states, faults(states)

    def _end_all(self, causes: dict[int, Exception], failure: Failure) -> None:
        for track_id, cause in causes.items():
            self._end(track_id, failure, cause)

    def _end(self, track_id: int, failure: Failure, cause: str | Exception) -> None:
        if track_id in self._alive:  # else it has ended with another one
            self.failures.note(cause)
            self.failures.end(track_id, self._now_ns, failure)
            self.remove(track_id)

    def _start_over(self, error: Exception) -> None:
        """Take a new bank, as the state of this one is unknown: all its tracks end."""
        self.failures.note(error)
        for track_id in self._alive:
            self.failures.end(track_id, self._now_ns, Failure.ESTIMATOR_RAISED)
            self._divergence.forget(track_id)
        self._alive.clear()
        self._bank = self._make()
        self._ask(lambda bank: bank.advance(self._now_ns))


def _states_at(bank: TrackBank, stamp_ns: int) -> StatesAt:
    states = bank.states_at(stamp_ns)
    check_real(states.means, states.covariances)
    if not len(states.track_ids) == len(states.means) == len(states.covariances):
        raise ValueError(f"{len(states.track_ids)} tracks have {len(states.means)} states")
    return states


def _smoothed(bank: TrackBank) -> tuple[list[SmoothedReport], dict[int, Failure]]:
    """Return the smoothed states, and the faults of some by their index."""
    reports = bank.smoothed()
    return reports, faults([report.state for report in reports])


_MOST = np.array([1e9, 1e9, 1e3, 1e5, 1e4, 1e6])
"""Largest x, y, yaw, speed, yaw rate and acceleration, in SI units: far beyond any vehicle on Earth."""
_ROUNDING = 1e-9
"""Tolerance of an eigenvalue of a correlation matrix below 0: rounding, where an entry is known for certain."""
_FAULTS = Failure.NOT_FINITE, Failure.OUT_OF_BOUNDS, Failure.NOT_DEFINITE
"""By the codes of the compiled loop."""

IN_A_ROW, RARE = 8, 1e-4
"""A track has diverged when so many measurements in a row have a NIS that is rarer than this."""


def check_real(*arrays: FloatArray) -> None:
    """Raise `TypeError` where one of them does not hold real numbers."""
    for array in arrays:
        if array.dtype.kind not in "fiu":
            raise TypeError(f"states must be real numbers, are of type {array.dtype}")


def are_finite(means: FloatArray, covariances: FloatArray) -> BoolArray:
    """True where a state is, of means (m, n) and covariances (m, n, n); shape (m,)."""
    return np.asarray(np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))


def faults(states: Sequence[TrackState]) -> dict[int, Failure]:
    """Return what is wrong with kinematic states, by their index; nothing where all can be published.

    A state is sound where it is finite, no entry is larger than any vehicle's (10^9 m, 10^5 m/s, 10^4 rad/s,
    10^6 m/s^2), and its covariance is symmetric and positive definite: up to rounding, as an entry that the motion
    model does not have is 0 with variance 0. Raises `TypeError` for what is not a real number, `ValueError` for
    wrong shapes.
    """
    if not states:
        return {}
    if isinstance(states, PresentStates):
        means, covariances = states.means, states.covariances
    else:
        means = np.array([state.mean for state in states])
        covariances = np.array([state.covariance for state in states])
    check_real(means, covariances)
    n = means.shape[1]
    if not 5 <= n <= len(_MOST) or covariances.shape[1:] != (n, n):
        raise ValueError(f"states have the shapes {means.shape} and {covariances.shape}")
    arrays = (np.array(array, dtype=np.float64, order="C") for array in (means, covariances))
    codes = kernels("fgtrack.tracking.kernels").faults(*arrays, _MOST, _ROUNDING).tolist()
    return {row: _FAULTS[code - 1] for row, code in enumerate(codes) if code} if any(codes) else {}


@cache
def _limit(dof: int) -> float:
    return float(chdtri(dof, RARE))


class Divergence:
    """Counts how often a track diverges: `IN_A_ROW` measurements have a NIS that only the share `RARE` should have.

    With a noise that fits, this happens by chance once in 10^32 measurements; where the errors of positions are three
    times as large as the noise says, once in some 5000. A NIS is judged by the chi-square distribution of what was
    measured; measurements count in the order of their arrival, whatever their sensors. A track diverges again only
    after a measurement that fits.
    """

    def __init__(self) -> None:
        self._surprises: dict[int, int] = {}  # by track: how many in a row

    def count(
        self, track_ids: Sequence[int], measurements: Sequence[Measurement], results: Sequence[UpdateResult]
    ) -> int:
        """Return the number of tracks that diverge with these updates."""
        least, surprises, diverged = _limit(1), self._surprises, 0
        for track_id, measurement, result in zip(track_ids, measurements, results, strict=True):
            nis = result.nis
            if nis is None:
                continue
            if nis <= least or nis <= _limit(len(measurement.z) - len(measurement.assumed)):
                if surprises:
                    surprises.pop(track_id, None)
                continue
            surprises[track_id] = surprises.get(track_id, 0) + 1
            diverged += surprises[track_id] == IN_A_ROW
        return diverged

    def forget(self, track_id: int) -> None:
        """Forget a track that has ended."""
        self._surprises.pop(track_id, None)

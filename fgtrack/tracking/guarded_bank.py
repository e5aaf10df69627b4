"""A bank that outlives failures of its estimators: a failing track ends, is counted, and may be reinitialised."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import compress
from typing import Any

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.linalg import kernels
from fgtrack.core.types import SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, TrackBank, UpdateResult, UpdateStatus
from fgtrack.estimation.failures import EstimatorError, Failure, Failures
from fgtrack.estimation.filters.propagation import States


class GuardedBank:
    """Guards a bank: what it raises, and states that cannot be published (see `faults`), end the track concerned.
    Where it is unknown which track failed, all tracks of that call end. A `DataError` is an answer, not a failure,
    and propagates; so does a `CallError` until a first track could be started: the estimator cannot be made as it is
    configured. `make` gives an empty bank.
    """

    def __init__(self, make: Callable[[], TrackBank], failures: Failures | None = None) -> None:
        self._make, self._bank = make, make()
        self._now_ns = 0
        self._alive: dict[int, None] = {}  # track ids in order of birth
        self._can_start = False
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
        self._ask("advance", now_ns)

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`; states that are not finite are left out."""
        states: StatesAt = self._ask("states_at", stamp_ns)
        if math.isfinite(np.vdot(states.means, states.means) + np.vdot(states.covariances, states.covariances)):
            return states
        finite = np.isfinite(states.means.sum(axis=1) + states.covariances.sum(axis=(1, 2)))
        return StatesAt(tuple(compress(states.track_ids, finite)), states.means[finite], states.covariances[finite])

    def state_of(self, track_id: int, stamp_ns: int) -> StatesAt:
        """Return the state of one track at `stamp_ns`, see `states_at`; of no track where it has none.
        A bank with `states_of` is asked for it alone.
        """
        if hasattr(self._bank, "states_of"):
            states: StatesAt = self._ask("states_of", stamp_ns, track_id)
            return states
        return self.states_at(stamp_ns).of(track_id)

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`; a measurement whose update raises has failed, and its track ends."""
        results = [UpdateResult(UpdateStatus.FAILED)] * len(track_ids)
        try:
            results = self._bank.update(stamp_ns, track_ids, measurements)
        except DataError:
            raise
        except EstimatorError as error:
            results = [error.answers.get(track_id, results[0]) for track_id in track_ids]
            self._end(error.causes, Failure.UPDATE_FAILED)
        except Exception as error:
            self._end(dict.fromkeys(track_ids, error), Failure.UPDATE_FAILED)
        for result in results:
            if result.nis is None and result.status is UpdateStatus.FAILED:
                self.failures.add(Failure.UPDATE_FAILED)
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
        try:
            self._bank.remove(track_id)
        except Exception as error:
            self.failures.add(Failure.ESTIMATOR_RAISED)
            if isinstance(error, EstimatorError):
                self.failures.note(error)
            else:
                self._start_over(error)

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`; all are sound."""
        while True:
            states: Sequence[TrackState] = self._ask("present")
            unsound = faults(states)
            if not unsound:
                return states
            for track_id, fault in [(self.track_ids[row], fault) for row, fault in unsound.items()]:
                self.failures.add(fault)
                self._end({track_id: f"the state of track {track_id} is {fault.value}"}, fault)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`; those that are not sound are left out."""
        reports: list[SmoothedReport] = self._ask("smoothed")
        unsound = faults([report.state for report in reports]) if reports else {}
        for fault in unsound.values():
            self.failures.add(fault)
        return [report for row, report in enumerate(reports) if row not in unsound] if unsound else reports

    def _ask(self, method: str, *arguments: int) -> Any:  # Any: what the method returns
        """Return the bank's answer, when the tracks that prevent one have ended."""
        while True:
            try:
                return getattr(self._bank, method)(*arguments)
            except DataError:
                raise
            except Exception as error:
                self.failures.add(Failure.ESTIMATOR_RAISED)
                if isinstance(error, EstimatorError) and error.causes.keys() & self._alive.keys():
                    self._end(error.causes, Failure.ESTIMATOR_RAISED)
                elif self._alive:
                    self._start_over(error)
                else:
                    text = f"the estimator fails even without tracks ({type(error).__name__}: {error})"
                    raise DataError(text) from error

    def _end(self, causes: Mapping[int, str | Exception], failure: Failure) -> None:
        for track_id, cause in causes.items():
            if track_id in self._alive:  # else it has ended with another one
                self.failures.note(cause)
                self.failures.end(track_id, self._now_ns, failure)
                self.remove(track_id)

    def _start_over(self, error: Exception) -> None:
        """Take a new bank, as the state of this one is unknown: all its tracks end."""
        self.failures.note(error)
        for track_id in self._alive:
            self.failures.end(track_id, self._now_ns, Failure.ESTIMATOR_RAISED)
        self._alive.clear()
        self._bank = self._make()
        self.advance(self._now_ns)


_KINDS = Failure.NOT_FINITE, Failure.NOT_DEFINITE  # as the kernel numbers them


def faults(states: Sequence[TrackState]) -> dict[int, Failure]:
    """Return the faults of kinematic states by their index; nothing where all can be published.
    A state is sound where it is finite, its entries sum up to at most 10^9, and its covariance is symmetric and
    positive definite: up to rounding, as an entry that the motion model does not have is 0 with variance 0.
    """
    if not states:
        return {}
    if isinstance(states, States):
        x, P = states.means, states.covariances
    else:
        x, P = np.array([state.mean for state in states]), np.array([state.covariance for state in states])
    x, P = np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(P, dtype=np.float64)
    codes = kernels("fgtrack.tracking.kernels").faults(x, P)
    return {row: _KINDS[codes[row] - 1] for row in codes.nonzero()[0].tolist()}

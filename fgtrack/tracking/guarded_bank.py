"""A bank that outlives the failures of its estimators: a track that fails ends, is counted, and may be born again."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, TrackBank, UpdateResult, UpdateStatus
from fgtrack.estimation.failures import EstimatorError, Failure, Failures
from fgtrack.tracking.soundness import Divergence, are_finite, check_real, faults

__all__ = ["GuardedBank"]

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
        finite = are_finite(states.means, states.covariances)
        if finite.all():
            return states
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

"""A bank that outlives the failures of its estimators: a track that fails begins anew, or ends, and is counted."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import TypeVar

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import ACCEL, SPEED, YAW, YAW_RATE, SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, TrackBank, UpdateResult, UpdateStatus
from fgtrack.estimation.failures import Failure, Failures
from fgtrack.estimation.forwarding import ForwardingBank
from fgtrack.estimation.present import PresentStates
from fgtrack.tracking.soundness import Divergence, are_finite, check_real, faults

__all__ = ["RestartingBank"]

_T = TypeVar("_T")
Faults = dict[int, Failure]
_SHAPES = {(n, n, n) for n in (5, 6)}


class RestartingBank(ForwardingBank):
    """Stands in front of a bank, and handles what it raises and states that cannot be published (see `faults`).

    A track that fails begins anew from its last good state, under the same id; what it knew of the past is lost. If it
    fails again before an update has succeeded, it ends. Where it cannot be told which track failed, all begin anew in a
    new bank. A `DataError` is an answer, no failure, and is let through; so is a `CallError` until a first track could
    be started: the estimator cannot be made as it is configured.

    Parameters
    ----------
    make
        Makes an empty bank.
    failures
        Counts.
    """

    def __init__(self, make: Callable[[], TrackBank], failures: Failures | None = None) -> None:
        super().__init__(make())
        self._make = make
        self._now_ns = 0
        self._starts: dict[int, Start] = {}  # by track: how it began
        self._good: tuple[tuple[int, ...], list[TrackState]] = (), []  # tracks, and their last good states
        self._suspects: dict[int, bool] = {}  # tracks that have failed: whether an update has succeeded since
        self._can_start = False
        self._divergence = Divergence()
        self.failures = failures or Failures()
        """What has failed, and what was done about it."""

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self._now_ns = now_ns
        self._ask(lambda bank: bank.advance(now_ns))

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`; states that are not finite are left out."""
        states = self._ask(lambda bank: _states_at(bank, stamp_ns))
        if are_finite(states.means, states.covariances):
            return states
        rows = [row for row in range(len(states.means)) if are_finite(states.means[row], states.covariances[row])]
        return StatesAt(tuple(states.track_ids[row] for row in rows), states.means[rows], states.covariances[rows])

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`; tracks that have failed before are updated alone, to be told from the others."""
        if not self._suspects:
            return self._update(stamp_ns, track_ids, measurements)
        alone = [[place] for place, track_id in enumerate(track_ids) if track_id in self._suspects]
        others = [place for place, track_id in enumerate(track_ids) if track_id not in self._suspects]
        results: dict[int, UpdateResult] = {}
        for places in [others, *alone] if others else alone:
            ids = [track_ids[place] for place in places]
            results |= zip(places, self._update(stamp_ns, ids, [measurements[place] for place in places]), strict=True)
        return [results[place] for place in range(len(track_ids))]

    def _update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        try:
            results = self._bank.update(stamp_ns, track_ids, measurements)
            diverged = self._divergence.count(track_ids, measurements, results)
        except DataError:
            raise
        except Exception as error:
            self.failures.note(error)
            self.failures.add(Failure.UPDATE_FAILED, len(track_ids))
            for track_id in track_ids:
                self._restart(track_id, Failure.UPDATE_FAILED)
            return [UpdateResult(UpdateStatus.FAILED) for _ in track_ids]
        failed = len([one for one in results if one.nis is None and one.status is UpdateStatus.FAILED])
        for failure, count in ((Failure.UPDATE_FAILED, failed), (Failure.DIVERGED, diverged)):
            if count:
                self.failures.add(failure, count)
        for track_id in self._suspects.keys() & set(track_ids):
            self._suspects[track_id] = True
        return results

    def has(self, track_id: int) -> bool:
        """See `ForwardingBank.has`: whether its birth has succeeded, and nothing has ended it."""
        return track_id in self._starts

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`; where it fails, there is no such track afterwards."""
        try:
            self._bank.birth(track_id, prior)
            self._starts[track_id] = prior
            self._can_start = True
        except Exception as error:
            if isinstance(error, CallError) and not self._can_start:
                raise
            self.failures.note(error)
            self.failures.add(Failure.BIRTH_FAILED)
            self.remove(track_id)

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`; if need be by a new bank. A track that a failure has ended need not be there."""
        known = self.has(track_id)
        self._forget(track_id)
        if not known and track_id not in self._alive:
            return
        try:
            self._bank.remove(track_id)
        except Exception as error:
            self._raised(error)
            self._rebuild([other for other in self._alive if other != track_id])

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; all are sound."""
        while True:  # a track that is not sound twice in a row ends
            states, found = self._ask(_present)
            track_ids = self._bank.track_ids
            if not found:
                break
            for place, fault in found.items():
                self.failures.add(fault)
                self.failures.note(f"the state of track {track_ids[place]} is {fault.value}")
            for place, fault in found.items():
                self._restart(track_ids[place], fault)
        self._good = track_ids, states
        for track_id in [i for i, updated in self._suspects.items() if updated]:
            del self._suspects[track_id]
        return states

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`; those that are not sound are left out."""
        reports, found = self._ask(_smoothed)
        for fault in found.values():
            self.failures.add(fault)
        return [report for place, report in enumerate(reports) if place not in found] if found else reports

    def _ask(self, question: Callable[[TrackBank], _T]) -> _T:
        """The bank's answer to what concerns all tracks; if it has none, that of a new bank."""
        try:
            return question(self._bank)
        except DataError:
            raise
        except Exception as error:
            self._raised(error)
        self._rebuild(self._alive)
        try:
            return question(self._bank)
        except Exception as error:
            self._raised(error)
        alive = self._alive
        guilty = [track_id for track_id in alive if not self._answers_alone(track_id, question)]
        for track_id in guilty or alive:
            self._ended(track_id, Failure.ESTIMATOR_RAISED)
        self._rebuild([track_id for track_id in alive if track_id in self._starts])
        return self._without_excuse(question)

    @property
    def _alive(self) -> tuple[int, ...]:
        """The tracks of the bank; where it does not tell them, those that began and have not ended."""
        try:
            return tuple(self._bank.track_ids)
        except Exception:
            return tuple(self._starts)

    def _answers_alone(self, track_id: int, question: Callable[[TrackBank], object]) -> bool:
        bank = self._make()
        try:
            bank.advance(self._now_ns)
            bank.birth(track_id, self._start(track_id))
            question(bank)
        except Exception:
            return False
        return True

    def _rebuild(self, track_ids: Iterable[int]) -> None:
        """A new bank with these tracks, each from its last good state."""
        self._bank = self._make()
        self._without_excuse(lambda bank: bank.advance(self._now_ns))
        for track_id in track_ids:
            self._born_again(track_id, Failure.ESTIMATOR_RAISED)

    def _without_excuse(self, question: Callable[[TrackBank], _T]) -> _T:
        """The bank's answer, which it must give: its tracks are new, or there are none."""
        try:
            return question(self._bank)
        except Exception as error:
            raise DataError(f"the estimator fails whatever its tracks are ({type(error).__name__}: {error})") from error

    def _restart(self, track_id: int, failure: Failure) -> None:
        """Begin a track anew in this bank; one that has failed before, without success since, ends."""
        if track_id not in self._alive:
            return  # it has ended with another one
        again = track_id in self._suspects
        start = self._start(track_id)
        self.remove(track_id)
        if again:
            self.failures.end(track_id, self._now_ns, failure)
            return
        self._starts[track_id] = start
        self._born_again(track_id, failure)

    def _born_again(self, track_id: int, failure: Failure) -> None:
        start = self._start(track_id)
        try:
            self._bank.birth(track_id, start)
        except Exception as error:
            self.failures.note(error)
            self._ended(track_id, failure)
            self.remove(track_id)
            return
        self.failures.add(Failure.TRACK_RESTARTED)
        self._suspects[track_id] = False
        self._divergence.forget(track_id)

    def _ended(self, track_id: int, failure: Failure) -> None:
        self.failures.end(track_id, self._now_ns, failure)
        self._forget(track_id)

    def _forget(self, track_id: int) -> None:
        self._starts.pop(track_id, None)
        self._suspects.pop(track_id, None)
        self._divergence.forget(track_id)

    def _start(self, track_id: int) -> Start:
        """What is known of a track: its last good state, or how it began, where that was too uncertain for a start."""
        track_ids, states = self._good
        if track_id in track_ids:
            with suppress(CallError):
                return _start_at(states[track_ids.index(track_id)])
        return self._starts[track_id]

    def _raised(self, error: Exception) -> None:
        self.failures.add(Failure.ESTIMATOR_RAISED)
        self.failures.note(error)


def _states_at(bank: TrackBank, stamp_ns: int) -> StatesAt:
    states = bank.states_at(stamp_ns)
    check_real(states.means, states.covariances)
    if not len(states.track_ids) == len(states.means) == len(states.covariances):
        raise ValueError(f"{len(states.track_ids)} tracks have {len(states.means)} states")
    return states


def _present(bank: TrackBank) -> tuple[list[TrackState], Faults]:
    """The present states, and what is wrong with them."""
    states, many = bank.present(), len(bank.track_ids)
    if isinstance(states, PresentStates):
        shapes = {(*states.means.shape[1:], *states.covariances.shape[1:])} if states else set()
    else:
        shapes = {(*state.mean.shape, *state.covariance.shape) for state in states}
    if len(states) != many or not shapes <= _SHAPES:
        raise ValueError(f"{many} tracks have {len(states)} states of shapes {', '.join(map(str, shapes))}")
    return states, faults(states)


def _smoothed(bank: TrackBank) -> tuple[list[SmoothedReport], Faults]:
    """The smoothed states, and what is wrong with them."""
    reports = bank.smoothed()
    return reports, faults([report.state for report in reports])


def _start_at(state: TrackState) -> Start:
    """A track of which this kinematic state is known, and no more than that.

    A start has no covariances between position, yaw, speed and the others. Without them, P <= k blockdiag(P) for the
    k blocks on the diagonal: (a + b + ...)^2 is at most k (a^2 + b^2 + ...).
    """
    mean = state.mean.tolist()
    blocks = len(mean) - 1
    std = np.sqrt(blocks * np.maximum(np.diag(state.covariance), 0.0)).tolist()
    accel = {"accel_mps2": mean[ACCEL], "accel_std_mps2": std[ACCEL]} if len(mean) > ACCEL else {}
    return Start(
        stamp_ns=state.stamp_ns,
        position_m=state.mean[:2],
        position_covariance=blocks * state.covariance[:2, :2],
        yaw_rad=mean[YAW],
        yaw_std_rad=std[YAW],
        speed_mps=mean[SPEED],
        speed_std_mps=std[SPEED],
        yaw_rate_radps=mean[YAW_RATE],
        yaw_rate_std_radps=std[YAW_RATE],
        **accel,
    )

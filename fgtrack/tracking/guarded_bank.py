"""A bank that outlives failures of its estimators: a failing track ends, is counted, and may be reinitialised."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import compress
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.linalg import kernels
from fgtrack.core.state import Snapshot, Stateful, stateful
from fgtrack.core.types import SmoothedReport, TrackState
from fgtrack.estimation.base import (
    Measurement,
    Measurements,
    Start,
    StatesAt,
    TrackBank,
    UpdateResult,
    UpdateStatus,
    WindowBank,
)
from fgtrack.estimation.failures import EstimatorError, Failure, Failures
from fgtrack.estimation.filters.propagation import States

if TYPE_CHECKING:
    from fgtrack.estimation.smoothing.window import Window

_T = TypeVar("_T")


class GuardedBank(Stateful):
    """Bank whose failures end the failing track alone.

    A track ends when its estimator raises, and when its state cannot be published (see `faults`). If the failing track
    is unknown, all tracks of the call end. A track with an unchanged state goes on (`EstimatorError.unchanged`). A
    `DataError` is an answer, not a failure, and propagates. A `CallError` propagates until a first track has started:
    it means that the configured estimator cannot be made. `make` returns an empty bank.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_now_ns",
        "_alive",
        "_can_start",
    )

    def __init__(
        self, make: Callable[[], TrackBank], failures: Failures | None = None
    ) -> None:
        self._make, self._bank = make, make()
        self._now_ns = 0
        self._alive: dict[int, None] = {}  # track ids in order of birth
        self._can_start = False
        self.failures = failures or Failures()
        """Counts of failures and of the tracks that they have ended."""

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Raises `CallError` for a plug-in that has no checkpoint."""
        return {**super().checkpoint(), "bank": stateful(self._bank).checkpoint()}

    def restore(self, snapshot: Snapshot) -> None:
        """See `Stateful.restore`."""
        super().restore(snapshot)
        stateful(self._bank).restore(snapshot["bank"])

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

    def holds(self, track_id: int) -> bool:
        """Return True if the track exists. The cost does not depend on the number of tracks."""
        return track_id in self._alive

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self._now_ns = now_ns
        try:
            self._bank.advance(now_ns)
        except Exception as error:
            self._ask(lambda bank: bank.advance(now_ns), error, changes=True)

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`; states that are not finite are left out."""
        try:
            states = self._bank.states_at(stamp_ns)
        except Exception as error:
            states = self._ask(lambda bank: bank.states_at(stamp_ns), error)
        if math.isfinite(
            np.vdot(states.means, states.means)
            + np.vdot(states.covariances, states.covariances)
        ):
            return states
        finite = np.isfinite(
            states.means.sum(axis=1) + states.covariances.sum(axis=(1, 2))
        )
        return StatesAt(
            tuple(compress(states.track_ids, finite)),
            states.means[finite],
            states.covariances[finite],
        )

    def state_of(self, track_id: int, stamp_ns: int) -> StatesAt:
        """Return the state of one track at `stamp_ns`, see `states_at`; an empty `StatesAt` without a state.

        If the bank has `states_of`, it computes only the state of this track.
        """
        bank: Any = self._bank  # Any: not each bank has `states_of`
        if not hasattr(bank, "states_of"):
            return self.states_at(stamp_ns).of(track_id)
        try:
            states: StatesAt = bank.states_of(stamp_ns, track_id)
        except Exception as error:
            states = self._ask(
                lambda bank: bank.states_of(stamp_ns, track_id),  # type: ignore[attr-defined]
                error,
            )
        return states

    def window(self, track_id: int) -> "Window":
        """Return a copy of the window of a track. Raises `CallError` unless the estimator is a smoother."""
        if not isinstance(self._bank, WindowBank):
            raise CallError(
                "window: the estimator keeps no window, take a smoother: smoother, smoother-batch or smoother-banded"
            )
        return self._bank.window(track_id)

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[UpdateResult]:
        """See `TrackBank.update`. A measurement has failed if its update raises, or if its track has ended.

        A propagated exception and an interrupt leave states unknown, so they end all tracks of the call.
        """
        ids = track_ids
        given = set(ids)
        if not given <= self._alive.keys():
            ids = [track_id for track_id in track_ids if track_id in self._alive]
            given = set(ids)
            measurements = [
                each
                for track_id, each in zip(track_ids, measurements, strict=True)
                if track_id in given
            ]
        try:
            answers = self._updated(stamp_ns, ids, measurements) if ids else {}
        except BaseException as error:
            self._end(dict.fromkeys(ids, error), Failure.UPDATE_FAILED)
            if isinstance(error, DataError) or not isinstance(error, Exception):
                raise
            answers = {}
        found = list(map(answers.get, track_ids))
        results = [each for each in found if each]
        if len(results) == len(found) and None not in [each.nis for each in results]:
            return results
        results = [each or UpdateResult(UpdateStatus.FAILED) for each in found]
        for track_id, result in zip(track_ids, results, strict=True):
            if result.nis is None and result.status is UpdateStatus.FAILED:
                self.failures.add(Failure.UPDATE_FAILED)
                if track_id in answers or track_id not in given:
                    self.failures.note(
                        f"a measurement of track {track_id} could not be fused"
                    )
        return results

    def withdraw(self, track_ids: Sequence[int], stack: Measurement) -> list[bool]:
        """Undo the fusion of `stack`, which has a measurement of each track.

        Return False for a track whose estimator cannot, or does not have the measurement. A track that raises ends.
        """
        bank: Any = self._bank  # Any: not each bank has `withdraw`
        if not hasattr(bank, "withdraw"):
            return [False] * len(track_ids)
        if hasattr(bank, "withdraw_stack") and self._alive.keys() >= set(track_ids):
            outcomes = bank.withdraw_stack(track_ids, stack).tolist()
            cause = np.linalg.LinAlgError("a measurement can no longer be fused")
            pairs = zip(track_ids, outcomes, strict=True)
            failed = {each: cause for each, outcome in pairs if outcome < 0}
            if failed:
                self._end(failed, Failure.UPDATE_FAILED)
            return [outcome > 0 for outcome in outcomes]
        return [
            self._withdraw_one(each, own)
            for each, own in zip(track_ids, Measurements(stack), strict=True)
        ]

    def _withdraw_one(self, track_id: int, measurement: Measurement) -> bool:
        """See `withdraw`."""
        bank: Any = self._bank
        if track_id not in self._alive:
            return False
        try:
            return bool(bank.withdraw(track_id, measurement))
        except Exception as error:
            self._end({track_id: error}, Failure.UPDATE_FAILED)
            return False

    def _updated(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> Mapping[int, UpdateResult]:
        """Return the results by track.

        A track that raises ends and has no result. It does not end if its state is unchanged.
        """
        try:
            results = self._bank.update(stamp_ns, track_ids, measurements)
        except EstimatorError as error:
            ended = {
                each: cause
                for each, cause in error.causes.items()
                if each not in error.unchanged
            }
            for each in error.unchanged:
                self.failures.note(error.causes[each])
            self._end(ended, Failure.UPDATE_FAILED)
            return {
                each: error.answers[each] for each in track_ids if each in error.answers
            }
        if not {*map(type, results)} <= {UpdateResult}:
            raise TypeError(f"update must return results, returned {results!r:.200}")
        return dict(zip(track_ids, results, strict=True))

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`. A track whose start fails does not exist afterwards."""
        self._alive[track_id] = None
        try:
            self._bank.birth(track_id, prior)
        except BaseException as error:
            if track_id in self._bank.track_ids:
                self.remove(track_id)
            self._alive.pop(track_id, None)
            if not isinstance(error, Exception) or (
                isinstance(error, CallError) and not self._can_start
            ):
                raise
            self.failures.note(error)
            self.failures.add(Failure.BIRTH_FAILED)
        else:
            self._can_start = True

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`. A track that a failure has ended already is ignored."""
        if track_id not in self._alive:
            return
        try:
            self._bank.remove(track_id)
        except Exception as error:
            self.failures.add(Failure.ESTIMATOR_RAISED)
            if (
                isinstance(error, EstimatorError)
                and track_id not in self._bank.track_ids
            ):
                self.failures.note(error)
            else:
                self._alive.pop(track_id)
                self._start_over(error)
        self._alive.pop(track_id, None)

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`. States with a fault are left out: their tracks end."""
        while True:
            try:
                states, unsound = self._checked(self._bank.present())
            except Exception as error:
                states, unsound = self._ask(
                    lambda bank: self._checked(bank.present()), error
                )
            if not unsound:
                return states
            for track_id, fault in [
                (self.track_ids[row], fault) for row, fault in unsound.items()
            ]:
                self.failures.add(fault)
                self._end(
                    {track_id: f"the state of track {track_id} is {fault.value}"}, fault
                )

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`. States with a fault are left out."""
        try:
            reports = self._bank.smoothed()
            if not reports:
                return reports
            reports, unsound = _smoothed(reports)
        except Exception as error:
            reports, unsound = self._ask(lambda bank: _smoothed(bank.smoothed()), error)
        for fault in unsound.values():
            self.failures.add(fault)
        return (
            [report for row, report in enumerate(reports) if row not in unsound]
            if unsound
            else reports
        )

    def _checked(
        self, states: Sequence[TrackState]
    ) -> tuple[Sequence[TrackState], dict[int, Failure]]:
        """Return present states and their faults. Raises `ValueError` for another number of states than of tracks."""
        if len(states) != len(self._alive):
            raise ValueError(
                f"present gives {len(states)} states of {len(self._alive)} tracks"
            )
        return states, faults(states)

    def _ask(
        self,
        question: Callable[[TrackBank], _T],
        error: Exception,
        *,
        changes: bool = False,
    ) -> _T:
        """Return the answer of the bank to a question that raised `error`, after the tracks that cause the error have
        ended.

        Raises `MemoryError` if the memory is not enough for the answer, unless the question `changes` states.
        """
        is_new = False
        while True:
            if isinstance(error, DataError):
                raise error
            if isinstance(error, MemoryError) and not changes:
                raise error
            self.failures.add(Failure.ESTIMATOR_RAISED)
            if (
                isinstance(error, EstimatorError)
                and error.causes.keys() & self._alive.keys()
            ):
                self._end(error.causes, Failure.ESTIMATOR_RAISED)
            elif self._alive:
                self._start_over(error)
            elif is_new:
                text = f"the estimator fails even without tracks ({type(error).__name__}: {error})"
                raise DataError(text) from error
            else:
                is_new = True
                self.failures.note(error)
                self._bank = self._make()
                with suppress(Exception):  # the repeated question shows it
                    self._bank.advance(self._now_ns)
            try:
                return question(self._bank)
            except Exception as another:
                error = another

    def _end(self, causes: Mapping[int, str | BaseException], failure: Failure) -> None:
        for track_id, cause in causes.items():
            if track_id in self._alive:  # else it has ended with another one
                self.failures.note(cause)
                self.failures.end(track_id, self._now_ns, failure)
                self.remove(track_id)

    def _start_over(self, error: Exception) -> None:
        """Replace the bank by a new bank, because its state is unknown. All its tracks end."""
        self.failures.note(error)
        self._bank = self._make()
        for track_id in self._alive:
            self.failures.end(track_id, self._now_ns, Failure.ESTIMATOR_RAISED)
        self._alive.clear()
        self.advance(self._now_ns)


def _smoothed(
    reports: list[SmoothedReport],
) -> tuple[list[SmoothedReport], dict[int, Failure]]:
    """Return smoothed states and their faults."""
    return reports, faults([report.state for report in reports]) if reports else {}


_KINDS = Failure.NOT_FINITE, Failure.NOT_DEFINITE  # as the kernel numbers them


def faults(states: Sequence[TrackState]) -> dict[int, Failure]:
    """Return the faults of kinematic states by their index; empty if all states can be published.

    A sound state is finite, its entries sum up to at most 10^9, and its covariance is symmetric and positive definite.
    Definiteness is checked up to rounding, because an entry that the motion model lacks is 0 with variance 0.
    """
    if not states:
        return {}
    if isinstance(states, States):
        x, P = states.means, states.covariances
    else:
        x, P = (
            np.array([state.mean for state in states]),
            np.array([state.covariance for state in states]),
        )
    x, P = (
        np.ascontiguousarray(x, dtype=np.float64),
        np.ascontiguousarray(P, dtype=np.float64),
    )
    codes = kernels("fgtrack.tracking.kernels").faults(x, P)
    return {row: _KINDS[codes[row] - 1] for row in codes.nonzero()[0].tolist()}

"""A bank of independent estimators, and the estimator of one object from a bank."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import repeat
from types import TracebackType
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

import numpy as np

from fgtrack.core.checks import as_stamp, is_number
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.state import Snapshot, Stateful, stateful
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray, SmoothedReport, TrackState
from fgtrack.estimation.base import (
    Estimator,
    Measurement,
    MeasurementBank,
    Start,
    StatesAt,
    TrackBank,
    UpdateResult,
    UpdateStatus,
    WindowBank,
    asked_stamp,
    described,
)
from fgtrack.estimation.failures import EstimatorError
from fgtrack.estimation.filters.ekf import predict
from fgtrack.estimation.filters.propagation import kinematic_states, track_state
from fgtrack.models.motion import MotionModel

if TYPE_CHECKING:
    from fgtrack.estimation.smoothing.window import Window

_E = TypeVar("_E", bound=Estimator)
_T = TypeVar("_T")


class Outcomes:
    """Results of an update of several tracks, collected part by part. An exception of one part does not affect
    other parts.
    """

    def __init__(self) -> None:
        self._answers = dict[int, UpdateResult]()
        self._causes = dict[int, Exception]()
        self._unchanged = set[int]()

    def add(
        self, track_ids: Sequence[int], fuse: Callable[[], Sequence[UpdateResult]]
    ) -> None:
        """Add the results that `fuse` returns for these tracks, or its exception. A `DataError` propagates."""
        try:
            self._answers.update(zip(track_ids, fuse(), strict=True))
        except DataError:
            raise
        except EstimatorError as error:
            self._answers.update(error.answers)
            self._causes.update(error.causes)
            self._unchanged.update(error.unchanged)
        except Exception as error:
            self._causes.update(dict.fromkeys(track_ids, error))

    def results(self, track_ids: Sequence[int]) -> list[UpdateResult]:
        """Return the results of all tracks. Raises `EstimatorError` if a part has raised."""
        if self._causes:
            raise EstimatorError(self._causes, self._answers, self._unchanged)
        return [self._answers[track_id] for track_id in track_ids]


def as_unchanged(error: Exception, track_ids: Sequence[int]) -> Exception:
    """Return an `EstimatorError` for an error that has not changed the states of these tracks. A `DataError` is
    returned as it is.
    """
    if isinstance(error, DataError):
        return error
    return EstimatorError(dict.fromkeys(track_ids, error), {}, track_ids)


class changing_nothing:  # noqa: N801 - as `contextlib.suppress`
    """Context that turns an exception into an `EstimatorError` that reports these tracks as unchanged.

    It is a class because a generator takes three times as long.
    """

    __slots__ = ("_track_ids",)

    def __init__(self, track_ids: Sequence[int]) -> None:
        self._track_ids = track_ids

    def __enter__(self) -> None:
        pass

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if isinstance(error, Exception) and not isinstance(error, DataError):
            raise as_unchanged(error, self._track_ids) from error


class ObjectBank(Stateful, Generic[_E]):
    """A bank with one `Estimator` per object, which `start` makes.

    An exception becomes an `EstimatorError`, except a `DataError`. `lagged_s` are the lags of the lagged states.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "present_ns",
        "_starts",
    )

    def __init__(
        self,
        motion: MotionModel,
        start: Callable[[Start], _E],
        lag_s: float,
        lagged_s: Sequence[float] = (),
    ) -> None:
        self._motion = motion
        self._lagged_s = lagged_s
        self._start = start
        self._lag_ns = nanoseconds(lag_s)
        self._estimators: dict[int, _E] = {}
        self._starts: dict[int, Start] = {}  # by track id
        self.present_ns = 0
        """See `TrackBank.present_ns`."""

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Raises `CallError` for an estimator that has no checkpoint."""
        estimators = {
            track_id: stateful(item).checkpoint()
            for track_id, item in self._estimators.items()
        }
        return {**super().checkpoint(), "estimators": estimators}

    def restore(self, snapshot: Snapshot) -> None:
        """See `Stateful.restore`. Each estimator is made from its start, and then gets its state."""
        super().restore(snapshot)
        self._estimators = {}
        for track_id, own in snapshot["estimators"].items():
            item = self._start(self._starts[track_id])
            stateful(item).restore(own)
            self._estimators[track_id] = item

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`."""
        return self.present_ns - self._lag_ns

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return tuple(self._estimators)

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self.present_ns = now_ns
        self._ask(lambda _, estimator: estimator.advance(now_ns))

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`."""
        states = self._ask(
            lambda _, item: (
                self._state(item, stamp_ns) if item.window_ns[0] <= stamp_ns else None
            )
        )
        known = {
            track_id: state for track_id, state in states.items() if state is not None
        }
        return StatesAt(tuple(known), *_stacked(known.values(), self._motion.dim))

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        seen = dict(zip(track_ids, measurements, strict=True))
        result = self._ask(
            lambda track_id, item: _checked(
                item.update(seen[track_id]), seen[track_id]
            ),
            track_ids,
        )
        return [result[track_id] for track_id in track_ids]

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        self._estimators[track_id] = self._start(prior)
        self._starts[track_id] = prior

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        del self._estimators[track_id], self._starts[track_id]

    def withdraw(self, track_id: int, measurement: Measurement) -> bool:
        """Undo the fusion of a measurement. Return False if the estimator cannot, or does not have the measurement."""
        withdraw = getattr(self._estimators[track_id], "withdraw", None)
        if withdraw is None:
            return False
        try:
            withdraw(measurement)
        except CallError:
            return False
        return True

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`. An object whose first stamp is after the present has its first state."""
        states = self._ask(
            lambda _, item: self._state(item, max(self.present_ns, item.window_ns[0]))
        )
        return kinematic_states(
            self._motion, self.present_ns, *_stacked(states.values(), self._motion.dim)
        )

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`: states of every lag, and no final states."""
        return lagged_reports(self, self._motion, self._lagged_s)

    def _ask(
        self, question: Callable[[int, _E], _T], track_ids: Sequence[int] | None = None
    ) -> dict[int, _T]:
        """Return the results of `question` by track id, for all estimators or for `track_ids`.

        Raises `EstimatorError` if the question raises for some of them.
        """
        answers, causes = dict[int, _T](), dict[int, Exception]()
        for track_id in self._estimators if track_ids is None else track_ids:
            try:
                answers[track_id] = question(track_id, self._estimators[track_id])
            except DataError:
                raise
            except Exception as error:
                causes[track_id] = error
        if causes:
            raise EstimatorError(causes, answers)
        return answers

    def _state(self, estimator: _E, stamp_ns: int) -> TrackState:
        state, n = estimator.state_at(stamp_ns), self._motion.dim
        if state.mean.shape != (n,) or state.covariance.shape != (n, n):
            raise ValueError(
                f"a state has the shapes {state.mean.shape} and {state.covariance.shape}"
            )
        return state


def checked_lags(lag_s: float, lagged_s: Sequence[float] | float) -> tuple[float, ...]:
    """Return `lagged_s` as floats. Raises `ValueError` for a lag that is not between 0 and `lag_s`."""
    lags = [lagged_s] if isinstance(lagged_s, int | float) else list(lagged_s)
    if not all(is_number(each, 0.0) and each <= lag_s for each in lags):
        raise ValueError(
            f"lagged_s: must lie between 0 and the window of {lag_s:g} s, is {lagged_s}"
        )
    return tuple(map(float, lags))


def lagged_reports(
    bank: TrackBank, motion: MotionModel, lagged_s: Sequence[float]
) -> list[SmoothedReport]:
    """Return the states of all tracks of `bank` at each of `lagged_s` before the present."""
    reports = list[SmoothedReport]()
    for lag_s in lagged_s:
        stamp_ns = bank.present_ns - nanoseconds(lag_s)
        states = bank.states_at(stamp_ns)
        lagged = kinematic_states(motion, stamp_ns, states.means, states.covariances)
        reports += map(SmoothedReport, states.track_ids, lagged, repeat(lag_s))
    return reports


def _checked(result: UpdateResult, measurement: Measurement) -> UpdateResult:
    if not isinstance(result, UpdateResult):
        raise TypeError(
            f"update must return an UpdateResult, returned a {type(result).__name__}"
        )
    if (
        result.innovation is not None
        and np.shape(result.innovation) != measurement.z.shape
    ):
        raise ValueError(
            f"the innovation of {measurement.z.shape} has the shape {np.shape(result.innovation)}"
        )
    return result


def _stacked(states: Iterable[TrackState], n: int) -> tuple[FloatArray, FloatArray]:
    means, covariances = (
        [state.mean for state in states],
        [state.covariance for state in states],
    )
    return np.array(means).reshape(-1, n), np.array(covariances).reshape(-1, n, n)


@contextmanager
def _own_cause() -> Iterator[None]:
    """Replace an `EstimatorError` by the exception that the only track of the bank has raised."""
    try:
        yield
    except EstimatorError as error:
        raise error.causes.get(0, error) from error


class SingleObject(Stateful):
    """A bank with one object, as an `Estimator`. The clock of the bank follows the newest stamp.

    `bank` must be empty. A bank on a time grid, such as `BackwardForwardBank`, returns the state of the nearest
    grid point.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_first_ns",
        "_newest_ns",
        "bank",
    )

    def __init__(
        self, motion: MotionModel, bank: TrackBank, start: Start, name: str = ""
    ) -> None:
        self._motion = motion
        self.bank = bank
        self._name = name or type(bank).__name__
        self._kept = bank if isinstance(bank, MeasurementBank) else None
        self._windows = bank if isinstance(bank, WindowBank) else None
        self._first_ns = self._newest_ns = start.stamp_ns
        bank.advance(start.stamp_ns)
        bank.birth(0, start)

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Raises `CallError` for a plug-in that has no checkpoint."""
        stateful(self.bank)
        return super().checkpoint()

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return max(self.bank.window_start_ns, self._first_ns), self._newest_ns

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        now_ns = as_stamp("now_ns", now_ns)
        if now_ns > self.bank.present_ns:
            self.bank.advance(now_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        stamp_ns = measurement.stamp_ns
        if stamp_ns < self.window_ns[0]:
            return UpdateResult(UpdateStatus.TOO_OLD)
        if not (np.isfinite(measurement.z).all() and np.isfinite(measurement.R).all()):
            return UpdateResult(UpdateStatus.FAILED)  # before the clock moves
        self.advance(stamp_ns)
        with _own_cause():
            result = self.bank.update(
                stamp_ns, [0], [measurement.seen_by(self._motion)]
            )[0]
        if result.status is not UpdateStatus.FAILED:
            self._newest_ns = max(self._newest_ns, stamp_ns)
        return result

    def has_fused(self, measurement: Measurement) -> bool:
        """True if the window has an identical measurement, and the bank keeps measurements."""
        if self._kept is None or measurement.stamp_ns < self.window_ns[0]:
            return False
        return self._kept.has_fused(0, measurement)

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`."""
        stamp_ns = as_stamp("stamp_ns", stamp_ns)
        with _own_cause():
            states = states_of(self.bank, self._motion, stamp_ns)
        if not states.track_ids:
            asked_stamp(stamp_ns, self.window_ns[0])
            raise CallError(f"stamp_ns: there is no finite state at {stamp_ns} ns")
        return track_state(
            self._motion, stamp_ns, states.means[0], states.covariances[0]
        )

    def window(self) -> "Window":
        """Return a copy of the window: states, prior and measurements. Raises `CallError` unless the bank is a
        smoother.
        """
        with _own_cause():
            return self._smoother("window").window(0)

    def withdraw(self, measurement: Measurement) -> None:
        """Undo the fusion of a measurement: the states become the states without this measurement.

        In a linear model they are exact at once, else after `converge()` of the bank. Raises `CallError` if the
        measurement has left the window or was never fused, and if the estimator is not a smoother.
        """
        bank, stamp_ns, oldest_ns = (
            self._smoother("withdraw"),
            measurement.stamp_ns,
            self.window_ns[0],
        )
        if stamp_ns < oldest_ns:
            raise CallError(
                f"withdraw: the measurement at {stamp_ns} ns has left the window, which begins at {oldest_ns} ns"
            )
        with _own_cause():
            is_withdrawn = bank.withdraw(0, measurement.seen_by(self._motion))
        if not is_withdrawn:
            raise CallError(
                f"withdraw: the measurement at {stamp_ns} ns was not fused, or was withdrawn before"
            )

    def _smoother(self, call: str) -> WindowBank:
        """Return the bank. Raises `CallError` if the bank has no windows."""
        if self._windows is None:
            raise CallError(
                f"{call}: {self._name} keeps no window, take a smoother: smoother, smoother-batch or smoother-banded"
            )
        return self._windows

    def __repr__(self) -> str:
        return described(self._name, self._motion, self.window_ns)


def states_of(bank: TrackBank, motion: MotionModel, stamp_ns: int) -> StatesAt:
    """Return the states of all tracks of `bank` whose windows have begun, at any stamp, in the state of `motion`."""
    return ahead_of(
        bank.states_at(min(stamp_ns, bank.present_ns)),
        bank.present_ns,
        motion,
        stamp_ns,
    )


def ahead_of(
    states: StatesAt, present_ns: int, motion: MotionModel, stamp_ns: int
) -> StatesAt:
    """Return `states` at the present predicted to a later stamp. At a stamp up to the present they are returned
    unchanged.
    """
    if stamp_ns <= present_ns or not states.track_ids:
        return states
    ahead = predict(
        states.means, states.covariances, motion, seconds(stamp_ns - present_ns)
    )
    return StatesAt(states.track_ids, *ahead)


def state_of(
    bank: TrackBank, motion: MotionModel, track_id: int, stamp_ns: int
) -> TrackState:
    """Return the state of a track of `bank` at any stamp.

    Raises `CallError` for a stamp before the window of the track, and for a state that is not finite.
    """
    states = states_of(bank, motion, stamp_ns)
    if track_id not in states.track_ids:
        raise CallError(
            f"track {track_id} has no state at {stamp_ns} ns: "
            "the stamp lies before its window, or the state is not finite"
        )
    row = states.track_ids.index(track_id)
    return track_state(motion, stamp_ns, states.means[row], states.covariances[row])

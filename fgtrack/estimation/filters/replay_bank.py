"""The replaying EKFs of all objects in arrays."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import compress
from typing import Any, ClassVar

import numpy as np

from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.linalg import equal_ones, kernels
from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import (
    BoolArray,
    FloatArray,
    IntArray,
    SmoothedReport,
    TrackState,
)
from fgtrack.estimation.base import (
    Measurement,
    Measurements,
    Start,
    StatesAt,
    TrackBank,
    UpdateResult,
    UpdateStatus,
    no_states,
    stacks,
)
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.failures import EstimatorError
from fgtrack.estimation.filters.initiation import DEFAULT, checked_initiation
from fgtrack.estimation.filters.propagation import kinematic_states
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.filters.stepwise_replay import (
    FUSED,
    KERNELS,
    NO_ROOM,
    STATUS,
    Outside,
    StepwiseReplay,
    stack_of,
)
from fgtrack.estimation.filters.track_initiation import TrackInitiation
from fgtrack.estimation.object_bank import (
    ObjectBank,
    Outcomes,
    as_unchanged,
    changing_nothing,
    checked_lags,
    lagged_reports,
)
from fgtrack.models.measurement import SensorPose
from fgtrack.models.motion import MotionModel, WhiteNoise

#: Column of `labels` at which the codes of the components begin, see `kernels.replay_arrays`.
CODES = 3


class ReplayBank(Stateful):
    """The replaying EKFs of all objects. Their steps lie in arrays: a compiled loop replays all tracks of a list.

    A track is replayed step by step, outside this loop, in two cases: its window has a step at which the direction
    of travel was sought, or a measurement that a plug-in models. See `fgtrack.estimation.kernels.replay`.

    Parameters
    ----------
    motion
        One of the shipped models.
    lag_s
        Length of the windows.
    initiation
        See `Initiation`.
    lagged_s
        Lags of the lagged states, each at most `lag_s`.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "present_ns",
        "_start_ns",
        "_rows",
        "_order",
        "_outside",
        "_free",
        "_arrays",
        "_shape",
    )

    def __init__(
        self,
        motion: WhiteNoise,
        lag_s: float,
        initiation: str = DEFAULT,
        lagged_s: Sequence[float] | float = (),
    ) -> None:
        self._motion, self._lag_ns = motion, nanoseconds(lag_s)
        self._lagged_s = checked_lags(lag_s, lagged_s)
        self._initiation = checked_initiation(initiation)
        self._kind, self._noise = motion.kind, motion.noise
        self.present_ns = 0
        """See `TrackBank.present_ns`."""
        self._start_ns = -int(LARGEST_NS)  # oldest stamp that the clock allows
        self._rows: dict[int, int] = {}
        """Row of the arrays that holds each track, by track id in order of birth."""
        self._order: IntArray | None = (
            None  # the same rows as an array; None after a birth or removal
        )
        self._outside: dict[int, dict[int, Outside]] = {}
        """Steps that compiled loops cannot replay alone, by row and slot."""
        self._free: list[int] = []
        self._arrays: tuple[Any, ...] = ()
        self._shape: tuple[int, ...] = 0, 0, 0  # numbers of tracks, steps, components
        self._allocate(8, 64, 4)

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`."""
        return self.present_ns - self._lag_ns

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return tuple(self._rows)

    def _allocate(self, *least: int) -> None:
        """Make arrays for at least `least` tracks, steps and components, and copy the present contents.

        `fgtrack.estimation.kernels.replay_arrays` describes the arrays.
        """
        present, n = self._shape[0], self._motion.dim
        rows, slots, k = shape = tuple(map(max, self._shape, (*least, 0, 0)))
        arrays = [
            np.tile(np.arange(slots), (rows, 1)),
            np.zeros((rows, slots, CODES + k), dtype=np.int64),
            np.zeros((rows, slots, 3 * n + 2, n)),
            np.zeros((rows, 3), dtype=np.int64),
            np.zeros((rows, slots, k + 1, k)),
            np.zeros((rows, slots, len(SensorPose()) + 1)),
        ]
        if self._arrays:
            order, labels, steps, windows, measured, views = self._arrays
            track, place = np.nonzero(np.arange(order.shape[1]) < windows[:, :1])
            used = track, order[track, place]  # memory is used by these slots only
            arrays[0][:present, : order.shape[1]], arrays[3][:present] = order, windows
            arrays[1][*used, : labels.shape[2]], arrays[2][used] = (
                labels[used],
                steps[used],
            )
            arrays[4][*used, : measured.shape[2], : measured.shape[3]] = measured[used]
            arrays[5][used] = views[used]
        free = [*self._free, *range(present, rows)]
        self._arrays, self._shape, self._free = tuple(arrays), shape, free

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self.present_ns = now_ns
        self._start_ns = max(self._start_ns, now_ns - self._lag_ns)

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`."""
        known, *states = self._states(stamp_ns)
        if known is None:
            return StatesAt(self.track_ids, *states)
        return StatesAt(
            tuple(compress(self.track_ids, known.tolist())),
            *(each[known] for each in states),
        )

    def states_of(self, stamp_ns: int, track_id: int) -> StatesAt:
        """Return the state of one track at `stamp_ns`, at a cost that does not depend on the number of tracks."""
        if track_id not in self._rows:
            return no_states(self._motion.dim)
        count, _, *states = self._ahead(np.array([self._rows[track_id]]), stamp_ns)
        return StatesAt((track_id,), *states) if count else no_states(self._motion.dim)

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`. An object whose first stamp is after the present has its first state."""
        return kinematic_states(
            self._motion,
            self.present_ns,
            *self._states(self.present_ns, is_present=True)[1:],
        )

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        if isinstance(measurements, Measurements):
            return self._update(stamp_ns, track_ids, measurements.stack)
        outcomes = Outcomes()
        for indices, alike in stacks(measurements):
            ids = [track_ids[i] for i in indices]
            outcomes.add(ids, partial(self._update, stamp_ns, ids, alike))
        return outcomes.results(track_ids)

    def _update(
        self, stamp_ns: int, track_ids: Sequence[int], one: Measurement
    ) -> list[UpdateResult]:
        """Return the results of a stack of measurements, one for each of `track_ids`.

        Raises `EstimatorError` with the tracks that failed.
        """
        try:
            seen = one.seen_by(self._motion)
            is_plugin = not seen.model.is_compiled
        except Exception as error:
            raise as_unchanged(error, track_ids) from error
        if not is_plugin and not self._outside:
            return self._fused(stamp_ns, track_ids, seen)
        is_outside = [
            is_plugin or self._rows.get(each) in self._outside for each in track_ids
        ]
        outcomes = Outcomes()
        for chosen in equal_ones(is_outside):
            part, ids = seen, track_ids
            if len(chosen) < len(track_ids):
                part, ids = (
                    replace(seen, z=seen.z[chosen], R=seen.R[chosen]),
                    [track_ids[k] for k in chosen],
                )
            if not is_outside[chosen[0]]:
                outcomes.add(ids, partial(self._fused, stamp_ns, ids, part))
                continue
            for track_id, own in zip(ids, Measurements(part), strict=True):
                outcomes.add([track_id], partial(self._fused_outside, track_id, own))
        return outcomes.results(track_ids)

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        mean, covariance = initial_state(self._motion, prior)
        search = TrackInitiation.of(self._motion, prior, self._initiation)
        if not self._free:
            self._allocate(2 * self._shape[0])
        row = self._free[-1]
        order, labels, steps, windows, _, _ = (array[row] for array in self._arrays)
        first = order[0]
        windows[:] = 1, prior.stamp_ns, prior.stamp_ns
        labels[first, :2] = prior.stamp_ns, 0
        steps[first] = np.vstack([mean, covariance, mean, covariance, covariance])
        self._outside.pop(row, None)
        if search is not None:
            self._outside[row] = {int(first): Outside(None, search)}
        self._rows[track_id], self._order = self._free.pop(), None

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        row = self._rows.pop(track_id)
        self._outside.pop(row, None)
        self._free.append(row)
        self._order = None

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`: filtered states of every lag, and no final states."""
        return lagged_reports(self, self._motion, self._lagged_s)

    def has_fused(self, track_id: int, measurement: Measurement) -> bool:
        """True if the window has an identical measurement of this track."""
        seen = measurement.seen_by(self._motion)
        if len(seen.z) > self._shape[2]:
            return False
        one = replace(seen, z=seen.z[None], R=seen.R[None])
        rows = np.array([self._rows[track_id]])
        find = kernels(KERNELS).find
        return bool(find(self._arrays, rows, seen.stamp_ns, stack_of(one)) > 0)

    def withdraw(self, track_id: int, measurement: Measurement) -> bool:
        """Filter a track without a measurement, as if it had never been fused. Return False if the window does not
        have it.

        False also for a track that is replayed step by step. Raises `EstimatorError` if a later measurement can no
        longer be fused.
        """
        one = replace(measurement, z=measurement.z[None], R=measurement.R[None])
        outcome = int(self.withdraw_stack([track_id], one)[0])
        if outcome < 0:
            cause = np.linalg.LinAlgError("a measurement can no longer be fused")
            raise EstimatorError({track_id: cause}, {})
        return outcome > 0

    def withdraw_stack(self, track_ids: Sequence[int], stack: Measurement) -> IntArray:
        """Filter each track without its measurement in `stack`, see `withdraw`.

        Returns 1 for a track that had the measurement, 0 for another track, and -1 if a later measurement can no longer
        be fused, shape (tracks,).
        """
        seen = stack.seen_by(self._motion)
        outcomes = np.zeros(len(track_ids), dtype=np.int64)
        rows = [self._rows[each] for each in track_ids]
        rows = [-1 if row in self._outside else row for row in rows]
        if seen.z.shape[1] <= self._shape[2]:
            kernels(KERNELS).withdraw(
                self._kind,
                self._noise,
                self._arrays,
                np.array(rows),
                seen.stamp_ns,
                stack_of(seen),
                outcomes,
            )
        return outcomes

    def _fused(
        self, stamp_ns: int, track_ids: Sequence[int], one: Measurement
    ) -> list[UpdateResult]:
        """Fuse a stack of measurements in the compiled loop, and return the results.

        Raises `EstimatorError` with the tracks that failed.
        """
        try:
            rows = np.array(list(map(self._rows.__getitem__, track_ids)))
            m, k = one.z.shape
            if k > self._shape[2]:
                self._allocate(0, 0, k)
            y, S, nis = np.empty((m, k)), np.empty((m, k, k)), np.empty(m)
            status = np.empty(m, dtype=np.int64)
            now = self._lag_ns, self._start_ns, stamp_ns
            seen = stack_of(one), one.measured
            fuse = kernels(KERNELS).fuse
        except Exception as error:
            raise as_unchanged(error, track_ids) from error
        model, results = (self._kind, self._noise), (y, S, nis, status)
        if not fuse(*model, self._arrays, rows, now, *seen, results):
            return _results(y, S, nis, status)
        outcomes = Outcomes()
        for is_full in (False, True):
            chosen = ((status == NO_ROOM) == is_full).nonzero()[0]
            ids = [track_ids[k] for k in chosen.tolist()]
            if is_full:
                part = replace(one, z=one.z[chosen], R=one.R[chosen])
                outcomes.add(
                    ids, partial(self._fused_in_more_room, stamp_ns, ids, part)
                )
            else:
                outcomes.add(
                    ids,
                    partial(
                        _results, y[chosen], S[chosen], nis[chosen], status[chosen]
                    ),
                )
        return outcomes.results(track_ids)

    def _fused_in_more_room(
        self, stamp_ns: int, track_ids: Sequence[int], one: Measurement
    ) -> list[UpdateResult]:
        """Double the slots of all tracks, then return `_fused`: all slots of these tracks are in use."""
        with changing_nothing(track_ids):
            self._allocate(0, 2 * self._shape[1], 0)
        return self._fused(stamp_ns, track_ids, one)

    def _states(
        self, stamp_ns: int, is_present: bool = False
    ) -> tuple[BoolArray | None, FloatArray, FloatArray]:
        """Return the states of all tracks at `stamp_ns`: a mask (m,), means (m, n) and covariances (m, n, n).

        The mask is True for tracks with a state, and None if all tracks have a state. The rows of the other tracks have
        arbitrary values. If `is_present`, a track that begins after the stamp has its first state.
        """
        if self._order is None:
            self._order = np.array([*self._rows.values()], dtype=np.int64)
        count, known, means, covariances = self._ahead(
            self._order, stamp_ns, is_present
        )
        return None if count == len(known) else known, means, covariances

    def _ahead(
        self, rows: IntArray, stamp_ns: int, is_present: bool = False
    ) -> tuple[int, BoolArray, FloatArray, FloatArray]:
        """Return the states of the tracks in `rows` at `stamp_ns`: number of tracks with a state, mask of these
        tracks, means and covariances.

        The arguments and arrays are described in `fgtrack.estimation.kernels.replay.ahead`.
        """
        m, n = len(rows), self._motion.dim
        known, means, covariances = (
            np.empty(m, dtype=bool),
            np.empty((m, n)),
            np.empty((m, n, n)),
        )
        at = rows, self._start_ns, stamp_ns, is_present
        count = kernels(KERNELS).ahead(
            self._kind, self._noise, self._arrays, *at, means, covariances, known
        )
        return count, known, means, covariances

    # --- tracks outside the compiled loop, step by step

    def _fused_outside(self, track_id: int, one: Measurement) -> list[UpdateResult]:
        """Fuse a measurement into a track that is replayed step by step, and return the result.

        An exception changes nothing.
        """
        with changing_nothing([track_id]):
            row, k = self._rows[track_id], len(one.z)
            if k > self._shape[2]:
                self._allocate(0, 0, k)
            kept = [array[row].copy() for array in self._arrays]
            steps, is_fused = dict(self._outside.get(row, {})), False
            try:
                replay = StepwiseReplay(self._motion, self._arrays, row, steps)
                result = replay.fused(one, self._lag_ns, self._start_ns)
                if result is not None and result.status in FUSED:
                    self._keep_outside(row, steps)
                    is_fused = True
            except np.linalg.LinAlgError:
                result = UpdateResult(UpdateStatus.FAILED)
            finally:
                if not is_fused:
                    for array, own in zip(self._arrays, kept, strict=True):
                        array[row] = own
            if result is None:
                self._allocate(0, 2 * self._shape[1])
        return [result] if result else self._fused_outside(track_id, one)

    def _keep_outside(self, row: int, steps: dict[int, Outside]) -> None:
        """Keep the `steps` of a track that its window needs. If none is left, the compiled loop replays the track."""
        order, labels, _, windows, _, _ = self._arrays
        slots = order[row, : windows[row, 0]]
        oldest_ns = max(int(windows[row, 1]), self._start_ns)
        first = max(int(labels[row, slots, 0].searchsorted(oldest_ns)) - 1, 0)
        kept = {slot: steps[slot] for slot in slots[first:].tolist() if slot in steps}
        if any(each.search is not None or each.is_plugin for each in kept.values()):
            self._outside[row] = kept
        else:
            self._outside.pop(row, None)


def _results(
    y: FloatArray, S: FloatArray, nis: FloatArray, status: IntArray
) -> list[UpdateResult]:
    """Return the results of innovations (m, k), covariances (m, k, k), NIS (m,) and outcomes (m,) of the compiled
    loop.
    """
    statuses = list(map(STATUS.__getitem__, status.tolist()))
    results = list(map(UpdateResult, statuses, y, nis.tolist(), S))
    if UpdateStatus.FAILED in statuses or UpdateStatus.TOO_OLD in statuses:
        results = [
            each if each.status in FUSED else UpdateResult(each.status)
            for each in results
        ]
    return results


def ekf_replay(
    motion: MotionModel,
    lag_s: float,
    initiation: str = DEFAULT,
    lagged_s: Sequence[float] | float = (),
) -> TrackBank:
    """Return the bank of EKFs with replay, whose estimates do not depend on the order of arrival.

    The filters keep the measurements of a window. They roll back and re-filter later measurements, as
    robot_localization does. A motion model of a plug-in is linearised outside the compiled loops, with a
    `ReplayEkf` for each object. `initiation`: see `Initiation`. `lagged_s` are lags of additional outputs: filtered
    states of the past, with everything that has arrived since.
    """
    if isinstance(motion, WhiteNoise) and motion.is_compiled:
        return ReplayBank(motion, lag_s, initiation, lagged_s)
    return ObjectBank(
        motion,
        lambda start: ReplayEkf(motion, start, lag_s, initiation),
        lag_s,
        checked_lags(lag_s, lagged_s),
    )


ekf_replay.bank = True  # type: ignore[attr-defined]  # claims, see `fgtrack.estimation.registry.Claims`
for _claim in ("exact", "retrodicts", "initiates"):
    setattr(ekf_replay, _claim, getattr(ReplayEkf, _claim))

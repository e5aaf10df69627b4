"""The replaying EKFs of all objects in arrays."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import compress
from typing import Any

import numpy as np

from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.linalg import equal_ones, kernels
from fgtrack.core.types import BoolArray, FloatArray, IntArray, TrackState
from fgtrack.estimation.base import (
    Measurement,
    Measurements,
    Start,
    StatesAt,
    UpdateResult,
    UpdateStatus,
    no_states,
    stacks,
)
from fgtrack.estimation.failures import EstimatorError
from fgtrack.estimation.filters.ekf import Prediction
from fgtrack.estimation.filters.propagation import kinematic_states
from fgtrack.estimation.filters.replay import ReplayEkf, Step
from fgtrack.estimation.object_bank import ObjectBank, Outcomes, changing_nothing
from fgtrack.models.measurement import COMPONENTS, SensorPose, measurement_model
from fgtrack.models.motion import WhiteNoise
from fgtrack.models.robust import compiled_form
from fgtrack.models.sensors import RobustLoss

_KERNELS = "fgtrack.estimation.kernels.replay"
#: In the order of the numbers that the kernels give.
_STATUS = (
    UpdateStatus.FAILED,
    UpdateStatus.TOO_OLD,
    UpdateStatus.IN_SEQUENCE,
    UpdateStatus.OUT_OF_SEQUENCE,
)
_FUSED, _NO_ROOM = _STATUS[2:], len(_STATUS)
#: Column of `labels` at which the components begin, see the kernels.
CODES = 3


class ReplayBank(ObjectBank[ReplayEkf]):
    """`ReplayEkf` of all objects, whose steps lie in arrays: a compiled loop replays all that a list concerns.

    Filters of their own remain where a direction of travel is sought, and where a window has a measurement with a
    robust loss or of what is not an entry of the state. See `ObjectBank` and `fgtrack.estimation.kernels.replay`. The
    motion model is one of the shipped ones.
    """

    def __init__(
        self, motion: WhiteNoise, start: Callable[[Start], ReplayEkf], lag_s: float
    ) -> None:
        super().__init__(motion, start, lag_s)
        self._kind, self._noise = motion.kind, motion.noise
        self._start_ns = -int(LARGEST_NS)  # of all windows, by the clock
        self._rows: dict[int, int] = {}  # of tracks in the arrays
        self._order: IntArray | None = (
            None  # of all tracks by birth, until one comes, goes or moves
        )
        self._free: list[int] = []
        self._losses: dict[tuple[int, float], RobustLoss] = {}  # by kind and width
        self._arrays = list[Any]()
        self._shape: tuple[int, ...] = (
            0,
            0,
            0,
        )  # numbers of tracks, steps and components
        self._allocate(8, 64, 4)

    def _allocate(self, *least: int) -> None:
        """Make arrays for at least so many tracks, steps and components with the present contents (see the kernels)."""
        present, n = self._shape[0], self._motion.dim
        rows, slots, k = shape = tuple(map(max, self._shape, least))
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
            used = track, order[track, place]  # only the pages of used slots are made
            arrays[0][:present, : order.shape[1]], arrays[3][:present] = order, windows
            arrays[1][*used, : labels.shape[2]], arrays[2][used] = (
                labels[used],
                steps[used],
            )
            arrays[4][*used, : measured.shape[2], : measured.shape[3]] = measured[used]
            arrays[5][used] = views[used]
        free = [*self._free, *range(present, rows)]
        self._arrays, self._shape, self._free = arrays, shape, free

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self.present_ns = now_ns
        self._start_ns = max(self._start_ns, now_ns - self._lag_ns)
        if len(self._rows) < len(self._estimators):
            self._ask(
                lambda _, item: item.advance(now_ns),
                [i for i in self._estimators if i not in self._rows],
            )

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
        """Return `states_at` of one track, at a cost that does not depend on the number of the others."""
        if track_id not in self._rows:
            return self.states_at(stamp_ns).of(track_id)
        count, _, *states = self._ahead(np.array([self._rows[track_id]]), stamp_ns)
        return StatesAt((track_id,), *states) if count else no_states(self._motion.dim)

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
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
        """Return the outcomes of a stack of measurements."""
        with changing_nothing(track_ids):
            seen = one.seen_by(self._motion)
            is_plain = _is_plain(seen)
            is_held = [is_plain and each in self._rows for each in track_ids]
            groups: Sequence[Sequence[int]] = [range(len(is_held))]
            if not (is_held and all(is_held)):
                groups = equal_ones(is_held)
        outcomes = Outcomes()
        for chosen in groups:
            part, ids = seen, track_ids
            if len(chosen) < len(track_ids):
                part, ids = (
                    replace(seen, z=seen.z[chosen], R=seen.R[chosen]),
                    [track_ids[k] for k in chosen],
                )
            fuse = self._fused if is_held[chosen[0]] else self._alone
            outcomes.add(ids, partial(fuse, stamp_ns, ids, part))
        return outcomes.results(track_ids)

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        super().birth(track_id, prior)
        self._order = None
        self._put_in([track_id])

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        super().remove(track_id)
        self._order = None
        if track_id in self._rows:
            self._free.append(self._rows.pop(track_id))

    def _alone(
        self, stamp_ns: int, track_ids: Sequence[int], one: Measurement
    ) -> list[UpdateResult]:
        """Outcomes of a stack of measurements that need the filters of their objects."""
        with changing_nothing(track_ids):
            for track_id in track_ids:
                self._take_out(track_id)
        try:
            results = super().update(stamp_ns, track_ids, Measurements(one))
        except EstimatorError as error:
            self._put_in(error.answers)
            raise
        self._put_in(track_ids)
        return results

    def _fused(
        self, stamp_ns: int, track_ids: Sequence[int], one: Measurement
    ) -> list[UpdateResult]:
        """Outcomes of a stack of measurements of entries of the state."""
        with changing_nothing(track_ids):
            rows, (m, k) = (
                np.array(list(map(self._rows.__getitem__, track_ids))),
                one.z.shape,
            )
            if k > self._shape[2]:
                self._allocate(0, 0, k)
            z, R = (
                np.ascontiguousarray(one.z, dtype=np.float64),
                np.ascontiguousarray(one.R, dtype=np.float64),
            )
            y, S, nis, status = (
                np.empty((m, k)),
                np.empty((m, k, k)),
                np.empty(m),
                np.empty(m, dtype=np.int64),
            )
            loss, width = compiled_form(one.loss, k)
            if one.loss is not None:
                self._losses[loss, width] = one.loss
            now = self._lag_ns, self._start_ns, stamp_ns
            view = np.array([*one.pose, width])
            fuse = partial(
                kernels(_KERNELS).fuse,
                self._kind,
                self._noise,
                *self._arrays,
                rows,
                *now,
                one.model.codes,
                view,
                loss,
                z,
                R,
            )
        if not fuse(one.measured, y, S, nis, status):
            return _results(y, S, nis, status)
        outcomes = Outcomes()
        for is_full in (False, True):
            chosen = ((status == _NO_ROOM) == is_full).nonzero()[0]
            ids = [track_ids[k] for k in chosen.tolist()]
            if is_full:
                part = replace(one, z=z[chosen], R=R[chosen])
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
        """Return `_fused` of tracks whose slots are all in use, after the slots have doubled."""
        with changing_nothing(track_ids):
            self._allocate(0, 2 * self._shape[1], 0)
        return self._fused(stamp_ns, track_ids, one)

    def _states(
        self, stamp_ns: int, is_present: bool = False
    ) -> tuple[BoolArray | None, FloatArray, FloatArray]:
        """True of the tracks that are known (m,), None if all are, means (m, n) and covariances (m, n, n) of all."""
        if self._order is None:
            self._order = np.array(
                [self._rows.get(i, -1) for i in self._estimators], dtype=np.int64
            )
        count, known, means, covariances = self._ahead(
            self._order, stamp_ns, is_present
        )
        if len(self._rows) < len(known):
            apart = [
                track_id for track_id in self._estimators if track_id not in self._rows
            ]
            states = self._ask(
                lambda _, item: self._state_of(item, stamp_ns, is_present), apart
            )
            for k, track_id in enumerate(self._estimators):
                state = states.get(track_id)
                if state is not None:
                    known[k], means[k], covariances[k] = (
                        True,
                        state.mean,
                        state.covariance,
                    )
                    count += 1
                elif track_id in states:
                    known[k] = False
        return None if count == len(known) else known, means, covariances

    def _state_of(
        self, item: ReplayEkf, stamp_ns: int, is_present: bool
    ) -> TrackState | None:
        """Return the state of a filter; at the present its first one instead of none."""
        start_ns = item.window_ns[0]
        return (
            self._state(item, max(stamp_ns, start_ns))
            if is_present or start_ns <= stamp_ns
            else None
        )

    def _ahead(
        self, rows: IntArray, stamp_ns: int, is_present: bool = False
    ) -> tuple[int, BoolArray, FloatArray, FloatArray]:
        """Return `kernels.replay.ahead` of rows of the arrays: how many and which are known, means and covariances."""
        m, n = len(rows), self._motion.dim
        known, means, covariances = (
            np.empty(m, dtype=bool),
            np.empty((m, n)),
            np.empty((m, n, n)),
        )
        at = rows, self._start_ns, stamp_ns, is_present
        count = kernels(_KERNELS).ahead(
            self._kind, self._noise, *self._arrays[:4], *at, means, covariances, known
        )
        return count, known, means, covariances

    def _put_in(self, track_ids: Iterable[int]) -> None:
        """Move the steps of filters into the arrays, where these can hold them; without memory they stay filters."""
        with suppress(MemoryError):
            for track_id in track_ids:
                item = self._estimators[track_id]
                if all(
                    each.search is None and _is_plain(each.measurement)
                    for each in item.steps
                ):
                    self._put(track_id, item)

    def _put(self, track_id: int, item: ReplayEkf) -> None:
        """Move the steps of a filter into the arrays."""
        k = max(
            (
                len(each.measurement.z)
                for each in item.steps
                if each.measurement is not None
            ),
            default=0,
        )
        rows, slots, largest = self._shape
        if not self._free or len(item.steps) >= slots or k > largest:
            self._allocate(rows * (1 + (not self._free)), 2 * len(item.steps), k)
        row = self._free[-1]
        order, labels, steps, windows, measured, views = (
            array[row] for array in self._arrays
        )
        windows[:] = len(item.steps), *item.window_ns
        for slot, each in zip(order, item.steps, strict=False):
            steps[slot] = np.vstack([each.mean, each.covariance, *each.predicted])
            labels[slot, :2] = each.stamp_ns, 0
            if each.measurement is not None:
                own, d = each.measurement, len(each.measurement.z)
                loss, width = compiled_form(own.loss, d)
                if own.loss is not None:
                    self._losses[loss, width] = own.loss
                labels[slot, 1 : d + CODES] = d, loss, *own.model.codes
                views[slot] = *own.pose, width
                measured[slot, 0, :d], measured[slot, 1 : d + 1, :d] = own.z, own.R
        self._rows[track_id], self._order = self._free.pop(), None

    def _take_out(self, track_id: int) -> None:
        """Move the steps of a filter out of the arrays, if they are there."""
        row, n = self._rows.get(track_id), self._motion.dim
        if row is None:
            return
        order, labels, steps, windows, measured, views = (
            array[row] for array in self._arrays
        )
        chain = list[Step]()
        for slot in order[: windows[0]].tolist():
            own, (stamp_ns, d, loss, *codes), measurement = (
                steps[slot].copy(),
                labels[slot].tolist(),
                None,
            )
            if d:
                names = tuple(COMPONENTS[code] for code in codes[:d])
                *pose, width = views[slot].tolist()
                z, R = (
                    measured[slot, 0, :d].copy(),
                    measured[slot, 1 : d + 1, :d].copy(),
                )
                measurement = Measurement(
                    stamp_ns,
                    measurement_model(names, self._motion),
                    z,
                    R,
                    SensorPose(*pose),
                    self._losses.get((loss, width)),
                )
            predicted = Prediction(own[n + 1], own[n + 2 : 2 * n + 2], own[2 * n + 2 :])
            chain.append(Step(stamp_ns, measurement, own[0], own[1 : n + 1], predicted))
        item = self._estimators[track_id]
        item.resume(chain, *windows[1:].tolist())
        item.advance(self._start_ns + self._lag_ns)
        self._free.append(self._rows.pop(track_id))
        self._order = None


def _results(
    y: FloatArray, S: FloatArray, nis: FloatArray, status: IntArray
) -> list[UpdateResult]:
    """Return the outcomes of innovations (m, k), covariances (m, k, k), NIS and status as the kernels write them."""
    statuses = list(map(_STATUS.__getitem__, status.tolist()))
    results = list(map(UpdateResult, statuses, y, nis.tolist(), S))
    if UpdateStatus.FAILED in statuses or UpdateStatus.TOO_OLD in statuses:
        results = [
            each if each.status in _FUSED else UpdateResult(each.status)
            for each in results
        ]
    return results


def _is_plain(measurement: Measurement | None) -> bool:
    """True for None, and for a measurement whose model compiled loops contain."""
    return measurement is None or measurement.model.is_compiled

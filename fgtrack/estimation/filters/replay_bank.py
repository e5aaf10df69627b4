"""The replaying EKFs of all objects in arrays."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np

from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.linalg import kernels
from fgtrack.core.types import FloatArray, IntArray, TrackState
from fgtrack.estimation.base import Measurement, Measurements, Start, StatesAt, UpdateResult, UpdateStatus, stacks
from fgtrack.estimation.filters.ekf import Prediction
from fgtrack.estimation.filters.propagation import kinematic_states
from fgtrack.estimation.filters.replay import ReplayEkf, Step
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.models.measurement import MeasurementModel, measurement_model
from fgtrack.models.motion import WhiteNoise

#: In the order of the numbers that the kernels give.
_STATUS = UpdateStatus.FAILED, UpdateStatus.TOO_OLD, UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE


class ReplayBank(ObjectBank[ReplayEkf]):
    """`ReplayEkf` of all objects, whose steps lie in arrays: a compiled loop replays all that a list concerns.

    Filters of their own remain where a direction of travel is sought, and where a window has a measurement with a
    robust loss or of what is not an entry of the state. See `ObjectBank` and `fgtrack.estimation.kernels.replay`. The
    motion model is one of the shipped ones.
    """

    def __init__(self, motion: WhiteNoise, start: Callable[[Start], ReplayEkf], lag_s: float) -> None:
        super().__init__(motion, start, lag_s)
        self._kernels = kernels("fgtrack.estimation.kernels.replay")
        self._kind, self._density = motion.kind, motion.density
        self._start_ns = -int(LARGEST_NS)  # of all windows, by the clock
        self._rows: dict[int, int] = {}  # of tracks in the arrays
        self._order: IntArray | None = None  # of all tracks by birth, until one comes, goes or moves
        self._free: list[int] = []
        self._arrays = list[Any]()
        self._allocate(8, 64, 4)

    def _allocate(self, rows: int, slots: int, k: int) -> None:
        """Make arrays for so many tracks, steps and components with the present contents (see the kernels)."""
        n = self._motion.dim
        arrays = [
            np.tile(np.arange(slots), (rows, 1)),
            np.zeros((rows, slots, 2 + k), dtype=np.int64),
            np.zeros((rows, slots, 3 * n + 2, n)),
            np.zeros((rows, 3), dtype=np.int64),
            np.zeros((rows, slots, k + 1, k)),
        ]
        self._free += range(len(self._arrays[0]) if self._arrays else 0, rows)
        for new, present in zip(arrays, self._arrays, strict=bool(self._arrays)):
            new[tuple(map(slice, present.shape))] = present
        self._arrays = arrays

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self.present_ns = now_ns
        self._start_ns = max(self._start_ns, now_ns - self._lag_ns)
        if len(self._rows) < len(self._estimators):
            self._ask(lambda _, item: item.advance(now_ns), [i for i in self._estimators if i not in self._rows])

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`."""
        rows, starts_ns = self._windows()
        track_ids, inside = self.track_ids, starts_ns <= stamp_ns
        if not inside.all():
            track_ids = tuple(compress(track_ids, inside.tolist()))
        return StatesAt(track_ids, *self._ahead(track_ids, rows[inside], np.full(len(track_ids), stamp_ns)))

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
        rows, starts_ns = self._windows()
        states = self._ahead(self.track_ids, rows, np.maximum(starts_ns, self.present_ns))
        return kinematic_states(self._motion, self.present_ns, *states)

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        results = [UpdateResult(UpdateStatus.FAILED)] * len(track_ids)
        for indices, alike in stacks(measurements):
            seen = alike.seen_by(self._motion)
            rows = np.array([self._rows.get(track_ids[i], -1) for i in indices])
            inside = (rows >= 0) & _is_plain(seen)
            for chosen in filter(len, (inside.nonzero()[0], (~inside).nonzero()[0])):
                part = seen if len(chosen) == len(rows) else replace(seen, z=seen.z[chosen], R=seen.R[chosen])
                ids = [track_ids[indices[k]] for k in chosen.tolist()]
                if inside[chosen[0]]:
                    values = self._fused(stamp_ns, rows[chosen], part)
                else:
                    for track_id in ids:
                        self._take_out(track_id)
                    values = super().update(stamp_ns, ids, Measurements(part))
                    for track_id in ids:
                        self._put_in(track_id)
                for k, result in zip(chosen.tolist(), values, strict=True):
                    results[indices[k]] = result
        return results

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        super().birth(track_id, prior)
        self._order = None
        self._put_in(track_id)

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`."""
        if track_id in self._rows:
            self._free.append(self._rows.pop(track_id))
        super().remove(track_id)
        self._order = None

    def _windows(self) -> tuple[IntArray, IntArray]:
        """Rows of all tracks in the arrays, -1 of filters of their own, and starts of their windows, shapes (m,)."""
        if self._order is None:
            self._order = np.array([self._rows.get(i, -1) for i in self._estimators], dtype=np.int64)
        starts_ns = np.maximum(self._arrays[3][self._order, 1], self._start_ns)
        if len(self._rows) < len(self._estimators):
            for k, (i, item) in enumerate(self._estimators.items()):
                starts_ns[k] = starts_ns[k] if i in self._rows else item.window_ns[0]
        return self._order, starts_ns

    def _fused(self, stamp_ns: int, rows: IntArray, one: Measurement) -> list[UpdateResult]:
        """Outcomes of a stack of measurements of entries of the state."""
        m, k = one.z.shape
        self._make_room(rows, k)
        measured = np.arange(k) if one.measured is None else np.array(one.measured)
        new, label = np.empty((m, k + 1, k)), np.array([stamp_ns, k, *one.model.selected])
        new[:, 0], new[:, 1:] = one.z, one.R
        y, S, nis, status = np.empty((m, k)), np.empty((m, k, k)), np.empty(m), np.empty(m, dtype=np.int64)
        lags_ns = self._lag_ns, self._start_ns
        self._kernels.fuse(
            self._kind, self._density, *self._arrays, rows, *lags_ns, label, new, measured, y, S, nis, status
        )
        codes = status.tolist()
        results = list(map(UpdateResult, map(_STATUS.__getitem__, codes), y, nis.tolist(), S))
        for i in (status <= self._kernels.TOO_OLD).nonzero()[0].tolist():
            results[i] = UpdateResult(_STATUS[codes[i]])
        return results

    def _make_room(self, rows: IntArray, k: int) -> None:
        """Let there be a free slot for a measurement of `k` components in each of `rows`."""
        order, labels, _, windows, measured = self._arrays
        num_rows, slots = order.shape
        for row in rows[windows[rows, 0] == slots].tolist():
            stamps_ns = labels[row, order[row], 0]
            gone = max(np.searchsorted(stamps_ns, max(self._start_ns, windows[row, 1])) - 1, 0)
            windows[row, 0] -= gone
            order[row] = np.roll(order[row], -gone)
        largest, is_full = measured.shape[-1], bool((windows[:, 0] == slots).any())
        if k > largest or is_full:
            self._allocate(num_rows, slots * (1 + is_full), max(k, largest))

    def _ahead(self, track_ids: Sequence[int], rows: IntArray, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Means (m, n) and covariances (m, n, n) of tracks, each at its stamp, with the yaw in (-pi, pi]."""
        n = self._motion.dim
        means, covariances = np.empty((len(rows), n)), np.empty((len(rows), n, n))
        self._kernels.ahead(self._kind, self._density, *self._arrays[:4], rows, stamps_ns, means, covariances)
        if len(self._rows) < len(self._estimators):
            for i in (rows < 0).nonzero()[0].tolist():
                state = self._estimators[track_ids[i]].state_at(int(stamps_ns[i]))
                means[i], covariances[i] = state.mean, state.covariance
        return means, covariances

    def _put_in(self, track_id: int) -> None:
        """Move the steps of a filter into the arrays, where these can hold them."""
        item = self._estimators[track_id]
        if not all(each.search is None and _is_plain(each.measurement) for each in item.steps):
            return
        (rows, slots), largest = self._arrays[0].shape, self._arrays[4].shape[-1]
        k = max((len(each.measurement.z) for each in item.steps if each.measurement is not None), default=0)
        if not self._free or len(item.steps) >= slots or k > largest:
            self._allocate(rows * (1 + (not self._free)), max(slots, 2 * len(item.steps)), max(k, largest))
        row = self._rows[track_id] = self._free.pop()
        self._order = None
        order, labels, steps, windows, measured = (array[row] for array in self._arrays)
        windows[:] = len(item.steps), *item.window_ns
        for slot, each in zip(order, item.steps, strict=False):
            steps[slot] = np.vstack([each.mean, each.covariance, *each.predicted])
            labels[slot, :2] = each.stamp_ns, 0
            if each.measurement is not None:
                own, d = each.measurement, len(each.measurement.z)
                labels[slot, 1 : d + 2] = d, *own.model.selected
                measured[slot, 0, :d], measured[slot, 1 : d + 1, :d] = own.z, own.R

    def _take_out(self, track_id: int) -> None:
        """Move the steps of a filter out of the arrays, if they are there."""
        row, n, self._order = self._rows.pop(track_id, None), self._motion.dim, None
        if row is None:
            return
        self._free.append(row)
        order, labels, steps, windows, measured = (array[row] for array in self._arrays)
        chain = list[Step]()
        for slot in order[: windows[0]].tolist():
            own, (stamp_ns, d, *entries), measurement = steps[slot].copy(), labels[slot].tolist(), None
            if d:
                names = tuple(self._motion.state_names[entry] for entry in entries[:d])
                z, R = measured[slot, 0, :d].copy(), measured[slot, 1 : d + 1, :d].copy()
                measurement = Measurement(stamp_ns, measurement_model(names, self._motion), z, R)
            predicted = Prediction(own[n + 1], own[n + 2 : 2 * n + 2], own[2 * n + 2 :])
            chain.append(Step(stamp_ns, measurement, own[0], own[1 : n + 1], predicted))
        item = self._estimators[track_id]
        item.resume(chain, *windows[1:].tolist())
        item.advance(self._start_ns + self._lag_ns)


def _is_plain(measurement: Measurement | None) -> bool:
    """True if a measurement, or what is none, is of entries of the state, without a loss."""
    if measurement is None:
        return True
    return measurement.loss is None and type(measurement.model) is MeasurementModel and measurement.model.linear

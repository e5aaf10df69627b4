"""How the published implementation of Karle et al. 2023 takes its input, each defect a component of its own."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DetectionList, Disposition, EgoState, UpdateRecord
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego import EgoPose, extrapolated, is_finite, low_passed
from fgtrack.tracking.inbox import Batch, record, records
from fgtrack.tracking.validity import is_covariance, is_number


class PublishedEgo:
    """Ego storage at the ticks, nearest entry instead of interpolation, and a low-pass that filters its own output
    again on every tick without a new message (defect Q13)."""

    def __init__(self, yaw_weight: float, yaw_rate_weight: float, step_ns: int, storage_ticks: int) -> None:
        self._yaw_weight = yaw_weight
        self._yaw_rate_weight = yaw_rate_weight
        self._half_step_ns = step_ns / 2
        self._length = storage_ticks
        self._current: EgoState | None = None
        self._stored: list[EgoState] = []  # newest last
        self._in_pit = False

    @property
    def current(self) -> EgoState | None:
        """See `EgoSource.current`."""
        return self._current

    @property
    def in_pit(self) -> bool:
        """See `EgoSource.in_pit`."""
        return self._in_pit

    def receive(self, ego: EgoState) -> str | None:
        """See `EgoSource.receive`."""
        if ego.in_pit is not None:
            self._in_pit = ego.in_pit
        if self._current is not None and ego.stamp_ns == self._current.stamp_ns:
            return "repeated stamp"
        if not is_finite(ego):
            return "not finite"
        self._current = ego
        return None

    def start_tick(self) -> None:
        """Store the current state, low-passed against the entry before it; of a stamp that is stored already, its yaw
        and yaw rate alone."""
        if self._current is None:
            return
        newest = self._stored[-1] if self._stored else None
        if newest is None or newest.stamp_ns != self._current.stamp_ns:
            if newest is not None:
                self._current = self._filtered(newest, self._current)
            self._stored.append(self._current)
            del self._stored[: -self._length]
        elif len(self._stored) > 1:
            filtered = self._filtered(self._stored[-2], self._current)
            turned = replace(newest, yaw_rad=filtered.yaw_rad, yaw_rate_radps=filtered.yaw_rate_radps)
            if newest is self._current:  # the stored entry and the current state are one object
                self._current = turned
            self._stored[-1] = turned

    def _filtered(self, before: EgoState, ego: EgoState) -> EgoState:
        return low_passed(before.yaw_rad, before.yaw_rate_radps, ego, self._yaw_weight, self._yaw_rate_weight)

    def pose_at(self, stamp_ns: int, present_ns: int) -> EgoPose | None:
        """See `EgoSource.pose_at`; from the nearest entry, however far away it is."""
        if self._current is None:
            return None
        if present_ns - stamp_ns <= self._half_step_ns:
            return extrapolated(self._current, stamp_ns)
        nearest = min(reversed(self._stored), key=lambda ego: abs(ego.stamp_ns - stamp_ns))
        return extrapolated(nearest, stamp_ns)


class SlotInbox:
    """One slot per sensor: a second message within a tick overwrites the first, a repeated stamp empties the slot
    (defect Q12). The mean of object stamps is taken in floating point."""

    def __init__(self, sensors: Mapping[str, SensorModel]) -> None:
        self._sensors = sensors
        self._slots: dict[str, Batch] = {}
        self._last_stamp_ns: dict[str, int] = {}

    def put(self, message: DetectionList) -> list[UpdateRecord]:
        """See `Inbox.put`."""
        sensor = self._sensors[message.sensor]
        stamp_ns = _float_stamp(message) if sensor.stamp_from == "objects_mean" else message.stamp_ns
        if self._last_stamp_ns.get(message.sensor) == stamp_ns:
            return self._superseded(message.sensor) + records(message, Disposition.DUPLICATE)
        delay_ns = message.receipt_ns - stamp_ns
        if sensor.max_delay_s is not None and delay_ns > nanoseconds(sensor.max_delay_s):
            return records(message, Disposition.TOO_OLD)
        kept, ended, broken = [], [], False
        for index, detection in enumerate(message.objects):
            values = [getattr(detection, name) for name in sensor.components]
            if (detection.x_m or 0.0) == 0.0 and (detection.y_m or 0.0) == 0.0:
                ended.append(record(message, index, Disposition.INVALID))
            elif all(value is not None and is_number(value) for value in values) and is_covariance(detection, sensor):
                kept.append(index)
            else:
                broken = True
                ended.append(record(message, index, Disposition.INVALID))
        superseded = self._superseded(message.sensor)
        if kept or not broken:
            self._slots[message.sensor] = Batch(message, stamp_ns, tuple(kept))
            self._last_stamp_ns[message.sensor] = stamp_ns
        return superseded + ended

    def _superseded(self, sensor: str) -> list[UpdateRecord]:
        batch = self._slots.pop(sensor, None)
        if batch is None:
            return []
        return [batch.record(index, Disposition.SUPERSEDED) for index in batch.indices]

    def collect(self) -> list[Batch]:
        """See `Inbox.collect`; equal stamps keep the order of the sensors."""
        batches = [self._slots[name] for name in self._sensors if name in self._slots]
        self._slots = {}
        return sorted(batches, key=lambda batch: batch.stamp_ns)


def _float_stamp(message: DetectionList) -> int:
    """Mean of the object stamps in float64, which at today's epoch is good to 256 ns."""
    if not message.objects:
        return message.stamp_ns
    stamps = [message.stamp_ns if item.stamp_ns is None else item.stamp_ns for item in message.objects]
    return int(np.mean(np.array(stamps, dtype=np.int64)))

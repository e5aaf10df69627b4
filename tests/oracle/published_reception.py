"""What the published tracker does with its input, read from BEHAVIOUR.md sections 2, 4 and 8: naive and literal."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from published_filter import wrap

from fgtrack.core.types import Detection, DetectionList, EgoState, Message

STORAGE = 350


@dataclass(frozen=True)
class Sensor:
    """A line of the table in section 2."""

    std: tuple[float, ...]
    max_delay_ns: int
    measures_yaw: bool
    measures_speed: bool
    counter_init: int
    counter_add: int
    stamps_of_objects: bool


SENSORS = {
    "lidar": Sensor((0.3, 0.3, 0.4), 300_000_000, True, False, 5, 2, False),
    "lidar_cluster": Sensor((0.3, 0.3, 0.35), 400_000_000, False, False, 3, 1, False),
    "radar": Sensor((3.0, 3.0, 0.35, 0.2), 200_000_000, False, True, 5, 2, True),
}


class PublishedReception:
    """The ego state with its storage, and an inbox slot per sensor; yaw 0 along +y."""

    def __init__(self) -> None:
        self.ego: tuple[int, list[float]] | None = None  # the current ego
        self.ego_storage: deque[tuple[int, list[float]]] = deque(
            maxlen=STORAGE
        )  # newest first
        self.in_pit = False
        self.slots: dict[str, tuple[list[list[float]], int] | None] = dict.fromkeys(
            SENSORS
        )
        self.accepted_ns: dict[str, int | None] = dict.fromkeys(SENSORS)

    def receive(self, message: Message) -> None:
        """Take an ego state or a detection list; anything else is not for the tracker."""
        if isinstance(message, EgoState):
            self._receive_ego(message)
        elif isinstance(message, DetectionList):
            self._receive_detections(message)

    def _receive_ego(self, ego: EgoState) -> None:
        if ego.in_pit is not None:
            self.in_pit = ego.in_pit
        repeated = self.ego is not None and self.ego[0] == ego.stamp_ns
        if repeated or math.isnan(ego.x_m) or math.isnan(ego.y_m):
            return
        yaw = wrap(wrap(ego.yaw_rad) - math.pi / 2)
        state = [
            ego.x_m,
            ego.y_m,
            yaw,
            ego.speed_mps,
            ego.yaw_rate_radps,
            ego.accel_mps2,
        ]
        self.ego = (ego.stamp_ns, state)

    def _receive_detections(self, message: DetectionList) -> None:
        name, sensor = message.sensor, SENSORS[message.sensor]
        stamp_ns = message.stamp_ns
        if sensor.stamps_of_objects and message.objects:
            own = [
                stamp_ns if item.stamp_ns is None else item.stamp_ns
                for item in message.objects
            ]
            stamp_ns = int(np.mean(own))
        if stamp_ns == self.accepted_ns[name]:
            self.slots[name] = None
            return
        if message.receipt_ns - stamp_ns > sensor.max_delay_ns:
            return
        entries, dropped = [], 0
        for item in message.objects:
            entry = self._entry(item, sensor)
            if abs(entry[0]) + abs(entry[1]) == 0:
                continue
            if all(math.isfinite(value) for value in entry):
                entries.append(entry)
            else:
                dropped += 1
        if dropped and not entries:
            self.slots[name] = None
            return
        self.slots[name] = (entries, stamp_ns)
        self.accepted_ns[name] = stamp_ns

    @staticmethod
    def _entry(item: Detection, sensor: Sensor) -> list[float]:
        values: list[Any] = [item.x_m, item.y_m]
        if sensor.measures_yaw:
            values.append(
                item.yaw_rad
            )  # relative to the ego: the same number in both conventions
        if sensor.measures_speed:
            values.append(item.speed_mps)
        return values

    def collect(self) -> list[tuple[int, str, list[list[float]]]]:
        """Stamp, sensor and objects of the full slots, oldest first; the slots are empty afterwards (section 6)."""
        batches = [
            (slot[1], name, slot[0])
            for name, slot in self.slots.items()
            if slot is not None
        ]
        self.slots = dict.fromkeys(SENSORS)
        return sorted(batches, key=lambda batch: batch[0])

    def store_ego(self) -> None:
        """Low-pass the current ego and store it, at every tick (section 8)."""
        if self.ego is None:
            return
        stamp_ns, state = self.ego
        if not self.ego_storage:
            self.ego_storage.appendleft(self.ego)
            return
        overwrite = stamp_ns == self.ego_storage[0][0]
        i = 1 if overwrite else 0
        if len(self.ego_storage) <= i:
            return
        before = self.ego_storage[i][1]
        yaw = wrap(before[2] + 0.9 * wrap(state[2] - before[2]))
        yaw_rate = (1 - 0.4) * before[4] + 0.4 * state[4]
        target = (
            self.ego_storage[0][1] if overwrite else state
        )  # the same list, unless an old stamp came back
        target[2], target[4] = yaw, yaw_rate
        if not overwrite:
            self.ego_storage.appendleft(self.ego)

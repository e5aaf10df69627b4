"""The published tracker of Karle et al. 2023 once more, read from its description alone: the oracle of fgtrack's.

Sections are those of `../shared/reference/BEHAVIOUR.md`. Slow and literal on purpose, and in the reference's own yaw
(0 along +y) inside; REP-103 comes in with the messages and goes out with the results. It imports none of fgtrack's
models, estimators or tracking.
"""

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from published_lane import Array, PublishedLane
from scipy.optimize import linear_sum_assignment

from fgtrack.core.types import Detection, DetectionList, EgoState, Message

STEP_NS = 10_000_000  # T
DT = 0.01
STORAGE = 350
REAR_AXLE = 1.74
MERGE_DISTANCE, MATCH_DISTANCE, SHORT_RANGE = 5.1, 5.0, 60.0
COUNTER_CAP = 25
FORGET_NS = 2_000_000_000
P_INIT = np.diag([0.01, 0.01, 0.3, 4.0, 0.3, 1.0])
Q0 = np.diag(np.square([0.2, 0.2, 0.3, 1.0, 0.5, 3.0])) * DT**2


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


def wrap(angle: float) -> float:
    """One step only (section 1)."""
    if angle <= -math.pi:
        return angle + 2 * math.pi
    if angle > math.pi:
        return angle - 2 * math.pi
    return angle


def rot(yaw: float) -> Array:
    """Local to global (section 1)."""
    return np.array([[-math.sin(yaw), -math.cos(yaw)], [math.cos(yaw), -math.sin(yaw)]])


def rotated(matrix: Array, yaw: float) -> Array:
    """`matrix` with its upper left block turned by `yaw`."""
    turned = matrix.copy()
    turned[:2, :2] = rot(yaw) @ matrix[:2, :2] @ rot(yaw).T
    return turned


def predict(state: Array, P: Array) -> tuple[Array, Array]:
    """One step of DT (section 7)."""
    x, y, yaw, v, r, a = (float(value) for value in state)
    s, c = math.sin(yaw), math.cos(yaw)
    F = np.eye(6)
    F[0, 2], F[0, 3] = -v * DT * c, -DT * s
    F[1, 2], F[1, 3] = -v * DT * s, DT * c
    F[2, 4] = DT
    predicted = np.array([x - v * DT * s, y + v * DT * c, min(yaw + r * DT, math.pi), v + a * DT, r, a])
    return predicted, (F @ P) @ F.T + rotated(Q0, yaw)


def line_of_sight(offset: Array) -> float:
    """Bearing of `offset` (section 13)."""
    distance = math.hypot(*offset)
    if distance == 0.0:
        return math.pi / 2
    bearing = math.acos(min(max(offset[1] / distance, -1.0), 1.0))
    return wrap(-bearing if offset[0] > 0 else bearing)


def correct(x: Array, P: Array, z: Array, std: tuple[float, ...], ego_xy: Array) -> tuple[Array, Array]:
    """Measurement update (section 13)."""
    R = rotated(np.diag(np.square(std)), line_of_sight(x[:2] - ego_xy))
    H = np.eye(len(std), 6)
    y = z - H @ x
    y[2] = wrap(wrap(z[2]) - x[2])
    S = H @ (P @ H.T) + R
    K = (P @ H.T) @ np.linalg.inv(S)
    posterior = x + K @ y
    posterior[2] = wrap(posterior[2])
    return posterior, (np.eye(6) - K @ H) @ P


@dataclass
class History:
    """What an object looked like at the stamp of a delayed batch (section 9)."""

    index: int
    x: Array
    P: Array
    ego_xy: Array


@dataclass
class Object:
    """A tracked object. Arrays are replaced, never written into."""

    x: Array
    P: Array
    counter: int
    last_seen_ns: int
    num_measured: int = 1
    states: deque[Array] = field(default_factory=lambda: deque(maxlen=STORAGE))  # newest first
    stamps: deque[int] = field(default_factory=lambda: deque(maxlen=STORAGE))
    covariances: deque[Array] = field(default_factory=lambda: deque(maxlen=STORAGE))
    estimate: Array = None  # for matching
    last_known: Array = None  # for ageing
    history: History | None = None

    def store(self, stamp_ns: int) -> None:
        self.states.appendleft(self.x)
        self.stamps.appendleft(stamp_ns)
        self.covariances.appendleft(self.P)


@dataclass(frozen=True)
class ObjectResult:
    """An object after a tick, in REP-103 (yaw not wrapped)."""

    x: Array
    P: Array
    counter: int
    num_measured: int
    last_seen_ns: int


@dataclass(frozen=True)
class TickResult:
    """All that a tick gives."""

    now_ns: int
    track_ns: int
    objects: dict[int, ObjectResult]
    births: list[int]
    deaths: list[int]
    ego: tuple[int, Array] | None


class PublishedTracker:
    """The node, without its publishers."""

    def __init__(self, track_csv: Path, pit_csv: Path) -> None:
        self.track = PublishedLane(track_csv, inner_buffer=-0.5, outer_buffer=-1.5)
        self.pit = PublishedLane(pit_csv, inner_buffer=-1.5, outer_buffer=-1.5)
        self.ego: tuple[int, list[float]] | None = None  # the current ego
        self.ego_storage: deque[tuple[int, list[float]]] = deque(maxlen=STORAGE)
        self.in_pit = False
        self.slots: dict[str, tuple[list[list[float]], int] | None] = dict.fromkeys(SENSORS)
        self.accepted_ns: dict[str, int | None] = dict.fromkeys(SENSORS)
        self.track_ns: int | None = None
        self.objects: dict[int, Object] = {}
        self.next_id = 0
        self.births: list[int] = []
        self.deaths: list[int] = []

    # Section 4

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
        state = [ego.x_m, ego.y_m, yaw, ego.speed_mps, ego.yaw_rate_radps, ego.accel_mps2]
        self.ego = (ego.stamp_ns, state)

    def _receive_detections(self, message: DetectionList) -> None:
        name, sensor = message.sensor, SENSORS[message.sensor]
        stamp_ns = message.stamp_ns
        if sensor.stamps_of_objects and message.objects:
            own = [stamp_ns if item.stamp_ns is None else item.stamp_ns for item in message.objects]
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
            values.append(item.yaw_rad)  # relative to the ego: the same number in both conventions
        if sensor.measures_speed:
            values.append(item.speed_mps)
        return values

    # Sections 5 and 6

    def tick(self, now_ns: int) -> TickResult:
        """One cycle of the node."""
        self.births, self.deaths = [], []
        num_steps = self._advance(now_ns)
        batches = [(slot[1], name, slot[0]) for name, slot in self.slots.items() if slot is not None]
        self.slots = dict.fromkeys(SENSORS)
        for thing in self.objects.values():
            thing.last_known = thing.x
            for step in reversed(range(num_steps)):
                thing.x, thing.P = predict(thing.x, thing.P)
                thing.store(self.track_ns - step * STEP_NS)
            thing.estimate = thing.states[0]
        if self.ego is not None:
            self._store_ego()
            for stamp_ns, name, entries in sorted(batches, key=lambda batch: batch[0]):
                self._process(stamp_ns, name, entries)
        return self._result(now_ns)

    def _advance(self, now_ns: int) -> int:
        if self.track_ns is None:
            self.track_ns = now_ns
            return 1
        tic = now_ns - self.track_ns
        num_steps = 1 if tic < STEP_NS else -(-tic // STEP_NS)
        self.track_ns += num_steps * STEP_NS
        return num_steps

    def _result(self, now_ns: int) -> TickResult:
        to_rep103 = np.array([0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0])
        objects = {
            name: ObjectResult(
                thing.x + to_rep103, thing.P, thing.counter, thing.num_measured, thing.last_seen_ns
            )
            for name, thing in self.objects.items()
        }
        ego = None if self.ego is None else (self.ego[0], np.array(self.ego[1]) + to_rep103)
        return TickResult(now_ns, self.track_ns, objects, self.births, self.deaths, ego)

    # Section 8

    def _store_ego(self) -> None:
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
        target = self.ego_storage[0][1] if overwrite else state  # the same list, unless an old stamp came back
        target[2], target[4] = yaw, yaw_rate
        if not overwrite:
            self.ego_storage.appendleft(self.ego)

    # Sections 9 to 14

    def _process(self, stamp_ns: int, name: str, entries: list[list[float]]) -> None:
        sensor = SENSORS[name]
        offered = list(self.objects)
        detections: list[Array] = []
        if entries:
            ego_ns, ego = self.ego
            if self.track_ns - stamp_ns > STEP_NS / 2:
                ego_ns, ego = min(self.ego_storage, key=lambda entry: abs(entry[0] - stamp_ns))
                offered = [number for number in offered if self._look_up(number, stamp_ns, ego)]
            detections = self._preprocess(entries, sensor, (stamp_ns - ego_ns) / 1e9, ego)
        matches, new, unmatched = self._match(detections, offered, sensor)
        self._age(unmatched, name)
        for index, number in matches:
            self._update(self.objects[number], detections[index], sensor, stamp_ns)
        for number, index in new:
            self._give_birth(number, detections[index], sensor, stamp_ns)
        for number in [number for _, number in matches]:
            self._compensate(self.objects[number])
        for thing in self.objects.values():
            thing.history = None
            thing.estimate = thing.last_known = thing.x

    def _look_up(self, number: int, stamp_ns: int, ego: list[float]) -> bool:
        thing = self.objects[number]
        if thing.stamps[-1] - stamp_ns > STEP_NS / 2:
            return False
        h = min(range(len(thing.stamps)), key=lambda i: abs(thing.stamps[i] - stamp_ns))
        thing.estimate = thing.states[h]
        thing.history = History(h, thing.states[h], thing.covariances[h], np.array(ego[:2]))
        return True

    def _preprocess(
        self, entries: list[list[float]], sensor: Sensor, dt: float, ego: list[float]
    ) -> list[Array]:
        x, y, yaw, v, r, _ = ego
        origin = np.array([x - v * dt * math.sin(yaw), y + v * dt * math.cos(yaw)])
        ego_yaw = yaw + r * dt
        kept = []
        for entry in entries:
            position = rot(ego_yaw) @ np.array([entry[0] - REAR_AXLE, entry[1]]) + origin
            if sensor.measures_yaw:
                z = [*position, wrap(entry[2] + ego_yaw), *entry[3:]]
            else:
                z = [*position, self.track.at(position).heading, *entry[2:]]
            if not (self.track.outside(position) and self.pit.outside(position)):
                kept.append(np.array(z))
        return merge(kept)

    def _match(
        self, detections: list[Array], offered: list[int], sensor: Sensor
    ) -> tuple[list[tuple[int, int]], list[tuple[int, int]], list[int]]:
        if not detections:
            return [], [], offered
        cost = np.zeros((len(detections), len(offered)))
        for i, z in enumerate(detections):
            for j, number in enumerate(offered):
                cost[i, j] = math.hypot(*(z[:2] - self.objects[number].estimate[:2]))
        pairs = sorted(zip(*(side.tolist() for side in linear_sum_assignment(cost)), strict=True))
        paired = {i for i, _ in pairs}
        births = [i for i in range(len(detections)) if i not in paired]
        births += [i for i, j in pairs if cost[i, j] > MATCH_DISTANCE]
        matches = [(i, offered[j]) for i, j in pairs if cost[i, j] <= MATCH_DISTANCE]
        new = []
        for i in births:
            new.append((self.next_id, i))
            self.next_id += 1
        for _, number in matches:
            if self.objects[number].counter < COUNTER_CAP:
                self.objects[number].counter += sensor.counter_add
        matched = {number for _, number in matches}
        return matches, new, [number for number in offered if number not in matched]

    def _age(self, unmatched: list[int], name: str) -> None:
        for number in unmatched:
            thing = self.objects[number]
            distance = math.hypot(*(thing.last_known[:2] - self.ego[1][:2]))
            if distance <= SHORT_RANGE:
                thing.counter -= name == "lidar_cluster"
            else:
                thing.counter -= name == "radar"
            if self.track_ns - thing.last_seen_ns > FORGET_NS:
                thing.counter = -1
            if thing.counter <= 0:
                del self.objects[number]
                self.deaths.append(number)

    def _update(self, thing: Object, z: Array, sensor: Sensor, stamp_ns: int) -> None:
        past = thing.history
        x, P, ego_xy = (
            (thing.x, thing.P, np.array(self.ego[1][:2])) if past is None else (past.x, past.P, past.ego_xy)
        )
        thing.x, thing.P = correct(x, P, z, sensor.std, ego_xy)
        thing.num_measured += 1
        thing.last_seen_ns = stamp_ns

    def _compensate(self, thing: Object) -> None:
        if thing.history is None:
            return
        for j in range(thing.history.index, -1, -1):
            if j < thing.history.index:
                thing.x, thing.P = predict(thing.x, thing.P)
            thing.states[j], thing.covariances[j] = thing.x, thing.P

    def _give_birth(self, number: int, z: Array, sensor: Sensor, stamp_ns: int) -> None:
        _, _, _, v_ego, _, a_ego = self.ego[1]
        yaw = wrap(z[2])
        if sensor.measures_speed:
            v = z[3]
        else:
            v = 0.0 if self.in_pit else 0.8 * v_ego
        r = v * self.track.at(z[:2]).curvature
        a = a_ego if v_ego < 10.0 else 0.0
        # The shared P_init of quirk Q1 is not imitated: turning a multiple of the identity changes nothing.
        thing = Object(
            np.array([z[0], z[1], yaw, v, r, a]), rotated(P_INIT, yaw), sensor.counter_init, self.track_ns
        )
        n = max(round((self.track_ns - stamp_ns) / STEP_NS), 0)
        thing.store(self.track_ns - n * STEP_NS)
        for step in reversed(range(n)):
            thing.x, thing.P = predict(thing.x, thing.P)
            thing.store(self.track_ns - step * STEP_NS)
        self.objects[number] = thing
        self.births.append(number)


def merge(detections: list[Array]) -> list[Array]:
    """Overlap merge (section 10.6), in the order of the reference: that of a set of index tuples."""
    indices = range(len(detections))
    near = [
        tuple(j for j in indices if math.hypot(*(detections[i] - detections[j])[:2]) <= MERGE_DISTANCE)
        for i in indices
    ]
    groups = {members for members in near if len(members) >= 2}
    merged = [sum(detections[j] for j in members) / len(members) for members in groups]
    return merged + [detections[i] for i in indices if not any(i in members for members in groups)]


def run(
    messages: Iterable[Message], ticks_ns: Iterable[int], track_csv: Path, pit_csv: Path
) -> Iterator[TickResult]:
    """The results at `ticks_ns`; what was received at or before a tick is delivered before it."""
    tracker = PublishedTracker(track_csv, pit_csv)
    waiting = deque(messages)
    for now_ns in ticks_ns:
        while waiting and waiting[0].receipt_ns <= now_ns:
            tracker.receive(waiting.popleft())
        yield tracker.tick(now_ns)

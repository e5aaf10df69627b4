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

import numpy as np
from published_filter import P_INIT, correct, predict, rot, rotated, wrap
from published_lane import Array, PublishedLane
from published_reception import SENSORS, STORAGE, PublishedReception, Sensor
from scipy.optimize import linear_sum_assignment

from fgtrack.core.types import Message

STEP_NS = 10_000_000  # T
REAR_AXLE = 1.74
MERGE_DISTANCE, MATCH_DISTANCE, SHORT_RANGE = 5.1, 5.0, 60.0
COUNTER_CAP = 25
FORGET_NS = 2_000_000_000


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
    states: deque[Array] = field(
        default_factory=lambda: deque(maxlen=STORAGE)
    )  # newest first
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

    track_ns: int
    objects: dict[int, ObjectResult]
    deaths: list[int]


class PublishedTracker:
    """The node, without its publishers."""

    def __init__(self, track_csv: Path, pit_csv: Path) -> None:
        self.track = PublishedLane(track_csv, inner_buffer=-0.5, outer_buffer=-1.5)
        self.pit = PublishedLane(pit_csv, inner_buffer=-1.5, outer_buffer=-1.5)
        self.input = PublishedReception()
        self.started, self.track_ns = False, 0
        self.objects: dict[int, Object] = {}
        self.next_id = 0
        self.deaths: list[int] = []

    # Sections 5 and 6

    def tick(self, now_ns: int) -> TickResult:
        """One cycle of the node."""
        self.deaths = []
        num_steps = self._advance(now_ns)
        batches = self.input.collect()
        for thing in self.objects.values():
            thing.last_known = thing.x
            for step in reversed(range(num_steps)):
                thing.x, thing.P = predict(thing.x, thing.P)
                thing.store(self.track_ns - step * STEP_NS)
            thing.estimate = thing.states[0]
        if self.input.ego is not None:
            self.input.store_ego()
            for stamp_ns, name, entries in batches:
                self._process(stamp_ns, name, entries)
        return self._result()

    def _advance(self, now_ns: int) -> int:
        if not self.started:
            self.started, self.track_ns = True, now_ns
            return 1
        tic = now_ns - self.track_ns
        num_steps = 1 if tic < STEP_NS else -(-tic // STEP_NS)
        self.track_ns += num_steps * STEP_NS
        return num_steps

    def _ego(self) -> tuple[int, list[float]]:
        assert self.input.ego is not None, "batches are processed once there is an ego"
        return self.input.ego

    def _result(self) -> TickResult:
        to_rep103 = np.array([0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0])
        objects = {
            name: ObjectResult(
                thing.x + to_rep103,
                thing.P,
                thing.counter,
                thing.num_measured,
                thing.last_seen_ns,
            )
            for name, thing in self.objects.items()
        }
        return TickResult(self.track_ns, objects, self.deaths)

    # Sections 9 to 14

    def _process(self, stamp_ns: int, name: str, entries: list[list[float]]) -> None:
        sensor = SENSORS[name]
        offered = list(self.objects)
        detections: list[Array] = []
        if entries:
            ego_ns, ego = self._ego()
            if self.track_ns - stamp_ns > STEP_NS / 2:
                ego_ns, ego = min(
                    self.input.ego_storage, key=lambda entry: abs(entry[0] - stamp_ns)
                )
                offered = [
                    number for number in offered if self._look_up(number, stamp_ns, ego)
                ]
            detections = self._preprocess(
                entries, sensor, (stamp_ns - ego_ns) / 1e9, ego
            )
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
        thing.history = History(
            h, thing.states[h], thing.covariances[h], np.array(ego[:2])
        )
        return True

    def _preprocess(
        self, entries: list[list[float]], sensor: Sensor, dt: float, ego: list[float]
    ) -> list[Array]:
        x, y, yaw, v, r, _ = ego
        origin = np.array([x - v * dt * math.sin(yaw), y + v * dt * math.cos(yaw)])
        ego_yaw = yaw + r * dt
        kept = []
        for entry in entries:
            position = (
                rot(ego_yaw) @ np.array([entry[0] - REAR_AXLE, entry[1]]) + origin
            )
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
        pairs = sorted(
            zip(*(side.tolist() for side in linear_sum_assignment(cost)), strict=True)
        )
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
            distance = math.hypot(*(thing.last_known[:2] - self._ego()[1][:2]))
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
            (thing.x, thing.P, np.array(self._ego()[1][:2]))
            if past is None
            else (past.x, past.P, past.ego_xy)
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
        _, _, _, v_ego, _, a_ego = self._ego()[1]
        yaw = wrap(z[2])
        assumed = 0.0 if self.input.in_pit else 0.8 * v_ego
        v = z[3] if sensor.measures_speed else assumed
        r = v * self.track.at(z[:2]).curvature
        a = a_ego if v_ego < 10.0 else 0.0
        # The shared P_init of quirk Q1 is not imitated: turning a multiple of the identity changes nothing.
        thing = Object(
            np.array([z[0], z[1], yaw, v, r, a]),
            rotated(P_INIT, yaw),
            sensor.counter_init,
            self.track_ns,
        )
        n = max(round((self.track_ns - stamp_ns) / STEP_NS), 0)
        thing.store(self.track_ns - n * STEP_NS)
        for step in reversed(range(n)):
            thing.x, thing.P = predict(thing.x, thing.P)
            thing.store(self.track_ns - step * STEP_NS)
        self.objects[number] = thing


def merge(detections: list[Array]) -> list[Array]:
    """Overlap merge (section 10.6), in the order of the reference: that of a set of index tuples."""
    indices = range(len(detections))
    near = [
        tuple(
            j
            for j in indices
            if math.hypot(*(detections[i] - detections[j])[:2]) <= MERGE_DISTANCE
        )
        for i in indices
    ]
    groups = {members for members in near if len(members) >= 2}
    merged = [sum(detections[j] for j in members) / len(members) for members in groups]
    return merged + [
        detections[i] for i in indices if not any(i in members for members in groups)
    ]


def run(
    messages: Iterable[Message], ticks_ns: Iterable[int], track_csv: Path, pit_csv: Path
) -> Iterator[TickResult]:
    """The results at `ticks_ns`; what was received at or before a tick is delivered before it."""
    tracker = PublishedTracker(track_csv, pit_csv)
    waiting = deque(messages)
    for now_ns in ticks_ns:
        while waiting and waiting[0].receipt_ns <= now_ns:
            tracker.input.receive(waiting.popleft())
        yield tracker.tick(now_ns)

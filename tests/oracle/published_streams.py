"""Generated streams of messages for the published tracker. Not a simulator: nothing here has to be realistic."""

import math
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from published_situations import Interval, Situation

from fgtrack.core.types import Detection, DetectionList, EgoState

Array = Any  # numpy array of floats
Messages = list[EgoState | DetectionList]

NODE_NS = 20_000_000
REAR_AXLE_M = 1.74
DELAYS_S = {
    "lidar": (0.10, 0.02),
    "lidar_cluster": (0.151, 0.03),
    "radar": (0.062, 0.02),
}  # mean, std


class Line:
    """The reference line of a map file, to drive along."""

    def __init__(self, path: Path) -> None:
        table = np.loadtxt(path, delimiter=";", comments="#")
        self.points, heading = table[:, :2], table[:, 14]
        self.arcs = np.concatenate(
            [[0.0], np.cumsum(np.hypot(*np.diff(self.points, axis=0).T))]
        )
        self.lap_m = float(self.arcs[-1])
        self.jump_m = float(self.arcs[np.argmax(np.abs(np.diff(heading)))])
        self.jump_rep103_m = float(self.arcs[np.argmin(np.abs(heading - math.pi / 2))])

    def pose(self, arc: float, left: float) -> tuple[Array, float]:
        """Position, shape (2,), `left` of the line, and yaw (REP-103)."""
        before, after = (
            np.array(
                [
                    np.interp((arc + step) % self.lap_m, self.arcs, column)
                    for column in self.points.T
                ]
            )
            for step in (-2.0, 2.0)
        )
        yaw = math.atan2(after[1] - before[1], after[0] - before[0])
        return (before + after) / 2 + left * np.array(
            [-math.sin(yaw), math.cos(yaw)]
        ), yaw


class World:
    """The ego and the objects, driving along the lines."""

    def __init__(
        self, situation: Situation, rng: np.random.Generator, track: Line, pit: Line
    ) -> None:
        self.situation, self.rng, self.track = situation, rng, track
        begin = {
            "anywhere": rng.uniform(0.0, track.lap_m),
            "closing": track.lap_m,
            "jump": track.jump_m,
            "jump_rep103": track.jump_rep103_m,
        }
        self.speed = float(rng.choice(situation.ego_speed_mps))
        ahead_m = (
            0.0
            if situation.start == "anywhere"
            else rng.uniform(0.2, 0.8) * situation.duration_s * self.speed
        )
        self.begin_m = float(begin[situation.start] - ahead_m)
        low, high = situation.num_objects
        spread = situation.spread_m
        self.objects = [
            (
                pit if rng.random() < situation.in_pit_p else track,
                float(rng.uniform(-spread, spread)),
                float(rng.uniform(-6.0, 6.0)),
                float(rng.normal(0.0, situation.relative_speed_mps)),
            )
            for _ in range(rng.integers(low, high + 1))
        ]

    def ego(self, time_s: float) -> tuple[Array, float, float]:
        """Position, yaw and speed of the ego."""
        change = self.situation.ego_speed_changes_mps
        arc = self.begin_m + self.speed * time_s + change * (1.0 - math.cos(time_s))
        return *self.track.pose(arc, 0.0), self.speed + change * math.sin(time_s)

    def seen(self, time_s: float, sensor: str) -> list[Detection]:
        """Detections in the ego frame, as true as `situation` says."""
        situation, rng = self.situation, self.rng
        if rng.random() < situation.empty_p:
            return []
        places = []
        for line, offset_m, left_m, relative_mps in self.objects:
            gone = situation.objects_gone_s[0] <= time_s < situation.objects_gone_s[1]
            if rng.random() < situation.seen_p and not gone:
                share = line.lap_m / self.track.lap_m  # beside the ego on both lines
                arc = (
                    self.begin_m + (self.speed + relative_mps) * time_s + offset_m
                ) * share
                places.append((*line.pose(arc, left_m), self.speed + relative_mps))
        origin, ego_yaw, _ = self.ego(time_s)
        for _ in range(rng.poisson(situation.clutter)):
            places.append(
                (
                    origin + rng.uniform(-70.0, 70.0, 2),
                    rng.uniform(-math.pi, math.pi),
                    30.0,
                )
            )
        return [self._detection(place, origin, ego_yaw, sensor) for place in places]

    def _detection(
        self,
        place: tuple[Array, float, float],
        origin: Array,
        ego_yaw: float,
        sensor: str,
    ) -> Detection:
        rng = self.rng
        position, yaw, speed = place
        dx, dy = position - origin + rng.normal(0.0, 1.0, 2) * self.situation.noise_m
        x = math.cos(ego_yaw) * dx + math.sin(ego_yaw) * dy + REAR_AXLE_M
        y = -math.sin(ego_yaw) * dx + math.cos(ego_yaw) * dy
        values = [
            float(x),
            float(y),
            math.remainder(
                yaw - ego_yaw + rng.normal(0.0, self.situation.noise_rad), math.tau
            ),
        ]
        values.append(float(abs(speed + rng.normal(0.0, self.situation.noise_mps))))
        if rng.random() < self.situation.zero_p:
            values[0:2] = [0.0, 0.0]
        if rng.random() < self.situation.nan_p:
            values[rng.integers(4)] = float(rng.choice([math.nan, math.inf]))
        x, y, yaw, speed = values
        return Detection(
            x,
            y,
            yaw if sensor == "lidar" else None,
            speed if sensor == "radar" else None,
        )


def generate(
    situation: Situation, seed: int, track: Path, pit: Path
) -> tuple[Messages, list[int]]:
    """Messages in receipt order, and the ticks of the node."""
    rng = np.random.default_rng(seed)
    world = World(situation, rng, Line(track), Line(pit))
    messages = [*_ego_messages(situation, world, rng)]
    for sensor in situation.sensors:
        messages += _detection_lists(situation, world, rng, sensor)
    messages.sort(key=lambda message: message.receipt_ns)
    return messages, _ticks(situation, rng, messages)


def _times(
    situation: Situation, rng: np.random.Generator, hz: float, silent_s: Interval
) -> list[float]:
    times = np.arange(rng.uniform(0.0, 1.0 / hz), situation.duration_s, 1.0 / hz)
    return [float(time) for time in times if not silent_s[0] <= time < silent_s[1]]


def _stamp_ns(situation: Situation, time_s: float) -> int:
    stamp_ns = situation.epoch_ns + round(time_s * 1e9)
    return stamp_ns // situation.stamp_grid_ns * situation.stamp_grid_ns


def _ego_messages(
    situation: Situation, world: World, rng: np.random.Generator
) -> Messages:
    messages: list[EgoState] = []
    in_pit = False
    for time_s in _times(situation, rng, situation.ego_hz, situation.ego_silent_s):
        position, yaw, speed = world.ego(time_s)
        noise = (
            rng.normal(0.0, 1.0, 6)
            * situation.ego_noise
            * [0.05, 0.05, 0.01, 0.2, 0.03, 0.5]
        )
        noise[3:] += situation.ego_bias * np.array([4.0, 0.5, 2.0])
        values = np.array([*position, yaw, speed, 0.0, 0.0]) + noise
        values[2] = math.remainder(values[2], math.tau)
        values[3] = abs(values[3])
        if situation.ego_exact_speeds_mps and rng.random() < 0.5:
            values[3] = rng.choice(situation.ego_exact_speeds_mps)
        if rng.random() < situation.ego_nan_p:
            values[rng.integers(2)] = math.nan
        told: bool | None = None
        if rng.random() < situation.pit_toggle_p:
            told = in_pit = not in_pit
        stamp_ns = _stamp_ns(situation, time_s)
        receipt_ns = stamp_ns + int(rng.integers(1_000_000, 3_000_000))
        if messages and rng.random() < situation.ego_repeated_p:
            stamp_ns = messages[-1].stamp_ns
        message = replace(EgoState(stamp_ns, receipt_ns, *values.tolist()), in_pit=told)
        messages.append(message)
        if rng.random() < situation.ego_resent_p:
            old = messages[max(len(messages) - 2 - int(rng.integers(3)), 0)]
            messages.append(EgoState(old.stamp_ns, receipt_ns + 100, *values.tolist()))
    return list(messages)


def _detection_lists(
    situation: Situation, world: World, rng: np.random.Generator, sensor: str
) -> Messages:
    messages: Messages = []
    newest_ns = 0
    for time_s in _times(
        situation, rng, situation.sensors_hz, situation.sensors_silent_s
    ):
        objects = world.seen(time_s, sensor)
        stamp_ns = _stamp_ns(situation, time_s)
        receipt_ns = stamp_ns + _delay_ns(situation, rng, sensor)
        newest_ns = receipt_ns = max(receipt_ns, newest_ns, situation.epoch_ns)
        if situation.object_stamps:
            spread_ns = rng.integers(-20_000_000, 1_000_000, len(objects))
            objects = [
                _stamped(item, stamp_ns + int(own))
                for item, own in zip(objects, spread_ns, strict=True)
            ]
        messages.append(DetectionList(sensor, stamp_ns, receipt_ns, tuple(objects)))
        if rng.random() < situation.duplicate_p:
            objects = world.seen(time_s, sensor) if rng.random() < 0.5 else objects
            receipt_ns += int(rng.integers(0, 30_000_000))
            messages.append(DetectionList(sensor, stamp_ns, receipt_ns, tuple(objects)))
        if rng.random() < situation.burst_p:
            objects = world.seen(time_s, sensor)
            messages.append(
                DetectionList(
                    sensor,
                    stamp_ns + int(rng.integers(-5_000_000, 9_000_000)),
                    receipt_ns + 1,
                    tuple(objects),
                )
            )
    return messages


def _stamped(item: Detection, stamp_ns: int) -> Detection:
    return Detection(
        item.x_m, item.y_m, item.yaw_rad, item.speed_mps, stamp_ns=stamp_ns
    )


def _delay_ns(situation: Situation, rng: np.random.Generator, sensor: str) -> int:
    usual_s = max(rng.normal(*DELAYS_S[sensor]), 0.0)
    delay_s = {
        "usual": usual_s,
        "none": 0.0,
        "mixed": rng.choice([0.0, usual_s]),
        "tiny": rng.uniform(0.0, 0.006),
        "future": rng.uniform(-0.1, 0.02),
        "huge": rng.uniform(0.0, 0.6),
    }[situation.delay]
    return round(float(delay_s) * 1e9)


def _ticks(
    situation: Situation, rng: np.random.Generator, messages: Messages
) -> list[int]:
    first_ns = -(-messages[0].receipt_ns // NODE_NS) * NODE_NS
    num_ticks = max(round(situation.duration_s * 1e9) // NODE_NS, 1)
    steps_ns = np.full(num_ticks, NODE_NS)
    if situation.clock == "jitter":
        kinds = [
            rng.integers(1, 10_000_000, num_ticks),
            rng.integers(15_000_000, 25_000_000, num_ticks),
            rng.choice(
                [10_000_000, 20_000_000, 30_000_000, 10_000_001, 9_999_999], num_ticks
            ),
            rng.integers(20_000_000, 200_000_000, num_ticks),
        ]
        steps_ns = np.choose(rng.choice(4, num_ticks, p=[0.3, 0.4, 0.2, 0.1]), kinds)
    if situation.clock == "gaps":
        long = rng.random(num_ticks) < 0.05
        steps_ns = np.where(
            long, rng.integers(500_000_000, 6_000_000_000, num_ticks), steps_ns
        )
    last_ns = messages[-1].receipt_ns + 500_000_000
    ticks = accumulate((int(step) for step in steps_ns), initial=first_ns)
    return [now_ns for now_ns in ticks if now_ns <= last_ns]

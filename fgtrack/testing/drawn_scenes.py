"""Drawn scenes of several objects and sensors, whose messages may arrive in any order."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, EgoState, FloatArray, Frame

SIDE_M = 160.0
"""Side of the square in which objects and clutter appear."""
STD_M, BEARING_STD_RAD, DOPPLER_STD_MPS, YAW_STD_RAD = 0.3, 0.01, 0.3, 0.1
HORIZON_S = 2.5
"""Window of the tracker: no list is later than this."""
_DETECTION_PROBABILITY = 0.85
_LENGTH_M, _SECOND_SHARE = 12.0, 0.3
_CLUTTER = 99
"""Number of the object of a detection that shows none."""
KINDS: Mapping[str, Mapping[str, float]] = {
    "position": {"x_m": STD_M, "y_m": STD_M},
    "yaw": {"x_m": STD_M, "y_m": STD_M, "yaw_rad": YAW_STD_RAD},
    "identity": {"x_m": 2.0 * STD_M, "y_m": 2.0 * STD_M},
    "long": {"x_m": STD_M, "y_m": STD_M},
    "range_bearing": {"range_m": STD_M, "bearing_rad": BEARING_STD_RAD},
    "doppler": {
        "range_m": STD_M,
        "bearing_rad": BEARING_STD_RAD,
        "range_rate_mps": DOPPLER_STD_MPS,
    },
    "bearing": {"bearing_rad": BEARING_STD_RAD},
}
"""Measured components of each kind of sensor, with their standard deviations.

"identity" reports identities, of which some are wrong or missing. "long" often reports both ends of an object.
"""
Message = EgoState | DetectionList


@dataclass(frozen=True, repr=False)
class Scene:
    """Messages of a scene, each received at its stamp, and the configuration of a tracker."""

    label: str
    """Arguments of `drawn`, and of `late`."""
    messages: Sequence[Message]
    config: Mapping[str, Any]  # Any: values of all kinds of keys
    length_s: float

    def __repr__(self) -> str:
        return self.label

    def late(self, seed: int, lists_s: float, ego_s: float = 0.0) -> "Scene":
        """Return the scene with random delays up to `lists_s` of the lists, and up to `ego_s` of the ego's states."""
        rng = np.random.default_rng(seed)
        delays_s = {False: lists_s, True: ego_s}
        messages = [
            replace(
                each,
                receipt_ns=each.stamp_ns
                + round(
                    NS_PER_S * rng.uniform(0.0, delays_s[isinstance(each, EgoState)])
                ),
            )
            for each in self.messages
        ]
        label = f"{self.label}.late({seed}, {lists_s}, {ego_s})"
        return replace(self, messages=messages, label=label)

    def with_config(self, **sections: Any) -> "Scene":
        """Return the scene with other sections of the configuration."""
        return replace(self, config={**self.config, **sections})

    def with_estimator(self, name: str) -> "Scene":
        """Return the scene for another estimator."""
        return self.with_config(estimator=name)


@dataclass(frozen=True)
class _Ego:
    """An ego that turns and accelerates. Its reported position jumps at `jump_s` by `jump_m`."""

    turn_radps: float
    accel_mps2: float
    jump_s: float
    jump_m: float

    def at(self, t_s: float) -> EgoState:
        """Return the true state at a time."""
        stamp_ns = round(t_s * NS_PER_S)
        steps_s = np.linspace(0.0, t_s, 50)
        yaws = 0.5 * self.turn_radps * steps_s**2
        speeds = 10.0 + self.accel_mps2 * steps_s
        x_m, y_m = (
            float(np.trapezoid(speeds * each(yaws), steps_s))
            for each in (np.cos, np.sin)
        )
        return EgoState(
            stamp_ns,
            stamp_ns,
            x_m,
            y_m,
            0.5 * self.turn_radps * t_s**2,
            10.0 + self.accel_mps2 * t_s,
            self.turn_radps * t_s,
            self.accel_mps2,
        )

    def reported(self, t_s: float) -> EgoState:
        """Return the state that the ego reports."""
        ego = self.at(t_s)
        return ego if t_s < self.jump_s else replace(ego, x_m=ego.x_m + self.jump_m)


@dataclass(frozen=True)
class _Objects:
    """Objects with constant velocities that appear and disappear."""

    first_m: FloatArray
    velocity_mps: FloatArray
    begin_s: FloatArray
    end_s: FloatArray

    @classmethod
    def drawn(
        cls, rng: np.random.Generator, number: int, length_s: float
    ) -> "_Objects":
        """Return objects, of which half are there from the beginning."""
        first_m = rng.uniform(-SIDE_M / 2.0, SIDE_M / 2.0, (number, 2))
        velocity_mps = rng.normal(0.0, 6.0, (number, 2))
        begin_s = np.where(
            rng.random(number) < 0.5, 0.0, rng.uniform(0.0, 0.6 * length_s, number)
        )
        end_s = begin_s + rng.uniform(0.3 * length_s, 1.2 * length_s, number)
        return cls(first_m, velocity_mps, begin_s, end_s)

    def detections(
        self,
        rng: np.random.Generator,
        sensor: "_Sensor",
        ego: EgoState,
        detected: float,
    ) -> Iterator[Detection]:
        """Yield the detections of a list."""
        t_s = ego.stamp_ns / NS_PER_S
        for n in range(len(self.first_m)):
            if not self.begin_s[n] <= t_s < self.end_s[n] or rng.random() > detected:
                continue
            velocity_mps = self.velocity_mps[n]
            at_m = self.first_m[n] + velocity_mps * (t_s - self.begin_s[n])
            yield sensor.detection(rng, at_m, velocity_mps, ego, n)
            if sensor.kind == "long" and rng.random() < _SECOND_SHARE:
                end_m = _LENGTH_M * velocity_mps / np.hypot(*velocity_mps)
                yield sensor.detection(rng, at_m - end_m, velocity_mps, ego, n)


@dataclass(frozen=True)
class _Sensor:
    """A sensor of a kind, with detections in a frame."""

    kind: str
    frame: Frame

    def config(self, clutter: float) -> Mapping[str, Any]:
        """Return the section of the sensor."""
        section: dict[str, Any] = {
            "std": dict(KINDS[self.kind]),
            "detection_probability": _DETECTION_PROBABILITY,
            "clutter_per_m2": max(clutter, 0.1) / SIDE_M**2,
        }
        if self.kind == "long":
            section["second_returns"] = {"share": _SECOND_SHARE, "std_m": _LENGTH_M}
        return section

    def detection(
        self,
        rng: np.random.Generator,
        at_m: FloatArray,
        velocity_mps: FloatArray,
        ego: EgoState,
        number: int,
    ) -> Detection:
        """Return the detection of an object at a position and with a velocity in the map."""
        std = KINDS[self.kind]
        offset_m = at_m - [ego.x_m, ego.y_m]
        c, s = math.cos(ego.yaw_rad), math.sin(ego.yaw_rad)
        seen_m = np.array([[c, s], [-s, c]]) @ offset_m
        is_map = self.frame == "map"
        values: dict[str, Any] = {}
        if "x_m" in std:
            x_m, y_m = (at_m if is_map else seen_m) + rng.normal(0.0, std["x_m"], 2)
            values |= {"x_m": float(x_m), "y_m": float(y_m)}
        if "range_m" in std:
            range_m = np.hypot(*seen_m) + rng.normal(0.0, std["range_m"])
            values["range_m"] = float(range_m)
        if "bearing_rad" in std:
            bearing_rad = math.atan2(seen_m[1], seen_m[0])
            values["bearing_rad"] = bearing_rad + rng.normal(0.0, std["bearing_rad"])
        if "range_rate_mps" in std:
            own_mps = np.array([c, s]) * ego.speed_mps
            rate_mps = (velocity_mps - own_mps) @ offset_m / np.hypot(*offset_m)
            rate_mps += rng.normal(0.0, std["range_rate_mps"])
            values["range_rate_mps"] = float(rate_mps)
        if "yaw_rad" in std:
            yaw_rad = math.atan2(velocity_mps[1], velocity_mps[0])
            yaw_rad += rng.normal(0.0, std["yaw_rad"]) + math.pi * (rng.random() < 0.1)
            values["yaw_rad"] = yaw_rad - (0.0 if is_map else ego.yaw_rad)
        if self.kind == "identity" and rng.random() < 0.7:
            own = number if rng.random() < 0.95 else int(rng.integers(20))
            values["id"] = f"own {own}"
        return Detection(**values)


def drawn(
    seed: int,
    kinds: Sequence[str] = ("position", "position"),
    num_objects: int = 5,
    length_s: float = 5.0,
    detected: float = 0.85,
    clutter: float = 1.5,
    frame: Frame = "ego",
    ego_hz: float = 50.0,
    jump_m: float = 0.0,
    **config: Any,
) -> Scene:
    """Return a scene: an ego that turns, and objects that appear and disappear, with misses and clutter.

    `kinds` are those of the sensors, of `KINDS`. The ego's reported position jumps by `jump_m` in the middle. `config`
    has other sections of the configuration.
    """
    rng = np.random.default_rng(seed)
    objects = _Objects.drawn(rng, num_objects, length_s)
    ego = _Ego(rng.normal(0.0, 0.2), rng.normal(0.0, 1.0), 0.5 * length_s, jump_m)
    messages: list[Message] = [
        ego.reported(t_s)
        for t_s in np.arange(0.0, length_s + 0.5, 1.0 / ego_hz).tolist()
    ]
    sections: dict[str, Any] = {}
    for k, kind in enumerate(kinds):
        sensor, name = _Sensor(kind, frame), f"{kind}{k}"
        sections[name] = sensor.config(clutter)
        for t_s in np.arange(0.013 + 0.021 * k, length_s, 0.1 + 0.03 * k).tolist():
            at = ego.at(t_s)
            found = list(objects.detections(rng, sensor, at, detected))
            for _ in range(rng.poisson(clutter)):
                at_m = rng.uniform(-SIDE_M / 2.0, SIDE_M / 2.0, 2)
                velocity_mps = rng.normal(0.0, 6.0, 2)
                found.append(sensor.detection(rng, at_m, velocity_mps, at, _CLUTTER))
            shuffled = [found[i] for i in rng.permutation(len(found))]
            stamp_ns = at.stamp_ns
            messages.append(
                DetectionList(name, stamp_ns, stamp_ns, shuffled, frame=frame)
            )
    given = {
        "estimator": "ekf-replay",
        "association": {"kind": "hypotheses", "most": 4},
        "sensors": sections,
        "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
        "birth": {"speed_std_mps": 10.0},
        "clock": {"node_hz": 20.0},
        "filter": {"storage_s": HORIZON_S},
        "smoother": {"lag_s": HORIZON_S},
        **config,
    }
    label = (
        f"drawn({seed}, {tuple(kinds)}, {num_objects=}, {length_s=}, {detected=}, "
        f"{clutter=}, {frame=}, {ego_hz=}, {jump_m=}, **{config})"
    )
    return Scene(label, messages, given, length_s)

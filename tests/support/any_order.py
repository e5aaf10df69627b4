"""Drawn scenes of several sensors, whose messages arrive in any order, and what a tracker finds in them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fgtrack import Config, Detection, DetectionList, EgoState
from fgtrack.core.types import (
    Disposition,
    FinalTrack,
    Revision,
    TrackReport,
    UpdateRecord,
)
from fgtrack.pipeline.build import build_tracker

SECOND = 1_000_000_000
SIDE_M = 160.0
STD_M, BEARING_STD_RAD, DOPPLER_STD_MPS, YAW_STD_RAD = 0.3, 0.01, 0.3, 0.1
HORIZON_S = 2.5
#: A track that is less probable at present ends without any list, once the lists up to now are usually there.
LEAST_EXISTENCE = 0.02
SURE_EXISTENCE = 0.6
#: Measured components of each kind of sensor.
KINDS: Mapping[str, Mapping[str, float]] = {
    "position": {"x_m": STD_M, "y_m": STD_M},
    "yaw": {"x_m": STD_M, "y_m": STD_M, "yaw_rad": YAW_STD_RAD},
    "identity": {"x_m": 2.0 * STD_M, "y_m": 2.0 * STD_M},
    "range_bearing": {"range_m": STD_M, "bearing_rad": BEARING_STD_RAD},
    "doppler": {
        "range_m": STD_M,
        "bearing_rad": BEARING_STD_RAD,
        "range_rate_mps": DOPPLER_STD_MPS,
    },
    "bearing": {"bearing_rad": BEARING_STD_RAD},
}
Message = EgoState | DetectionList
Key = tuple[str, int, int]


@dataclass(frozen=True, repr=False)
class Scene:
    """Messages of a scene, each received at its stamp, and the configuration of a tracker."""

    label: str
    """Arguments of `drawn`."""
    messages: Sequence[Message]
    config: Mapping[str, Any]
    length_s: float

    def __repr__(self) -> str:
        return f"drawn({self.label})"

    def late(self, seed: int, lists_s: float, ego_s: float = 0.0) -> "Scene":
        """Return the scene with random delays up to `lists_s` of the lists, and up to `ego_s` of the ego's states."""
        rng = np.random.default_rng(seed)
        delays_s = {False: lists_s, True: ego_s}
        messages = [
            replace(
                each,
                receipt_ns=each.stamp_ns
                + round(
                    SECOND * rng.uniform(0.0, delays_s[isinstance(each, EgoState)])
                ),
            )
            for each in self.messages
        ]
        return replace(self, messages=messages)

    def with_estimator(self, name: str) -> "Scene":
        """Return the scene for another estimator."""
        return replace(self, config={**self.config, "estimator": name})


def drawn(
    seed: int,
    kinds: Sequence[str] = ("position", "position"),
    num_objects: int = 5,
    length_s: float = 5.0,
    detected: float = 0.85,
    clutter: float = 1.5,
    frame: str = "ego",
    ego_hz: float = 50.0,
    **config: Any,
) -> Scene:
    """Return a scene: an ego that turns, and objects that appear and disappear, with misses and clutter.

    A sensor of the kind "identity" reports identities, of which some are wrong or missing.
    """
    rng = np.random.default_rng(seed)
    first_m = rng.uniform(-SIDE_M / 2.0, SIDE_M / 2.0, (num_objects, 2))
    velocity_mps = rng.normal(0.0, 6.0, (num_objects, 2))
    begin_s = np.where(
        rng.random(num_objects) < 0.5,
        0.0,
        rng.uniform(0.0, 0.6 * length_s, num_objects),
    )
    end_s = begin_s + rng.uniform(0.3 * length_s, 1.2 * length_s, num_objects)
    turn_radps, accel_mps2 = rng.normal(0.0, 0.2), rng.normal(0.0, 1.0)

    def ego_at(t_s: float) -> EgoState:
        stamp_ns, yaw_rad = round(t_s * SECOND), 0.5 * turn_radps * t_s**2
        steps_s = np.linspace(0.0, t_s, 50)
        yaws, speeds = 0.5 * turn_radps * steps_s**2, 10.0 + accel_mps2 * steps_s
        x_m, y_m = (
            float(np.trapezoid(speeds * each(yaws), steps_s))
            for each in (np.cos, np.sin)
        )
        speed_mps = 10.0 + accel_mps2 * t_s
        return EgoState(
            stamp_ns,
            stamp_ns,
            x_m,
            y_m,
            yaw_rad,
            speed_mps,
            turn_radps * t_s,
            accel_mps2,
        )

    messages: list[Message] = []
    for t_s in np.arange(0.0, length_s + 0.5, 1.0 / ego_hz).tolist():
        messages.append(ego_at(t_s))
    sensors: dict[str, Any] = {}
    for k, kind in enumerate(kinds):
        name = f"{kind}{k}"
        std = KINDS[kind]
        sensors[name] = {
            "std": dict(std),
            "detection_probability": 0.85,
            "clutter_per_m2": max(clutter, 0.1) / SIDE_M**2,
        }
        for t_s in np.arange(0.013 + 0.021 * k, length_s, 0.1 + 0.03 * k).tolist():
            ego = ego_at(t_s)
            objects = []
            for n in range(num_objects):
                if not begin_s[n] <= t_s < end_s[n] or rng.random() > detected:
                    continue
                at_m = first_m[n] + velocity_mps[n] * (t_s - begin_s[n])
                objects.append(
                    _detection(rng, kind, at_m, velocity_mps[n], ego, frame, n)
                )
            for _ in range(rng.poisson(clutter)):
                at_m = rng.uniform(-SIDE_M / 2.0, SIDE_M / 2.0, 2)
                objects.append(
                    _detection(rng, kind, at_m, rng.normal(0.0, 6.0, 2), ego, frame, 99)
                )
            order = rng.permutation(len(objects))
            stamp_ns = round(t_s * SECOND)
            shuffled = [objects[i] for i in order]
            messages.append(
                DetectionList(name, stamp_ns, stamp_ns, shuffled, frame=frame)  # type: ignore[arg-type]
            )
    given = {
        "estimator": "ekf-replay",
        "association": {"kind": "hypotheses", "most": 4},
        "sensors": sensors,
        "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
        "birth": {"speed_std_mps": 10.0},
        "clock": {"node_hz": 20.0},
        "filter": {"storage_s": HORIZON_S},
        "smoother": {"lag_s": HORIZON_S},
        **config,
    }
    label = f"{seed}, {kinds}, {num_objects=}, {detected=}, {clutter=}, {frame=}"
    return Scene(label, messages, given, length_s)


def _detection(
    rng: np.random.Generator,
    kind: str,
    at_m: np.ndarray,
    velocity_mps: np.ndarray,
    ego: EgoState,
    frame: str,
    number: int,
) -> Detection:
    """Return the detection of an object at a position and with a velocity in the map."""
    std = KINDS[kind]
    offset_m = at_m - [ego.x_m, ego.y_m]
    c, s = math.cos(ego.yaw_rad), math.sin(ego.yaw_rad)
    seen_m = np.array([[c, s], [-s, c]]) @ offset_m
    values: dict[str, Any] = {}
    if "x_m" in std:
        x_m, y_m = (at_m if frame == "map" else seen_m) + rng.normal(0.0, std["x_m"], 2)
        values |= {"x_m": float(x_m), "y_m": float(y_m)}
    if "range_m" in std:
        values["range_m"] = float(np.hypot(*seen_m) + rng.normal(0.0, std["range_m"]))
    if "bearing_rad" in std:
        bearing_rad = math.atan2(seen_m[1], seen_m[0])
        values["bearing_rad"] = bearing_rad + rng.normal(0.0, std["bearing_rad"])
    if "range_rate_mps" in std:
        own_mps = (
            np.array([math.cos(ego.yaw_rad), math.sin(ego.yaw_rad)]) * ego.speed_mps
        )
        rate_mps = (velocity_mps - own_mps) @ offset_m / np.hypot(*offset_m)
        values["range_rate_mps"] = float(
            rate_mps + rng.normal(0.0, std["range_rate_mps"])
        )
    if "yaw_rad" in std:
        yaw_rad = math.atan2(velocity_mps[1], velocity_mps[0])
        yaw_rad += rng.normal(0.0, std["yaw_rad"]) + math.pi * (rng.random() < 0.1)
        values["yaw_rad"] = yaw_rad - (0.0 if frame == "map" else ego.yaw_rad)
    if kind == "identity" and rng.random() < 0.7:
        values["id"] = f"own {number if rng.random() < 0.95 else rng.integers(20)}"
    return Detection(**values)


@dataclass
class Outcome:
    """What a tracker has found in the end."""

    states: dict[tuple[Key, int], tuple[np.ndarray, np.ndarray]]
    """Mean and covariance of each track at several stamps, by its first detection and the stamp."""
    tracks: list[tuple[Any, ...]]
    """Final tracks without their numbers, sorted."""
    of: dict[Key, Key | None]
    """Track of each detection by its first detection."""
    statuses: dict[Key, Any]
    """Status and description of each probable track at the end, by its first detection."""
    records: list[UpdateRecord] = field(repr=False, default_factory=list)
    revisions: list[Revision] = field(repr=False, default_factory=list)


def outcome(scene: Scene) -> Outcome:
    """Return what a tracker finds in a scene."""
    messages = sorted(scene.messages, key=lambda each: each.receipt_ns)
    tracker = build_tracker(Config.from_dict(dict(scene.config)))
    records: list[UpdateRecord] = []
    revisions: list[Revision] = []
    at, end_s = 0, scene.length_s + HORIZON_S - 1.0
    for tick in range(round(end_s * 20.0)):
        now_ns = tick * SECOND // 20
        while at < len(messages) and messages[at].receipt_ns <= now_ns:
            tracker.receive(messages[at])
            at += 1
        report = tracker.tick(now_ns)
        records += report.updates
        revisions += report.revisions
    assert at == len(messages)
    reports: list[tuple[int, TrackReport]] = []
    for back_s in (0.0, 0.5, 1.0):
        stamp_ns = round((scene.length_s - back_s) * SECOND)
        reports += [
            (stamp_ns, each)
            for each in tracker.tracks_at(stamp_ns)
            if (each.score or 0.0) > LEAST_EXISTENCE
        ]
    tracker.finish()
    revisions += tracker.revised()
    assert not tracker.failures.ended
    of = _last_tracks(records, revisions)
    first: dict[int, Key] = {}
    for key, track_id in of.items():
        if track_id is not None:
            first[track_id] = min(first.get(track_id, key), key, key=_by_stamp)
    states = {
        (first[each.track_id], stamp_ns): (each.state.mean, each.state.covariance)
        for stamp_ns, each in reports
        if each.track_id in first
    }
    statuses = {
        first[each.track_id]: (each.status, each.object)
        for _, each in reports
        if each.track_id in first and (each.score or 0.0) > SURE_EXISTENCE
    }
    return Outcome(
        states,
        sorted(_unnumbered(each) for each in tracker.final_tracks()),
        {key: None if i is None else first[i] for key, i in of.items()},
        statuses,
        records,
        revisions,
    )


def _unnumbered(track: FinalTrack) -> tuple[Any, ...]:
    return tuple(track[1:])


def _by_stamp(key: Key) -> tuple[int, str, int]:
    return key[1], key[0], key[2]


def _last_tracks(
    records: Sequence[UpdateRecord], revisions: Sequence[Revision]
) -> dict[Key, int | None]:
    """Return the track of each detection in the end."""
    found = {
        (each.sensor, each.stamp_ns, each.index): each.track_id for each in records
    }
    assert len(found) == len(records)
    for each in revisions:
        key = each.sensor, each.stamp_ns, each.index
        assert found[key] == each.old_track_id
        found[key] = each.track_id
    return found


def assert_equal(found: Outcome, expected: Outcome, atol_m: float = 0.0) -> None:
    """Assert that both trackers have found the same tracks, with states that differ by at most `atol_m`."""
    assert found.of == expected.of
    assert found.states.keys() == expected.states.keys()
    for key, (mean, covariance) in found.states.items():
        other_mean, other_covariance = expected.states[key]
        if atol_m == 0.0:
            np.testing.assert_array_equal(mean, other_mean)
            np.testing.assert_array_equal(covariance, other_covariance)
            continue
        std_m = np.sqrt(np.maximum(np.diag(other_covariance), 0.0))
        assert np.all(np.abs(mean - other_mean) <= np.maximum(atol_m, 0.02 * std_m))
    assert found.statuses == expected.statuses
    assert found.tracks == expected.tracks


#: Dispositions of detections that are no copies.
USED = {
    Disposition.BIRTH,
    Disposition.IN_SEQUENCE,
    Disposition.OUT_OF_SEQUENCE,
    Disposition.BEYOND_WINDOW,
    Disposition.MERGED,
}

"""The order of arrival changes no decision of a tracker that decides by hypotheses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from fgtrack import Config, Detection, DetectionList, FloatArray
from fgtrack.core.state import from_bytes, to_bytes
from fgtrack.core.types import (
    Disposition,
    FinalTrack,
    Revision,
    UpdateRecord,
)
from fgtrack.pipeline.build import build_tracker
from fgtrack.tracking.tracker_state import TrackerState

SECOND = 1_000_000_000
LENGTH_S = 8.0
SIDE_M = 150.0
CLUTTER = 2.0
STDS = {"lidar": 0.3, "radar": 0.8}
Lists = Sequence[tuple[str, int, Sequence[Detection]]]


def configuration(estimator: str, **others: Any) -> Config:
    """Return a tracker that decides by hypotheses."""
    return Config.from_dict(
        {
            "estimator": estimator,
            "association": {"kind": "hypotheses", "most": 6},
            "sensors": {
                name: {
                    "std": {"x_m": std, "y_m": std},
                    "detection_probability": 0.85,
                    "clutter_per_m2": CLUTTER / SIDE_M**2,
                }
                for name, std in STDS.items()
            },
            "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
            "birth": {"speed_std_mps": 10.0},
            "clock": {"node_hz": 20.0},
            "filter": {"storage_s": 3.0},
            "smoother": {"lag_s": 3.0},
            **others,
        }
    )


def scene(
    seed: int, num_objects: int = 6, detected: float = 0.85, clutter: float = CLUTTER
) -> Lists:
    """Return the lists of two sensors: objects that appear and disappear, misses and clutter."""
    rng = np.random.default_rng(seed)
    first_m = rng.uniform(-SIDE_M / 2.0, SIDE_M / 2.0, (num_objects, 2))
    velocity_mps = rng.normal(0.0, 6.0, (num_objects, 2))
    begin_s = np.where(
        np.arange(num_objects) < num_objects / 2,
        0.0,
        rng.uniform(0.0, LENGTH_S / 2.0, num_objects),
    )
    end_s = begin_s + rng.uniform(2.0, LENGTH_S, num_objects)
    lists = []
    for sensor, (period_s, offset_s) in {
        "lidar": (0.1, 0.013),
        "radar": (0.13, 0.041),
    }.items():
        for t_s in np.arange(offset_s, LENGTH_S, period_s).tolist():
            seen = [
                first_m[k]
                + velocity_mps[k] * (t_s - begin_s[k])
                + rng.normal(0.0, STDS[sensor], 2)
                for k in range(num_objects)
                if begin_s[k] <= t_s < end_s[k] and rng.random() < detected
            ]
            seen += list(
                rng.uniform(-SIDE_M / 2.0, SIDE_M / 2.0, (rng.poisson(clutter), 2))
            )
            objects = [Detection(x_m=float(x), y_m=float(y)) for x, y in seen]
            lists.append((sensor, round(t_s * SECOND), objects))
    return lists


@dataclass
class Outcome:
    """What a tracker has found."""

    states: list[tuple[float, ...]]
    """Present states and covariances of all tracks that no time alone may have ended, sorted."""
    tracks: list[FinalTrack]
    records: list[UpdateRecord]
    revisions: list[Revision]

    def last_tracks(self) -> dict[tuple[str, int, int], int | None]:
        """Return the track of each detection in the end."""
        found = {
            (each.sensor, each.stamp_ns, each.index): each.track_id
            for each in self.records
        }
        for each in self.revisions:
            key = each.sensor, each.stamp_ns, each.index
            assert found[key] == each.old_track_id
            found[key] = each.track_id
        return found

    def groups(self) -> set[frozenset[tuple[str, int, int]]]:
        """Return the detections of each track."""
        members: dict[int, set[tuple[str, int, int]]] = {}
        for key, track_id in self.last_tracks().items():
            if track_id is not None:
                members.setdefault(track_id, set()).add(key)
        return {frozenset(each) for each in members.values()}


def outcome(lists: Lists, delays_ns: Sequence[int], config: Config) -> Outcome:
    """Return what a tracker finds if the lists arrive with these delays."""
    messages = [
        DetectionList(sensor, stamp_ns, stamp_ns + delay_ns, objects, frame="map")
        for (sensor, stamp_ns, objects), delay_ns in zip(lists, delays_ns, strict=True)
    ]
    messages.sort(key=lambda each: each.receipt_ns)
    tracker = build_tracker(config)
    records: list[UpdateRecord] = []
    revisions: list[Revision] = []
    final_tracks: list[FinalTrack] = []
    at = 0
    for tick in range(round((LENGTH_S + 2.0) * 20.0)):
        now_ns = tick * SECOND // 20
        while at < len(messages) and messages[at].receipt_ns <= now_ns:
            tracker.receive(messages[at])
            at += 1
        report = tracker.tick(now_ns)
        records += report.updates
        revisions += report.revisions
        final_tracks += report.final_tracks
    assert at == len(messages)
    states = sorted(
        (*each.state.mean.tolist(), *each.state.covariance.ravel().tolist())
        for each in tracker.tracks_at(round(LENGTH_S * SECOND))
        if (each.score or 0.0) > 0.02
    )
    tracker.finish()
    final_tracks += [*tracker.settled_tracks(), *tracker.final_tracks()]
    return Outcome(states, sorted(final_tracks), records, revisions)


def delays(lists: Lists, seed: int, most_s: float) -> list[int]:
    """Return random delays of all lists."""
    rng = np.random.default_rng(seed)
    return [round(each * SECOND) for each in rng.uniform(0.0, most_s, len(lists))]


def fixed_delays(lists: Lists, of_sensors_s: Mapping[str, float]) -> list[int]:
    """Return the delays of the sensors."""
    return [round(of_sensors_s[sensor] * SECOND) for sensor, _, _ in lists]


def as_array(states: list[tuple[float, ...]]) -> FloatArray:
    """Return states as an array."""
    return np.array(states)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_late_lists_give_the_tracks_of_a_stream_in_order(seed: int) -> None:
    lists, config = scene(seed), configuration("ekf-replay")
    in_order = outcome(lists, [0] * len(lists), config)
    for late in (
        delays(lists, seed, 1.0),
        fixed_delays(lists, {"lidar": 0.151, "radar": 0.062}),
    ):
        found = outcome(lists, late, config)
        assert found.states == in_order.states
        assert [each[1:] for each in sorted(found.tracks, key=lambda t: t[1:])] == [
            each[1:] for each in sorted(in_order.tracks, key=lambda t: t[1:])
        ]
        assert found.groups() == in_order.groups()
        assert len(found.records) == sum(len(objects) for _, _, objects in lists)
        assert found.revisions
    assert not in_order.revisions or all(
        each.old_track_id != each.track_id for each in in_order.revisions
    )


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
@pytest.mark.parametrize("seed", range(6))
def test_dense_clutter_in_any_order(estimator: str, seed: int) -> None:
    lists = scene(seed, num_objects=12, detected=0.7, clutter=8.0)
    config = configuration(estimator)
    in_order = outcome(lists, [0] * len(lists), config)
    found = outcome(lists, delays(lists, seed, 1.0), config)
    np.testing.assert_allclose(
        as_array(found.states),
        as_array(in_order.states),
        atol=0.0 if estimator == "ekf-replay" else 1e-6,
        rtol=0.0,
    )
    assert found.groups() == in_order.groups()


@pytest.mark.parametrize("estimator", ["smoother-banded", "smoother"])
def test_smoothers_follow_the_same_decisions(estimator: str) -> None:
    lists = scene(2)
    config = configuration(estimator)
    in_order = outcome(lists, [0] * len(lists), config)
    found = outcome(lists, delays(lists, 2, 1.0), config)
    np.testing.assert_allclose(
        as_array(found.states), as_array(in_order.states), atol=1e-6
    )
    assert found.groups() == in_order.groups()
    decided = outcome(lists, [0] * len(lists), configuration("ekf-replay"))
    assert decided.groups() == in_order.groups()


def test_a_checkpoint_of_the_decisions_goes_on_with_the_same_bits() -> None:
    lists, config = scene(4), configuration("ekf-replay")
    late = delays(lists, 4, 0.5)
    messages = [
        DetectionList(sensor, stamp_ns, stamp_ns + delay_ns, objects, frame="map")
        for (sensor, stamp_ns, objects), delay_ns in zip(lists, late, strict=True)
    ]
    messages.sort(key=lambda each: each.receipt_ns)
    half = len(messages) // 2
    tracker = build_tracker(config)
    for message in messages[:half]:
        tracker.receive(message)
        tracker.tick(message.receipt_ns)
    saved = tracker.checkpoint()

    def rest() -> list[tuple[Any, ...]]:
        found: list[tuple[Any, ...]] = []
        for message in messages[half:]:
            tracker.receive(message)
            report = tracker.tick(message.receipt_ns)
            found += [
                (each.track_id, each.status, *each.state.mean.tolist())
                for each in report.tracks
            ]
            found += [
                (each.track_id, each.index, each.disposition) for each in report.updates
            ]
        return found

    first = rest()
    tracker.restore(saved)
    assert rest() == first
    tracker = build_tracker(config)
    loaded = from_bytes(to_bytes(saved))
    assert isinstance(loaded, TrackerState)
    tracker.restore(loaded)
    assert rest() == first


@pytest.mark.parametrize(
    ("estimator", "revise"), [("drop", True), ("ekf-replay", False)]
)
def test_late_lists_change_no_decision_of_a_tracker_that_drops_them(
    estimator: str, revise: bool
) -> None:
    lists = scene(5, num_objects=3)[:60]
    newest_ns, in_order = 0, []
    late = delays(lists, 5, 0.5)
    arrivals = sorted(
        zip(lists, late, strict=True), key=lambda each: each[0][1] + each[1]
    )
    for each, delay_ns in arrivals:
        tick = -(-(each[1] + delay_ns) * 20 // SECOND)
        in_order.append((tick, each))
    in_order.sort(key=lambda each: (each[0], each[1][1]))
    taken = []
    for _, each in in_order:
        if each[1] >= newest_ns:
            newest_ns = each[1]
            taken.append(each)
    config = configuration(
        estimator, association={"kind": "hypotheses", "most": 6, "revise": revise}
    )
    found = outcome(lists, late, config)
    old = sum(each.disposition is Disposition.TOO_OLD for each in found.records)
    assert old == sum(len(each[2]) for each in lists) - sum(
        len(each[2]) for each in taken
    )
    alone = outcome(taken, [0] * len(taken), configuration("ekf-replay"))
    assert found.groups() == alone.groups()


def test_every_detection_ends_once() -> None:
    lists = scene(5)
    found = outcome(lists, delays(lists, 5, 1.0), configuration("ekf-replay"))
    keys = [(each.sensor, each.stamp_ns, each.index) for each in found.records]
    assert len(set(keys)) == len(keys)
    known = {
        Disposition.BIRTH,
        Disposition.IN_SEQUENCE,
        Disposition.OUT_OF_SEQUENCE,
        Disposition.GATED,
    }
    assert {each.disposition for each in found.records} <= known

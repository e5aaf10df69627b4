"""The tracker in a running system: nothing that arrives may end it, and nothing is lost without a count."""

import copy
import json
import math
import pickle
from collections import Counter
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from fgtrack.config.reading import read_config, read_scenario
from fgtrack.core.errors import CallError
from fgtrack.core.types import (
    Detection,
    DetectionList,
    EgoState,
    TickReport,
    TruthState,
)
from fgtrack.pipeline.live import Tracker
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.sim.simulate import simulate

MS = 1_000_000
NOW_NS = 1_600_000_000_000_000_000


def ego(stamp_ns: int) -> EgoState:
    return EgoState(stamp_ns, stamp_ns, 10.0, -5.0, 0.3, 20.0)


def seen(
    stamp_ns: int, receipt_ns: int, x_m: float = 30.0, sensor: str = "lidar_cluster"
) -> DetectionList:
    return DetectionList(
        sensor, stamp_ns, receipt_ns, [Detection(x_m=x_m, y_m=1.0)], frame="ego"
    )


def started(name: str = "ekf-replay") -> tuple[Tracker, TickReport]:
    """A tracker that has seen a car five times, and its last report."""
    tracker = Tracker.from_config(
        "smoother", estimator=name, set={"merge.distance_m": 3.0}
    )
    for k in range(5):
        at_ns = NOW_NS + k * 50 * MS
        tracker.receive(ego(at_ns))
        tracker.receive(seen(at_ns, at_ns + 40 * MS))
        report = tracker.tick(at_ns + 40 * MS)
    return tracker, report


def test_the_end_of_a_run_gives_the_final_states_of_the_window() -> None:
    tracker, report = started("smoother")
    finals = [one for one in tracker.finish() if one.lag_s is None]
    assert {one.track_id for one in finals} == {report.tracks[0].track_id}
    assert [one.state.stamp_ns for one in finals] == [
        NOW_NS + k * 50 * MS for k in range(5)
    ]
    assert tracker.tick(report.now_ns + 20 * MS).tracks == ()


@pytest.mark.parametrize("name", ["ekf-replay", "smoother-banded"])
@pytest.mark.parametrize(
    "track_id", [np.array(0), np.array([0, 1]), 0.0, "0", None, [0], 7], ids=repr
)
def test_a_track_id_that_is_not_one_is_refused_and_no_track_ends(
    name: str, track_id: Any
) -> None:
    tracker, report = started(name)
    if isinstance(track_id, np.ndarray) and track_id.shape == ():
        assert tracker.state_at(track_id, report.now_ns).track_id == 0
    else:
        with pytest.raises(
            CallError, match=r"track_id: must be an integer|track 7 does not exist"
        ):
            tracker.state_at(track_id, report.now_ns)
    assert [track.track_id for track in tracker.tracks_at(report.now_ns)] == [0]
    assert tracker.failures == {}


@pytest.mark.parametrize("name", ["ekf-replay", "smoother", "ekf-backward-forward"])
def test_a_track_can_be_asked_for_any_time_in_or_after_its_window(name: str) -> None:
    tracker, report = started(name)
    [track] = report.tracks
    now = tracker.state_at(track.track_id, report.now_ns)
    assert (now.track_id, now.status, now.num_measured) == (
        track.track_id,
        track.status,
        track.num_measured,
    )
    np.testing.assert_allclose(now.state.mean, track.state.mean, atol=0.5)
    past, ahead = (
        tracker.state_at(track.track_id, report.now_ns + shift)
        for shift in (-80 * MS, 400 * MS)
    )
    assert past.stamp_ns == report.now_ns - 80 * MS
    distance_m = math.hypot(ahead.x_m - now.x_m, ahead.y_m - now.y_m)
    assert distance_m == pytest.approx(0.4 * now.speed_mps, rel=0.05)
    assert np.trace(ahead.covariance[:2, :2]) > np.trace(now.covariance[:2, :2])
    with pytest.raises(CallError, match="before its window"):
        tracker.state_at(track.track_id, NOW_NS - 10_000 * MS)
    with pytest.raises(CallError, match="track 77 does not exist: there are 0"):
        tracker.state_at(77, report.now_ns)


def test_an_unknown_sensor_is_counted_and_its_detections_are_invalid() -> None:
    tracker, report = started()
    at_ns = report.now_ns + 10 * MS
    tracker.receive(seen(at_ns, at_ns, sensor="sonar"))
    report = tracker.tick(at_ns)
    assert tracker.refused == {"sensor 'sonar' has no model": 1}
    assert [(row.sensor, row.disposition) for row in report.updates] == [
        ("sonar", "invalid")
    ]
    assert tracker.counts["sonar"] == {"invalid": 1}


def test_a_clock_that_runs_backwards_is_refused_and_counted_and_loses_nothing() -> None:
    tracker, report = started()
    later_ns = report.now_ns + 20 * MS
    tracker.receive(seen(later_ns, later_ns))
    refused = tracker.tick(report.now_ns - 1)
    assert tracker.refused == {"tick before the last one": 1}
    assert (refused.tick, refused.now_ns, refused.tracks, refused.updates) == (
        *(report.tick, report.now_ns),
        *(report.tracks, ()),
    )
    following = tracker.tick(later_ns)
    assert following.tick == report.tick + 1
    assert [row.disposition for row in following.updates] == ["in_sequence"]


def test_it_gives_what_the_replay_of_the_same_messages_gives() -> None:
    config = read_config(
        "smoother", ["clock.node_hz=null"], track_map="oval", pit_map="oval"
    )
    scenario = replace(read_scenario("default"), duration_s=3.0)
    messages = [
        m
        for m in simulate(scenario, np.random.default_rng(3))
        if not isinstance(m, TruthState)
    ]
    run = replay_in_memory(messages, config)
    assert run.meta["broken_off"] is None
    tracker = Tracker(config)
    rows: list[tuple[float, ...]] = []
    for receipt_ns in sorted({m.receipt_ns for m in messages}):
        for message in messages:
            if message.receipt_ns == receipt_ns:
                tracker.receive(message)
        rows += [
            (track.x_m, track.y_m, track.speed_mps)
            for track in tracker.tick(receipt_ns).tracks
        ]
    assert len(rows) > 50
    np.testing.assert_array_equal(
        rows,
        np.stack(
            [run.tables["tracks"][n] for n in ("x_m", "y_m", "speed_mps")], axis=1
        ),
    )
    received = Counter(
        m.sensor for m in messages if isinstance(m, DetectionList) for _ in m.objects
    )
    assert {
        sensor: sum(counts.values()) for sensor, counts in tracker.counts.items()
    } == received


@pytest.mark.parametrize(
    "now_ns", [math.nan, math.inf, 1.5, None, "x", -1, 2**63], ids=repr
)
def test_what_is_no_time_is_refused_at_once_and_changes_nothing(now_ns: object) -> None:
    tracker = Tracker.from_config("smoother")
    first = tracker.tick(NOW_NS)
    for ask in (
        tracker.tick,
        tracker.tracks_at,
        lambda stamp_ns: tracker.state_at(0, stamp_ns),
    ):
        with pytest.raises(
            CallError,
            match=r"(now|stamp)_ns: must be integer nanoseconds since 1970, is",
        ):
            ask(now_ns)  # type: ignore[arg-type]  # wrong on purpose
    assert tracker.tick(np.int64(NOW_NS + 1)).tick == first.tick + 1


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"class_name": 7}, "class_name: a text expected"),
        ({"length_m": "4.5"}, "length_m: a number expected"),
        ({"covariance": {}}, "covariance: a list of numbers expected"),
        ({"covariance": [[1.0], [1.0, 2.0]]}, None),
    ],
)
def test_a_detection_of_wrong_types_is_invalid_with_a_reason_and_the_others_of_its_list_stay(
    wrong: Any, reason: str | None
) -> None:
    tracker, report = started()
    at_ns = report.now_ns + 10 * MS
    good = seen(at_ns, at_ns).objects[0]
    tracker.receive(replace(seen(at_ns, at_ns), objects=(replace(good, **wrong), good)))
    rows = tracker.tick(at_ns).updates
    assert [(row.index, row.disposition) for row in rows] == [
        (0, "invalid"),
        (1, "in_sequence"),
    ]
    assert len(tracker.refused) == 1
    assert reason is None or tracker.refused == {f"detection: {reason}": 1}
    assert tracker.failures == {}


@pytest.mark.parametrize(
    "given", [[0.1, 0.0, 0.0, 0.2], np.diag([0.1, 0.2])], ids=["list", "array"]
)
def test_a_covariance_may_be_a_list_or_an_array(given: Any) -> None:
    found = []
    for covariance in (given, (0.1, 0.0, 0.0, 0.2)):
        tracker = Tracker.from_config("open_space", estimator="ekf-replay")
        tracker.receive(
            DetectionList(
                "radar",
                NOW_NS,
                NOW_NS,
                [Detection(5.0, 2.0, covariance=covariance)],
                "map",
            )
        )
        [track] = tracker.tick(NOW_NS).tracks
        found.append(track.covariance)
    np.testing.assert_array_equal(*found)
    assert found[0][1, 1] == pytest.approx(0.2)


def test_reports_and_configurations_pickle_copy_and_turn_into_dicts() -> None:
    tracker, report = started()
    at_ns = report.now_ns + 10 * MS
    tracker.receive(seen(at_ns, at_ns))
    report = tracker.tick(at_ns)
    for value in (report.updates[0], tracker.config):
        assert pickle.loads(pickle.dumps(value)) == copy.deepcopy(value) == value
        assert asdict(value)
    assert json.dumps(asdict(report.updates[0])["innovation"])
    assert (
        repr(pickle.loads(pickle.dumps(report)))
        == repr(copy.deepcopy(report))
        == repr(report)
    )
    assert asdict(report)["tracks"][0]["track_id"] == report.tracks[0].track_id


def test_a_tracker_is_made_of_a_name_a_path_or_a_config() -> None:
    made = Tracker(
        "smoother", set={"smoother.lag_s": np.float64(2.0)}, estimator="ekf-replay"
    )
    assert made.config == Tracker.from_config(made.config).config
    assert (made.config.smoother.lag_s, made.config.estimator) == (2.0, "ekf-replay")
    assert Tracker().config == read_config(None)
    with pytest.raises(CallError, match=r"^config: must be a name or a path, is a int"):
        Tracker(5)  # type: ignore[arg-type]  # the same

"""The health of a live tracker: what turns its state, and what a clock that was set back does."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fgtrack.core.types import Detection, DetectionList, EgoState, TickReport
from fgtrack.pipeline.health import HealthLimits, HealthState
from fgtrack.pipeline.live import Tracker

MS, S = 1_000_000, 1_000_000_000
START_NS = 1_700_000_000 * S
STD_M = 0.3
SENSORS: dict[str, object] = {
    "lidar": {"std": {"x_m": STD_M, "y_m": STD_M}, "max_delay_s": 0.5},
    "radar": {"std": {"x_m": STD_M, "y_m": STD_M}},
}


def made(**settings: object) -> Tracker:
    chosen = {
        "sensors": SENSORS,
        "clock.node_hz": 50.0,
        "motion": {"kind": "cv", "std_per_s": {"velocity": 3.0}},
    }
    return Tracker(estimator="ekf-replay", set={**chosen, **settings})


def drive(
    tracker: Tracker,
    num_ticks: int = 100,
    begin_ns: int = START_NS,
    change: Callable[[DetectionList], Any] = lambda message: message,
    scatter: float = 1.0,
    seed: int = 0,
) -> list[TickReport]:
    """Ticks of 20 ms with a car ahead; each sensor sends at every second tick, 40 ms late."""
    rng, reports = np.random.default_rng(seed), []
    for k in range(num_ticks):
        now_ns = begin_ns + k * 20 * MS
        tracker.receive(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        for phase, sensor in enumerate(SENSORS):
            if k % 2 == phase:
                off_m = scatter * STD_M * rng.standard_normal(2)
                car = Detection(
                    x_m=20.0
                    + 0.1 * ((now_ns - START_NS) // (20 * MS) % 2000)
                    + off_m[0],
                    y_m=2.0 + off_m[1],
                )
                message = DetectionList(sensor, now_ns - 40 * MS, now_ns, [car])
                if (sent := change(message)) is not None:
                    tracker.receive(sent)
        reports.append(tracker.tick(now_ns))
    return reports


def test_a_consistent_tracker_is_ok_and_its_nis_is_near_one() -> None:
    tracker = made()
    drive(tracker, 400)
    health = tracker.health(HealthLimits(missed_share=1.0))
    assert (health.state, health.reasons) == (HealthState.OK, ())
    assert set(health.sensors) == {"lidar", "radar", "ego"}
    for name in SENSORS:
        nis = health.sensors[name].nis
        assert nis is not None
        assert nis.limits[0] < nis.mean_per_component < nis.limits[1]
        assert health.sensors[name].late_shares["lifecycle.out_of_view_s"] == 0.0
    assert health.sensors["ego"].nis is None


def test_the_horizon_of_a_sensor_is_its_usual_delay_up_to_the_window() -> None:
    tracker = made()
    window_s = tracker.config.effective.reach_s

    def late(message: DetectionList) -> DetectionList:
        late_ns = round((window_s + 1.0) * 1e9)
        stamp_ns = message.stamp_ns - (late_ns if message.sensor == "radar" else 0)
        return replace(message, stamp_ns=stamp_ns)

    assert tracker.health().sensors["lidar"].horizon_s == 0.0
    drive(tracker, 40)
    found = tracker.health().sensors
    assert [found[name].horizon_s for name in SENSORS] == pytest.approx([0.04, 0.04])
    drive(tracker, 300, START_NS + 800 * MS, late)
    found = tracker.health().sensors
    assert found["lidar"].horizon_s == pytest.approx(0.04)
    assert found["radar"].horizon_s <= window_s
    assert found["radar"].late_shares[tracker.config.effective.lag_key] > 0.8


def test_a_tracker_without_a_tick_is_stale() -> None:
    assert made().health().reasons == ("ticks: none yet",)


@pytest.mark.parametrize(
    ("scatter", "word"), [(3.0, "outside 0.25 to 1.7"), (0.02, "outside 0.25 to 1.7")]
)
def test_wrong_noise_degrades_with_the_nis_as_its_reason(
    scatter: float, word: str
) -> None:
    tracker = made()
    drive(tracker, 200, scatter=scatter)
    health = tracker.health()
    assert health.state is HealthState.DEGRADED
    assert any(
        each.startswith("lidar: NIS") and word in each for each in health.reasons
    )


def test_a_sensor_that_is_off_to_one_side_has_a_bias() -> None:
    tracker = made()

    def shifted(message: DetectionList) -> DetectionList:
        if message.sensor == "radar":
            return message
        [car] = message.objects
        objects = [Detection(x_m=car.x_m, y_m=(car.y_m or 0.0) + 1.0)]
        return DetectionList("lidar", message.stamp_ns, message.receipt_ns, objects)

    drive(tracker, 200, change=shifted, scatter=0.3)
    health = tracker.health()
    assert any(each.startswith("lidar: bias of y_m 0.5") for each in health.reasons)
    assert health.sensors["radar"].bias["y_m"] < -0.4


def test_a_sensor_that_stops_degrades_and_all_that_stop_are_stale() -> None:
    tracker = made()
    drive(tracker, 100)
    end_ns = START_NS + 100 * 20 * MS
    drive(tracker, 80, end_ns, lambda each: each if each.sensor == "radar" else None)
    health = tracker.health(HealthLimits(missed_share=1.0))
    assert health.state is HealthState.DEGRADED
    assert health.reasons[0].startswith("lidar: silent for 1.6")
    drive(tracker, 80, end_ns + 80 * 20 * MS, lambda each: None)
    health = tracker.health(HealthLimits(missed_share=1.0))
    assert health.state is HealthState.STALE
    assert health.reasons[0].startswith("sensors: no sensor")
    drive(tracker, 100, end_ns + 160 * 20 * MS)
    assert tracker.health(HealthLimits(missed_share=1.0)).state is HealthState.OK


def test_an_ego_that_stops_makes_tracks_of_its_frame_stale() -> None:
    tracker = made()
    drive(tracker, 20)
    for k in range(80):
        tracker.tick(START_NS + (20 + k) * 20 * MS)
    assert "ego: lists need its pose, and it sends nothing" in tracker.health().reasons


def test_late_and_failed_lists_degrade_with_the_key_of_the_limit() -> None:
    tracker = made()

    def late(message: DetectionList) -> DetectionList:
        if message.sensor == "radar":
            return message
        stamp_ns = message.stamp_ns - 560 * MS
        return DetectionList("lidar", stamp_ns, message.receipt_ns, message.objects)

    drive(tracker, 100, change=late)
    reasons = tracker.health().reasons
    assert any("later than sensors.lidar.max_delay_s (0.5 s)" in one for one in reasons)
    assert any("later than lifecycle.out_of_view_s" in one for one in reasons)
    drive(
        tracker,
        40,
        START_NS + 2 * S,
        lambda each: DetectionList(
            each.sensor, each.stamp_ns, each.receipt_ns, [Detection()]
        ),
    )
    assert any("failed or invalid" in one for one in tracker.health().reasons)


@pytest.mark.parametrize("back_ns", [5 * S, 3600 * S])
def test_a_clock_that_was_set_back_ends_the_tracks_and_new_ones_start(
    back_ns: int,
) -> None:
    tracker = made()
    before = drive(tracker)[-1]
    assert len(before.tracks) == 1
    after = drive(tracker, 50, START_NS + 100 * 20 * MS - back_ns)
    assert [len(each.tracks) for each in after[:2]] == [1, 1]  # of the last tick
    assert after[1].now_ns == before.now_ns
    [track] = after[-1].tracks
    assert track.track_id > before.tracks[0].track_id
    assert [each.tick for each in after[2:4]] == [before.tick + 1, before.tick + 2]
    assert tracker.refused["clock was set back, tracks ended"] == 1
    assert sum(map(sum, (each.values() for each in tracker.counts.values()))) == 150
    assert tracker.health(HealthLimits(missed_share=1.0)).state is HealthState.OK
    assert tracker.timing.deadline_misses <= 150


def test_a_tick_far_ahead_of_the_others_costs_three_ticks() -> None:
    tracker = made()
    drive(tracker)
    tracker.tick(START_NS + 3600 * S)
    after = drive(tracker, 50, START_NS + 100 * 20 * MS)
    assert len(after[-1].tracks) == 1
    assert tracker.refused["tick before the last one"] == 2


def test_early_ticks_that_are_rare_or_hardly_early_end_no_track() -> None:
    tracker = made()
    [before] = drive(tracker)[-1].tracks
    end_ns = START_NS + 100 * 20 * MS
    for k in range(10):
        tracker.tick(end_ns - 10 * S)
        tracker.tick(end_ns - 10 * S)
        tracker.tick(end_ns + k * 20 * MS)
    for _ in range(20):
        tracker.tick(end_ns - S // 2)
    [after] = drive(tracker, 20, end_ns + 200 * MS)[-1].tracks
    assert after.track_id == before.track_id
    assert tracker.refused == {"tick before the last one": 40}


def test_messages_of_the_time_before_the_clock_was_set_back_are_refused() -> None:
    tracker = made()
    drive(tracker)
    old_ns = START_NS + 2 * S
    car = [Detection(x_m=20.0, y_m=2.0)]
    for k in range(3):
        tracker.receive(DetectionList("lidar", old_ns, old_ns, car))
        tracker.tick(START_NS - 60 * S + k * 20 * MS)
    assert tracker.refused["received before the clock was set back"] == 3
    assert tracker.counts["lidar"]["invalid"] == 3


def bits(reports: list[TickReport]) -> list[object]:
    return [
        (report.tick, each.track_id, each.state.mean.tobytes(), each.state.stamp_ns)
        for report in reports
        for each in report.tracks
    ]


@pytest.mark.parametrize("name", ["ekf-replay", "smoother-banded"])
def test_a_copy_of_a_tracker_goes_on_with_the_same_bits_and_apart(name: str) -> None:
    tracker = made(estimator=name)
    drive(tracker, 60)
    tracker.receive(EgoState(START_NS, START_NS, 0.0, 0.0, 0.0, 0.0))
    end_ns = START_NS + 60 * 20 * MS
    copies = [copy.deepcopy(tracker), pickle.loads(pickle.dumps(tracker))]
    health = tracker.health()
    expected = bits(drive(tracker, 30, end_ns, seed=1))
    assert len(expected) == 30
    for each in copies:
        assert each.health() == health
        assert bits(drive(each, 30, end_ns, seed=1)) == expected
        assert each.counts == tracker.counts

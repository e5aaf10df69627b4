"""Revisions in live reports, the time until a state is final, and revisions in the health."""

import copy
from typing import Any

import numpy as np
import pytest

from fgtrack.core.types import Detection, DetectionList, Revision, TickReport
from fgtrack.pipeline.health import Revised
from fgtrack.pipeline.live import Tracker

MS, S = 1_000_000, 1_000_000_000
STORAGE_S = 1.0
NUM_TICKS = 30


def made(kind: str, estimator: str = "ekf-replay") -> Tracker:
    return Tracker(
        estimator=estimator,
        set={
            "association": {"kind": kind},
            "sensors": {
                name: {"std": {"x_m": 0.5, "y_m": 0.5}, "clutter_per_m2": 1e-3}
                for name in ("lidar", "radar")
            },
            "motion": {"kind": "cv", "std_per_s": {"velocity": 3.0}},
            "filter": {"storage_s": STORAGE_S},
            "smoother": {"lag_s": STORAGE_S},
        },
    )


def drive(tracker: Tracker) -> list[TickReport]:
    """Ticks of 50 ms. Two cars cross in clutter; the LiDAR comes 0.3 s late, the RADAR at once."""
    rng, reports = np.random.default_rng(3), []
    messages = []
    for k in range(NUM_TICKS):
        for sensor, delay_ns in (("lidar", 300 * MS), ("radar", 0)):
            points = [(0.5 * k, 0.06 * k), (0.5 * k, 3.0 - 0.06 * k)]
            seen = [np.array(each) + 0.5 * rng.standard_normal(2) for each in points]
            seen += list(rng.uniform((-5.0, -5.0), (20.0, 10.0), (3, 2)))
            objects = [
                Detection(x_m=float(x), y_m=float(y))
                for x, y in seen
                if rng.random() < 0.8
            ]
            stamp_ns = S + k * 50 * MS
            receipt_ns = stamp_ns + delay_ns
            messages.append(
                DetectionList(sensor, stamp_ns, receipt_ns, objects, frame="map")
            )
    for k in range(NUM_TICKS):
        now_ns = S + k * 50 * MS
        for message in messages:
            if now_ns - 50 * MS < message.receipt_ns <= now_ns:
                tracker.receive(message)
        reports.append(tracker.tick(now_ns))
    return reports


@pytest.fixture(scope="module")
def driven() -> tuple[Tracker, list[TickReport]]:
    tracker = made("hypotheses")
    return tracker, drive(tracker)


def all_revisions(reports: list[TickReport]) -> list[Revision]:
    return [each for report in reports for each in report.revisions]


def test_a_report_carries_the_decisions_that_late_data_has_changed(
    driven: tuple[Tracker, list[TickReport]],
) -> None:
    _, reports = driven
    assert all_revisions(reports), "the scene has none, so this test shows nothing"
    at: dict[Any, int | None] = {}
    for report in reports:
        for record in report.updates:
            at[record.sensor, record.stamp_ns, record.index] = record.track_id
        for each in report.revisions:
            key = each.sensor, each.stamp_ns, each.index
            assert each.tick == report.tick
            assert each.receipt_ns <= report.now_ns
            assert each.old_track_id == at[key], "a change begins where the last ended"
            at[key] = each.track_id


def test_a_refused_tick_repeats_no_revisions(
    driven: tuple[Tracker, list[TickReport]],
) -> None:
    tracker, reports = driven
    again = tracker.tick(reports[-1].now_ns - MS)
    assert again.revisions == ()


def test_a_tracker_that_decides_once_has_no_revisions() -> None:
    tracker = made("mahalanobis")
    assert all_revisions(drive(tracker)) == []
    assert tracker.health().revised.changes == 0


def test_the_health_has_the_revisions_of_the_last_minute(
    driven: tuple[Tracker, list[TickReport]],
) -> None:
    tracker, reports = copy.deepcopy(driven)
    count = len(all_revisions(reports))
    detections = sum(len(report.updates) for report in reports)
    assert tracker.health().revised == Revised(count, detections)
    assert tracker.health().revised.share == pytest.approx(count / detections)
    tracker.tick(reports[-1].now_ns + 59 * S)
    assert 0 < tracker.health().revised.detections < detections
    tracker.tick(reports[-1].now_ns + 60 * S)
    assert tracker.health().revised == Revised(0, 0)
    assert tracker.health().revised.share == 0.0


def test_a_checkpoint_keeps_the_revisions_of_the_last_minute(
    driven: tuple[Tracker, list[TickReport]],
) -> None:
    tracker, _ = driven
    other = made("hypotheses")
    other.restore(tracker.checkpoint())
    assert other.health().revised == tracker.health().revised


@pytest.mark.parametrize(
    ("kind", "estimator"),
    [("mahalanobis", "ekf-replay"), ("hypotheses", "smoother-banded")],
)
def test_a_state_is_open_until_its_stamp_has_left_the_window(
    kind: str, estimator: str
) -> None:
    tracker = made(kind, estimator)
    *_, report = drive(tracker)
    assert report.tracks
    # The window of a smoother includes the stored states behind it.
    reach_ns = round(tracker.config.effective.reach_s * S)
    for ago_ns in (0, 200 * MS, round(STORAGE_S * S)):
        stamp_ns = report.now_ns - ago_ns
        tracks = tracker.tracks_at(stamp_ns)
        assert tracks, "there is nothing to check"
        for each in tracks:
            assert not each.is_final
            assert each.open_until_ns == stamp_ns + reach_ns
    assert {each.open_until_ns for each in report.tracks} == {report.now_ns + reach_ns}

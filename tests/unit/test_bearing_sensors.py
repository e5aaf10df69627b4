"""A direction alone is no object: what sensors without a range may do to a track, and what not."""

from dataclasses import replace

import numpy as np
import pytest
from support.tracking import START_NS, ms

from fgtrack.core.types import Detection, DetectionList, Disposition, EgoState, TickReport, TrackStatus
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.config import Config, CountingConfig, MotionConfig
from fgtrack.tracking.association import GatedEuclidean
from fgtrack.tracking.birth import MeasuredBirth
from fgtrack.tracking.existence import ExistenceRules
from fgtrack.tracking.lifecycle import LifecycleRules
from fgtrack.tracking.tracker import Tracker

AT_M = np.array([40.0, 10.0])
LIVES: list[LifecycleRules | ExistenceRules] = [
    CountingConfig(forget_s=2.0, confirm_count=3),
    CountingConfig(kind="published", forget_s=2.0, confirm_count=3),
    ExistenceRules(lifetime_s=2.0, out_of_view_s=1e6),
]
SENSORS = {"lidar": SensorModel(std={"x_m": 0.3, "y_m": 0.3}), "camera": SensorModel(std={"bearing_rad": 0.01})}


def tracker(lifecycle, estimator: str = "ekf-replay") -> Tracker:
    motion = MotionConfig("cv", {"velocity": 1.0})
    association = GatedEuclidean(gate_m=5.0)
    birth = MeasuredBirth(ego_speed_factor=0.0)
    config = Config(estimator, sensors=SENSORS, lifecycle=lifecycle, association=association, birth=birth)
    return build_tracker(replace(config, motion=motion if estimator != "ekf-backward-forward" else config.motion))


def look(tracker: Tracker, sensor: str, at_ms: float) -> TickReport:
    """What the tracker makes of a list with one detection of the object, which stands still."""
    now_ns = START_NS + ms(at_ms)
    tracker.receive(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
    bearing_rad = float(np.arctan2(AT_M[1], AT_M[0] + 1.74))  # from the origin of the detections
    seen = Detection(x_m=AT_M[0], y_m=AT_M[1]) if sensor == "lidar" else Detection(bearing_rad=bearing_rad)
    tracker.receive(DetectionList(sensor, now_ns, now_ns, [seen], "map" if sensor == "lidar" else "ego"))
    return tracker.tick(now_ns)


@pytest.mark.parametrize("lifecycle", LIVES, ids=["counting", "published", "existence"])
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_bearing_alone_starts_no_track(lifecycle, estimator: str) -> None:
    one = tracker(lifecycle, estimator)
    for k in range(5):
        report = look(one, "camera", 100.0 * k)
        assert report.tracks == ()
        assert [update.disposition for update in report.updates] == [Disposition.GATED]


@pytest.mark.parametrize("lifecycle", LIVES, ids=["counting", "published", "existence"])
def test_bearings_alone_do_not_confirm_a_track(lifecycle) -> None:
    one = tracker(lifecycle)
    look(one, "lidar", 0.0)
    for k in range(1, 9):
        (track,) = look(one, "camera", 50.0 * k).tracks
        assert (track.status, track.num_measured) == (TrackStatus.TENTATIVE, 1 + k)
    for k in range(9, 12):
        (track,) = look(one, "lidar", 50.0 * k).tracks
    assert track.status is TrackStatus.CONFIRMED


@pytest.mark.parametrize("lifecycle", [LIVES[0], LIVES[2]], ids=["counting", "existence"])
def test_bearings_alone_do_not_keep_a_track_for_ever(lifecycle) -> None:
    one = tracker(lifecycle)
    for k in range(10):
        (track,) = look(one, "lidar", 100.0 * k).tracks
    assert track.status is TrackStatus.CONFIRMED
    lived_s = next(0.1 * k for k in range(10, 1000) if not look(one, "camera", 100.0 * k).tracks)
    assert 2.0 < lived_s < 40.0


@pytest.mark.parametrize("lifecycle", LIVES, ids=["counting", "published", "existence"])
def test_a_camera_that_does_not_see_a_track_does_not_end_it(lifecycle) -> None:
    one = tracker(lifecycle)
    look(one, "lidar", 0.0)
    for k in range(1, 60):
        now_ns = START_NS + ms(20.0 * k)
        one.receive(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        one.receive(DetectionList("camera", now_ns, now_ns, (), "ego"))
        assert len(one.tick(now_ns).tracks) == 1

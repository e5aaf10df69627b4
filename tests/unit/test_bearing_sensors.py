"""A direction alone is no object: what sensors without a range may do to a track, and what not."""

import numpy as np
import pytest
from support.tracking import START_NS, ms

from fgtrack.config.motion import MotionConfig
from fgtrack.config.settings import Config
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    TickReport,
    TrackStatus,
)
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.models.sensors import Correlation, SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.tracking.association import GatedEuclidean
from fgtrack.tracking.birth import Birth
from fgtrack.tracking.lives.counters import LifecycleRules
from fgtrack.tracking.lives.existence import ExistenceRules
from fgtrack.tracking.tracker import MultiObjectTracker

AT_M = np.array([40.0, 10.0])
LIVES: list[LifecycleRules | ExistenceRules] = [
    LifecycleRules(forget_s=2.0, confirm_count=3),
    LifecycleRules(kind="published", forget_s=2.0, confirm_count=3),
    ExistenceRules(lifetime_s=2.0, out_of_view_s=1e6),
]
SENSORS = {
    "lidar": SensorModel(std={"x_m": 0.3, "y_m": 0.3}),
    "camera": SensorModel(std={"bearing_rad": 0.01}),
}


def tracker(
    lifecycle, estimator: str = "ekf-replay", camera: SensorModel = SENSORS["camera"]
) -> MultiObjectTracker:
    motion = (
        Config().motion
        if estimator == "ekf-backward-forward"
        else MotionConfig("cv", {"velocity": 1.0})
    )
    config = Config(
        estimator,
        sensors={**SENSORS, "camera": camera},
        lifecycle=lifecycle,
        association=GatedEuclidean(gate_m=5.0),
        birth=Birth(ego_speed_factor=0.0, speed_std_mps=2.0),
        motion=motion,
    )
    return build_tracker(config)


def look(tracker: MultiObjectTracker, sensor: str, at_ms: float) -> TickReport:
    """What the tracker makes of a list with one detection of the object, which stands still."""
    now_ns = START_NS + ms(at_ms)
    tracker.receive(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
    bearing_rad = float(np.arctan2(AT_M[1], AT_M[0]))
    seen = (
        Detection(x_m=AT_M[0], y_m=AT_M[1])
        if sensor == "lidar"
        else Detection(bearing_rad=bearing_rad)
    )
    tracker.receive(
        DetectionList(
            sensor, now_ns, now_ns, [seen], "map" if sensor == "lidar" else "ego"
        )
    )
    return tracker.tick(now_ns)


@pytest.mark.parametrize("lifecycle", LIVES, ids=["counting", "published", "existence"])
@pytest.mark.parametrize("estimator", list(ESTIMATORS))
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


@pytest.mark.parametrize(
    "lifecycle", [LIVES[0], LIVES[2]], ids=["counting", "existence"]
)
def test_bearings_alone_do_not_keep_a_track_for_ever(lifecycle) -> None:
    one = tracker(lifecycle)
    for k in range(10):
        (track,) = look(one, "lidar", 100.0 * k).tracks
    assert track.status is TrackStatus.CONFIRMED
    lived_s = next(
        0.1 * k for k in range(10, 1000) if not look(one, "camera", 100.0 * k).tracks
    )
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


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_a_bias_that_is_a_state_pulls_no_track_and_is_found_whatever_arrives_first(
    estimator: str,
) -> None:
    """Bearings that are wrong by 2 m at the object, for good; half of them overtake the positions."""
    bias_rad, std_rad, errors_m, innovations = 0.05, 0.05, {}, []
    for name, correlation in (
        ("white", None),
        ("lasting", Correlation(share=0.99, time_s=100.0)),
    ):
        white_rad = std_rad * 0.1  # what of the error is new in every detection
        camera = SensorModel(
            std={"bearing_rad": std_rad if correlation else white_rad},
            correlation=correlation,
        )
        one = tracker(LIVES[0], estimator, camera)
        rng = np.random.default_rng(3)
        for k in range(100):
            now_ns = START_NS + ms(100.0 * k)
            one.receive(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
            if k % 5 == 2:  # 150 ms late
                x_m, y_m = AT_M + 0.3 * rng.standard_normal(2)
                late_ns = now_ns - ms(150.0)
                one.receive(
                    DetectionList(
                        "lidar", late_ns, now_ns, [Detection(x_m=x_m, y_m=y_m)], "map"
                    )
                )
            bearing_rad = (
                float(np.arctan2(AT_M[1], AT_M[0]))
                + bias_rad
                + white_rad * rng.standard_normal()
            )
            one.receive(
                DetectionList(
                    "camera",
                    now_ns,
                    now_ns,
                    [Detection(bearing_rad=bearing_rad)],
                    "ego",
                )
            )
            report = one.tick(now_ns)
            innovations += [
                each.innovation
                for each in report.updates
                if correlation and each.sensor == "camera"
            ]
        (track,) = report.tracks
        errors_m[name] = float(np.hypot(track.x_m - AT_M[0], track.y_m - AT_M[1]))
    assert errors_m["white"] > 0.8
    assert errors_m["lasting"] < 0.3
    last_rad = [each["bearing_rad"] for each in innovations[-30:]]
    assert abs(np.mean(last_rad)) < 0.2 * bias_rad

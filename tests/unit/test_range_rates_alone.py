"""A sensor may measure range rates alone: they update the tracks that other sensors have started."""

import math

import numpy as np
import pytest
from support.tracking import START_NS, ms

from fgtrack.config.settings import Config
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    TickReport,
)
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.tracking.association import GatedEuclidean, GatedMahalanobis
from fgtrack.tracking.tracker import MultiObjectTracker

SENSORS = {
    "lidar": SensorModel(std={"x_m": 0.5, "y_m": 0.5}),
    "doppler": SensorModel(std={"range_rate_mps": 0.1}),
}
#: Position in m and velocity in m/s at the start of two objects; the ego is at rest at the origin.
OBJECTS = ((40.0, 10.0, 12.0, 0.0), (30.0, -20.0, -8.0, 3.0))


ESTIMATORS = (
    "ekf-backward-forward",
    "ekf-replay",
    "imm-replay",
    "rts",
    "smoother",
    "smoother-banded",
    "smoother-batch",
    "ukf-replay",
)


def tracker(
    estimator: str, association: GatedEuclidean | GatedMahalanobis | None = None
) -> MultiObjectTracker:
    own = association or GatedMahalanobis()
    return build_tracker(Config(estimator, sensors=SENSORS, association=own))


def look(one: MultiObjectTracker, sensor: str, at_ms: float) -> TickReport:
    """What the tracker makes of a list with a detection of each object, in reversed order from the Doppler sensor."""
    now_ns, at_s = START_NS + ms(at_ms), 1e-3 * at_ms
    covariance = tuple(np.diag([0.01, 0.01, 1e-4, 0.01, 1e-4]).ravel().tolist())
    one.receive(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0, covariance=covariance))
    seen = []
    for x_m, y_m, vx_mps, vy_mps in OBJECTS:
        x_m, y_m = x_m + at_s * vx_mps, y_m + at_s * vy_mps
        if sensor == "lidar":
            seen.append(Detection(x_m=x_m, y_m=y_m))
        else:
            rate_mps = (x_m * vx_mps + y_m * vy_mps) / math.hypot(x_m, y_m)
            seen.insert(0, Detection(range_rate_mps=rate_mps))
    one.receive(DetectionList(sensor, now_ns, now_ns, seen, "ego"))
    return one.tick(now_ns)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_range_rate_alone_starts_no_track(estimator: str) -> None:
    report = look(tracker(estimator), "doppler", 0.0)
    assert report.tracks == ()
    assert [each.disposition for each in report.updates] == [Disposition.GATED] * 2


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_range_rates_alone_update_the_tracks_that_they_fit(estimator: str) -> None:
    one = tracker(estimator)
    for k in range(10):
        look(one, "lidar", 100.0 * k)
    before = {each.track_id: each for each in look(one, "lidar", 1000.0).tracks}
    report = look(one, "doppler", 1001.0)
    assert [each.disposition for each in report.updates] == [
        Disposition.IN_SEQUENCE
    ] * 2
    own = {each.index: each.track_id for each in report.updates}
    xs_m = [before[own[index]].x_m for index in (1, 0)]
    np.testing.assert_allclose(xs_m, [52.0, 22.0], atol=1.0)
    for track in report.tracks:
        assert track.covariance[3, 3] < 0.9 * before[track.track_id].covariance[3, 3]


def test_without_a_direction_no_distance_assigns_a_detection() -> None:
    one = tracker("ekf-replay", GatedEuclidean(gate_m=1e3))
    for k in range(5):
        look(one, "lidar", 100.0 * k)
    report = look(one, "doppler", 401.0)
    assert {each.disposition for each in report.updates} == {Disposition.GATED}

"""Objects at rest: the published state lies within its covariance, for any time and estimator."""

import math

import numpy as np
import pytest
from support.cases import each_once

import fgtrack
from fgtrack.core.types import FloatArray

NS_PER_S = 10**9
#: Noise of the default configuration: position, yaw or velocity, speed, and yaw rate.
POLAR = fgtrack.CTRV(0.0009, 0.0001, 2.25, 0.04)
CARTESIAN = fgtrack.CT(0.0009, 2.25, 0.04)
PUBLISHED = {"ekf-backward-forward", "rewind-forget"}
NAMES = [name for name in fgtrack.list_estimators() if name not in PUBLISHED]
FAST = ["ekf-replay", "imm-replay", "ukf-replay", "smoother-banded", "smoother"]


def parked(
    name: str,
    motion: fgtrack.MotionModel,
    duration_s: float,
    rate_hz: float,
    std_m: float,
    seed: int,
    yaw_std: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """States (m, 5) and covariances (m, 5, 5), from 5 s on, of an object that stands at the origin with yaw 0."""
    rng = np.random.default_rng(seed)
    start = fgtrack.Start(
        position_m=tuple(rng.normal(0.0, std_m, 2)),
        position_std_m=std_m,
        speed_std_mps=10.0,
        yaw_rate_std_radps=0.5,
    )
    one, means, covariances = fgtrack.estimator(name, motion, start), [], []
    for k in range(1, round(duration_s * rate_hz) + 1):
        stamp_ns = round(k / rate_hz * NS_PER_S)
        values = dict(zip(("x_m", "y_m"), rng.normal(0.0, std_m, 2), strict=True))
        stds = {"x_m": std_m, "y_m": std_m}
        if yaw_std:
            values["yaw_rad"], stds["yaw_rad"] = rng.normal(0.0, yaw_std), yaw_std
        one.update(fgtrack.Measurement.of(stamp_ns, **values, std=stds))
        one.advance(stamp_ns)
        if k / rate_hz > 5.0:
            state = one.state_at(stamp_ns)
            mean, covariance = motion.published(state.mean, state.covariance)
            means.append(mean[:5])
            covariances.append(covariance[:5, :5])
    return np.array(means), np.array(covariances)


def assert_within(means: FloatArray, covariances: FloatArray) -> None:
    """95 % of yaw rate and heading error are within 2.5 and 3 standard deviations; the yaw rate is small."""
    stds = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    yaw_errors = np.abs((means[:, 2] + math.pi) % math.tau - math.pi)
    assert np.median(np.abs(means[:, 4])) < 0.3
    assert np.quantile(np.abs(means[:, 4]) / stds[:, 4], 0.95) < 2.5
    assert np.quantile(yaw_errors / stds[:, 2], 0.95) < 3.0
    nees = np.einsum(
        "ki,kij,kj->k",
        means[:, :2],
        np.linalg.inv(covariances[:, :2, :2]),
        means[:, :2],
    )
    assert np.mean(nees) < 3.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "motion"), each_once(FAST, [POLAR, CARTESIAN]), ids=str
)
def test_a_parked_object_seen_by_positions_does_not_turn(
    name: str, motion: fgtrack.MotionModel
) -> None:
    runs = [parked(name, motion, 60.0, 10.0, 0.3, seed) for seed in range(2)]
    assert_within(*map(np.concatenate, zip(*runs, strict=True)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate_hz", "std_m"),
    [(10.0, 0.3), (2.0, 0.1), (25.0, 0.1), (25.0, 2.0), (2.0, 2.0)],
)
@pytest.mark.parametrize("motion", [POLAR, CARTESIAN], ids=["ctrv", "ct"])
@pytest.mark.parametrize("name", NAMES)
def test_a_parked_object_does_not_turn_for_ten_minutes(
    name: str, motion: fgtrack.MotionModel, rate_hz: float, std_m: float
) -> None:
    assert_within(*parked(name, motion, 600.0, rate_hz, std_m, 1))


@pytest.mark.long
@pytest.mark.parametrize("name", FAST)
def test_a_parked_object_with_a_measured_yaw_keeps_it(name: str) -> None:
    means, covariances = parked(name, POLAR, 60.0, 10.0, 0.3, 2, yaw_std=0.1)
    assert_within(means, covariances)
    assert np.sqrt(np.mean(np.square(means[:, 2]))) < 0.1


def tracks_of_car(
    estimator: str, sensor: dict[str, object], rests_s: float, seed: int
) -> tuple[set[int], set[int]]:
    """Track ids before and after a car drives off at 3 m/s^2 in any direction, which confirmed tracks near it have."""
    rng = np.random.default_rng(seed)
    components = list(sensor["std"])  # type: ignore[call-overload]
    tracker = fgtrack.Tracker(
        fgtrack.Config().replace({"estimator": estimator, "sensors": {"radar": sensor}})
    )
    heading = rng.uniform(-math.pi, math.pi)
    before, after = set[int](), set[int]()
    for k in range(round((rests_s + 3.0) * 10.0)):
        stamp_ns = (1000 * 10 + k) * NS_PER_S // 10
        driven_m = 1.5 * max(0.1 * k - rests_s, 0.0) ** 2
        speed_mps = 3.0 * max(0.1 * k - rests_s, 0.0)
        x_m, y_m = (
            30.0 + driven_m * math.cos(heading),
            20.0 + driven_m * math.sin(heading),
        )
        range_m, bearing_rad = math.hypot(x_m, y_m), math.atan2(y_m, x_m)
        exact = {
            "x_m": x_m,
            "y_m": y_m,
            "yaw_rad": heading,
            "range_m": range_m,
            "bearing_rad": bearing_rad,
            "range_rate_mps": speed_mps * math.cos(heading - bearing_rad),
        }
        values = {
            name: exact[name] + rng.normal(0.0, sensor["std"][name])
            for name in components
        }  # type: ignore[index]
        tracker.receive(fgtrack.EgoState(stamp_ns, stamp_ns, 0.0, 0.0, 0.0, 0.0))
        objects = [fgtrack.Detection(**values)]
        tracker.receive(
            fgtrack.DetectionList(
                "radar", stamp_ns, stamp_ns + 20_000_000, objects, frame="ego"
            )
        )
        report = tracker.tick(stamp_ns + 20_000_000)
        near = [
            track.track_id
            for track in report.tracks
            if track.status != "tentative"
            and math.hypot(track.x_m - x_m, track.y_m - y_m) < 3.0
        ]
        if 0.1 * k > rests_s - 2.0:
            (before if driven_m == 0.0 else after).update(near)
    return before, after


SENSORS: dict[str, dict[str, object]] = {
    "positions": {"std": {"x_m": 0.3, "y_m": 0.3}},
    "yaw": {"std": {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1}},
    "Doppler": {"std": {"range_m": 0.3, "bearing_rad": 0.01, "range_rate_mps": 0.2}},
}


@pytest.mark.long
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_a_car_that_drives_off_keeps_its_identity(estimator: str, sensor: str) -> None:
    for seed in range(5):
        before, after = tracks_of_car(estimator, SENSORS[sensor], 6.0, seed)
        assert before == after
        assert len(before) == 1


@pytest.mark.slow
@pytest.mark.parametrize("rests_s", [5.0, 120.0, 600.0])
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded", "imm-replay"])
def test_a_car_that_stood_for_long_keeps_its_identity(
    estimator: str, sensor: str, rests_s: float
) -> None:
    for seed in range(20 if rests_s < 60.0 else 5):
        before, after = tracks_of_car(estimator, SENSORS[sensor], rests_s, seed)
        assert before == after
        assert len(before) == 1


def test_the_motion_has_a_heading_where_a_sensor_measures_one() -> None:
    config = fgtrack.Config().replace({"sensors": {"radar": SENSORS["positions"]}})
    assert isinstance(config.motion_model(), fgtrack.CT)
    both = config.replace(
        {"sensors": {"radar": SENSORS["positions"], "lidar": SENSORS["yaw"]}}
    )
    assert isinstance(both.motion_model(), fgtrack.CTRV)
    assert isinstance(
        both.replace({"ignore_sensors": ["lidar"]}).motion_model(), fgtrack.CT
    )
    assert isinstance(
        config.replace({"motion.kind": "ctrv"}).motion_model(), fgtrack.CTRV
    )

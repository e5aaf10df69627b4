"""Errors of a sensor that last: their states, and that the estimators are consistent with them."""

from dataclasses import replace

import numpy as np
import pytest

from fgtrack.core.time import NS_PER_S
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import correct_one
from fgtrack.estimation.registry import estimator
from fgtrack.models.correlated_errors import (
    CorrelatedErrors,
    position_cross,
    split_error,
    total_error,
    with_correlated_errors,
)
from fgtrack.models.measurement import SensorPose, measured_position, measurement_model
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import Correlation, SensorModel
from fgtrack.testing import check_motion_model
from fgtrack.tracking.birth import Birth
from fgtrack.tracking.preprocess import Candidate

WHITE = SensorModel({"x_m": 1.0, "y_m": 1.0})
CAMERA = SensorModel({"bearing_rad": 0.02}, correlation=Correlation(0.8, 2.0))
LIDAR = SensorModel(
    {"x_m": 0.5, "y_m": 0.5, "yaw_rad": 0.1}, correlation=Correlation(0.5, 1.0)
)
SENSORS = {"white": WHITE, "camera": CAMERA, "lidar": LIDAR}


@pytest.mark.parametrize(
    "base", [CTRV(), CTRA(), CV()], ids=lambda base: type(base).__name__
)
def test_it_keeps_the_contract_of_a_motion_model(base: MotionModel) -> None:
    check_motion_model(with_correlated_errors(base, SENSORS))


def test_there_is_a_state_for_every_component_of_a_sensor_whose_errors_last() -> None:
    motion = with_correlated_errors(CTRV(), SENSORS)
    added = "camera.bearing_rad", "lidar.x_m", "lidar.y_m", "lidar.yaw_rad"
    assert motion.state_names == (*CTRV.state_names, *added)
    assert (motion.dim, motion.linear) == (9, False)
    assert with_correlated_errors(CV(), SENSORS).linear
    assert with_correlated_errors(CTRV(), {"white": WHITE}) == CTRV()


def test_an_error_is_stationary_and_falls_to_its_e_th_part_after_its_time() -> None:
    motion = CorrelatedErrors(CV(), (("a.x_m", 2.0), ("a.y_m", 0.5)))
    F, Q = motion.jacobian(np.zeros(6), 2.0), motion.process_noise(np.zeros(6), 2.0)
    assert np.diag(F)[4:] == pytest.approx([np.exp(-1.0), np.exp(-4.0)])
    assert np.diag(F @ np.eye(6) @ F.T + Q)[4:] == pytest.approx([1.0, 1.0])
    assert not Q[:4, 4:].any()
    assert [motion.start_variance(name) for name in motion.state_names[4:]] == [
        1.0,
        1.0,
    ]


@pytest.mark.parametrize("name", ["camera", "lidar"])
def test_one_detection_is_as_uncertain_as_its_covariance_says(name: str) -> None:
    sensor, motion = SENSORS[name], with_correlated_errors(CTRV(), SENSORS)
    x = np.array([30.0, 10.0, 0.3, 5.0, 0.1, 0.7, -0.4, 0.2, 1.1])
    plain, pose = (
        measurement_model(sensor.components, motion),
        SensorPose(1.0, 2.0, 0.2),
    )
    k = len(sensor.components)
    R = np.diag([0.04, 0.09, 0.01])[:k, :k] + (0.01 if k > 1 else 0.0)
    model, white = split_error(name, sensor, plain, R, motion.state_names)
    H = model.jacobian(x, pose)
    assert H[:, 5:] @ H[:, 5:].T + white == pytest.approx(R)
    assert total_error(model, white) == pytest.approx(R)
    assert white == pytest.approx((1.0 - sensor.correlation.share) * R)  # type: ignore[union-attr]  # both have one
    assert model.predict(x, pose) == pytest.approx(
        plain.predict(x, pose) + H[:, 5:] @ x[5:]
    )
    numeric = np.stack(
        [
            (model.predict(x + d, pose) - model.predict(x - d, pose)) / 2e-6
            for d in 1e-6 * np.eye(9)
        ]
    ).T
    np.testing.assert_allclose(H, numeric, atol=1e-7)
    assert model.linear == (name == "lidar")
    assert H.flags.writeable == (name == "camera")  # that of a linear model is shared


def nees(name: str, modelled: bool, lag_s: float, num_runs: int = 40) -> float:
    """NEES of the position `lag_s` ago of an object with positions whose errors last for a second."""
    correlation, step_s, found = Correlation(0.8, 1.0), 0.1, []
    sensor = SensorModel({"x_m": 1.0, "y_m": 1.0}, correlation=correlation)
    base = CV(velocity_density_m2ps3=0.5)
    motion = with_correlated_errors(base, {"lidar": sensor}) if modelled else base
    rng = np.random.default_rng(5)
    for _ in range(num_runs):
        x = np.array([0.0, 0.0, 5.0, 0.0])
        start = x + np.sqrt([100.0, 100.0, 4.0, 4.0]) * rng.standard_normal(4)
        first = Start(
            position_m=start[:2],
            position_std_m=10.0,
            yaw_rad=0.0,
            speed_mps=0.0,
            speed_std_mps=10.0,
        )
        one = estimator(name, motion, first, lag_s=2.0)
        e, states = rng.standard_normal(2), []
        for k in range(1, 31):
            x = base.predict(x, step_s) + rng.multivariate_normal(
                np.zeros(4), base.process_noise(x, step_s)
            )
            decay = np.exp(-step_s / correlation.time_s)
            e = decay * e + np.sqrt(1.0 - decay**2) * rng.standard_normal(2)
            share = correlation.share
            z = (
                x[:2]
                + np.sqrt(share) * e
                + np.sqrt(1.0 - share) * rng.standard_normal(2)
            )
            model, R = measurement_model(("x_m", "y_m"), motion), np.eye(2)
            if modelled:
                model, R = split_error("lidar", sensor, model, R, motion.state_names)
            states.append(x)
            one.update(Measurement(round(k * step_s * NS_PER_S), model, z, R))
        behind = round(lag_s / step_s)
        state = one.state_at(round((30 - behind) * step_s * NS_PER_S))
        d = state.mean[:2] - states[-1 - behind][:2]
        found.append(float(d @ np.linalg.solve(state.covariance[:2, :2], d)))
    return float(np.mean(found))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf-replay", "smoother", "smoother-banded"])
@pytest.mark.parametrize("lag_s", [0.0, 0.5])
def test_estimators_are_consistent_where_the_errors_have_a_state(
    name: str, lag_s: float
) -> None:
    """The mean of 40 values of chi-square 2 has a standard deviation of 2 / sqrt(40) = 0.32."""
    assert abs(nees(name, True, lag_s) - 2.0) < 0.95


@pytest.mark.slow
def test_without_it_a_smoother_believes_its_past_too_much() -> None:
    assert nees("smoother", False, 0.5) > 5.0


def test_both_estimators_agree_where_all_is_linear() -> None:
    assert nees("ekf-replay", True, 0.0, 3) == pytest.approx(
        nees("smoother", True, 0.0, 3), rel=1e-6
    )


@pytest.mark.parametrize("seen", ["x_m", "range_m"])
def test_an_object_that_begins_where_a_detection_is_knows_that_it_shares_its_error(
    seen: str,
) -> None:
    """The same as an object of which nothing was known before that detection."""
    std = (
        {"x_m": 1.0, "y_m": 2.0}
        if seen == "x_m"
        else {"range_m": 1.0, "bearing_rad": 0.01}
    )
    sensor = SensorModel(std, correlation=Correlation(0.9, 10.0))
    motion, pose = (
        with_correlated_errors(CV(), {"lidar": sensor}),
        SensorPose(3.0, -2.0, 0.4),
    )
    components = sensor.components
    z, R = (
        np.array([40.0, 30.0]) if seen == "x_m" else np.array([50.0, 0.3]),
        sensor.noise(components),
    )
    model, white = split_error(
        "lidar", sensor, measurement_model(components, motion), R, motion.state_names
    )
    first = measured_position(components, z, R, pose)
    assert first is not None
    cross = position_cross(model, z, pose)
    start = Start(
        position_m=first[0],
        position_covariance=first[1],
        position_cross=cross,
        speed_std_mps=2.0,
    )
    _, P = initial_state(motion, start)
    vague = replace(start, position_covariance=np.eye(2) * 1e6, position_cross={})
    x = np.concatenate([first[0], np.zeros(4)])
    _, expected, *_ = correct_one(
        x, initial_state(motion, vague)[1], Measurement(0, model, z, white, pose)
    )
    np.testing.assert_allclose(P, expected, atol=2e-2)
    assert abs(expected[:2, 4:]).max() > 0.5


def test_a_second_detection_at_once_says_only_what_is_new_of_it() -> None:
    cross = {"lidar.x_m": (-(0.9**0.5), 0.0), "lidar.y_m": (0.0, -(0.9**0.5))}
    sensor = SensorModel({"x_m": 1.0, "y_m": 1.0}, correlation=Correlation(0.9, 10.0))
    motion = with_correlated_errors(CV(), {"lidar": sensor})
    plain = measurement_model(("x_m", "y_m"), motion)
    model, white = split_error("lidar", sensor, plain, np.eye(2), motion.state_names)
    for name in ("ekf-replay", "smoother", "smoother-banded"):
        one = estimator(name, motion, Start(position_cross=cross), lag_s=2.0)
        one.update(Measurement(0, model, np.array([1.0, 0.0]), white))
        np.testing.assert_allclose(
            np.diag(one.state_at(0).covariance)[:2], 0.95, rtol=1e-6
        )


def test_the_tracker_gives_a_new_track_the_error_of_its_detection() -> None:
    sensor = SensorModel({"x_m": 1.0, "y_m": 1.0}, correlation=Correlation(0.9, 10.0))
    motion = with_correlated_errors(CV(), {"lidar": sensor})
    model, white = split_error(
        "lidar",
        sensor,
        measurement_model(("x_m", "y_m"), motion),
        np.eye(2),
        motion.state_names,
    )
    z = np.array([3.0, 4.0])
    candidate = Candidate(0, (), Measurement(0, model, z, white), z, np.eye(2))
    measured = Birth().prior(candidate, Road(), None, ego_in_pit=False)
    assert measured is not None
    assert measured.position_cross["lidar.x_m"] == pytest.approx((-(0.9**0.5), 0.0))
    assert measured.position_cross["lidar.y_m"] == pytest.approx((0.0, -(0.9**0.5)))
    fixed = Birth(kind="fixed").prior(candidate, Road(), None, ego_in_pit=False)
    assert fixed is not None
    assert fixed.position_cross == {}


def test_errors_that_last_for_less_than_a_moment_stay_numbers_when_moved_back() -> None:
    short = replace(LIDAR, correlation=Correlation(0.5, 1e-9))
    motion = with_correlated_errors(CTRV(), {"lidar": short})
    x = np.zeros(motion.dim)
    for found in (motion.predict(x, -1.0), motion.jacobian(x, -1.0)):
        assert np.isfinite(found).all()

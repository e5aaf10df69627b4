"""Statistical linear regression by sigma points."""

import numpy as np
import pytest
from support.cases import each_once

from fgtrack.core.geometry import rotation
from fgtrack.core.time import NS_PER_S
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.ukf import (
    DenseRule,
    UkfReplay,
    measurement_regression,
    regression,
)
from fgtrack.estimation.registry import estimator
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRA, CTRV, MotionModel

MEAN = np.array([1.0, -2.0, 0.5])
ROOT = np.array([[0.7, 0.0, 0.0], [0.2, 0.5, 0.0], [-0.1, 0.3, 0.4]])
P = ROOT @ ROOT.T


def test_an_affine_function_is_its_own_regression() -> None:
    A, b = np.array([[1.0, 2.0, -1.0], [0.5, 0.0, 3.0]]), np.array([4.0, -1.0])
    mean, slope, noise = regression(lambda x: x @ A.T + b, MEAN, P)
    np.testing.assert_allclose(mean, A @ MEAN + b, rtol=1e-12)
    np.testing.assert_allclose(slope, A, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(noise, 0.0, atol=1e-20)


def test_a_quadratic_has_its_mean_and_slope_exactly() -> None:
    m, s = 3.0, 0.5  # E[x^2] = m^2 + s^2, Cov(x, x^2) = 2 m s^2
    mean, slope, _ = regression(lambda x: x**2, np.array([m]), np.array([[s * s]]))
    assert mean[0] == pytest.approx(m * m + s * s, rel=1e-9)
    assert slope[0, 0] == pytest.approx(2.0 * m, rel=1e-9)


def test_the_noise_is_that_of_the_cubature_points() -> None:
    def g(x: np.ndarray) -> np.ndarray:
        return x[..., :1] ** 2 + x[..., 1:2] * x[..., 2:]

    points = MEAN + np.sqrt(3.0) * np.vstack([ROOT.T, -ROOT.T])
    mean, slope, noise = regression(g, MEAN, P)
    left = g(points) - mean - (points - MEAN) @ slope.T
    np.testing.assert_allclose(noise, left.T @ left / 6.0, rtol=1e-9)
    assert noise[0, 0] > 0.01


def test_a_narrow_spread_gives_the_derivative() -> None:
    motion, x = CTRV(), np.array([3.0, 1.0, 0.4, 20.0, 0.3])
    mean, slope, _ = regression(
        lambda each: motion.predict(each, 0.2), x, 1e-8 * np.eye(5)
    )
    np.testing.assert_allclose(slope, motion.jacobian(x, 0.2), atol=1e-6)
    np.testing.assert_allclose(mean, motion.predict(x, 0.2), atol=1e-6)


def test_bearings_are_averaged_across_half_a_turn() -> None:
    measurement = Measurement.of(0, bearing_rad=3.1, std={"bearing_rad": 0.1})
    x = np.array([-10.0, 0.0, 0.0, 1.0, 0.0])  # straight behind
    mean, slope, noise = measurement_regression(measurement, x, np.eye(5))
    assert abs(abs(mean[0]) - np.pi) < 1e-9
    np.testing.assert_allclose(slope[0], [0.0, -0.1, 0.0, 0.0, 0.0], atol=0.01)
    assert noise[0, 0] < 1e-3


def test_a_yaw_is_an_entry_of_the_state_however_wide_it_is() -> None:
    measurement = Measurement.of(
        0, yaw_rad=3.0, range_m=9.0, std={"yaw_rad": 0.1, "range_m": 1.0}
    )
    wide = np.diag([1.0, 1.0, 4.0, 1.0, 1.0])
    mean, slope, _ = measurement_regression(
        measurement, np.array([10.0, 0.0, 1.0, 1.0, 0.0]), wide
    )
    np.testing.assert_allclose(slope[0], [0.0, 0.0, 1.0, 0.0, 0.0], atol=1e-12)
    assert mean[0] == pytest.approx(1.0)


def test_a_semidefinite_covariance_is_taken() -> None:
    motion = CTRV()
    assert np.isfinite(
        regression(
            lambda x: motion.predict(x, 0.1), np.zeros(5), np.diag([1.0, 1, 0, 1, 0])
        )[1]
    ).all()
    with pytest.raises(np.linalg.LinAlgError):
        regression(
            lambda x: motion.predict(x, 0.1),
            np.zeros(5),
            np.diag([1.0, 1.0, -1.0, 1.0, 1.0]),
        )


SAMPLES = 200_000
#: Monte-Carlo errors of means and covariances are far below: sqrt(2 / SAMPLES) is 0.003.
NEAR = 0.02


def spread(yaw_std_rad: float, n: int = 5) -> np.ndarray:
    """A covariance with correlations of the yaw with position, speed and yaw rate."""
    P = np.diag([1.0, 1.0, yaw_std_rad**2, 4.0, 0.09, *[1.0] * (n - 5)])
    for row, correlation in ((0, 0.3), (3, -0.5), (4, 0.3)):
        P[row, 2] = P[2, row] = correlation * np.sqrt(P[row, row]) * yaw_std_rad
    return P


def turned(
    covariance: np.ndarray, mean: np.ndarray, angle_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """The same state in a world that is turned round the origin."""
    J = np.eye(len(mean))
    J[:2, :2] = rotation(angle_rad)
    result = J @ mean
    result[2] += angle_rad
    return J @ covariance @ J.T, result


@pytest.mark.parametrize(
    ("motion", "dt_s", "yaw_std_rad"),
    each_once(
        [CTRV(), CTRA()],
        [0.1, 1.0, 3.0],
        [0.1, 0.3, 0.7, 1.0, np.pi / 2, np.pi / np.sqrt(3.0), 3.0, 7.0],
    ),
    ids=lambda value: type(value).__name__ if isinstance(value, MotionModel) else None,
)
def test_a_prediction_has_the_moments_of_the_model_however_wide_the_yaw(
    motion: MotionModel, dt_s: float, yaw_std_rad: float
) -> None:
    mean, P = (
        np.array([3.0, 4.0, 3.0, 10.0, 0.2, 0.5])[: motion.dim],
        spread(yaw_std_rad, motion.dim),
    )
    found = UkfReplay(motion, Start(), 1.0).predict(mean, P, dt_s)
    x = np.random.default_rng(2).multivariate_normal(mean, P, SAMPLES)
    y = motion.predict(x, dt_s)
    apart = y - y.mean(axis=0)
    covariance = apart.T @ apart / SAMPLES + motion.process_noise(x[:5000], dt_s).mean(
        axis=0
    )
    std, before = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(P))
    np.testing.assert_allclose((found.mean - y.mean(axis=0)) / std, 0.0, atol=NEAR)
    np.testing.assert_allclose(
        (found.covariance - covariance) / np.outer(std, std), 0.0, atol=NEAR
    )
    cross = apart.T @ (x - x.mean(axis=0)) / SAMPLES
    np.testing.assert_allclose(
        (found.cross - cross) / np.outer(std, before), 0.0, atol=NEAR
    )


@pytest.mark.parametrize("name", ["ukf-replay", "iplf-replay"])
def test_an_object_of_unknown_heading_spreads_round_its_place(name: str) -> None:
    """At 10 m/s after 1 s it lies on a ring of 10 m: the same in every direction."""
    start = Start(
        yaw_rad=3.0,
        yaw_std_rad=4.0,
        speed_mps=10.0,
        speed_std_mps=1.0,
        position_std_m=1.0,
    )
    state = estimator(name, CTRV(), start).state_at(NS_PER_S)
    np.testing.assert_allclose(state.mean[:2], 0.0, atol=0.1)
    expected = (10.0**2 + 1.0) / 2.0 + 1.0
    np.testing.assert_allclose(np.diag(state.covariance)[:2], expected, rtol=0.02)
    assert abs(state.covariance[0, 1]) < 0.01 * expected


SEEN = (
    ("bearing_rad",),
    ("range_m", "bearing_rad"),
    ("range_m", "bearing_rad", "range_rate_mps"),
)


@pytest.mark.parametrize("seen", SEEN, ids=",".join)
@pytest.mark.parametrize(
    "position_m", [(-30.0, 0.2), (-30.0, -0.2), (-30.0, 0.0), (10.0, 0.0)], ids=str
)
@pytest.mark.parametrize(
    ("along_m", "yaw_std_rad"), [(1.0, 0.2), (1.0, 1.8), (30.0, 0.2), (30.0, 1.8)]
)
def test_a_measurement_has_the_moments_of_its_model_across_half_a_turn(
    seen: tuple[str, ...],
    position_m: tuple[float, float],
    along_m: float,
    yaw_std_rad: float,
) -> None:
    """Where the sensor may lie in the middle of the object's spread, the bearing has a jump: the errors are larger."""
    measurement = Measurement.of(
        0, std=dict.fromkeys(seen, 1.0), **dict.fromkeys(seen, 1.0)
    )
    mean, P = (
        np.array([*position_m, 0.5, 10.0, 0.0]),
        np.diag([along_m**2, 0.25 * along_m**2, yaw_std_rad**2, 4.0, 0.1]),
    )
    z, A, noise = measurement_regression(measurement, mean, P)
    x = np.random.default_rng(4).multivariate_normal(mean, P, SAMPLES)
    y = measurement.model.residual(measurement.model.predict(x), z)
    S = y.T @ y / SAMPLES
    std, before = np.sqrt(np.diag(S)), np.sqrt(np.diag(P))
    tolerance = 0.05 if along_m < 10.0 else 0.08
    np.testing.assert_allclose(y.mean(axis=0) / std, 0.0, atol=tolerance)
    np.testing.assert_allclose(
        (A @ P @ A.T + noise - S) / np.outer(std, std), 0.0, atol=tolerance
    )
    np.testing.assert_allclose(
        (A @ P - y.T @ (x - mean) / SAMPLES) / np.outer(std, before),
        0.0,
        atol=tolerance,
    )


@pytest.mark.parametrize("name", ["ukf-replay", "iplf-replay"])
@pytest.mark.parametrize("angle_rad", [0.3, 1.7, np.pi, -2.0])
@pytest.mark.parametrize("spread_m", [5.0, 30.0])
def test_a_turned_world_gives_the_turned_estimate(
    name: str, angle_rad: float, spread_m: float
) -> None:
    """With a spread that is the same in all directions, and a bearing that lies beyond half a turn."""
    found = []
    for turn_rad in (0.0, angle_rad):
        at = rotation(turn_rad) @ [-30.0, 0.2]
        start = Start(
            position_m=at,
            position_std_m=spread_m,
            yaw_rad=turn_rad,
            yaw_std_rad=1.8,
            speed_mps=10.0,
        )
        one = estimator(name, CTRV(), start)
        one.advance(NS_PER_S // 2)
        bearing_rad = float(np.angle(np.exp(1j * (np.pi + 0.02 + turn_rad))))
        assert (
            one.update(
                Measurement.of(NS_PER_S // 2, bearing_rad=bearing_rad, std=0.05)
            ).nis
            is not None
        )
        state = one.state_at(NS_PER_S // 2)
        P, mean = turned(state.covariance, state.mean, -turn_rad)
        found.append((mean[:2], P[:2, :2]))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=0.03 * spread_m)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=0.03 * spread_m**2)


def test_a_dense_rule_keeps_what_is_affine_and_all_weights_positive() -> None:
    A = np.random.default_rng(0).normal(size=(3, 5))
    mean, P, turns = np.arange(5.0), spread(2.0), np.zeros((1, 5))
    turns[0, 2] = 1.0
    rule = DenseRule.of(mean, P, turns, np.zeros((0, 5)))
    assert rule is not None
    assert rule.weights.min() > 0.0
    assert rule.weights.sum() == pytest.approx(1.0)
    z, slopes, noise = rule.regression(rule.points @ A.T, A @ mean)
    np.testing.assert_allclose(z, A @ mean, rtol=1e-12)
    np.testing.assert_allclose(slopes, A, rtol=1e-9)
    np.testing.assert_allclose(noise, 0.0, atol=1e-20)
    turns[0, 2] = 0.1
    assert DenseRule.of(mean, P, turns, np.zeros((0, 5))) is None


def test_a_wide_heading_and_doppler_track_a_car() -> None:
    """The car stays within what its covariance reports, from an unknown heading: chi-square of 2 x 40, 99.9 %."""
    rng, total = np.random.default_rng(8), 0.0
    for _ in range(40):
        heading_rad = rng.uniform(-np.pi, np.pi)
        velocity = 10.0 * np.array([np.cos(heading_rad), np.sin(heading_rad)])
        start_m = np.array([60.0, 20.0]) + rng.normal(0.0, 1.0, 2)
        start = Start(
            position_m=start_m,
            position_std_m=1.0,
            yaw_rad=0.0,
            yaw_std_rad=4.0,
            speed_mps=10.0,
            speed_std_mps=1.0,
        )
        one, model = (
            estimator("ukf-replay", CTRV(), start),
            measurement_model(SEEN[2], CTRV()),
        )
        for k in range(1, 9):
            truth = np.array(
                [*(np.array([60.0, 20.0]) + velocity * 0.1 * k), heading_rad, 10.0, 0.0]
            )
            std = np.array([0.5, 0.01, 0.2])
            z = model.predict(truth) + std * rng.standard_normal(3)
            one.update(Measurement(k * NS_PER_S // 10, model, z, np.diag(std**2)))
        state = one.state_at(8 * NS_PER_S // 10)
        off = state.mean[:2] - truth[:2]
        total += off @ np.linalg.solve(state.covariance[:2, :2], off)
    assert total < 124.8

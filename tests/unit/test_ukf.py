"""Statistical linear regression by sigma points."""

import numpy as np
import pytest

from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ukf import measurement_regression, regression
from fgtrack.models.motion import CTRV

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
    mean, slope, _ = regression(lambda each: motion.predict(each, 0.2), x, 1e-8 * np.eye(5))
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
    measurement = Measurement.of(0, yaw_rad=3.0, range_m=9.0, std={"yaw_rad": 0.1, "range_m": 1.0})
    wide = np.diag([1.0, 1.0, 4.0, 1.0, 1.0])
    mean, slope, _ = measurement_regression(measurement, np.array([10.0, 0.0, 1.0, 1.0, 0.0]), wide)
    np.testing.assert_allclose(slope[0], [0.0, 0.0, 1.0, 0.0, 0.0], atol=1e-12)
    assert mean[0] == pytest.approx(1.0)


def test_a_semidefinite_covariance_is_taken() -> None:
    motion = CTRV()
    assert np.isfinite(regression(lambda x: motion.predict(x, 0.1), np.zeros(5), np.diag([1.0, 1, 0, 1, 0]))[1]).all()
    with pytest.raises(np.linalg.LinAlgError):
        regression(lambda x: motion.predict(x, 0.1), np.zeros(5), np.diag([1.0, 1.0, -1.0, 1.0, 1.0]))

"""What the iterated, the unscented and the posterior linearisation filter promise beyond the contract."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.iekf import IekfReplay, negative_log_posterior
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.registry import estimator
from fgtrack.models.motion import CTRV
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.streams import START

NAMES = ("iekf-replay", "ukf-replay", "iplf-replay")
MOTION = CTRV()
MEAN = np.array([12.0, 5.0, 0.3, 8.0, 0.1])
P = np.diag([4.0, 4.0, 0.1, 4.0, 0.04]) + 0.3 * (
    np.eye(5, k=1) + np.eye(5, k=-1)
) * np.sqrt(0.04)


def seen(loss: RobustLoss | None = None) -> Measurement:
    std = {"range_m": 0.1, "bearing_rad": 0.05}
    return Measurement.of(0, range_m=10.0, bearing_rad=0.75, std=std, loss=loss)


FILTERS: dict[str, Any] = {
    "ekf": ReplayEkf(MOTION, START, 1.0),
    **{
        name: estimator(f"{name}-replay", MOTION, START)
        for name in ("iekf", "ukf", "iplf")
    },
}


@pytest.mark.parametrize(
    "loss", [None, RobustLoss("huber", 1.0), RobustLoss("cauchy", 1.0)]
)
def test_the_iterated_update_is_the_mode(
    loss: RobustLoss | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(IekfReplay, "_max_iterations", 100)
    measurement = seen(loss)

    def cost(x: FloatArray) -> float:
        y = measurement.model.residual(measurement.z, measurement.model.predict(x))
        return negative_log_posterior(x - MEAN, P, y, measurement.R, loss)

    found = FILTERS["iekf"].correct(MEAN, P, measurement)
    best = minimize(
        cost,
        found.mean,
        method="Nelder-Mead",
        options={"xatol": 1e-10, "fatol": 1e-14, "maxiter": 20000},
    )
    np.testing.assert_allclose(found.mean, best.x, atol=1e-4)
    assert cost(found.mean) < cost(FILTERS["ekf"].correct(MEAN, P, measurement).mean)


def test_the_iterated_update_says_what_the_extended_one_says_of_the_innovation() -> (
    None
):
    found, plain = (FILTERS[name].correct(MEAN, P, seen()) for name in ("iekf", "ekf"))
    np.testing.assert_array_equal(found.innovation, plain.innovation)
    assert found.nis == plain.nis


@cache
def posterior() -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the state after the measurement, from weighted samples of the prior."""
    rng, measurement = np.random.default_rng(0), seen()
    x = rng.multivariate_normal(MEAN, P, size=400_000)
    y = measurement.model.residual(measurement.z, measurement.model.predict(x))
    w = np.exp(-0.5 * np.sum(y * y / measurement.R.diagonal(), axis=1))
    mean = w @ x / w.sum()
    return mean, (w[:, None] * (x - mean)).T @ (x - mean) / w.sum()


def divergence(mean: FloatArray, covariance: FloatArray) -> float:
    """Of the true posterior from N(mean, covariance), of the position."""
    true, spread = posterior()
    S, T, off = covariance[:2, :2], spread[:2, :2], (mean - true)[:2]
    ratio = np.linalg.solve(S, T)
    return float(
        0.5
        * (
            np.trace(ratio)
            - 2.0
            - np.log(np.linalg.det(ratio))
            + off @ np.linalg.solve(S, off)
        )
    )


def test_iterating_comes_nearer_to_the_posterior_of_a_precise_range() -> None:
    found = {}
    for name, each in FILTERS.items():
        correction = each.correct(MEAN, P, seen())
        found[name] = divergence(correction.mean, correction.covariance)
    assert found["iekf"] < 0.2 * found["ekf"]
    assert found["iplf"] < 0.2 * found["ukf"]
    assert found["iplf"] < 0.02


def test_a_step_that_makes_it_worse_is_halved() -> None:
    measurement = Measurement.of(
        0, range_m=1.6, bearing_rad=2.0, std={"range_m": 0.1, "bearing_rad": 0.05}
    )
    mean, wide = (
        np.array([2.6, -2.6, 0.0, 1.0, 0.0]),
        np.diag([9.0, 9.0, 0.1, 1.0, 0.1]),
    )

    def cost(x: FloatArray) -> float:
        y = measurement.model.residual(measurement.z, measurement.model.predict(x))
        return negative_log_posterior(x - mean, wide, y, measurement.R, None)

    plain = FILTERS["ekf"].correct(mean, wide, measurement)
    found = FILTERS["iekf"].correct(mean, wide, measurement)
    assert cost(plain.mean) > cost(mean)  # the full step overshoots
    assert cost(found.mean) < 0.01 * cost(mean)


def test_the_unscented_prediction_is_the_mean_over_the_spread() -> None:
    wide = np.diag([0.1, 0.1, 0.09, 1.0, 0.01])
    x = np.random.default_rng(0).multivariate_normal(MEAN, wide, size=400_000)
    moved = MOTION.predict(x, 1.0)
    found, plain = (
        FILTERS[name].predict(MEAN[None], wide[None], np.ones(1))
        for name in ("ukf", "ekf")
    )
    np.testing.assert_allclose(found.mean[0], moved.mean(axis=0), atol=0.02)
    assert np.linalg.norm(plain.mean - moved.mean(axis=0)) > 0.2
    spread = np.cov(moved.T) + MOTION.process_noise(MEAN, 1.0)
    assert np.linalg.norm(found.covariance - spread) < 0.1 * np.linalg.norm(spread)
    cross = (moved - moved.mean(axis=0)).T @ (x - x.mean(axis=0)) / len(x)
    assert np.linalg.norm(found.cross - cross) < 0.1 * np.linalg.norm(cross)

"""Robust losses outside the graph: the weights, and the filters that use them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi, norm

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, Measurement
from fgtrack.estimation.filters.ekf import correct, correct_one
from fgtrack.estimation.registry import ESTIMATORS, Claims, estimator
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CV
from fgtrack.models.robust import LEAST_WEIGHT, penalty, weight, width
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.streams import LINEAR, MS, START, measured

KINDS = ("huber", "cauchy", "tukey", "geman_mcclure", "dcs")
MOTION = CV()
POSITION = measurement_model(("x_m", "y_m"), MOTION)
MEAN = np.array([1.0, -2.0, 3.0, 0.5])
P = np.array(
    [
        [0.5, 0.1, 0.2, 0.0],
        [0.1, 0.4, 0.0, 0.1],
        [0.2, 0.0, 2.0, 0.3],
        [0.0, 0.1, 0.3, 1.5],
    ]
)
R = np.array([[0.3, 0.1], [0.1, 0.2]])


def seen(off: float, loss: RobustLoss | None) -> Measurement:
    return Measurement(
        0, POSITION, MEAN[:2] + off * np.array([1.0, -0.7]), R, loss=loss
    )


def objective(x: FloatArray, measurement: Measurement) -> float:
    r = measurement.z - x[:2]
    distance = float(np.sqrt(r @ np.linalg.solve(R, r)))
    return float(
        0.5 * (x - MEAN) @ np.linalg.solve(P, x - MEAN)
        + penalty(measurement.loss, distance, 2)
    )


@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_loss_leaves_the_square_for_the_same_share_of_good_measurements(
    size: int,
) -> None:
    loss = RobustLoss("huber", 1.5)
    distances = np.linalg.norm(
        np.random.default_rng(0).standard_normal((20_000, size)), axis=1
    )
    share = np.mean(
        [weight(loss, float(distance), size) < 1.0 for distance in distances]
    )
    assert share == pytest.approx(
        2.0 * norm.sf(1.5), abs=4.0 * 0.0024
    )  # four standard deviations of a share of 13 %
    assert width(loss, size) == pytest.approx(
        chi.isf(2.0 * norm.sf(1.5), size), rel=1e-9
    )
    assert width(RobustLoss("huber", 100.0), size) == 100.0  # no probability is left


@pytest.mark.parametrize("off", [0.3, 8.0])
@pytest.mark.parametrize("kind", KINDS)
def test_the_update_is_a_minimum_of_prior_plus_loss(kind: str, off: float) -> None:
    measurement = seen(off, RobustLoss(kind, 1.5))
    found = correct_one(MEAN, P, measurement)
    best = minimize(
        objective,
        found.mean,
        args=(measurement,),
        method="BFGS",
        options={"gtol": 1e-9},
    )
    np.testing.assert_allclose(found.mean, best.x, atol=1e-5)
    assert objective(found.mean, measurement) <= objective(
        correct_one(MEAN, P, seen(off, None)).mean, measurement
    )
    information = np.linalg.inv(P)
    information[:2, :2] += found.weight * np.linalg.inv(R)
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(information), rtol=1e-9, atol=1e-12
    )


def test_an_inlier_counts_in_full_and_the_nis_is_that_without_a_loss() -> None:
    inlier = correct_one(MEAN, P, seen(0.2, RobustLoss("huber", 1.5)))
    plain = correct_one(MEAN, P, seen(0.2, None))
    assert inlier.weight == 1.0
    np.testing.assert_array_equal(inlier.mean, plain.mean)
    far, plain = (
        correct_one(MEAN, P, seen(9.0, RobustLoss("cauchy", 1.5))),
        correct_one(MEAN, P, seen(9.0, None)),
    )
    assert far.weight < 0.1
    assert far.nis == plain.nis


def test_a_redescending_loss_ignores_what_is_hopeless() -> None:
    assert penalty(None, 3.0, 2) == 4.5
    assert weight(RobustLoss("tukey", 4.7), float("inf"), 2) == LEAST_WEIGHT
    found = correct_one(MEAN, P, seen(1e4, RobustLoss("tukey", 4.7)))
    assert found.weight == LEAST_WEIGHT
    np.testing.assert_allclose(found.mean, MEAN, atol=1e-6)
    np.testing.assert_allclose(found.covariance, P, rtol=1e-6, atol=1e-9)


def test_a_stack_of_states_is_weighted_one_by_one() -> None:
    items = [seen(0.2, RobustLoss("huber", 1.0)), seen(6.0, RobustLoss("huber", 1.0))]
    means = np.array([MEAN] * 2)
    stacked = correct(
        means,
        np.array([P] * 2),
        *POSITION.linearised(
            np.array([item.z for item in items]), means, items[0].pose
        ),
        np.array([item.R for item in items]),
        loss=items[0].loss,
    )
    for row, item in enumerate(items):
        one = correct_one(MEAN, P, item)
        np.testing.assert_allclose(stacked.mean[row], one.mean, rtol=1e-12)
        np.testing.assert_allclose(stacked.covariance[row], one.covariance, rtol=1e-12)
        assert stacked.nis[row] == pytest.approx(one.nis, rel=1e-12)


def fed(name: str, loss: RobustLoss | None) -> Estimator:
    """Forty positions in sequence, then some late ones; each tenth is 8 m off."""
    rng, found = (
        np.random.default_rng(5),
        estimator(name, LINEAR, replace(START, speed_mps=20.0), lag_s=3.0),
    )
    order = [*range(1, 31), *range(33, 41), 31, 32]
    for k in order:
        item = measured(rng, LINEAR, k * 50 * MS)
        off = 8.0 if k % 10 == 9 or k == 32 else 0.0
        found.update(replace(item, z=item.z + off, loss=loss))
    return found


FILTERS = [name for name in ESTIMATORS if not Claims.of(ESTIMATORS.load(name)).held_s]


@pytest.mark.parametrize("name", FILTERS)
def test_every_estimator_is_pulled_less_by_outliers_with_a_loss(name: str) -> None:
    at_ns = START.stamp_ns + 40 * 50 * MS
    truth = np.array([3.0, -2.0]) + 40.0 * np.array([np.cos(0.4), np.sin(0.4)])
    plain, robust = (
        fed(name, loss).state_at(at_ns).mean[:2]
        for loss in (None, RobustLoss("huber", 1.0))
    )
    assert np.linalg.norm(robust - truth) < 0.6 * np.linalg.norm(plain - truth)

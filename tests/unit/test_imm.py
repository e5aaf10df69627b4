"""The interacting multiple model filter: what it is made of, and that late measurements change nothing."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

import fgtrack
from fgtrack.core.errors import CallError
from fgtrack.core.types import ACCEL, FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.imm import ImmReplay
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.models.correlated_errors import CorrelatedErrors
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.models.sensors import RobustLoss

START = Start(yaw_rad=0.3, speed_mps=20.0, speed_std_mps=2.0)
MS = 1_000_000


def positions(
    speeds_mps: FloatArray, std_m: float = 0.2, seed: int = 0
) -> list[Measurement]:
    """Positions every 50 ms of an object that drives straight on at these speeds."""
    rng = np.random.default_rng(seed)
    way_m = np.cumsum(0.05 * speeds_mps)
    places = np.outer(way_m, [np.cos(0.3), np.sin(0.3)]) + std_m * rng.standard_normal(
        (len(way_m), 2)
    )
    std = {"x_m": std_m, "y_m": std_m}
    return [
        Measurement.of((k + 1) * 50 * MS, x_m=x, y_m=y, std=std)
        for k, (x, y) in enumerate(places.tolist())
    ]


def probabilities(estimator: ImmReplay) -> FloatArray:
    """Of both models after the newest measurement."""
    mixture = estimator.steps[-1].mixture
    assert mixture is not None
    return mixture.probabilities


def fed(estimator: ImmReplay | ReplayEkf, measurements: list[Measurement]) -> None:
    for measurement in measurements:
        assert estimator.update(measurement).innovation is not None


def test_transitions_are_those_of_the_generator_and_compose() -> None:
    chain = ImmReplay(CTRV(), START, 1.0, stay_s=0.8)
    G = np.array([[-1.25, 1.25], [1.25, -1.25]])
    for dt_s in (0.0, 1e-6, 0.05, 3.0, 400.0):
        assert_allclose(chain.transition(dt_s), expm(G * dt_s), atol=1e-12)
    assert_allclose(
        chain.transition(0.4),
        chain.transition(0.15) @ chain.transition(0.25),
        atol=1e-14,
    )
    assert probabilities(chain).tolist() == [0.5, 0.5]


def test_a_model_that_is_never_or_always_left_is_refused() -> None:
    for stay_s in (0.0, -1.0, np.inf):
        with pytest.raises(CallError, match="stay_s: must be positive and finite"):
            fgtrack.estimator("imm-replay", CTRV(), START, stay_s=stay_s)


@pytest.mark.parametrize(
    "motion", [CTRV(), CTRA(), CV()], ids=lambda each: type(each).__name__
)
def test_of_two_models_that_are_the_same_it_is_the_replaying_filter(
    motion: MotionModel,
) -> None:
    imm, ekf = (
        ImmReplay(motion, START, 1.0, other=motion),
        ReplayEkf(motion, START, 1.0),
    )
    measurements = positions(np.full(12, 20.0))
    late = [*measurements[:5], *measurements[6:], measurements[5]]
    for estimator in (imm, ekf):
        fed(estimator, late)
    for at_ns in (100 * MS, 600 * MS, 730 * MS):
        found, expected = imm.state_at(at_ns), ekf.state_at(at_ns)
        assert_allclose(found.mean, expected.mean, rtol=1e-10)
        assert_allclose(found.covariance, expected.covariance, rtol=1e-8, atol=1e-12)
    assert_allclose(probabilities(imm), [0.5, 0.5])


def test_braking_makes_acceleration_probable_and_steady_driving_does_not() -> None:
    calm, braking = (
        np.full(60, 20.0),
        np.concatenate([np.full(30, 20.0), 20.0 - 0.4 * np.arange(30)]),
    )
    found = []
    for speeds_mps in (calm, braking):
        imm = ImmReplay(CTRV(), START, 1.0, other=CTRA(accel_density_m2ps5=4.0))
        fed(imm, positions(speeds_mps, std_m=0.05))
        found.append(probabilities(imm)[1])
    assert found[0] < 0.3 < 0.9 < found[1]


def test_the_estimate_lies_between_those_of_its_models() -> None:
    """Of a quarter of a second, in which the chain hardly moves: Bayes's rule over two whole filters."""
    measurements = positions(np.full(5, 24.0), std_m=0.5)
    imm = ImmReplay(CTRV(), START, 1.0, stay_s=1e9)
    fed(imm, measurements)
    logs, means = [], []
    for motion in (CTRV(), CTRA()):
        ekf, log = ReplayEkf(motion, START, 1.0), 0.0
        for measurement in measurements:
            result = ekf.update(measurement)
            assert result.innovation_covariance is not None
            log -= 0.5 * float(
                np.linalg.slogdet(result.innovation_covariance)[1] + (result.nis or 0.0)
            )
        logs.append(log)
        means.append(ekf.state_at(250 * MS).mean[:ACCEL])
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    assert_allclose(probabilities(imm), weights, atol=1e-6)
    assert_allclose(imm.state_at(250 * MS).mean, weights @ np.array(means), rtol=1e-6)


def test_an_outlier_under_a_loss_does_not_decide_between_the_models() -> None:
    measurements = positions(np.full(20, 20.0))
    far = Measurement.of(
        1010 * MS,
        x_m=60.0,
        y_m=0.0,
        std={"x_m": 0.2, "y_m": 0.2},
        loss=RobustLoss("tukey", 3.0),
    )
    imm = ImmReplay(CTRV(), START, 1.0)
    fed(imm, measurements)
    before = probabilities(imm)
    fed(imm, [far])
    assert_allclose(probabilities(imm), before, atol=0.1)


@pytest.mark.parametrize(
    ("motion", "options", "said"),
    [
        (CTRV(), {"other": "ctrw"}, "'ctrw' is unknown"),
        (
            CorrelatedErrors(CTRV(), (("lidar.x_m", 1.0),)),
            {},
            "no sensors with correlated errors",
        ),
    ],
)
def test_what_cannot_be_mixed_is_refused(
    motion: MotionModel, options: dict[str, str], said: str
) -> None:
    with pytest.raises(CallError, match=said):
        fgtrack.estimator("imm-replay", motion, START, **options)

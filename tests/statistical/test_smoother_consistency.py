"""Truth drawn from the motion model itself: are the estimators as sure as they should be?"""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chi2

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.registry import estimator as estimator_of
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.sim.vehicles import drawn

START_NS = 1_790_000_000_000_000_000
MOTION = CTRV(yaw_density_rad2ps=0.002, yaw_rate_density_rad2ps3=0.02, speed_density_m2ps3=0.5)
STEP_S = 0.05
LAG_S = 0.3
NUM_STEPS = 40
NUM_RUNS = 30
POSITION, WITH_SPEED = (measurement_model(("x_m", "y_m", *more), MOTION) for more in ((), ("speed_mps",)))


def prior(mean: FloatArray) -> Start:
    x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps = mean.tolist()
    position = np.array([x_m, y_m])
    return Start(
        stamp_ns=START_NS,
        position_m=position,
        position_std_m=0.3,
        yaw_rad=yaw_rad,
        yaw_std_rad=0.1,
        speed_mps=speed_mps,
        speed_std_mps=2.0,
        yaw_rate_radps=yaw_rate_radps,
        yaw_rate_std_radps=0.1,
    )


def smoother(motion: MotionModel, start: Start) -> Estimator:
    return estimator_of("smoother", motion, start, lag_s=1.0)


def replay(motion: MotionModel, start: Start) -> ReplayEkf:
    return ReplayEkf(motion, start, 1.0)


def drawn_truth(rng: np.random.Generator, start: FloatArray) -> list[FloatArray]:
    states = [start + np.linalg.cholesky(np.diag([0.09, 0.09, 0.01, 4.0, 0.01])) @ rng.standard_normal(5)]
    for _ in range(NUM_STEPS):
        states.append(drawn(MOTION, states[-1], STEP_S, rng))
    return states


def arrivals(rng: np.random.Generator, truth: list[FloatArray]) -> list[tuple[float, int, FloatArray]]:
    """Receipt time, step and z: positions 151 ms late, positions and speeds 62 ms late, in order of receipt."""
    found = []
    for k in range(1, NUM_STEPS + 1):
        slow = k % 2 == 0
        z = truth[k][[0, 1]] if slow else truth[k][[0, 1, 3]]
        std = np.full(len(z), 0.3)
        rng.random()
        late_s = 0.151 if slow else 0.062
        found.append((k * STEP_S + late_s, k, z + std * rng.standard_normal(len(z))))
    return sorted(found, key=lambda item: item[0])


def fed(estimator: Estimator, items: list[tuple[float, int, FloatArray]]) -> None:
    for _, k, z in items:
        model = POSITION if len(z) == 2 else WITH_SPEED
        estimator.update(Measurement(stamp(k), model, z, 0.09 * np.eye(len(z))))


def stamp(k: float) -> int:
    return START_NS + round(k * STEP_S * NS_PER_S)


def nees(estimator: Estimator, stamp_ns: int, truth: FloatArray) -> float:
    state = estimator.state_at(stamp_ns)
    error = state.mean - truth
    return float(error @ np.linalg.solve(state.covariance, error))


@pytest.mark.parametrize("make", [smoother, replay])
def test_the_error_of_the_present_state_is_as_large_as_its_covariance_says(
    make: Callable[[MotionModel, Start], Estimator],
) -> None:
    rng = np.random.default_rng(7)
    start = np.array([100.0, -50.0, 0.7, 30.0, 0.05])
    total = 0.0
    for _ in range(NUM_RUNS):
        truth = drawn_truth(rng, start)
        estimator = make(MOTION, prior(start))
        fed(estimator, arrivals(rng, truth))
        total += nees(estimator, stamp(NUM_STEPS), truth[-1])
    low, high = chi2.ppf([0.005, 0.995], 5 * NUM_RUNS)
    assert low < total < high


def test_the_error_of_the_lagged_state_is_smaller_and_as_large_as_its_covariance_says() -> None:
    rng = np.random.default_rng(8)
    start = np.array([100.0, -50.0, 0.7, 30.0, 0.05])
    total = lagged = present = 0.0
    for _ in range(NUM_RUNS):
        truth = drawn_truth(rng, start)
        estimator = smoother(MOTION, prior(start))
        fed(estimator, arrivals(rng, truth))
        back = round(LAG_S / STEP_S)
        then = estimator.state_at(stamp(NUM_STEPS - back))
        total += nees(estimator, then.stamp_ns, truth[-1 - back])
        lagged += float(np.sum((then.mean - truth[-1 - back])[:2] ** 2))
        present += float(np.sum((estimator.state_at(stamp(NUM_STEPS)).mean - truth[-1])[:2] ** 2))
    low, high = chi2.ppf([0.005, 0.995], 5 * NUM_RUNS)
    assert low < total < high
    assert np.sqrt(lagged / present) < 0.9

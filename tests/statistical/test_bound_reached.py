"""Nobody is better than the bound, and the exact methods are as good."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import chi2
from support.late_positions import STEP_NS, late_positions

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.registry import ESTIMATORS, OOSM_GROUP, estimator
from fgtrack.evaluation.bounds import bounds
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CV

START_NS = 1_790_000_000 * NS_PER_S
MOTION = CV(5.0)
PRIOR = Start(
    stamp_ns=START_NS,
    position_covariance=0.5 * np.eye(2),
    yaw_rad=0.0,
    yaw_std_rad=0.2,
    speed_mps=20.0,
    speed_std_mps=2.0,
    yaw_rate_std_radps=0.2,
)
NUM_STEPS = 40
NUM_RUNS = 40
NOW_NS = START_NS + NUM_STEPS * STEP_NS + STEP_NS // 2
POSITION = measurement_model(("x_m", "y_m"), MOTION)
EXACT = ("ekf-replay", "smoother")


def make(name: str) -> Estimator:
    return estimator(name, MOTION, PRIOR, lag_s=1.0)


@dataclass(frozen=True)
class Run:
    """What arrives until NOW_NS, and the true state then."""

    measurements: list[Measurement]
    truth: FloatArray


def drawn(seed: int) -> Run:
    rng = np.random.default_rng([11, seed])
    x0, P0 = initial_state(MOTION, PRIOR)
    half = STEP_NS / 2 / NS_PER_S
    root = np.linalg.cholesky(MOTION.process_noise(x0, half))
    states = [x0 + np.linalg.cholesky(P0) @ rng.standard_normal(4)]
    for noise in rng.standard_normal((2 * NUM_STEPS + 1, 4)):
        states.append(MOTION.predict(states[-1], half) + root @ noise)
    measurements = []
    for item in late_positions(MOTION, START_NS, NUM_STEPS):
        if item.receipt_ns <= NOW_NS:
            at = round((item.stamp_ns - START_NS) / STEP_NS) * 2
            z = states[at][:2] + np.sqrt(item.R[0, 0]) * rng.standard_normal(2)
            measurements.append(Measurement(item.stamp_ns, POSITION, z, item.R))
    return Run(measurements, states[-1])


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    return [drawn(seed) for seed in range(NUM_RUNS)]


def errors(name: str, runs: list[Run]) -> FloatArray:
    """Errors of the state at NOW_NS over all runs, shape (NUM_RUNS, 4)."""
    found = []
    for run in runs:
        estimator = make(name)
        for measurement in run.measurements:
            estimator.update(measurement)
        estimator.advance(NOW_NS)
        found.append(estimator.state_at(NOW_NS).mean - run.truth)
    return np.array(found)


@pytest.fixture(scope="module")
def gated() -> FloatArray:
    x0, P0 = initial_state(MOTION, PRIOR)

    def truth(stamps_ns: IntArray) -> FloatArray:
        return MOTION.predict(x0, (stamps_ns - START_NS) / NS_PER_S)[None]

    return bounds(MOTION, START_NS, P0, late_positions(MOTION, START_NS, NUM_STEPS), truth, [NOW_NS]).arrived[0]


@pytest.mark.parametrize("name", EXACT)
def test_the_exact_methods_reach_the_gated_bound(name: str, runs: list[Run], gated: FloatArray) -> None:
    found = errors(name, runs)
    total = np.sum(found @ np.linalg.solve(gated, np.eye(4)) * found)
    low, high = chi2.ppf([0.005, 0.995], 4 * NUM_RUNS)
    assert low < total < high


@pytest.mark.parametrize("name", ESTIMATORS.loaded(OOSM_GROUP))
def test_no_method_is_better_than_the_gated_bound(name: str, runs: list[Run], gated: FloatArray) -> None:
    squared_m2 = np.sum(errors(name, runs)[:, :2] ** 2, axis=1)
    standard_error = squared_m2.std() / np.sqrt(NUM_RUNS)
    assert squared_m2.mean() > np.trace(gated[:2, :2]) - 3.0 * standard_error


def test_what_drops_the_good_sensor_is_clearly_above_the_bound(runs: list[Run], gated: FloatArray) -> None:
    squared_m2 = np.sum(errors("drop", runs)[:, :2] ** 2, axis=1)
    assert squared_m2.mean() > 1.3 * np.trace(gated[:2, :2])

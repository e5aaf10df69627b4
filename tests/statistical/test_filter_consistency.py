"""Truth drawn from the model itself, range and bearing: which filters are as sure as they should be?"""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import chi2, wilcoxon

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.registry import estimator
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.sim.vehicles import draw_states

MOTION = CTRV(
    position_density_m2ps=0.001,
    yaw_density_rad2ps=0.002,
    speed_density_m2ps3=0.2,
    yaw_rate_density_rad2ps3=0.01,
)
MODEL = measurement_model(("range_m", "bearing_rad"), MOTION)
STEP_S = 0.1
NUM_RUNS = 20


def errors(
    names: Sequence[str],
    seed: int,
    std: FloatArray,
    range_m: float,
    speed_mps: float,
    num_steps: int,
) -> dict[str, FloatArray]:
    """Squared position error and NEES of the present state at each step, shape (steps, 2), of each estimator."""
    rng = np.random.default_rng(seed)
    mean, spread = (
        np.array([range_m, 0.0, 1.5, speed_mps, 0.0]),
        np.array([1.5, 1.5, 0.3, 0.5, 0.1]),
    )
    start = Start(
        position_m=mean[:2],
        position_std_m=1.5,
        yaw_rad=1.5,
        yaw_std_rad=0.3,
        speed_mps=speed_mps,
        speed_std_mps=0.5,
        yaw_rate_std_radps=0.1,
    )
    each = {name: estimator(name, MOTION, start) for name in names}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    x = mean + spread * rng.standard_normal(5)
    for k in range(1, num_steps + 1):
        x = draw_states(MOTION, x, STEP_S, rng)
        z = MODEL.predict(x) + std * rng.standard_normal(2)
        measurement = Measurement(nanoseconds(k * STEP_S), MODEL, z, np.diag(std**2))
        for name, one in each.items():
            one.update(measurement)
            state = one.state_at(measurement.stamp_ns)
            error = state.mean - x
            error[YAW] = wrap_angle(error[YAW])
            found[name].append(
                (
                    error[:2] @ error[:2],
                    error @ np.linalg.solve(state.covariance, error),
                )
            )
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.parametrize(
    "name", ["ekf-replay", "iekf-replay", "ukf-replay", "iplf-replay"]
)
def test_far_from_the_sensor_every_filter_is_consistent(name: str) -> None:
    std = np.array([0.3, 0.01])
    runs = [
        errors([name], seed, std, 60.0, 10.0, 12)[name][-1, 1]
        for seed in range(NUM_RUNS)
    ]
    low, high = chi2.ppf([0.005, 0.995], 5 * NUM_RUNS)
    assert low < sum(runs) < high


def test_near_the_sensor_the_iterated_filters_err_less_than_the_extended_one_and_know_it() -> (
    None
):
    names, std = ("ekf-replay", "iekf-replay", "iplf-replay"), np.array([0.02, 0.1])
    runs = [errors(names, seed, std, 3.0, 2.0, 10) for seed in range(NUM_RUNS)]
    squared = {
        name: np.array([run[name][:, 0].mean() for run in runs]) for name in names
    }
    nees = {name: np.median([run[name][:, 1].mean() for run in runs]) for name in names}
    assert nees["ekf-replay"] > 15.0  # 5 is expected
    for name in names[1:]:
        assert (
            wilcoxon(squared["ekf-replay"], squared[name], alternative="greater").pvalue
            < 0.01
        )
        assert nees[name] < 8.0

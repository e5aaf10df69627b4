"""Truth drawn from the motion model itself: are smoothed states as uncertain as their covariances say?"""

import numpy as np
from scipy.stats import chi2

from fgtrack.core.time import nanoseconds
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.registry import estimator
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.sim.vehicles import draw_states

MOTION = CTRV(
    yaw_density_rad2ps=0.002, yaw_rate_density_rad2ps3=0.02, speed_density_m2ps3=0.5
)
STEP_S, NUM_STEPS, NUM_RUNS = 0.05, 40, 30
LAGS = (0, 6)
POSITION, WITH_SPEED = (
    measurement_model(("x_m", "y_m", *more), MOTION) for more in ((), ("speed_mps",))
)
MEAN, STD = (
    np.array([100.0, -50.0, 0.7, 30.0, 0.05]),
    np.array([0.3, 0.3, 0.1, 2.0, 0.1]),
)
START = Start(
    position_m=MEAN[:2],
    position_std_m=0.3,
    yaw_rad=0.7,
    yaw_std_rad=0.1,
    speed_mps=30.0,
    speed_std_mps=2.0,
    yaw_rate_radps=0.05,
    yaw_rate_std_radps=0.1,
)


def test_the_errors_of_present_and_lagged_states_are_as_large_as_their_covariances_say() -> (
    None
):
    """Positions come 151 ms late and positions with speeds 62 ms late, at every other step."""
    rng, nees, squared_m2 = np.random.default_rng(7), np.zeros(2), np.zeros(2)
    for _ in range(NUM_RUNS):
        truth = [MEAN + STD * rng.standard_normal(5)]
        for _ in range(NUM_STEPS):
            truth.append(draw_states(MOTION, truth[-1], STEP_S, rng))
        one = estimator("smoother", MOTION, START, lag_s=1.0)
        for k in sorted(
            range(1, NUM_STEPS + 1),
            key=lambda k: k * STEP_S + (0.062 if k % 2 else 0.151),
        ):
            model, entries = (WITH_SPEED, [0, 1, 3]) if k % 2 else (POSITION, [0, 1])
            z = truth[k][entries] + 0.3 * rng.standard_normal(len(entries))
            one.update(
                Measurement(nanoseconds(k * STEP_S), model, z, 0.09 * np.eye(len(z)))
            )
        for i, lag in enumerate(LAGS):
            state = one.state_at(nanoseconds((NUM_STEPS - lag) * STEP_S))
            error = state.mean - truth[NUM_STEPS - lag]
            nees[i] += error @ np.linalg.solve(state.covariance, error)
            squared_m2[i] += error[:2] @ error[:2]
    low, high = chi2.ppf([0.005, 0.995], 5 * NUM_RUNS)
    assert ((low < nees) & (nees < high)).all()
    assert squared_m2[1] < 0.81 * squared_m2[0]

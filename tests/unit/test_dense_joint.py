"""The oracle of the exact estimators against the Kalman filter in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from fgtrack.core.errors import CallError
from fgtrack.estimation.base import Measurement, Start, no_states
from fgtrack.estimation.birth import initial_state
from fgtrack.models.motion import CV
from fgtrack.testing.references import dense_joint

NS = 10**9
START = Start(
    position_m=(1.0, 2.0),
    position_std_m=0.7,
    yaw_rad=0.3,
    yaw_std_rad=0.2,
    speed_mps=10.0,
)
STD = {"x_m": 0.3, "y_m": 0.5}


@pytest.mark.parametrize("speed_mps", [10.0, 0.0])
def test_two_nodes_are_a_prediction_a_correction_and_a_smoothing_step(
    speed_mps: float,
) -> None:
    start = replace(START, speed_mps=speed_mps)
    motion = CV(velocity_density_m2ps3=0.8)
    measurement = Measurement.of(2 * NS, x_m=20.0, y_m=9.0, std=STD).seen_by(motion)
    found = dense_joint(motion, start, [measurement], [0, 2 * NS, 3 * NS])
    x0, P0 = initial_state(motion, start)
    F, H = motion.jacobian(x0, 2.0), np.eye(2, 4)
    x, P = F @ x0, F @ P0 @ F.T + motion.process_noise(x0, 2.0)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag([0.09, 0.25]))
    corrected, spread = x + K @ ([20.0, 9.0] - x[:2]), P - K @ H @ P
    G = P0 @ F.T @ np.linalg.inv(P)
    F1, Q1 = motion.jacobian(x0, 1.0), motion.process_noise(x0, 1.0)
    expected = {
        0: (x0 + G @ (corrected - x), P0 + G @ (spread - P) @ G.T),
        2 * NS: (corrected, spread),
        3 * NS: (F1 @ corrected, F1 @ spread @ F1.T + Q1),
    }
    for stamp_ns, (mean, covariance) in expected.items():
        assert found[stamp_ns].stamp_ns == stamp_ns
        np.testing.assert_allclose(found[stamp_ns].mean, mean, rtol=1e-10)
        np.testing.assert_allclose(
            found[stamp_ns].covariance, covariance, rtol=1e-9, atol=1e-12
        )


def test_what_is_before_the_start_is_refused() -> None:
    with pytest.raises(CallError, match="stamp -1 ns lies before the prior's, 0 ns"):
        dense_joint(CV(), START, [], [-1])


def test_no_states_are_empty_arrays_of_the_shape_of_states() -> None:
    none = no_states(5)
    assert (none.means.shape, none.covariances.shape) == ((0, 5), (0, 5, 5))

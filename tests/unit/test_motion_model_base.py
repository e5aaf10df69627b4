"""A motion model that has `state_names`, `predict`, `jacobian` and `process_noise`, and nothing else."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fgtrack.core.errors import CallError
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel


@dataclass(frozen=True)
class Accelerating(MotionModel):
    """Constant acceleration, driven by white noise jerk."""

    state_names = ("x_m", "y_m", "vx_mps", "vy_mps", "ax_mps2", "ay_mps2")
    linear = True
    jerk_density_m2ps5: float = 1.0

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return (self.jacobian(x, dt_s) @ x[..., None])[..., 0]

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        t = np.asarray(dt_s)[..., None, None]
        F = np.eye(6) + t * np.eye(6, k=2) + t**2 / 2.0 * np.eye(6, k=4)
        return np.broadcast_to(F, (*np.broadcast_shapes(x.shape[:-1], np.shape(dt_s)), 6, 6))

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        t = self.forward(dt_s)[..., None, None]
        axis = [[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]]
        Q = self.jerk_density_m2ps5 * sum(
            np.kron(np.eye(3)[:, [i]] * np.eye(3)[j], np.eye(2)) * axis[i][j] for i in range(3) for j in range(3)
        )
        return np.broadcast_to(Q, (*np.broadcast_shapes(x.shape[:-1], np.shape(dt_s)), 6, 6))


class Walking(Accelerating):
    """Yaw and speed instead of the velocity, and no yaw rate."""

    state_names = ("x_m", "y_m", "yaw_rad", "speed_mps", "stride_m", "height_m")
    linear = False

    def start_variance(self, name: str) -> float:
        return {"stride_m": 0.01, "height_m": 0.04}[name]


MODEL, WALK = Accelerating(), Walking()
X = np.array([1.0, 2.0, 3.0, 4.0, 0.5, -0.5])


def test_steps_of_one_state_follow_from_the_functions_of_arrays() -> None:
    step = MODEL.step(X.tolist(), 0.3)
    assert_array_equal(step.mean, MODEL.predict(X, 0.3))
    assert_array_equal(step.F, MODEL.jacobian(X, 0.3))
    assert_array_equal(step.Q, MODEL.process_noise(X, 0.3))
    mean, F = MODEL.flow(X.tolist(), -0.3)
    assert_allclose(F @ MODEL.jacobian(X, 0.3), np.eye(6), atol=1e-15)
    assert_allclose(mean, MODEL.predict(X, -0.3))
    with pytest.raises(CallError, match="needs a duration >= 0"):
        MODEL.step(X.tolist(), -0.1)


def test_a_cartesian_state_gives_and_takes_what_cv_gives_and_takes() -> None:
    P = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + 0.1
    found, expected = MODEL.kinematic(X, P), CV().kinematic(X[:4], P[:4, :4])
    assert_allclose(found[0], expected[0])
    assert_allclose(found[1], expected[1])
    back, back_P = MODEL.from_kinematic(*expected)
    cv, cv_P = CV().from_kinematic(*expected)
    assert_array_equal(back[:4], cv)
    assert_allclose(back_P[:4, :4], cv_P)
    assert_array_equal(back[4:], 0.0)
    assert_array_equal(back_P[4:], np.eye(6)[4:])


def test_what_a_kinematic_state_lacks_starts_at_zero_with_the_model_s_variance() -> None:
    mean, P = np.array([1.0, 2.0, 0.3, 4.0, 0.1]), np.diag([1.0, 2.0, 3.0, 4.0, 5.0])
    x, covariance = WALK.from_kinematic(mean, P)
    assert_array_equal(x, [1.0, 2.0, 0.3, 4.0, 0.0, 0.0])
    assert_array_equal(np.diag(covariance), [1.0, 2.0, 3.0, 4.0, 0.01, 0.04])
    kinematic, covariance = WALK.kinematic(x, covariance)
    assert_array_equal(kinematic, [1.0, 2.0, 0.3, 4.0, 0.0])
    assert_array_equal(np.diag(covariance), [1.0, 2.0, 3.0, 4.0, 0.0])
    accelerated, covariance = CTRA().from_kinematic(*CTRV().from_kinematic(mean, P))
    assert_array_equal(accelerated, [*mean, 0.0])
    assert_array_equal(np.diag(covariance), [1.0, 2.0, 3.0, 4.0, 5.0, 1.0])


def test_an_object_of_unknown_direction_starts_with_any_velocity_and_the_model_s_other_entries() -> None:
    mean, P = initial_state(MODEL, Start(position_m=(5.0, 6.0), position_std_m=2.0, speed_std_mps=3.0))
    assert_array_equal(mean, [5.0, 6.0, 0.0, 0.0, 0.0, 0.0])
    assert_allclose(P, np.diag([4.0, 4.0, 9.0, 9.0, 1.0, 1.0]))

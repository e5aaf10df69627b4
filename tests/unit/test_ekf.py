import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.models import MODELS

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.ekf import correct, correct_one, predict
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV, CV, MotionModel

seeds = st.integers(0, 2**32 - 1)


def positive_definite(rng: np.random.Generator, count: int, n: int) -> FloatArray:
    root = rng.normal(size=(count, n, n))
    return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(n)


@settings(deadline=None, max_examples=30)
@given(
    seed=seeds,
    components=st.sampled_from(
        [("x_m", "y_m"), ("x_m", "y_m", "yaw_rad", "speed_mps")]
    ),
)
def test_the_correction_is_the_textbook_formula(
    seed: int, components: tuple[str, ...]
) -> None:
    rng = np.random.default_rng(seed)
    model = measurement_model(components, CTRV())
    k = len(components)
    x, P = rng.normal(size=(4, 5)), positive_definite(rng, 4, 5)
    z, R = x[:, :k] + rng.normal(scale=0.3, size=(4, k)), positive_definite(rng, 4, k)
    done = correct(x, P, *model.linearised(z, x, SensorPose()), R)
    for i in range(4):
        H = np.eye(5)[:k]
        y = z[i] - H @ x[i]
        S = H @ P[i] @ H.T + R[i]
        K = P[i] @ H.T @ np.linalg.inv(S)
        np.testing.assert_allclose(done.innovation[i], y, atol=1e-14)
        np.testing.assert_allclose(done.mean[i], x[i] + K @ y, atol=1e-11)
        np.testing.assert_allclose(
            done.covariance[i], (np.eye(5) - K @ H) @ P[i], atol=1e-11
        )
        assert done.nis[i] == pytest.approx(y @ np.linalg.inv(S) @ y, rel=1e-9)


@settings(deadline=None, max_examples=30)
@given(seed=seeds, scale=st.sampled_from([1e-12, 1e-6, 1.0, 1e6]))
def test_the_posterior_stays_symmetric_and_positive_however_good_the_measurement(
    seed: int, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    P = positive_definite(rng, 3, 5) * 1e4
    model = measurement_model(("x_m", "y_m", "yaw_rad"), CTRV())
    R = positive_definite(rng, 3, 3) * scale
    x, z = rng.normal(size=(3, 5)), rng.normal(size=(3, 3))
    done = correct(x, P, *model.linearised(z, x, SensorPose()), R)
    assert np.array_equal(done.covariance, np.swapaxes(done.covariance, -1, -2))
    assert np.linalg.eigvalsh(done.covariance).min() > -1e-10 * 1e4
    assert np.all(
        np.diagonal(done.covariance, axis1=-2, axis2=-1)
        <= np.diagonal(P, axis1=-2, axis2=-1)
    )


def test_a_singular_innovation_covariance_is_an_error() -> None:
    model = measurement_model(("x_m", "y_m"), CTRV())
    P = np.stack([np.zeros((5, 5)), np.eye(5)])
    found = correct(
        np.zeros((2, 5)), P, np.ones((2, 2)), model.selection(5), np.zeros((2, 2, 2))
    )
    assert found.fused.tolist() == [False, True]


@pytest.mark.parametrize("motion", MODELS)
def test_a_prediction_is_the_motion_model_with_its_noise_and_changes_no_input(
    motion: MotionModel,
) -> None:
    rng = np.random.default_rng(1)
    x, P = rng.normal(size=(3, motion.dim)), positive_definite(rng, 3, motion.dim)
    before = x.copy(), P.copy()
    mean, covariance = predict(x, P, motion, 0.25)
    np.testing.assert_allclose(mean, motion.predict(x, 0.25), rtol=1e-12)
    F, Q = motion.jacobian(x, 0.25), motion.process_noise(x, 0.25)
    for i in range(3):
        np.testing.assert_allclose(
            covariance[i], F[i] @ P[i] @ F[i].T + Q[i], atol=1e-12
        )
    assert np.array_equal(x, before[0])
    assert np.array_equal(P, before[1])


@settings(deadline=None, max_examples=60)
@given(
    seed=seeds,
    motion=st.sampled_from(MODELS),
    components=st.sampled_from(
        [
            ("x_m", "y_m"),
            ("x_m", "y_m", "speed_mps"),
            ("yaw_rad",),
            ("range_m", "bearing_rad", "range_rate_mps"),
        ]
    ),
)
def test_the_correction_of_one_state_is_that_of_a_stack(
    seed: int, motion: MotionModel, components: tuple[str, ...]
) -> None:
    rng = np.random.default_rng(seed)
    model, k = measurement_model(components, motion), len(components)
    x, P = rng.normal(size=motion.dim) * 5.0, positive_definite(rng, 1, motion.dim)[0]
    z, R = rng.normal(size=k) * 3.0, positive_definite(rng, 1, k)[0]
    inputs = [array.copy() for array in (x, P, z, R)]
    pose = SensorPose(20.0, -3.0, 0.4, 5.0, 1.0)
    one = correct_one(x, P, Measurement(0, model, z, R, pose))
    stack = correct(
        x[None], P[None], *model.linearised(z[None], x[None], pose), R[None]
    )
    for found, expected in zip(one[:-1], stack[:-1], strict=True):
        np.testing.assert_allclose(
            found, expected[0], rtol=1e-12, atol=1e-12 * np.abs(stack.mean).max()
        )
    np.testing.assert_array_equal(one.covariance, one.covariance.T)
    for array, before in zip((x, P, z, R), inputs, strict=True):
        np.testing.assert_array_equal(array, before)


def test_the_replaying_filter_remembers_no_more_than_its_window() -> None:
    estimator = ReplayEkf(CV(), Start(), 1.0)
    for k in range(100):
        estimator.update(Measurement.of(k * 10**8, x_m=0.0, std={"x_m": 1.0}))
    assert len(estimator.steps) == 12  # those of the window, and the one before it

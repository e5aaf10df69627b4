import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.models import MODELS

from fgtrack.core.types import FloatArray
from fgtrack.estimation.filters.propagation import ExactPropagator
from fgtrack.karle2023.euler import EulerCtrv
from fgtrack.karle2023.filter_defects import (
    YAW_LIMIT_RAD,
    SaturatedEulerCtrv,
    published_yaw,
)
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRA, CTRV, MotionModel

ISOTROPIC = np.array([4e-4, 4e-4, 9e-4, 1e-2, 2.5e-3])
ANISOTROPIC = np.array([4e-3, 1e-5, 9e-4, 1e-2, 2.5e-3])
seeds = st.integers(0, 2**32 - 1)


def random_states(
    rng: np.random.Generator, count: int, n: int
) -> tuple[FloatArray, FloatArray]:
    mean = (
        rng.normal(size=(count, n)) * np.array([500.0, 500.0, 1.5, 40.0, 0.3, 2.0])[:n]
    )
    root = (
        rng.normal(size=(count, n, n))
        * np.array([1.0, 1.0, 0.1, 1.0, 0.1, 1.0])[:n, None]
    )
    return mean, root @ np.swapaxes(root, -1, -2)


def naive_step(
    x: FloatArray,
    P: FloatArray,
    density: FloatArray,
    dt: float,
    driving: bool,
    limit: float,
) -> tuple[FloatArray, FloatArray]:
    """One Euler step of one object, written down entry by entry (Karle et al. 2023, eqs. 3, 4 and 10)."""
    n = len(x)
    yaw, speed = float(x[2]), float(x[3])
    c, s = math.cos(yaw), math.sin(yaw)
    F = np.eye(n)
    F[0, 2], F[0, 3] = -speed * s * dt, c * dt
    F[1, 2], F[1, 3] = speed * c * dt, s * dt
    F[2, 4] = dt
    turn = np.eye(n)
    turn[:2, :2] = [[c, -s], [s, c]]
    after = x.copy()
    after[0] += speed * c * dt
    after[1] += speed * s * dt
    after[2] = min(yaw + x[4] * dt, limit)
    if driving:
        after[3] += x[5] * dt
    return after, F @ P @ F.T + turn @ np.diag(density * dt) @ turn.T


PROPAGATORS = {
    "free": (EulerCtrv, CTRV(), False, math.inf),
    "accelerated": (EulerCtrv, CTRA(), True, math.inf),
    "saturated": (SaturatedEulerCtrv, CTRV(), False, YAW_LIMIT_RAD),
    "both": (SaturatedEulerCtrv, CTRA(), True, YAW_LIMIT_RAD),
}


@pytest.mark.parametrize("kind", PROPAGATORS)
@pytest.mark.parametrize(
    "density", [ISOTROPIC, ANISOTROPIC], ids=["isotropic", "anisotropic"]
)
@settings(deadline=None, max_examples=10)
@given(seed=seeds, steps=st.lists(st.integers(0, 400), min_size=1, max_size=4))
def test_all_euler_steps_at_once_are_the_steps_one_by_one(
    kind: str, density: FloatArray, seed: int, steps: list[int]
) -> None:
    make, motion, driving, limit = PROPAGATORS[kind]
    if motion.dim == 6:
        density = np.append(density, 9e-2)
    x, P = random_states(np.random.default_rng(seed), len(steps), motion.dim)
    propagator = make(motion, density, accelerates=driving)
    x = propagator.wrap(x)
    before = x.copy(), P.copy()
    means, covariances = propagator.propagate(x, P, np.array(steps), 0.01)
    assert means.shape == x.shape
    assert np.array_equal(x, before[0])
    assert np.array_equal(P, before[1])
    for i, count in enumerate(steps):
        mean, covariance = x[i], P[i]
        for _ in range(count):
            mean, covariance = naive_step(
                mean, covariance, density, 0.01, driving, limit
            )
        np.testing.assert_allclose(means[i], mean, rtol=0.0, atol=1e-9)
        scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        assert np.abs((covariances[i] - covariance) / scale).max() < 1e-11


@pytest.mark.parametrize("motion", MODELS, ids=lambda motion: type(motion).__name__)
@settings(deadline=None, max_examples=10)
@given(seed=seeds, steps=st.lists(st.integers(0, 60), min_size=1, max_size=3))
def test_exact_steps_at_once_are_the_exact_steps_one_by_one(
    motion: MotionModel, seed: int, steps: list[int]
) -> None:
    """Means, Jacobians and noise compose, so k steps from the start are one step k times."""
    propagator = ExactPropagator(motion)
    x, P = random_states(np.random.default_rng(seed), len(steps), motion.dim)
    means, covariances = propagator.propagate(x, P, np.array(steps), 0.02)
    for i, count in enumerate(steps):
        mean, covariance = x[i, None], P[i, None]
        for _ in range(count):
            mean, covariance = propagator.propagate(
                mean, covariance, np.array([1]), 0.02
            )
        np.testing.assert_allclose(means[i], mean[0], rtol=0.0, atol=1e-9)
        deviations = np.sqrt(np.diag(covariance[0]))
        assert (
            np.abs(
                (covariances[i] - covariance[0]) / np.outer(deviations, deviations)
            ).max()
            < 1e-9
        )


def test_an_acceleration_is_carried_along_where_it_does_not_drive() -> None:
    x, P = np.array([[0.0, 0.0, 0.0, 10.0, 0.0, 3.0]]), np.eye(6)[None]
    means, _ = EulerCtrv(CTRA(), np.append(ISOTROPIC, 0.1)).propagate(
        x, P, np.array([50]), 0.01
    )
    assert means[0, 3] == 10.0
    assert means[0, 5] == 3.0


@pytest.mark.parametrize(
    ("wrap", "wrapped"),
    [
        (EulerCtrv(CTRV(), ISOTROPIC).wrap, math.pi + 0.5 - 2 * math.pi),
        (ExactPropagator(CTRV()).wrap, math.pi + 0.5 - 2 * math.pi),
        (SaturatedEulerCtrv(CTRV(), ISOTROPIC).wrap, math.pi + 0.5),
    ],
)
def test_settling_wraps_a_copy_to_the_propagators_own_range(
    wrap, wrapped: float
) -> None:
    mean = np.array([[1.0, 2.0, math.pi + 0.5, 4.0, 5.0]])
    assert wrap(mean)[0] == pytest.approx([1.0, 2.0, wrapped, 4.0, 5.0])
    assert mean[0, 2] == math.pi + 0.5


def test_the_published_yaw_range_ends_where_the_published_yaw_is_pi() -> None:
    """Its yaw is 0 along +y: pi there is 3 pi / 2 here, and -pi is left out."""
    yaws = np.array([0.0, math.pi, -math.pi / 2, -math.pi / 2 + 1e-9, 3 * math.pi / 2])
    wanted = [0.0, math.pi, 3 * math.pi / 2, -math.pi / 2 + 1e-9, 3 * math.pi / 2]
    assert published_yaw(yaws) == pytest.approx(wanted)
    assert 3 * math.pi / 2 == YAW_LIMIT_RAD


def test_a_published_residual_wraps_by_one_turn_alone() -> None:
    model = measurement_model(("x_m", "yaw_rad", "bearing_rad"), CTRV())
    z, predicted = (
        np.array([3.0, -2.0, -3.0]),
        np.array([1.0, -2.0 - 2.0 * math.pi, 3.0]),
    )
    found = SaturatedEulerCtrv(CTRV(), ISOTROPIC).residual(model, z, predicted)
    assert found == pytest.approx([2.0, 2.0 * math.pi, 2.0 * math.pi - 6.0])

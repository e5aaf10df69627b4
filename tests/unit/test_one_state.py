import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad_vec

from fgtrack.core.errors import CallError
from fgtrack.core.types import FloatArray
from fgtrack.models import arc
from fgtrack.models.arc import MAX_SMALL_TURN_RAD
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel

#: The last two have noise of one kind only, so nothing else hides an error in it.
MODELS: dict[str, MotionModel] = {
    "CTRV": CTRV(),
    "CTRA": CTRA(),
    "CV": CV(velocity_density_m2ps3=0.5),
    "CTRV, yaw": CTRV(1e-6, 0.1, 0.0, 0.0),
    "CTRA, rates": CTRA(1e-6, 0.0, 0.0, 0.2, 0.3),
}
every_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)

DURATIONS_S = st.one_of(st.sampled_from([0.0, 1e-6, 0.05, 3.0]), st.floats(1e-9, 3.0))  # stamps are whole nanoseconds
_SWITCH_RAD = MAX_SMALL_TURN_RAD
TURNS_RAD = st.one_of(
    st.floats(-0.1, 0.1),
    st.floats(-10.0, 10.0),
    st.sampled_from([0.0, 5e-324, 1e-17, -1e-8, math.nextafter(_SWITCH_RAD, 1.0), _SWITCH_RAD, -_SWITCH_RAD, 4.0]),
)


@st.composite
def cases(draw: st.DrawFn) -> tuple[FloatArray, float]:
    """A kinematic state of six entries, and a duration over which it makes a drawn turn."""
    position = st.floats(-1000.0, 1000.0)
    yaw, speed, accel = st.floats(-4.0, 4.0), st.floats(-90.0, 90.0), st.floats(-20.0, 20.0)
    dt_s, turn = draw(DURATIONS_S), draw(TURNS_RAD)
    yaw_rate = turn / dt_s if dt_s > 1e-3 else turn
    return np.array([draw(s) for s in (position, position, yaw, speed, st.just(yaw_rate), accel)]), dt_s


def state_of(model: MotionModel, kinematic: FloatArray) -> FloatArray:
    return model.from_kinematic(kinematic, np.eye(6))[0]


def assert_close(actual: FloatArray, desired: FloatArray, rtol: float = 1e-12) -> None:
    """Covariances agree relative to the standard deviations of their rows and columns."""
    std = np.sqrt(np.diag(desired))
    scale = np.where(std > 0.0, std, 1.0)
    assert_allclose(actual / np.outer(scale, scale), desired / np.outer(scale, scale), rtol=0.0, atol=rtol)


@every_model
@given(case=cases())
def test_a_step_of_one_state_is_that_of_the_arrays(model: MotionModel, case: tuple[FloatArray, float]) -> None:
    kinematic, dt_s = case
    x = state_of(model, kinematic)
    step = model.step(x.tolist(), dt_s)
    travelled = 1.0 + np.abs(x).max() + dt_s * (90.0 + 20.0 * dt_s)
    assert_allclose(step.mean, model.predict(x, dt_s), rtol=0.0, atol=1e-13 * travelled)
    assert_allclose(step.F, model.jacobian(x, dt_s), rtol=0.0, atol=1e-13 * travelled)
    assert_close(step.Q, model.process_noise(x, dt_s))
    assert_array_equal(step.Q, step.Q.T)


@every_model
@given(case=cases(), backwards=st.booleans())
def test_the_flow_of_one_state_is_that_of_the_arrays_in_both_directions(
    model: MotionModel, case: tuple[FloatArray, float], backwards: bool
) -> None:
    kinematic, dt_s = case
    x = state_of(model, kinematic)
    dt_s = -dt_s if backwards else dt_s
    mean, F = model.flow(x.tolist(), dt_s)
    travelled = 1.0 + np.abs(x).max() + abs(dt_s) * (90.0 + 20.0 * abs(dt_s))
    assert_allclose(mean, model.predict(x, dt_s), rtol=0.0, atol=1e-13 * travelled)
    assert_allclose(F, model.jacobian(x, dt_s), rtol=0.0, atol=1e-13 * travelled)
    if not backwards:
        step = model.step(x.tolist(), dt_s)
        assert_array_equal(mean, step.mean)
        assert_array_equal(F, step.F)


@every_model
@given(case=cases(), fraction=st.floats(0.0, 1.0))
def test_steps_compose(model: MotionModel, case: tuple[FloatArray, float], fraction: float) -> None:
    kinematic, dt_s = case
    kinematic[4] = np.clip(kinematic[4], -1.0, 1.0)  # the arrays' own quadrature holds up to 4 rad
    x = state_of(model, kinematic).tolist()
    whole = model.step(x, dt_s)
    first = model.step(x, fraction * dt_s)
    second = model.step(first.mean, dt_s - fraction * dt_s)
    assert_allclose(second.mean, whole.mean, rtol=1e-12, atol=1e-10)
    assert_allclose(second.F @ first.F, whole.F, rtol=1e-12, atol=1e-10)
    assert_close(second.F @ first.Q @ second.F.T + second.Q, whole.Q)


@every_model
@given(case=cases())
def test_the_noise_of_a_step_is_positive_semidefinite(model: MotionModel, case: tuple[FloatArray, float]) -> None:
    kinematic, dt_s = case
    Q = model.step(state_of(model, kinematic).tolist(), dt_s).Q
    assert np.linalg.eigvalsh(Q)[0] >= -1e-14 * np.trace(Q)


@every_model
def test_no_time_changes_nothing_to_the_bit(model: MotionModel) -> None:
    x = state_of(model, np.array([3.0, -7.0, 2.0, 30.0, 0.4, 1.0])).tolist()
    mean, F, Q = model.step(x, 0.0)
    assert mean == x
    assert_array_equal(F, np.eye(model.dim))
    assert_array_equal(Q, np.zeros((model.dim, model.dim)))


@every_model
@pytest.mark.parametrize("yaw_rate", [0.1, 3.0])
def test_a_step_gives_new_writable_arrays_and_leaves_the_state(model: MotionModel, yaw_rate: float) -> None:
    x = state_of(model, np.array([3.0, -7.0, 2.0, 30.0, yaw_rate, 1.0])).tolist()
    before = list(x)
    first = model.step(x, 1.0)
    again = model.step(x, 1.0)
    for array in (first.F, first.Q):
        array[:] = np.nan
    assert x == before
    assert np.isfinite(again.F).all()
    assert np.isfinite(model.step(x, 1.0).F).all()
    assert np.isfinite(model.step(x, 1.0).Q).all()
    assert isinstance(first.mean, list)
    assert first.F.shape == first.Q.shape == (model.dim, model.dim)


@every_model
def test_a_step_backwards_is_refused(model: MotionModel) -> None:
    with pytest.raises(CallError, match=r"dt_s is -0\.1 s"):
        model.step([0.0] * model.dim, -0.1)


@pytest.mark.parametrize("turn", [1e-3, 0.2, 0.5])
def test_the_position_noise_of_a_yaw_error_is_that_of_samples_along_the_arc(turn: float) -> None:
    """The integral of the definition as a sum over many short pieces, without the arrays' quadrature."""
    model, dt_s, pieces = CTRV(0.0, 0.3, 0.0, 0.2), 2.0, 4000
    x = np.array([0.0, 0.0, 0.7, 40.0, turn / dt_s])
    middles_s = (np.arange(pieces) + 0.5) * dt_s / pieces
    Phi = model.jacobian(model.predict(x, middles_s), dt_s - middles_s)
    total = (Phi * [0.0, 0.0, 0.3, 0.0, 0.2] @ Phi.mT).sum(axis=0) * dt_s / pieces
    assert_close(model.step(x.tolist(), dt_s).Q, np.asarray(total), rtol=1e-6)


def kernel(order: int, ramp: int, w: float, R: float) -> complex:
    """Integral over r in [0, R] of (R - r)^ramp r^order exp(i w r)."""
    return complex(quad_vec(lambda r: (R - r) ** ramp * r**order * np.exp(1j * w * r), 0.0, R, epsrel=1e-13)[0])


@pytest.mark.parametrize("ramp", [0, 1])
def test_the_series_of_the_position_noise_are_their_integrals(ramp: int) -> None:
    w = 0.47
    square = w * w
    for order in (0, 1, 4):
        even, odd = arc._kernel(order, ramp)
        found = complex(np.polyval(even[::-1], square), w * np.polyval(odd[::-1], square))
        assert found == pytest.approx(kernel(order, ramp, w, 1.0), rel=1e-13)
    for first, second in ((0, 0), (0, 1), (1, 1)):

        def products(R: float, first: int = first, second: int = second) -> FloatArray:
            a, b = kernel(first, ramp, w, R), kernel(second, ramp, w, R)
            mixed = a.real * b.imag + a.imag * b.real
            return np.array([a.real * b.real, -mixed / (2.0 * w), a.imag * b.imag / square])

        expected = quad_vec(products, 0.0, 1.0, epsrel=1e-12)[0]
        series = arc._product(first, second, ramp)
        assert_allclose([np.polyval(part[::-1], square) for part in series], expected, rtol=1e-12)
        assert all(len(part) == 9 for part in series)


@every_model
@pytest.mark.parametrize("num", [1, 6, 7, 40])
@pytest.mark.parametrize("largest_rad", [0.4, 3.0])
def test_steps_of_many_states_are_the_steps_of_each(model: MotionModel, num: int, largest_rad: float) -> None:
    rng = np.random.default_rng([num, int(largest_rad)])
    dt_s = rng.choice([0.0, 1e-6, 0.05, 1.0], num)
    turn = rng.uniform(-largest_rad, largest_rad, num)
    kinematic = rng.normal(size=(num, 6)) * [500.0, 500.0, 2.0, 40.0, 1.0, 8.0]
    kinematic[:, 4] = np.where(dt_s > 1e-3, turn / np.maximum(dt_s, 1e-3), turn)
    states = np.array([state_of(model, row) for row in kinematic])
    found = model.steps(states, dt_s)
    for k in range(num):
        expected = model.step(states[k].tolist(), float(dt_s[k]))
        assert_allclose(found.mean[k], expected.mean, rtol=1e-12, atol=1e-9)
        assert_allclose(found.F[k], expected.F, rtol=1e-12, atol=1e-12)
        assert_close(found.Q[k], expected.Q)


def test_steps_go_forwards_only() -> None:
    with pytest.raises(CallError, match=r"dt_s is -0\.1 s"):
        CTRV().steps(np.zeros((10, 5)), np.full(10, -0.1))

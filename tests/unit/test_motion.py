import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from fgtrack.core.errors import CallError
from fgtrack.core.types import FloatArray
from fgtrack.models.motion import CTRA, CTRV, CV, MIN_SPEED_MPS, MotionModel

MODELS: tuple[MotionModel, ...] = (CTRV(), CTRA(), CV(velocity_density_m2ps3=0.5))
ARCS: tuple[CTRV, ...] = (CTRV(), CTRA())
every_model = pytest.mark.parametrize("model", MODELS, ids=lambda model: type(model).__name__)
every_arc = pytest.mark.parametrize("model", ARCS, ids=lambda model: type(model).__name__)

YAW_RATES_RADPS = st.one_of(
    st.floats(-1.0, 1.0), st.sampled_from([0.0, 5e-324, 1e-300, 1e-17, -1e-12, 1e-8, -1e-5, 1e-3])
)


@st.composite
def states(draw: st.DrawFn) -> FloatArray:
    """A kinematic state of six entries; the models take the leading ones that they have."""
    position = st.floats(-1000.0, 1000.0)
    yaw, speed, accel = st.floats(-4.0, 4.0), st.floats(-90.0, 90.0), st.floats(-20.0, 20.0)
    return np.array([draw(s) for s in (position, position, yaw, speed, YAW_RATES_RADPS, accel)])


def state_of(model: MotionModel, kinematic: FloatArray) -> FloatArray:
    return model.from_kinematic(kinematic, np.eye(6))[0]


def derivative_in_time(model: MotionModel, x: FloatArray) -> FloatArray:
    """The differential equation of the model, written down without its solution."""
    if model.cartesian:
        return np.array([x[2], x[3], 0.0, 0.0])
    accel = x[5] if model.dim == 6 else 0.0
    rates = np.array([x[3] * math.cos(x[2]), x[3] * math.sin(x[2]), x[4], accel, 0.0, 0.0])
    return rates[: model.dim]


def assert_close_to_scale(actual: FloatArray, desired: FloatArray, rtol: float) -> None:
    """Covariances agree relative to the standard deviations of their rows and columns."""
    std = np.sqrt(np.diag(desired))
    scale = np.where(std > 0.0, std, 1.0)
    assert_allclose(actual / np.outer(scale, scale), desired / np.outer(scale, scale), rtol=0.0, atol=rtol)


@every_model
def test_every_model_keeps_the_protocol(model: MotionModel) -> None:
    assert isinstance(model, MotionModel)
    assert model.dim == len(model.state_names)
    assert model.linear == model.cartesian
    assert model in {model}


@every_model
@given(kinematic=states())
def test_no_time_changes_nothing_to_the_bit(model: MotionModel, kinematic: FloatArray) -> None:
    x = state_of(model, kinematic)
    assert_array_equal(model.predict(x, 0.0), x)
    assert_array_equal(model.jacobian(x, 0.0), np.eye(model.dim))
    assert_array_equal(model.process_noise(x, 0.0), np.zeros((model.dim, model.dim)))


@every_model
@given(kinematic=states(), dt_s=st.floats(-3.0, 3.0))
def test_the_flow_solves_its_differential_equation(model: MotionModel, kinematic: FloatArray, dt_s: float) -> None:
    x = state_of(model, kinematic)
    solution = solve_ivp(
        lambda _, y: derivative_in_time(model, y), (0.0, dt_s), x, method="DOP853", rtol=1e-11, atol=1e-9
    )
    assert_allclose(model.predict(x, dt_s), solution.y[:, -1], rtol=1e-9, atol=1e-6)


@every_model
@given(kinematic=states(), a_s=st.floats(-5.0, 5.0), b_s=st.floats(-5.0, 5.0))
def test_the_flow_and_its_jacobian_compose_forwards_and_backwards(
    model: MotionModel, kinematic: FloatArray, a_s: float, b_s: float
) -> None:
    x = state_of(model, kinematic)
    between = model.predict(x, a_s)
    assert_allclose(model.predict(between, b_s), model.predict(x, a_s + b_s), rtol=1e-12, atol=1e-10)
    chained = model.jacobian(between, b_s) @ model.jacobian(x, a_s)
    assert_allclose(chained, model.jacobian(x, a_s + b_s), rtol=1e-12, atol=1e-10)


@every_model
@given(kinematic=states(), dt_s=st.floats(-2.0, 2.0))
def test_the_jacobian_is_the_numeric_derivative(model: MotionModel, kinematic: FloatArray, dt_s: float) -> None:
    x = state_of(model, kinematic)
    step = 1e-4 * np.eye(model.dim)
    numeric = (model.predict(x + step, dt_s) - model.predict(x - step, dt_s)).T / 2e-4
    assert_allclose(model.jacobian(x, dt_s), numeric, rtol=1e-6, atol=1e-5)


@every_model
@given(kinematic=states(), duration_s=st.floats(1e-6, 5.0), fraction=st.floats(0.0, 1.0))
def test_a_split_segment_gathers_the_same_noise(
    model: MotionModel, kinematic: FloatArray, duration_s: float, fraction: float
) -> None:
    kinematic[4] = np.clip(kinematic[4], -1.0 / duration_s, 1.0 / duration_s)
    x = state_of(model, kinematic)
    a_s = fraction * duration_s
    b_s = duration_s - a_s
    between = model.predict(x, a_s)
    F = model.jacobian(between, b_s)
    parts = F @ model.process_noise(x, a_s) @ F.T + model.process_noise(between, b_s)
    assert_close_to_scale(parts, model.process_noise(x, duration_s), rtol=1e-12)


@every_model
@given(kinematic=states(), dt_s=st.floats(0.0, 5.0))
def test_process_noise_is_symmetric_and_positive_semidefinite(
    model: MotionModel, kinematic: FloatArray, dt_s: float
) -> None:
    Q = model.process_noise(state_of(model, kinematic), dt_s)
    assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q)[0] >= -1e-13 * np.trace(Q)


@every_arc
def test_process_noise_of_an_arc_is_the_integral_of_its_definition(model: CTRV) -> None:
    x = np.array([1.0, 2.0, 0.4, 30.0, 0.6, -4.0])[: model.dim]
    densities = np.array([0.0004, 0.0004, 0.0009, 0.01, 0.0025, 0.09])[: model.dim]

    def integrand(s: float) -> FloatArray:
        transition = model.jacobian(model.predict(x, s), 1.5 - s)
        return transition @ np.diag(densities) @ transition.T

    integral = quad_vec(integrand, 0.0, 1.5, epsrel=1e-12)[0]
    assert_close_to_scale(model.process_noise(x, 1.5), integral, rtol=1e-11)


def test_process_noise_of_constant_velocity_is_that_of_van_loan() -> None:
    model, dt_s = CV(velocity_density_m2ps3=0.7), 1.3
    rates = np.zeros((4, 4))
    rates[0, 2] = rates[1, 3] = 1.0
    block = np.block([[-rates, np.diag([0.0, 0.0, 0.7, 0.7])], [np.zeros((4, 4)), rates.T]])
    exponential = expm(block * dt_s)
    F = exponential[4:, 4:].T
    x = np.zeros(4)
    assert_allclose(model.jacobian(x, dt_s), F, atol=1e-14)
    assert_allclose(model.process_noise(x, dt_s), F @ exponential[:4, 4:], atol=1e-14)


@every_arc
def test_an_arc_becomes_the_straight_line_as_the_yaw_rate_vanishes(model: CTRV) -> None:
    straight = np.array([5.0, -3.0, 0.7, 40.0, 0.0, 2.0])[: model.dim]
    accel = 2.0 if model.dim == 6 else 0.0
    distance_m = 40.0 * 1.5 + 0.5 * accel * 1.5**2
    expected = [5.0 + distance_m * math.cos(0.7), -3.0 + distance_m * math.sin(0.7)]
    assert_allclose(model.predict(straight, 1.5)[:2], expected, rtol=1e-15)
    for yaw_rate in (5e-324, 1e-300, 1e-200, 1e-20, -1e-16):
        x = straight.copy()
        x[4] = yaw_rate
        assert_allclose(model.predict(x, 1.5), model.predict(straight, 1.5), rtol=1e-14, atol=1e-15)
        assert_allclose(model.jacobian(x, 1.5), model.jacobian(straight, 1.5), rtol=1e-14, atol=1e-13)


@every_arc
def test_nothing_jumps_where_the_closed_form_takes_over(model: CTRV) -> None:
    below = np.array([0.0, 0.0, 0.3, 50.0, 4.0, 3.0])[: model.dim]
    above = below.copy()
    above[4] = np.nextafter(4.0, 5.0)
    for sign in (1.0, -1.0):
        assert_allclose(model.predict(above, sign), model.predict(below, sign), rtol=1e-13)
        assert_allclose(model.jacobian(above, sign), model.jacobian(below, sign), rtol=1e-12, atol=1e-13)


@every_arc
@pytest.mark.parametrize("yaw_rate", [1e-9, 1e-3, 0.5, 3.9, 4.1, -20.0, 300.0])
def test_an_arc_is_exact_relative_to_its_own_length(model: CTRV, yaw_rate: float) -> None:
    """The circle from chord and half angle, where nothing cancels; CTRA without acceleration."""
    x = np.array([0.0, 0.0, 0.2, 30.0, yaw_rate, 0.0])[: model.dim]
    half = 0.5 * yaw_rate * 1.0
    chord = 30.0 * math.sin(half) / half
    expected = np.array([chord * math.cos(0.2 + half), chord * math.sin(0.2 + half)])
    tolerance = 1e-13 * max(abs(chord), 0.01)
    assert_allclose(model.predict(x, 1.0)[:2], expected, rtol=0.0, atol=tolerance)


def test_full_circles_return_to_the_start_and_the_yaw_counts_them() -> None:
    x = np.array([3.0, 4.0, 0.5, 20.0, 2.0 * math.pi])
    after = CTRV().predict(x, 3.0)
    assert_allclose(after, [3.0, 4.0, 0.5 + 6.0 * math.pi, 20.0, 2.0 * math.pi], rtol=1e-13)


@every_model
def test_many_states_and_durations_at_once_equal_one_by_one(model: MotionModel) -> None:
    rng = np.random.default_rng(4)
    scale = np.array([100.0, 100.0, 2.0, 30.0, 2.0, 5.0])[: model.dim]
    x = rng.normal(size=(3, 4, model.dim)) * scale
    dt_s = rng.uniform(0.0, 4.0, size=(3, 4))
    for method in (model.predict, model.jacobian, model.process_noise):
        together = method(x, dt_s)
        for index in np.ndindex(3, 4):
            assert_allclose(together[index], method(x[index], float(dt_s[index])), rtol=1e-13, atol=1e-11)
        assert_allclose(method(x[0, 0], dt_s)[2, 1], method(x[0, 0], float(dt_s[2, 1])), rtol=1e-13, atol=1e-11)
        assert_allclose(method(x, 0.5)[2, 1], method(x[2, 1], 0.5), rtol=1e-13, atol=1e-11)


@every_model
@pytest.mark.parametrize("num", [1, 4, 60])
def test_many_steps_at_once_are_what_the_equations_give(model: MotionModel, num: int) -> None:
    rng = np.random.default_rng(num)
    kinematic = rng.normal(size=(num, 6)) * [50.0, 50.0, 2.0, 40.0, 0.8, 4.0]
    x, _ = model.from_kinematic(kinematic, np.tile(np.eye(6), (num, 1, 1)))
    dt_s = rng.uniform(0.0, 0.15, num)
    dt_s[: num // 4] = 0.0
    found = model.steps(x, dt_s)
    assert_allclose(found.mean, model.predict(x, dt_s), atol=1e-12)
    assert_allclose(found.F, model.jacobian(x, dt_s), atol=1e-12)
    Q = model.process_noise(x, dt_s)
    std = np.sqrt(np.diagonal(Q, axis1=1, axis2=2))
    assert (np.abs(found.Q - Q) <= 1e-13 * std[:, :, None] * std[:, None]).all()


@every_arc
def test_steps_that_turn_far_or_take_no_sense_are_left_to_the_equations(model: MotionModel) -> None:
    x = np.tile([0.0, 0.0, 0.3, 20.0, 9.0, 1.0][: model.dim], (5, 1))
    found = model.steps(x, np.full(5, 0.3))
    assert_array_equal(found.Q, model.process_noise(x, np.full(5, 0.3)))
    with pytest.raises(CallError, match="noise needs a duration"):
        model.steps(x, np.full(5, -0.01))


@every_model
def test_inputs_stay_as_they_are(model: MotionModel) -> None:
    x, dt_s = np.ones((2, model.dim)), np.array([0.5, 1.0])
    P = np.broadcast_to(np.eye(model.dim), (2, model.dim, model.dim)).copy()
    for array in (x, dt_s, P):
        array.flags.writeable = False
    for method in (model.predict, model.jacobian, model.process_noise):
        assert not np.shares_memory(method(x, dt_s), x)
    model.from_kinematic(*model.kinematic(x, P))


@every_model
def test_noise_over_a_negative_duration_is_refused(model: MotionModel) -> None:
    with pytest.raises(CallError, match=r"dt_s is -0\.1 s"):
        model.process_noise(np.zeros((2, model.dim)), np.array([0.2, -0.1]))


def test_the_default_noise_is_that_of_the_paper() -> None:
    std = {"position": 0.2, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5}
    assert CTRV.from_std_per_step(std, 100.0) == CTRV()
    assert CTRA.from_std_per_step({**std, "accel": 3.0}, 100.0) == CTRA()
    assert CV.from_std_per_step({"velocity": 1.0}, 100.0) == CV()


def test_one_step_of_the_stepping_filter_has_its_variance_on_the_diagonal() -> None:
    frequency_hz = 50.0
    model = CTRV.from_std_per_step({"position": 0.2, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5}, frequency_hz)
    variances = np.diag(model.process_noise(np.zeros(5), 1.0 / frequency_hz))
    steps = (np.array([0.2, 0.2, 0.3, 1.0, 0.5]) / frequency_hz) ** 2
    assert_allclose(variances[3:], steps[3:], rtol=1e-13)  # the others also gather the noise of their rates
    assert (variances[:3] >= steps[:3]).all()
    assert_allclose(variances[:3], steps[:3], rtol=1e-2)


@pytest.mark.parametrize(
    ("std", "frequency_hz", "message"),
    [
        ({"position": 0.2, "yaw": 0.3, "speed": 1.0}, 100.0, "give position, yaw, speed, yaw_rate"),
        ({"position": 0.2, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5, "accel": 1.0}, 100.0, "accel"),
        ({"position": 0.2, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5}, 0.0, "frequency_hz: must be positive"),
        ({"position": math.nan, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5}, 1.0, "position_density_m2ps"),
    ],
)
def test_a_bad_noise_is_refused_by_name(std: dict[str, float], frequency_hz: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CTRV.from_std_per_step(std, frequency_hz)


def test_a_negative_density_is_refused() -> None:
    with pytest.raises(ValueError, match="velocity_density_m2ps3: must be finite and not negative, is -1"):
        CV(velocity_density_m2ps3=-1.0)


def random_covariance(rng: np.random.Generator, std: FloatArray) -> FloatArray:
    root = rng.normal(size=(len(std), len(std)))
    return np.asarray((root @ root.T) * np.outer(std, std))


def test_arcs_give_their_state_and_adapt_the_acceleration_of_a_birth() -> None:
    rng = np.random.default_rng(1)
    mean, covariance = np.arange(6.0), random_covariance(rng, np.ones(6))
    for got, expected in zip(CTRA().kinematic(mean, covariance), (mean, covariance), strict=True):
        assert_array_equal(got, expected)
    for got, expected in zip(CTRA().from_kinematic(mean, covariance), (mean, covariance), strict=True):
        assert_array_equal(got, expected)
    x, P = CTRV().from_kinematic(mean, covariance)
    assert_array_equal(x, mean[:5])
    assert_array_equal(P, covariance[:5, :5])
    x, P = CTRA(accel_birth_variance_m2ps4=7.0).from_kinematic(x, P)
    assert_array_equal(x, [0.0, 1.0, 2.0, 3.0, 4.0, 0.0])
    assert_array_equal(P[:5, :5], covariance[:5, :5])
    assert_array_equal(P[5], [0.0, 0.0, 0.0, 0.0, 0.0, 7.0])


def test_the_kinematic_view_of_constant_velocity_is_its_linear_image() -> None:
    rng = np.random.default_rng(2)
    model = CV()
    x = rng.normal(size=(5, 4)) * [100.0, 100.0, 30.0, 30.0]
    P = np.stack([random_covariance(rng, np.array([0.5, 0.5, 1.0, 1.0])) for _ in range(5)])
    mean, covariance = model.kinematic(x, P)
    assert_allclose(mean[:, 2], np.arctan2(x[:, 3], x[:, 2]))
    assert_allclose(mean[:, 3] ** 2, x[:, 2] ** 2 + x[:, 3] ** 2)
    for i in range(5):
        step = 1e-5 * np.eye(4)
        J = (model.kinematic(x[i] + step, P[:4])[0] - model.kinematic(x[i] - step, P[:4])[0]).T / 2e-5
        assert_allclose(covariance[i], J @ P[i] @ J.T, rtol=1e-6, atol=1e-8)
    assert_array_equal(covariance[:, 4, :], 0.0)


def test_constant_velocity_survives_the_round_trip_through_the_kinematic_view() -> None:
    rng = np.random.default_rng(3)
    model = CV()
    x = rng.normal(size=(5, 4)) * [100.0, 100.0, 30.0, 30.0]
    P = np.stack([random_covariance(rng, np.full(4, 1e-3)) for _ in range(5)])
    back, covariance = model.from_kinematic(*model.kinematic(x, P))
    assert_allclose(back, x, rtol=1e-13)
    assert_allclose(covariance, P, rtol=1e-4, atol=1e-10)  # but for the second-order term


def test_at_speed_zero_the_heading_is_unknown_but_finite() -> None:
    mean, covariance = CV().kinematic(np.array([1.0, 2.0, 0.0, 0.0]), np.diag([1.0, 1.0, 4.0, 9.0]))
    assert_array_equal(mean, [1.0, 2.0, 0.0, 0.0, 0.0])
    assert_allclose(np.diag(covariance), [1.0, 1.0, 9.0 / MIN_SPEED_MPS**2, 4.0, 0.0])


@given(yaw=st.floats(-3.0, 3.0), speed=st.sampled_from([0.0, 3.0]))
def test_a_birth_with_constant_velocity_has_the_spread_of_its_samples(yaw: float, speed: float) -> None:
    """Also at speed 0, where the first order alone would be singular."""
    mean = np.array([0.0, 0.0, yaw, speed, 0.0])
    covariance = np.diag([1.0, 1.0, 0.05**2, 2.0**2, 1.0])
    P = CV().from_kinematic(mean, covariance)[1]
    rng = np.random.default_rng(0)
    yaws, speeds = yaw + 0.05 * rng.normal(size=40_000), speed + 2.0 * rng.normal(size=40_000)
    samples = np.cov(np.stack([speeds * np.cos(yaws), speeds * np.sin(yaws)]))
    assert_allclose(np.linalg.eigvalsh(P[2:, 2:]), np.linalg.eigvalsh(samples), rtol=0.03)
    assert_allclose(P[2:, 2:], samples, atol=0.05)
    assert np.linalg.eigvalsh(P)[0] > 0.0


def test_a_birth_at_rest_is_as_uncertain_across_its_heading_as_the_product_of_yaw_and_speed() -> None:
    """E[(a b)^2] - E[a b]^2 = var(a) var(b) + cov(a, b)^2 of Gaussians."""
    covariance = np.diag([1.0, 1.0, 0.05**2, 2.0**2, 1.0])
    covariance[2, 3] = covariance[3, 2] = 0.06
    P = CV().from_kinematic(np.zeros(5), covariance)[1]
    assert_allclose(P[2:, 2:], np.diag([2.0**2, 0.05**2 * 2.0**2 + 0.06**2]), rtol=1e-14)


def test_noise_grows_with_time_along_the_arc() -> None:
    x = np.array([0.0, 0.0, 0.3, 40.0, 0.2])
    noises = [CTRV().process_noise(x, dt_s) for dt_s in (0.1, 0.2, 0.5, 1.0, 2.0)]
    assert all((np.diag(late) > np.diag(early)).all() for early, late in pairwise(noises))

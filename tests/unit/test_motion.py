import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.motion import CT, CTRA, CTRV, CV, MIN_SPEED_MPS, MotionModel

MODELS: tuple[MotionModel, ...] = (CTRV(), CTRA(), CV(velocity_density_m2ps3=0.5))
ARCS: tuple[CTRV, ...] = (CTRV(), CTRA())
TURNS: tuple[CTRV, ...] = (
    CTRV(yaw_rate_std_radps=math.inf),
    CTRA(yaw_rate_std_radps=math.inf),
)
RESTLESS = (
    CTRV(yaw_rate_density_rad2ps3=2.0, slow_mps=2.0),
    CTRA(yaw_rate_density_rad2ps3=2.0, slow_mps=2.0),
)
every_model = pytest.mark.parametrize(
    "model", MODELS, ids=lambda model: type(model).__name__
)
every_arc = pytest.mark.parametrize(
    "model", ARCS, ids=lambda model: type(model).__name__
)
every_turn = pytest.mark.parametrize(
    "model", TURNS, ids=lambda model: type(model).__name__
)

YAW_RATES_RADPS = st.one_of(
    st.floats(-1.0, 1.0),
    st.sampled_from([0.0, 5e-324, 1e-300, 1e-17, -1e-12, 1e-8, -1e-5, 1e-3, 0.5, -4.0]),
)


@st.composite
def states(draw: st.DrawFn) -> FloatArray:
    """A kinematic state of six entries; the models take the leading ones that they have."""
    position = st.floats(-1000.0, 1000.0)
    yaw, speed, accel = (
        st.floats(-4.0, 4.0),
        st.floats(-90.0, 90.0),
        st.floats(-20.0, 20.0),
    )
    return np.array(
        [draw(s) for s in (position, position, yaw, speed, YAW_RATES_RADPS, accel)]
    )


def state_of(model: MotionModel, kinematic: FloatArray) -> FloatArray:
    return model.from_kinematic(kinematic, np.eye(6))[0]


def derivative_in_time(model: MotionModel, x: FloatArray) -> FloatArray:
    """The differential equation of the model, written down without its solution."""
    if model.cartesian:
        return np.array([x[2], x[3], 0.0, 0.0])
    accel = x[5] if model.dim == 6 else 0.0
    assert isinstance(model, CTRV)
    relaxation_hz = model.yaw_rate_density_rad2ps3 / (2.0 * model.yaw_rate_std_radps**2)
    rates = np.array(
        [
            x[3] * math.cos(x[2]),
            x[3] * math.sin(x[2]),
            x[4],
            accel,
            -relaxation_hz * x[4],
            0.0,
        ]
    )
    return rates[: model.dim]


def assert_close_to_scale(actual: FloatArray, desired: FloatArray, rtol: float) -> None:
    """Covariances agree relative to the standard deviations of their rows and columns."""
    std = np.sqrt(np.diag(desired))
    scale = np.where(std > 0.0, std, 1.0)
    assert_allclose(
        actual / np.outer(scale, scale),
        desired / np.outer(scale, scale),
        rtol=0.0,
        atol=rtol,
    )


@every_model
@given(kinematic=states())
def test_no_time_changes_nothing_to_the_bit(
    model: MotionModel, kinematic: FloatArray
) -> None:
    x = state_of(model, kinematic)
    assert_array_equal(model.predict(x, 0.0), x)
    assert_array_equal(model.jacobian(x, 0.0), np.eye(model.dim))
    assert_array_equal(model.process_noise(x, 0.0), np.zeros((model.dim, model.dim)))


@every_model
@given(kinematic=states(), dt_s=st.floats(-3.0, 3.0))
def test_the_flow_solves_its_differential_equation(
    model: MotionModel, kinematic: FloatArray, dt_s: float
) -> None:
    x = state_of(model, kinematic)
    solution = solve_ivp(
        lambda _, y: derivative_in_time(model, y),
        (0.0, dt_s),
        x,
        method="DOP853",
        rtol=1e-11,
        atol=1e-9,
    )
    assert_allclose(model.predict(x, dt_s), solution.y[:, -1], rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("model", [*ARCS, *TURNS, *RESTLESS])
@pytest.mark.parametrize("speed_mps", [30.0, 1.5, 0.0, -3.0])
def test_process_noise_of_an_arc_is_the_integral_of_its_definition(
    model: CTRV, speed_mps: float
) -> None:
    x = np.array([1.0, 2.0, 0.4, speed_mps, 0.6, 4.0])[: model.dim]

    def integrand(s: float) -> FloatArray:
        at = model.predict(x, s)
        densities = model.density.copy()
        densities[2] += (
            model.resting_yaw_rad2ps / (1.0 + (at[3] / model.slow_mps) ** 2) ** 2
        )
        transition = model.jacobian(at, 1.5 - s)
        return transition @ np.diag(densities) @ transition.T

    integral = quad_vec(integrand, 0.0, 1.5, epsrel=1e-12)[0]
    assert_close_to_scale(model.process_noise(x, 1.5), integral, rtol=1e-10)


@every_arc
def test_an_unmeasured_yaw_rate_keeps_its_variance_at_any_time(model: CTRV) -> None:
    """Ornstein-Uhlenbeck: the stationary variance is carried on by F and Q, over a second or a day."""
    for dt_s in (0.02, 1.0, 600.0):
        x = np.zeros(model.dim)
        F, Q = model.jacobian(x, dt_s), model.process_noise(x, dt_s)
        assert F[4, 4] ** 2 * 0.25 + Q[4, 4] == pytest.approx(0.25, rel=1e-9)


def test_process_noise_of_constant_velocity_is_that_of_van_loan() -> None:
    model, dt_s = CV(velocity_density_m2ps3=0.7), 1.3
    rates = np.zeros((4, 4))
    rates[0, 2] = rates[1, 3] = 1.0
    block = np.block(
        [[-rates, np.diag([0.0, 0.0, 0.7, 0.7])], [np.zeros((4, 4)), rates.T]]
    )
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
        assert_allclose(
            model.predict(x, 1.5), model.predict(straight, 1.5), rtol=1e-14, atol=1e-15
        )
        assert_allclose(
            model.jacobian(x, 1.5),
            model.jacobian(straight, 1.5),
            rtol=1e-14,
            atol=1e-13,
        )


@every_turn
@pytest.mark.parametrize("yaw_rate", [1e-9, 1e-3, 0.5, 3.9, 4.1, -20.0, 300.0])
def test_an_arc_is_exact_relative_to_its_own_length(
    model: CTRV, yaw_rate: float
) -> None:
    """The circle from chord and half angle, where nothing cancels; CTRA without acceleration."""
    x = np.array([0.0, 0.0, 0.2, 30.0, yaw_rate, 0.0])[: model.dim]
    half = 0.5 * yaw_rate * 1.0
    chord = 30.0 * math.sin(half) / half
    expected = np.array([chord * math.cos(0.2 + half), chord * math.sin(0.2 + half)])
    tolerance = 1e-13 * max(abs(chord), 0.01)
    assert_allclose(model.predict(x, 1.0)[:2], expected, rtol=0.0, atol=tolerance)


def test_a_yaw_rate_that_no_object_has_gives_no_number() -> None:
    for part in CTRV().transition(np.array([0.0, 0.0, 0.0, 1.0, 1e6]), 1.0):
        assert np.isnan(part).all()


def test_the_default_noise_is_that_of_the_paper() -> None:
    std = {"position": 0.2, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5}
    assert CTRV.from_std_per_step(std, 100.0) == CTRV()
    assert CTRA.from_std_per_step({**std, "accel": 3.0}, 100.0) == CTRA()
    assert CV.from_std_per_step({"velocity": 1.0}, 100.0) == CV()


@pytest.mark.parametrize(
    ("std", "frequency_hz", "message"),
    [
        (
            {"position": 0.2, "yaw": 0.3, "speed": 1.0},
            100.0,
            "give position, yaw, speed, yaw_rate",
        ),
        (
            {"position": 0.2, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5, "accel": 1.0},
            100.0,
            "accel",
        ),
        (
            {"position": math.nan, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5},
            1.0,
            "position_density_m2ps",
        ),
    ],
)
def test_a_bad_noise_is_refused_by_name(
    std: dict[str, float], frequency_hz: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        CTRV.from_std_per_step(std, frequency_hz)


def random_covariance(rng: np.random.Generator, std: FloatArray) -> FloatArray:
    root = rng.normal(size=(len(std), len(std)))
    return np.asarray((root @ root.T) * np.outer(std, std))


def test_arcs_give_their_state() -> None:
    rng = np.random.default_rng(1)
    mean, covariance = np.arange(6.0), random_covariance(rng, np.ones(6))
    for got, expected in zip(
        CTRA().kinematic(mean, covariance), (mean, covariance), strict=True
    ):
        assert_array_equal(got, expected)
    for got, expected in zip(
        CTRA().from_kinematic(mean, covariance), (mean, covariance), strict=True
    ):
        assert_array_equal(got, expected)
    x, P = CTRV().from_kinematic(mean, covariance)
    assert_array_equal(x, mean[:5])
    assert_array_equal(P, covariance[:5, :5])


def test_the_kinematic_view_of_constant_velocity_is_its_linear_image() -> None:
    rng = np.random.default_rng(2)
    model = CV()
    x = rng.normal(size=(5, 4)) * [100.0, 100.0, 30.0, 30.0]
    P = np.stack(
        [random_covariance(rng, np.array([0.5, 0.5, 1.0, 1.0])) for _ in range(5)]
    )
    mean, covariance = model.kinematic(x, P)
    assert_allclose(mean[:, 2], np.arctan2(x[:, 3], x[:, 2]))
    assert_allclose(mean[:, 3] ** 2, x[:, 2] ** 2 + x[:, 3] ** 2)
    for i in range(5):
        step = 1e-5 * np.eye(4)
        J = (
            model.kinematic(x[i] + step, P[:4])[0]
            - model.kinematic(x[i] - step, P[:4])[0]
        ).T / 2e-5
        assert_allclose(covariance[i], J @ P[i] @ J.T, rtol=1e-6, atol=1e-8)
    assert_array_equal(covariance[:, 4, :], 0.0)


@pytest.mark.parametrize("ratio", [0.03, 0.06, 0.12])
def test_the_published_yaw_of_a_slow_object_is_as_uncertain_as_samples_of_its_velocity(
    ratio: float,
) -> None:
    model, rng, x = CT(), np.random.default_rng(6), np.array([1.0, 2.0, 3.0, 4.0, 0.1])
    P = np.eye(5)
    P[2:4, 2:4] *= 25.0 * ratio
    samples = rng.multivariate_normal(x, P, 400_000)
    mean = model.published(x, P)[0][2]
    errors = (
        np.arctan2(samples[:, 3], samples[:, 2]) - mean + math.pi
    ) % math.tau - math.pi
    first, second = model.kinematic(x, P)[1][2, 2], model.published(x, P)[1][2, 2]
    assert first == pytest.approx(ratio)
    assert second == pytest.approx(ratio + ratio**2)
    assert abs(second - np.var(errors)) < 0.5 * abs(first - np.var(errors))


def test_correlated_errors_along_and_across_the_heading_make_the_published_yaw_less_certain() -> (
    None
):
    P = np.eye(5)
    P[2, 3] = P[3, 2] = 0.5
    x = np.array([0.0, 0.0, 2.0, 0.0, 0.0])
    assert CT().published(x, P)[1][2, 2] == pytest.approx(
        1.0 / 2.0**2 + (1.0 + 0.5**2) / 2.0**4
    )


def test_at_speed_zero_the_heading_is_unknown_but_finite() -> None:
    mean, covariance = CV().kinematic(
        np.array([1.0, 2.0, 0.0, 0.0]), np.diag([1.0, 1.0, 4.0, 9.0])
    )
    assert_array_equal(mean, [1.0, 2.0, 0.0, 0.0, 0.0])
    assert_allclose(np.diag(covariance), [1.0, 1.0, 9.0 / MIN_SPEED_MPS**2, 4.0, 0.0])


def test_a_birth_at_rest_is_as_uncertain_across_its_heading_as_the_product_of_yaw_and_speed() -> (
    None
):
    """E[(a b)^2] - E[a b]^2 = var(a) var(b) + cov(a, b)^2 of Gaussians."""
    covariance = np.diag([1.0, 1.0, 0.05**2, 2.0**2, 1.0])
    covariance[2, 3] = covariance[3, 2] = 0.06
    P = CV().from_kinematic(np.zeros(5), covariance)[1]
    assert_allclose(
        P[2:, 2:], np.diag([2.0**2, 0.05**2 * 2.0**2 + 0.06**2]), rtol=1e-14
    )


@pytest.mark.parametrize("model", [CTRV(), CT()], ids=["ctrv", "ct"])
def test_a_state_that_is_predicted_over_years_is_finite(model: MotionModel) -> None:
    x = np.array([1.0, 2.0, 3.0, 4.0, 0.0])
    mean, F, Q = model.transition(x, 1.6e9)
    assert np.isfinite(mean).all()
    assert np.isfinite(F).all()
    assert np.linalg.eigvalsh(Q)[0] > 0.0
    assert Q[0, 0] > 1e6**2


class Accelerating(CV):
    """Constant acceleration."""

    state_names = ("x_m", "y_m", "vx_mps", "vy_mps", "ax_mps2", "ay_mps2")


class Walking(CV):
    """Yaw and speed instead of the velocity, and no yaw rate."""

    state_names = ("x_m", "y_m", "yaw_rad", "speed_mps", "stride_m", "height_m")
    linear = False

    def start_variance(self, name: str) -> float:
        return {"stride_m": 0.01, "height_m": 0.04}[name]


MODEL, WALK = Accelerating(), Walking()


def test_what_a_kinematic_state_lacks_starts_at_zero_with_the_model_s_variance() -> (
    None
):
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


def test_an_object_of_unknown_direction_starts_with_any_velocity_and_the_model_s_other_entries() -> (
    None
):
    mean, P = initial_state(
        MODEL, Start(position_m=(5.0, 6.0), position_std_m=2.0, speed_std_mps=3.0)
    )
    assert_array_equal(mean, [5.0, 6.0, 0.0, 0.0, 0.0, 0.0])
    assert_allclose(P, np.diag([4.0, 4.0, 9.0, 9.0, 1.0, 1.0]))

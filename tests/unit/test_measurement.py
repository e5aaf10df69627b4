import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from support.models import MODELS

from fgtrack.core.errors import CallError
from fgtrack.core.types import MEASURABLE, FloatArray
from fgtrack.models.measurement import (
    COMPONENTS,
    MIN_RANGE_M,
    SLOW_MPS,
    MeasurementModel,
    SensorPose,
    measurement_model,
)
from fgtrack.models.motion import CTRV, CV, MIN_SPEED_MPS, MotionModel

every_model = pytest.mark.parametrize(
    "motion", MODELS, ids=lambda model: type(model).__name__
)
SELECTION = ("x_m", "y_m", "yaw_rad", "speed_mps")
DOPPLER = ("range_m", "bearing_rad", "range_rate_mps")


@st.composite
def poses(draw: st.DrawFn) -> SensorPose:
    position, yaw, velocity = (
        st.floats(-100.0, 100.0),
        st.floats(-4.0, 4.0),
        st.floats(-50.0, 50.0),
    )
    return SensorPose(*(draw(s) for s in (position, position, yaw, velocity, velocity)))


@st.composite
def kinematics(draw: st.DrawFn) -> FloatArray:
    """x, y, yaw, speed, yaw rate, acceleration of an object that is not far away and not quite at rest."""
    position, yaw, speed = (
        st.floats(-200.0, 200.0),
        st.floats(-3.0, 3.0),
        st.floats(0.5, 90.0),
    )
    return np.array([draw(s) for s in (position, position, yaw, speed)] + [0.1, 1.0])


def state_of(motion: MotionModel, kinematic: FloatArray) -> FloatArray:
    return motion.from_kinematic(kinematic, np.eye(6))[0]


def one_by_hand(name: str, kinematic: FloatArray, pose: SensorPose) -> float:
    """The component in words: the object in the frame of the sensor, by plain trigonometry."""
    x, y, yaw, speed = kinematic[:4]
    east, north = x - pose.x_m, y - pose.y_m
    distance = math.sqrt(east**2 + north**2)
    ahead = east * math.cos(pose.yaw_rad) + north * math.sin(pose.yaw_rad)
    left = north * math.cos(pose.yaw_rad) - east * math.sin(pose.yaw_rad)
    opening = east * (speed * math.cos(yaw) - pose.vx_mps) + north * (
        speed * math.sin(yaw) - pose.vy_mps
    )
    values = {
        "x_m": x,
        "y_m": y,
        "yaw_rad": yaw,
        "speed_mps": speed,
        "range_m": distance,
    }
    return float(
        {
            **values,
            "bearing_rad": math.atan2(left, ahead),
            "range_rate_mps": opening / distance,
        }[name]
    )


def far_from(pose: SensorPose, kinematic: FloatArray) -> FloatArray:
    """The object, moved away where it stands on the sensor."""
    if math.hypot(kinematic[0] - pose.x_m, kinematic[1] - pose.y_m) < 1.0:
        kinematic[0] = pose.x_m + 2.0
    return kinematic


@every_model
@given(kinematic=kinematics(), pose=poses())
def test_every_component_is_what_the_sensor_sees(
    motion: MotionModel, kinematic: FloatArray, pose: SensorPose
) -> None:
    kinematic = far_from(pose, kinematic)
    model = measurement_model(MEASURABLE, motion)
    by_hand = np.array([one_by_hand(name, kinematic, pose) for name in MEASURABLE])
    predicted = model.predict(state_of(motion, kinematic), pose)
    assert_allclose(model.residual(predicted, by_hand), np.zeros(7), atol=1e-9)


@every_model
@given(kinematic=kinematics(), pose=poses())
def test_the_jacobian_is_the_numeric_derivative(
    motion: MotionModel, kinematic: FloatArray, pose: SensorPose
) -> None:
    x = state_of(motion, far_from(pose, kinematic))
    model = measurement_model(MEASURABLE, motion)
    step = 1e-5 * np.eye(motion.dim)
    numeric = (
        model.residual(model.predict(x + step, pose), model.predict(x - step, pose)).T
        / 2e-5
    )
    assert_allclose(model.jacobian(x, pose), numeric, rtol=1e-5, atol=1e-6)


@every_model
def test_every_subset_is_the_rows_of_the_whole(motion: MotionModel) -> None:
    x = state_of(motion, np.array([30.0, -20.0, 2.0, 25.0, 0.1, 1.0]))
    pose = SensorPose(4.0, 5.0, 0.3, 10.0, -2.0)
    whole = measurement_model(MEASURABLE, motion)
    subsets = [names for k in range(1, 8) for names in combinations(MEASURABLE, k)]
    assert len(subsets) == 127
    for names in subsets:
        rows = [MEASURABLE.index(name) for name in names]
        model = measurement_model(names, motion)
        assert_array_equal(model.predict(x, pose), whole.predict(x, pose)[rows])
        assert_array_equal(model.jacobian(x, pose), whole.jacobian(x, pose)[rows])
        assert [names[k] for k in model.angular] == [
            name for name in ("yaw_rad", "bearing_rad") if name in names
        ]


@every_model
def test_a_model_is_linear_where_it_selects_entries_of_the_state(
    motion: MotionModel,
) -> None:
    cartesian = motion.cartesian
    assert measurement_model(("x_m", "y_m"), motion).linear
    assert measurement_model(SELECTION, motion).linear == (not cartesian)
    assert not measurement_model(("x_m", "y_m", "range_m"), motion).linear
    assert not measurement_model(("bearing_rad",), motion).linear


@given(
    angle=st.floats(-50.0, 50.0), turns=st.integers(-5, 5), other=st.floats(-4.0, 4.0)
)
def test_residuals_wrap_angles_and_nothing_else(
    angle: float, turns: int, other: float
) -> None:
    model = measurement_model(MEASURABLE, CTRV())
    z = np.full(7, angle + 2.0 * math.pi * turns)
    y = model.residual(z, np.full(7, other))
    for name, entry, plain in zip(MEASURABLE, y, z - other, strict=True):
        if name in ("yaw_rad", "bearing_rad"):
            assert -math.pi < entry <= math.pi
            assert_allclose(
                [math.cos(entry), math.sin(entry)],
                [math.cos(plain), math.sin(plain)],
                atol=1e-12,
            )
        else:
            assert entry == plain


@every_model
def test_an_object_at_the_sensor_or_at_rest_gives_finite_numbers(
    motion: MotionModel,
) -> None:
    model = measurement_model(MEASURABLE, motion)
    x = np.zeros(motion.dim)
    pose = SensorPose(yaw_rad=0.25, vx_mps=3.0, vy_mps=-2.0)
    assert_allclose(model.predict(x, pose), [0.0, 0.0, 0.0, 0.0, 0.0, -0.25, -3.0])
    H = model.jacobian(x, pose)
    assert np.isfinite(H).all()
    assert_allclose(H[4:6, :2], [[1.0, 0.0], [0.0, 1.0 / MIN_RANGE_M]])
    heading_row = [0.0, 1.0 / MIN_SPEED_MPS] if motion.cartesian else [1.0, 0.0]
    assert_allclose(H[2, 2:4], heading_row)


@pytest.mark.parametrize(
    ("components", "named"),
    [
        ((), "nothing"),
        (("y_m", "x_m"), "y_m, x_m"),
        (("x_m", "x_m"), "x_m, x_m"),
        (("x_m", "height_m"), "x_m, height_m"),
        (("vx_mps",), "vx_mps"),
    ],
)
def test_components_that_cannot_be_measured_are_refused(
    components: tuple[str, ...], named: str
) -> None:
    with pytest.raises(
        CallError,
        match=rf"measurement of {named}: give one or more of x_m, y_m, yaw_rad",
    ):
        MeasurementModel(components, CTRV().state_names)


@every_model
def test_a_state_of_another_kind_is_refused(motion: MotionModel) -> None:
    assert MeasurementModel(("x_m",), motion.state_names).components == ("x_m",)
    begins = "must begin with x_m, y_m, yaw_rad, speed_mps or x_m, y_m, vx_mps, vy_mps$"
    with pytest.raises(CallError, match=f"state of x_m, y_m, z_m: {begins}"):
        MeasurementModel(("x_m",), ("x_m", "y_m", "z_m"))


@given(speed_mps=st.floats(-20.0, 90.0), yaw_rate_radps=st.floats(-1.0, 1.0))
def test_a_curvature_is_the_yaw_rate_over_the_speed_and_says_nothing_at_rest(
    speed_mps: float, yaw_rate_radps: float
) -> None:
    model, x = (
        measurement_model(("curvature_radpm",), CTRV()),
        np.array([5.0, -3.0, 0.4, speed_mps, yaw_rate_radps]),
    )
    expected = yaw_rate_radps * speed_mps / (speed_mps**2 + SLOW_MPS**2)
    assert model.predict(x) == pytest.approx([expected])
    steps = 1e-6 * np.eye(5)
    numeric = [
        (model.predict(x + step) - model.predict(x - step))[0] / 2e-6 for step in steps
    ]
    assert_allclose(model.jacobian(x)[0], numeric, atol=1e-8)
    still = x.copy()
    still[3] = 0.0
    assert model.jacobian(still)[0, 4] == 0.0


def test_a_curvature_needs_a_yaw_rate() -> None:
    assert (*MEASURABLE, "curvature_radpm") == COMPONENTS
    with pytest.raises(
        CallError,
        match=r"must begin with x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps$",
    ):
        measurement_model(("x_m", "y_m", "curvature_radpm"), CV())

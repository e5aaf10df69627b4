"""Promises of the shipped measurement models: one suite for every measurable component.

Each component is measured alone and among all others, of the state of every shipped motion model.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import STATE_NAMES, FloatArray
from fgtrack.models.correlated_errors import CorrelatedErrors, split_error, total_error
from fgtrack.models.measurement import (
    COMPONENTS,
    MeasurementModel,
    SensorPose,
    measured_position,
    measurement_model,
)
from fgtrack.models.motion import CT, CTRA, CTRV, CV, MotionModel
from fgtrack.models.sensors import Correlation, SensorModel
from fgtrack.testing import equations
from fgtrack.testing.equations import Linearisation
from fgtrack.testing.promise import BrokenPromiseError, fault, require, run_all

_NUM_STATES = 6
#: Entries of measurements and Jacobians must agree with the definition to this share.
_TOLERANCE = 1e-9
_MOTIONS: tuple[MotionModel, ...] = (
    CTRV(),
    CTRA(),
    CT(),
    CV(),
    CorrelatedErrors(CTRV(), (("sensor.x_m", 1.0),)),
)


class Case(NamedTuple):
    """A measurement model of one component or of several, at a state and a sensor pose."""

    model: MeasurementModel
    x: FloatArray
    """State, shape (n,)."""
    pose: SensorPose
    row: int
    """Index of the component that is tested."""

    @property
    def expected(self) -> Linearisation:
        """Predicted measurement and its Jacobians, by the equations that define the components."""
        return equations.linearised(
            self.model.components, self.model.state_names, self.x, self.pose
        )


def check_measurement_models(seed: int = 0) -> None:
    """Raise `BrokenPromiseError` unless all shipped measurement models agree with their definitions."""
    for component in COMPONENTS:
        run_all(component, measurement_model_checks(component, seed))


def measurement_model_checks(
    component: str, seed: int = 0
) -> dict[str, Callable[[], None]]:
    """Return the checks of one of `COMPONENTS` by name of the promise, for `pytest.mark.parametrize`."""
    names = {
        check.__name__.removeprefix("_").replace("_", " "): check for check in _CHECKS
    }
    return {
        name: partial(_run, name, check, component, seed)
        for name, check in names.items()
    }


def _run(name: str, check: Callable[[Case], None], component: str, seed: int) -> None:
    for case in _cases(component, seed):
        if wrong := fault(check, case):
            text = f"{wrong}\nx = {case.x.tolist()}, pose = {case.pose}, measured {case.model.components}"
            raise BrokenPromiseError(component, {name: text})


def _cases(component: str, seed: int) -> Iterator[Case]:
    """Yield random states and poses for every motion model whose state determines the component."""
    rng = np.random.default_rng(seed)
    for motion in _MOTIONS:
        names = tuple(
            name
            for name in COMPONENTS
            if name != "curvature_radpm" or not motion.cartesian
        )
        if component not in names:
            continue
        for _ in range(_NUM_STATES):
            kinematic = rng.normal(size=len(STATE_NAMES)) * [
                50.0,
                50.0,
                2.0,
                20.0,
                0.3,
                2.0,
            ]
            x = motion.from_kinematic(kinematic, np.eye(len(STATE_NAMES)))[0]
            pose = SensorPose(
                *(rng.normal(size=5) * [50.0, 50.0, 2.0, 15.0, 15.0]).tolist()
            )
            for components in ((component,), names):
                yield Case(
                    measurement_model(components, motion),
                    x,
                    pose,
                    components.index(component),
                )


def _equal(values: FloatArray, expected: FloatArray, what: str) -> None:
    """Require that `values` equals `expected` up to rounding."""
    values = np.asarray(values)
    require(
        values.shape == expected.shape,
        f"{what} has shape {values.shape}, expected {expected.shape}",
    )
    close = np.abs(values - expected) < _TOLERANCE * (1.0 + np.abs(expected))
    require(
        close.all(),
        f"{what} is {values.tolist()}, by the definition {expected.tolist()}",
    )


def _measures_by_its_definition(case: Case) -> None:
    """Check the predicted measurement of one state and of an array of states. Full turns of an angle do not count."""
    model, row = case.model, case.row
    z = model.predict(case.x, case.pose)
    _equal(_turned(case, z[row], case.expected.z[row]), np.zeros(()), "the measurement")
    many = model.predict(np.stack([case.x, case.x]), case.pose)
    _equal(many[..., row], np.full(2, z[row]), "the measurement of two states")


def _turned(case: Case, z: float, predicted: float) -> FloatArray:
    component = case.model.components[case.row]
    return np.asarray(
        equations.residual((component,), np.array([z]), np.array([predicted]))[0]
    )


def _has_the_jacobian_of_its_definition(case: Case) -> None:
    """Check `jacobian` for one state and for two, `linearised`, and `selection` of a linear model."""
    model, row, expected = case.model, case.row, case.expected.H[case.row]
    _equal(model.jacobian(case.x, case.pose)[row], expected, "jacobian")
    many = model.jacobian(np.stack([case.x, case.x]), case.pose)
    _equal(many[:, row], np.stack([expected, expected]), "jacobian of two states")
    _equal(
        model.linearised(case.expected.z, case.x, case.pose)[1][row],
        expected,
        "the Jacobian of linearised",
    )
    if model.linear:
        _equal(model.selection(len(case.x))[row], expected, "selection")


def _is_linear_where_the_state_has_it(case: Case) -> None:
    """Check that a component is linear if it is an entry of the state.

    Compiled loops select the entries `selected` of the state, without a Jacobian.
    """
    model = case.model
    known = all(name in model.state_names for name in model.components)
    require(model.linear == known, f"linear is {model.linear}")
    if known:
        entry, expected = int(model.selected[case.row]), case.expected.H[case.row]
        _equal(np.eye(len(case.x))[entry], expected, f"the selection of entry {entry}")


def _has_the_pose_jacobian_of_its_definition(case: Case) -> None:
    _equal(
        case.model.pose_jacobian(case.x, case.pose)[case.row],
        case.expected.by_pose[case.row],
        "pose_jacobian",
    )


def _differs_by_the_short_way_round(case: Case) -> None:
    """Check the difference of two measurements: for an angle at most half a turn, else the plain difference."""
    predicted = case.expected.z
    for off in (-7.0, -3.0, 0.5, 3.0, 10.0):
        z = predicted + off
        y = case.model.residual(z, predicted)[case.row]
        _equal(
            y,
            _turned(case, z[case.row], predicted[case.row]),
            f"the residual of a difference of {off}",
        )


def _gives_back_the_position(case: Case) -> None:
    """Check the position that `measured_position` returns, and its covariance to first order.

    A model with x and y, or with range and bearing, must give a position. Other models must give None.
    """
    model, expected = case.model, case.expected
    R = np.diag(1e-4 * (1.0 + np.arange(len(model.components))))
    known = measured_position(model.components, expected.z, R, case.pose)
    names = model.components
    has_position = {"x_m", "y_m"} <= set(names) or {"range_m", "bearing_rad"} <= set(
        names
    )
    require((known is not None) == has_position, f"measured_position is {known}")
    if known is None:
        return
    pair = ("x_m", "y_m") if "x_m" in names else ("range_m", "bearing_rad")
    rows = [names.index(name) for name in pair]
    H = expected.H[rows, :2]
    _equal(known[0], case.x[:2], "the position")
    _equal(
        H @ known[1] @ H.T * 1e4,
        R[np.ix_(rows, rows)] * 1e4,
        "the covariance of the position",
    )


def _splits_an_error_that_is_correlated_in_time(case: Case) -> None:
    """Check z = h(x) + G e + white noise, with errors e of variance 1 in the state.

    Both parts together have the covariance R. Each measured component of a sensor has its own error. A position always
    has two components.
    """
    components, row, share = case.model.components, case.row, 0.7
    own = [name for name in components if name != "curvature_radpm"]
    if components[row] not in own or len({"x_m", "y_m"} & set(own)) == 1:
        return
    names = (*case.model.state_names, *(f"radar.{name}" for name in own))
    sensor = SensorModel(
        std=dict.fromkeys(own, 1.0), correlation=Correlation(share=share, time_s=2.0)
    )
    variances = 0.04 * (1.0 + np.arange(len(components)))
    plain, R = MeasurementModel(components, case.model.state_names), np.diag(variances)
    model, white = split_error("radar", sensor, plain, R, names)
    errors = 0.6 * np.eye(len(own))[own.index(components[row])]
    gain, x = math.sqrt(share * variances[row]), np.append(case.x, errors)
    expected = np.append(case.expected.H[row], gain / 0.6 * errors)
    _equal(
        model.jacobian(x, case.pose)[row],
        expected,
        "jacobian with the errors in the state",
    )
    _equal(
        model.linearised(case.expected.z, x, case.pose)[1][row],
        expected,
        "the Jacobian of linearised",
    )
    off = _turned(
        case, model.predict(x, case.pose)[row], case.expected.z[row] + 0.6 * gain
    )
    _equal(off, np.zeros(()), "the measurement with the error, less its expectation,")
    kept = [1.0 - share if name in own else 1.0 for name in components]
    _equal(white, R * kept, "the covariance of the rest")
    _equal(total_error(model, white), R, "the covariance of both parts")


_CHECKS: tuple[Callable[[Case], None], ...] = (
    _measures_by_its_definition,
    _has_the_jacobian_of_its_definition,
    _is_linear_where_the_state_has_it,
    _has_the_pose_jacobian_of_its_definition,
    _differs_by_the_short_way_round,
    _gives_back_the_position,
    _splits_an_error_that_is_correlated_in_time,
)

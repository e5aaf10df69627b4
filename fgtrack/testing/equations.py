"""The equations of the shipped models, written a second time.

No function here calls a shipped model. Motion is a stochastic differential equation, which is integrated numerically.
A measurement is a plain function of the object and the sensor. Derivatives are numeric. A wrong entry of a Jacobian or
of a noise covariance in a shipped model therefore differs from the result here.
"""

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from fgtrack.core.errors import CallError
from fgtrack.core.types import FloatArray
from fgtrack.models.correlated_errors import CorrelatedErrors
from fgtrack.models.motion import CT, CTRA, CTRV, CV, MotionModel

#: Tolerances of the integrator; states are in m, rad and s.
_RELATIVE, _ABSOLUTE = 1e-11, 1e-14
#: Step of derivatives in the imaginary direction, which have no rounding error of a difference.
_IMAGINARY = 1e-30

#: A function of states, shape (n, ...), also of complex ones.
StateFunction = Callable[[Any], Any]  # Any: real or complex arrays


class MotionEquation(NamedTuple):
    """Stochastic differential equation dx = drift(x) dt + dw, where dw has the covariance diffusion(x) dt."""

    drift: StateFunction
    """Rates of the states x (n, ...), a list of n entries. A complex state must be accepted."""
    diffusion: StateFunction
    """Covariance per second of the noise at the states x (n, m), shape (n, n) or (m, n, n)."""


class Moments(NamedTuple):
    """Mean, Jacobian and noise covariance of m states after their durations."""

    mean: FloatArray
    """Shape (m, n). Angles are not wrapped."""
    F: FloatArray
    """Derivative of the mean by the state before, shape (m, n, n)."""
    Q: FloatArray
    """Covariance of the accumulated noise, shape (m, n, n)."""


def _ctrv(model: CTRV) -> MotionEquation:
    relaxation_hz = _relaxation_hz(
        model.yaw_rate_density_rad2ps3, model.yaw_rate_std_radps
    )
    position, speed, yaw_rate = (
        model.position_density_m2ps,
        model.speed_density_m2ps3,
        model.yaw_rate_density_rad2ps3,
    )
    return MotionEquation(
        drift=lambda x: [
            x[3] * np.cos(x[2]),
            x[3] * np.sin(x[2]),
            x[4],
            0.0,
            -relaxation_hz * x[4],
        ],
        diffusion=lambda x: _diagonal(
            position, position, _yaw_density(model, x), speed, yaw_rate
        ),
    )


def _ctra(model: CTRA) -> MotionEquation:
    relaxation_hz = _relaxation_hz(
        model.yaw_rate_density_rad2ps3, model.yaw_rate_std_radps
    )
    position, speed, yaw_rate = (
        model.position_density_m2ps,
        model.speed_density_m2ps3,
        model.yaw_rate_density_rad2ps3,
    )
    accel = model.accel_density_m2ps5
    return MotionEquation(
        drift=lambda x: [
            x[3] * np.cos(x[2]),
            x[3] * np.sin(x[2]),
            x[4],
            x[5],
            -relaxation_hz * x[4],
            0.0,
        ],
        diffusion=lambda x: _diagonal(
            position, position, _yaw_density(model, x), speed, yaw_rate, accel
        ),
    )


def _ct(model: CT) -> MotionEquation:
    relaxation_hz = _relaxation_hz(
        model.yaw_rate_density_rad2ps3, model.yaw_rate_std_radps
    )
    position, velocity = model.position_density_m2ps, model.velocity_density_m2ps3
    return MotionEquation(
        drift=lambda x: [x[2], x[3], -x[4] * x[3], x[4] * x[2], -relaxation_hz * x[4]],
        diffusion=lambda x: np.diag(
            [position, position, velocity, velocity, model.yaw_rate_density_rad2ps3]
        ),
    )


def _relaxation_hz(density: float, std: float) -> float:
    """Rate r of dw = -r w dt + noise of a spectral density, whose stationary variance density / (2 r) is std^2."""
    return density / (2.0 * std**2)


def _yaw_density(model: CTRV, x: Any) -> Any:
    """Spectral density of the yaw at the states x (n, ...): a slow object has more."""
    return (
        model.yaw_density_rad2ps
        + model.resting_yaw_rad2ps / (1.0 + (x[3] / model.slow_mps) ** 2) ** 2
    )


def _diagonal(*entries: Any) -> FloatArray:
    """Diagonal matrices of entries that are numbers or arrays (m,), shape (m, n, n)."""
    rows = np.stack(np.broadcast_arrays(*entries), axis=-1)
    return np.asarray(rows[..., None] * np.eye(len(entries)))


def _cv(model: CV) -> MotionEquation:
    velocity = model.velocity_density_m2ps3
    return MotionEquation(
        drift=lambda x: [x[2], x[3], 0.0, 0.0],
        diffusion=lambda x: np.diag([0.0, 0.0, velocity, velocity]),
    )


def _with_errors(model: CorrelatedErrors) -> MotionEquation:
    """Return the equation of the object and of its errors e, which have correlation times T and variances 1."""
    base, n = equation_of(model.base), model.base.dim
    if base is None:
        raise CallError(f"the base of {model!r} has no entry in EQUATIONS")
    times_s = [time_s for _, time_s in model.times_s]

    def diffusion(x: Any) -> FloatArray:
        of_object = np.asarray(base.diffusion(x[:n]))
        D = np.zeros((*of_object.shape[:-2], len(x), len(x)))
        D[..., :n, :n] = of_object
        D[..., range(n, len(x)), range(n, len(x))] = [
            2.0 / time_s for time_s in times_s
        ]
        return D

    return MotionEquation(
        drift=lambda x: [
            *base.drift(x[:n]),
            *(-e / time_s for e, time_s in zip(x[n:], times_s, strict=True)),
        ],
        diffusion=diffusion,
    )


# Any: each function takes a model of its own type.
#: The equation of every shipped motion model, made from the parameters of the model.
EQUATIONS: dict[type[MotionModel], Callable[[Any], MotionEquation]] = {
    CTRV: _ctrv,
    CTRA: _ctra,
    CT: _ct,
    CV: _cv,
    CorrelatedErrors: _with_errors,
}


@cache
def equation_of(model: MotionModel) -> MotionEquation | None:
    """Return the equation of a shipped motion model, or None for a model of another type."""
    make = EQUATIONS.get(type(model))
    return None if make is None else make(model)


def moments(equation: MotionEquation, x: FloatArray, dt_s: FloatArray) -> Moments:
    """Moments of the states x (m, n) after `dt_s` (m,), by integration along the mean.

    With the Jacobian A of the drift and the diffusion D, both at the mean: dF/dt = A F and dQ/dt = A Q + Q A' + D.
    Time is counted in units of each duration and Q in units of D times the duration. A short duration then keeps
    its digits.
    """
    m, n = x.shape
    scale = dt_s[:, None, None]

    def rates(_: float, flat: FloatArray) -> FloatArray:
        packed = flat.reshape(m, n + 2 * n * n)
        mean = packed[:, :n]
        F, Q = (
            packed[:, n : n + n * n].reshape(m, n, n),
            packed[:, n + n * n :].reshape(m, n, n),
        )
        A = drift_jacobian(equation, mean) * scale
        AQ = A @ Q
        D = np.broadcast_to(
            np.asarray(equation.diffusion(mean.T), dtype=np.float64), (m, n, n)
        )
        parts = (
            _drift(equation, mean) * dt_s[:, None],
            A @ F,
            AQ + np.swapaxes(AQ, 1, 2) + D,
        )
        return np.concatenate([part.reshape(m, -1) for part in parts], axis=1).ravel()

    start = np.concatenate(
        [x, np.tile(np.eye(n).ravel(), (m, 1)), np.zeros((m, n * n))], axis=1
    )
    result = solve_ivp(
        rates,
        (0.0, 1.0),
        start.ravel(),
        method="DOP853",
        rtol=_RELATIVE,
        atol=_ABSOLUTE,
    )
    packed = result.y[:, -1].reshape(m, n + 2 * n * n)
    F, Q = (
        packed[:, n : n + n * n].reshape(m, n, n),
        packed[:, n + n * n :].reshape(m, n, n),
    )
    return Moments(packed[:, :n], F, Q * scale)


def _drift(equation: MotionEquation, x: Any) -> Any:
    """Rates of real or complex states x (m, n), shape (m, n)."""
    states = np.swapaxes(x, 0, 1)
    return np.stack(
        [np.broadcast_to(rate, len(x)) for rate in equation.drift(states)], axis=1
    )


def drift_jacobian(equation: MotionEquation, x: FloatArray) -> FloatArray:
    """Derivative of the drift at the states x (m, n), shape (m, n, n), by steps in the imaginary direction."""
    m, n = x.shape
    steps = np.repeat(x, n, axis=0) + 1j * _IMAGINARY * np.tile(np.eye(n), (m, 1))
    slopes = np.imag(_drift(equation, steps)) / _IMAGINARY
    return np.asarray(np.swapaxes(slopes.reshape(m, n, n), 1, 2))


class Seen(NamedTuple):
    """An object as a sensor sees it, in the axes of the sensor. Entries may be complex."""

    x_m: Any
    y_m: Any
    yaw_rad: Any
    speed_mps: Any
    yaw_rate_radps: Any
    ahead_m: Any
    """Position along the x axis of the sensor."""
    left_m: Any
    """Position along the y axis of the sensor."""
    ahead_mps: Any
    """Velocity relative to the sensor, along its x axis."""
    left_mps: Any
    """Velocity relative to the sensor, along its y axis."""


#: The definition of every measurable component.
COMPONENTS: Mapping[str, Callable[[Seen], Any]] = {
    "x_m": lambda seen: seen.x_m,
    "y_m": lambda seen: seen.y_m,
    "yaw_rad": lambda seen: seen.yaw_rad,
    "speed_mps": lambda seen: seen.speed_mps,
    "range_m": lambda seen: cmath.sqrt(seen.ahead_m**2 + seen.left_m**2),
    "bearing_rad": lambda seen: direction(seen.ahead_m, seen.left_m),
    "range_rate_mps": lambda seen: (
        (seen.ahead_m * seen.ahead_mps + seen.left_m * seen.left_mps)
        / cmath.sqrt(seen.ahead_m**2 + seen.left_m**2)
    ),
    "curvature_radpm": lambda seen: (
        seen.yaw_rate_radps * seen.speed_mps / (seen.speed_mps**2 + 1.0)
    ),
}
#: Components that are compared modulo a full turn.
ANGLES = ("yaw_rad", "bearing_rad")


def direction(ahead: Any, left: Any) -> Any:
    """Return the angle of a vector from the first axis to the second axis, in (-pi, pi]; 0 for the vector 0.

    Complex entries are accepted.
    """
    ahead, left = complex(ahead), complex(left)
    if not ahead.real and not left.real:
        return 0.0
    half_turn = math.copysign(math.pi, left.real)
    if abs(left.real) > abs(ahead.real):
        return half_turn / 2.0 - cmath.atan(ahead / left)
    return cmath.atan(left / ahead) + (half_turn if ahead.real < 0.0 else 0.0)


# Any: arrays of real or of complex numbers.
def measured(
    components: Sequence[str], state_names: Sequence[str], x: Any, pose: Any
) -> list[Any]:
    """Return the values of `components` for a state x (n,), without noise; angles are not wrapped.

    `pose` is the pose of the sensor: x, y, yaw, vx, vy. State and pose may be complex, for complex-step derivatives.
    """
    own = dict(zip(state_names, x, strict=True))
    if "vx_mps" in own:
        vx_mps, vy_mps = own["vx_mps"], own["vy_mps"]
        yaw_rad, speed_mps = (
            direction(vx_mps, vy_mps),
            cmath.sqrt(vx_mps**2 + vy_mps**2),
        )
    else:
        yaw_rad, speed_mps = own["yaw_rad"], own["speed_mps"]
        vx_mps, vy_mps = speed_mps * cmath.cos(yaw_rad), speed_mps * cmath.sin(yaw_rad)
    sensor_x_m, sensor_y_m, sensor_yaw_rad, sensor_vx_mps, sensor_vy_mps = pose
    cos, sin = cmath.cos(sensor_yaw_rad), cmath.sin(sensor_yaw_rad)
    east_m, north_m = own["x_m"] - sensor_x_m, own["y_m"] - sensor_y_m
    east_mps, north_mps = vx_mps - sensor_vx_mps, vy_mps - sensor_vy_mps
    seen = Seen(
        x_m=own["x_m"],
        y_m=own["y_m"],
        yaw_rad=yaw_rad,
        speed_mps=speed_mps,
        yaw_rate_radps=own.get("yaw_rate_radps", 0.0),
        ahead_m=cos * east_m + sin * north_m,
        left_m=cos * north_m - sin * east_m,
        ahead_mps=cos * east_mps + sin * north_mps,
        left_mps=cos * north_mps - sin * east_mps,
    )
    return [COMPONENTS[name](seen) for name in components]


class Linearisation(NamedTuple):
    """A measurement of k components, and its derivatives."""

    z: FloatArray
    """Shape (k,). Angles are not wrapped."""
    H: FloatArray
    """Derivative by the state, shape (k, n)."""
    by_pose: FloatArray
    """Derivative by the sensor pose, shape (k, 5)."""


def linearised(
    components: Sequence[str],
    state_names: Sequence[str],
    x: FloatArray,
    pose: Sequence[float],
) -> Linearisation:
    """The measurement of one state x (n,), with derivatives by steps in the imaginary direction."""
    n, at = len(x), np.array([*x, *pose], dtype=np.complex128)
    values = np.real(measured(components, state_names, at[:n], at[n:]))
    steps = at + 1j * _IMAGINARY * np.eye(len(at))
    slopes = [
        np.imag(measured(components, state_names, row[:n], row[n:])) / _IMAGINARY
        for row in steps
    ]
    both = np.column_stack(slopes)
    return Linearisation(np.asarray(values, dtype=np.float64), both[:, :n], both[:, n:])


def residual(
    components: Sequence[str], z: FloatArray, predicted: FloatArray
) -> FloatArray:
    """Measured minus predicted, both (k,), with angles in [-pi, pi]."""
    y = z - predicted
    angular = [math.remainder(value, 2.0 * math.pi) for value in y]
    return np.where([name in ANGLES for name in components], angular, y)

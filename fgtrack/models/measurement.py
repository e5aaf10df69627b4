"""Measurement models: any subset of the measurable components, seen from a sensor pose.

x_m, y_m and yaw_rad are in the map frame and speed_mps is over ground along the heading. range_m, bearing_rad
(0 along the sensor's x axis, counter-clockwise) and range_rate_mps are relative to the sensor. curvature_radpm, left
turn positive, is that of the way of the object: its yaw rate over its speed. No sensor measures it, a map tells it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import cartesian, cartesian_gradient, polar, polar_gradient, wrap_angles
from fgtrack.core.types import MEASURABLE, YAW_RATE, FloatArray, IntArray
from fgtrack.models.motion import CARTESIAN, MIN_SPEED_MPS, POLAR, MotionModel

#: The gradient of a bearing by the position grows as 1 / range; below this range it stays as it is there.
MIN_RANGE_M = 1e-6

#: Far below this speed a curvature says nothing of the yaw rate: an object at rest has no way that could turn.
SLOW_MPS = 1.0

#: What a measurement may be of: what a detection measures, and what the map says of a moving object.
COMPONENTS = (*MEASURABLE, "curvature_radpm")
#: Components that are angles.
ANGULAR = ("yaw_rad", "bearing_rad")
#: Components that are relative to the sensor.
RELATIVE = ("range_m", "bearing_rad", "range_rate_mps")
_NONE = np.zeros(2)


class SensorPose(NamedTuple):
    """Pose and velocity of a sensor in the map at the stamp of the measurement."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0


_AT_ORIGIN = SensorPose()


@dataclass(frozen=True)
class MeasurementModel:
    """What is measured of a state, z = h(x, pose) + noise; `measurement_model` gives a shared one.

    A state may have more entries than `state_names`; the Jacobian is as wide as the state that it is given.
    Raises `CallError` when a component is unknown, repeated or out of order, or the state is of another kind.
    """

    components: tuple[str, ...]
    """Measured components, a non-empty subset of `COMPONENTS` in that order."""
    state_names: tuple[str, ...]
    """Names of the entries of the state: x, y and either yaw, speed or vx, vy, and what follows."""

    def __post_init__(self) -> None:
        if not self.components or self.components != tuple(name for name in COMPONENTS if name in self.components):
            raise CallError(
                f"measurement of {', '.join(self.components) or 'nothing'}: give one or more of "
                f"{', '.join(COMPONENTS)}, each once and in this order"
            )
        if self.state_names[:4] not in (POLAR, CARTESIAN):
            raise CallError(
                f"state of {', '.join(self.state_names)}: must begin with {', '.join(POLAR)} or {', '.join(CARTESIAN)}"
            )
        if "curvature_radpm" in self.components and self.state_names[YAW_RATE : YAW_RATE + 1] != ("yaw_rate_radps",):
            raise CallError("measurement of curvature_radpm: needs a state with a yaw rate, as that of CTRV or CTRA")

    @cached_property
    def angular(self) -> tuple[int, ...]:
        """Places of the components that are angles."""
        return tuple(index for index, name in enumerate(self.components) if name in ANGULAR)

    @cached_property
    def relative(self) -> tuple[int, ...]:
        """Places of the components that are relative to the sensor."""
        return tuple(index for index, name in enumerate(self.components) if name in RELATIVE)

    @cached_property
    def linear(self) -> bool:
        """Whether the measurement selects entries of the state, whatever the sensor pose."""
        return set(self.components) <= set(self.state_names)

    def predict(self, x: FloatArray, pose: SensorPose = _AT_ORIGIN) -> FloatArray:
        """Measurement expected of the states `x`, shape (..., n) -> (..., k). Angles are not wrapped."""
        if self.linear:
            return x.take(self._selected, axis=-1)
        scene = _Scene(x, pose, self._cartesian)
        return np.stack([_COMPONENTS[name].value(scene) for name in self.components], axis=-1)

    def jacobian(self, x: FloatArray, pose: SensorPose = _AT_ORIGIN) -> FloatArray:
        """Derivative H of `predict` by `x`, shape (..., k, n); read-only where the model is linear.

        Finite everywhere: the gradient of an angle grows up to `MIN_RANGE_M` and `MIN_SPEED_MPS` and no
        further.
        """
        shape = (*x.shape[:-1], len(self.components), x.shape[-1])
        if self.linear:
            return np.broadcast_to(self.selection(x.shape[-1]), shape)
        scene = _Scene(x, pose, self._cartesian)
        H = np.zeros(shape)
        for row, name in enumerate(self.components):
            component = _COMPONENTS[name]
            H[..., row, :2], H[..., row, 2:4] = component.gradient(scene)
            if component.by_yaw_rate is not None:
                H[..., row, YAW_RATE] = component.by_yaw_rate(scene)
        return H

    def pose_jacobian(self, x: FloatArray, pose: SensorPose) -> FloatArray:
        """Derivative of `predict` by the entries of `pose`, shape (..., k, 5); finite as `jacobian` is."""
        D = np.zeros((*x.shape[:-1], len(self.components), len(pose)))
        if not self.relative:
            return D
        scene = _Scene(x, pose, self._cartesian)
        for row in self.relative:
            name = self.components[row]
            D[..., row, :2] = -_COMPONENTS[name].gradient(scene)[0]  # the offset alone counts
            if name == "bearing_rad":
                D[..., row, 2] = -1.0
            elif name == "range_rate_mps":
                D[..., row, 3:] = -scene.line_of_sight
        return D

    def selection(self, n: int) -> FloatArray:
        """`jacobian` of a linear model at any state of `n` entries, shape (k, n), read-only."""
        if n not in self._selections:
            H = np.eye(n)[self._selected]
            H.flags.writeable = False
            self._selections[n] = H
        return self._selections[n]

    def residual(self, z: FloatArray, z_predicted: FloatArray) -> FloatArray:
        """Measured minus predicted, shape (..., k), with angles in (-pi, pi]; the only place that wraps."""
        y = np.asarray(z - z_predicted)
        for index in self.angular:
            angles = y[..., index]
            wrapped = wrap_angles(angles)
            if wrapped is not angles:
                y[..., index] = wrapped
        return y

    @cached_property
    def _cartesian(self) -> bool:
        return self.state_names[:4] == CARTESIAN

    @cached_property
    def _selections(self) -> dict[int, FloatArray]:
        return {}

    @cached_property
    def _selected(self) -> IntArray:
        return np.array([self.state_names.index(name) for name in self.components])


def measurement_model(components: tuple[str, ...], motion_model: MotionModel) -> MeasurementModel:
    """The measurement of `components` for the state of `motion_model`: one shared object for each."""
    return _shared_model(components, motion_model.state_names)


@cache
def _shared_model(components: tuple[str, ...], state_names: tuple[str, ...]) -> MeasurementModel:
    return MeasurementModel(components, state_names)


def measured_position(
    components: tuple[str, ...], z: FloatArray, R: FloatArray, pose: SensorPose
) -> tuple[FloatArray, FloatArray] | None:
    """Position in the map, shape (2,), and its covariance, (2, 2), from x and y, or range and bearing to first order.

    `z` (k,) and `R` (k, k) are those of `components`, in the order of `MEASURABLE`; None where these hold no position.
    """
    if components[:2] == ("x_m", "y_m"):
        return z[:2], R[:2, :2]
    G = position_gradient(components, z, pose)
    if G is None:
        return None
    direction_range = z[_polar_rows(components)] + np.array([pose.yaw_rad, 0.0])
    return np.array([pose.x_m, pose.y_m]) + cartesian(direction_range), G @ R @ G.T


def position_gradient(components: tuple[str, ...], z: FloatArray, pose: SensorPose) -> FloatArray | None:
    """Derivative of what `measured_position` gives by z, shape (2, k); None where z holds no position."""
    G = np.zeros((2, len(components)))
    if components[:2] == ("x_m", "y_m"):
        G[:, :2] = np.eye(2)
    elif {"range_m", "bearing_rad"} <= set(components):
        rows = _polar_rows(components)
        G[:, rows] = cartesian_gradient(z[rows] + np.array([pose.yaw_rad, 0.0]))
    else:
        return None
    return G


def _polar_rows(components: tuple[str, ...]) -> list[int]:
    return [components.index("bearing_rad"), components.index("range_m")]


class _Scene:
    """States and a sensor pose, and what several components derive from them.

    `motion` is the third and fourth entry of the state: (yaw, speed), or (vx, vy) where `cartesian_motion` is
    set. `turn`, shape (..., 1), is the yaw rate of a state that has one.
    """

    def __init__(self, x: FloatArray, pose: SensorPose, cartesian_motion: bool) -> None:
        self.position: FloatArray = x[..., :2]
        self.motion: FloatArray = x[..., 2:4]
        self.turn: FloatArray = x[..., YAW_RATE : YAW_RATE + 1]
        self.pose = pose
        self.cartesian_motion = cartesian_motion

    @cached_property
    def offset(self) -> FloatArray:
        """From the sensor to the object in the map, shape (..., 2)."""
        return np.asarray(self.position - np.array([self.pose.x_m, self.pose.y_m]))

    @cached_property
    def offset_gradient(self) -> FloatArray:
        """Derivative of direction and range by the position, shape (..., 2, 2)."""
        return polar_gradient(self.offset, MIN_RANGE_M)

    @property
    def line_of_sight(self) -> FloatArray:
        """Unit vector from the sensor to the object in the map, shape (..., 2)."""
        return np.asarray(self.offset_gradient[..., 1, :])

    @property
    def yaw_speed(self) -> FloatArray:
        """Heading and speed along it, shape (..., 2)."""
        return polar(self.motion) if self.cartesian_motion else self.motion

    @property
    def yaw_speed_gradient(self) -> FloatArray:
        """Derivative of heading and speed by `motion`, shape (..., 2, 2)."""
        return polar_gradient(self.motion, MIN_SPEED_MPS) if self.cartesian_motion else np.eye(2)

    @property
    def relative_velocity(self) -> FloatArray:
        """Velocity of the object minus that of the sensor in the map, shape (..., 2)."""
        velocity = self.motion if self.cartesian_motion else cartesian(self.motion)
        return np.asarray(velocity - np.array([self.pose.vx_mps, self.pose.vy_mps]))

    @property
    def velocity_gradient(self) -> FloatArray:
        """Derivative of the velocity by `motion`, shape (..., 2, 2)."""
        return np.eye(2) if self.cartesian_motion else cartesian_gradient(self.motion)


class _Component(NamedTuple):
    """One quantity: its value and its gradients by position and `motion`, shape (..., 2) each."""

    value: Callable[[_Scene], FloatArray]
    gradient: Callable[[_Scene], tuple[FloatArray, FloatArray]]
    by_yaw_rate: Callable[[_Scene], FloatArray] | None = None
    """Derivative by the yaw rate, shape (...); None where it is 0."""


def _range_rate(scene: _Scene) -> FloatArray:
    """Relative velocity along the line of sight."""
    return np.asarray(np.sum(scene.relative_velocity * scene.line_of_sight, axis=-1))


def _range_rate_gradient(scene: _Scene) -> tuple[FloatArray, FloatArray]:
    """A moved object turns the line of sight towards its normal; the velocity counts along it."""
    along = scene.line_of_sight
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    across_mps = np.sum(scene.relative_velocity * normal, axis=-1, keepdims=True)
    by_motion = (along[..., None, :] @ scene.velocity_gradient)[..., 0, :]
    return across_mps * scene.offset_gradient[..., 0, :], by_motion


def _pace(scene: _Scene) -> FloatArray:
    """1 / v, which falls to 0 at rest: v / (v^2 + v0^2) with v0 = `SLOW_MPS`."""
    speed_mps = scene.motion[..., 1]
    return np.asarray(speed_mps / (speed_mps**2 + SLOW_MPS**2))


def _curvature_gradient(scene: _Scene) -> tuple[FloatArray, FloatArray]:
    """By the speed alone: the derivative of `_pace` is 1 / (v^2 + v0^2) - 2 pace^2."""
    by_speed = scene.turn[..., 0] * (1.0 / (scene.motion[..., 1] ** 2 + SLOW_MPS**2) - 2.0 * _pace(scene) ** 2)
    return _NONE, np.stack([np.zeros_like(by_speed), by_speed], axis=-1)


_COMPONENTS = {
    "x_m": _Component(lambda s: s.position[..., 0], lambda s: (np.array([1.0, 0.0]), _NONE)),
    "y_m": _Component(lambda s: s.position[..., 1], lambda s: (np.array([0.0, 1.0]), _NONE)),
    "yaw_rad": _Component(lambda s: s.yaw_speed[..., 0], lambda s: (_NONE, s.yaw_speed_gradient[..., 0, :])),
    "speed_mps": _Component(lambda s: s.yaw_speed[..., 1], lambda s: (_NONE, s.yaw_speed_gradient[..., 1, :])),
    "range_m": _Component(lambda s: polar(s.offset)[..., 1], lambda s: (s.line_of_sight, _NONE)),
    "bearing_rad": _Component(
        lambda s: polar(s.offset)[..., 0] - s.pose.yaw_rad, lambda s: (s.offset_gradient[..., 0, :], _NONE)
    ),
    "range_rate_mps": _Component(_range_rate, _range_rate_gradient),
    "curvature_radpm": _Component(lambda s: s.turn[..., 0] * _pace(s), _curvature_gradient, _pace),
}

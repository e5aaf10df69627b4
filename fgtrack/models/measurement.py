"""Measurement models: any subset of the measurable components, seen from a sensor pose.

x_m, y_m and yaw_rad are in the map frame, and speed_mps is over ground along the heading. range_m, bearing_rad (0 along
the sensor's x axis, counter-clockwise) and range_rate_mps are relative to the sensor. curvature_radpm is the yaw rate
of the object over its speed, positive for a left turn. No sensor measures a curvature: it comes from the map.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import cartesian, cartesian_gradient
from fgtrack.core.linalg import kernels
from fgtrack.core.types import MEASURABLE, STATE_NAMES, FloatArray, IntArray
from fgtrack.models.motion import CARTESIAN, POLAR, MotionModel

#: The derivative of a bearing by the position grows as 1 / range. Below this range it is constant.
MIN_RANGE_M = 1e-6
#: Far below this speed a curvature has no effect on the yaw rate: an object at rest follows no curve.
SLOW_MPS = 1.0
#: Components of measurements: the components that a detection measures, and the curvature from the map.
COMPONENTS = (*MEASURABLE, "curvature_radpm")
_KERNELS = "fgtrack.models.measurement_kernels"
#: Components that are angles.
ANGULAR = ("yaw_rad", "bearing_rad")
#: Components that are relative to the sensor.
RELATIVE = ("range_m", "bearing_rad", "range_rate_mps")


class SensorPose(NamedTuple):
    """Pose and velocity of a sensor in the map at the stamp of the measurement."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0


AT_ORIGIN = SensorPose()


@dataclass(frozen=True)
class MeasurementModel:
    """Measurement of a state, z = h(x, pose) + noise. `measurement_model` returns shared models.

    A state may have more entries than `state_names`. Raises `CallError` for unknown components or states.
    """

    components: tuple[str, ...]
    """Measured components: a non-empty subset of `COMPONENTS` in that order."""
    state_names: tuple[str, ...]
    """Names of the entries of the state: x, y and either yaw, speed or vx, vy, then further entries."""

    def __post_init__(self) -> None:
        if not self.components or self.components != tuple(
            name for name in COMPONENTS if name in self.components
        ):
            raise CallError(
                f"measurement of {', '.join(self.components) or 'nothing'}: give one or more of "
                f"{', '.join(COMPONENTS)}, each once and in this order"
            )
        begins = (
            (STATE_NAMES[:5],)
            if "curvature_radpm" in self.components
            else (POLAR, CARTESIAN)
        )
        if not any(self.state_names[: len(each)] == each for each in begins):
            raise CallError(
                f"measurement of {', '.join(self.components)}: state of {', '.join(self.state_names)}: must begin with "
                f"{' or '.join(', '.join(each) for each in begins)}"
            )

    def __reduce_ex__(self, protocol: Any) -> Any:  # Any: as `object` has it
        """Let pickle return the shared model, so that equal measurements still form one stack after reading."""
        if type(self) is MeasurementModel:
            return _shared_model, (self.components, self.state_names)
        return super().__reduce_ex__(protocol)

    @cached_property
    def angular(self) -> tuple[int, ...]:
        """Indices of the components that are angles."""
        return tuple(
            index for index, name in enumerate(self.components) if name in ANGULAR
        )

    @cached_property
    def relative(self) -> tuple[int, ...]:
        """Indices of the components that are relative to the sensor."""
        return tuple(
            index for index, name in enumerate(self.components) if name in RELATIVE
        )

    @cached_property
    def linear(self) -> bool:
        """True if the measurement selects entries of the state, for every sensor pose."""
        return set(self.components) <= set(self.state_names)

    def predict(self, x: FloatArray, pose: SensorPose = AT_ORIGIN) -> FloatArray:
        """Return the measurement expected for the states `x`, shape (..., n) -> (..., k). Angles are not wrapped."""
        if self.linear:
            return x.take(self.selected, axis=-1)
        return self._observed(self.codes, x, pose)[0]

    def jacobian(self, x: FloatArray, pose: SensorPose = AT_ORIGIN) -> FloatArray:
        """Return the derivative H of `predict` by `x`, shape (..., k, n). It is always finite, see
        `MIN_RANGE_M`.

        The H of a linear model is read-only.
        """
        if self.linear:
            n = x.shape[-1]
            shape = (*x.shape[:-1], len(self.components), n)
            return np.broadcast_to(self.selection(n), shape)
        return self._observed(self.codes, x, pose)[1]

    def predict_with_jacobian(
        self, x: FloatArray, pose: SensorPose = AT_ORIGIN
    ) -> tuple[FloatArray, FloatArray]:
        """Return `predict` (..., k) and `jacobian`. A linear model returns one Jacobian (k, n) for all states."""
        if self.is_compiled and not self.linear:
            return self._observed(self.codes, x, pose)
        H = self.selection(x.shape[-1]) if self.linear else self.jacobian(x, pose)
        return self.predict(x, pose), H

    def linearised(
        self,
        z: FloatArray,
        x: FloatArray,
        pose: SensorPose = AT_ORIGIN,
        residual: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the innovation y (..., k) of z (..., k) at the states x (..., n), and its Jacobian H, (k, n)
        or (..., k, n).

        `residual` may replace the residual of this model.
        """
        h, H = self.predict_with_jacobian(x, pose)
        return (residual or self.residual)(z, h), H

    def pose_jacobian(self, x: FloatArray, pose: SensorPose) -> FloatArray:
        """Return the derivative of `predict` by the entries of `pose`, shape (..., k, 5); finite as `jacobian`."""
        D = np.zeros((*x.shape[:-1], len(self.components), len(pose)))
        if not self.relative:
            return D
        range_code = COMPONENTS.index("range_m")
        _, G = self._observed(np.append(self.codes, range_code), x, pose)
        for row in self.relative:
            D[..., row, :2] = -G[..., row, :2]  # the offset alone counts
            if self.components[row] == "bearing_rad":
                D[..., row, 2] = -1.0
            elif self.components[row] == "range_rate_mps":
                D[..., row, 3:] = -G[..., -1, :2]
        return D

    def selection(self, n: int) -> FloatArray:
        """Return the `jacobian` of a linear model at any state of `n` entries, shape (k, n), read-only."""
        if n not in self._selections:
            H = np.eye(n)[self.selected]
            H.flags.writeable = False
            self._selections[n] = H
        return self._selections[n]

    def residual(self, z: FloatArray, z_predicted: FloatArray) -> FloatArray:
        """Return measured minus predicted values, shape (..., k), with angles in (-pi, pi]. No other function
        wraps angles.
        """
        y = np.array(z - z_predicted, dtype=np.float64, order="C")
        if self.angular:
            kernels(_KERNELS).wrap(self.codes, y.reshape(-1, y.shape[-1]))
        return y

    def part(self, rows: Sequence[int]) -> "MeasurementModel":
        """Return the model of the components `rows` alone, in ascending order."""
        return _shared_model(
            tuple(self.components[row] for row in rows), self.state_names
        )

    @cached_property
    def codes(self) -> IntArray:
        """Indices of the components in `COMPONENTS`, shape (k,): their numbers in compiled loops."""
        return np.array([COMPONENTS.index(name) for name in self.components])

    @property
    def is_compiled(self) -> bool:
        """True if compiled loops may use the shipped equations, because no subclass has replaced a part of them."""
        return type(self) is MeasurementModel

    def _observed(
        self, codes: IntArray, x: FloatArray, pose: SensorPose
    ) -> tuple[FloatArray, FloatArray]:
        """Return the values (..., k) of the components `codes`, and their derivatives by the state, shape (...,
        k, n).
        """
        k, n = len(codes), x.shape[-1]
        states = np.array(x, dtype=np.float64, order="C").reshape(-1, n)
        h, H = np.empty((len(states), k)), np.empty((len(states), k, n))
        seen_from = np.array(pose, dtype=np.float64)
        is_cartesian = self.state_names[:4] == CARTESIAN
        kernels(_KERNELS).observations(codes, is_cartesian, states, seen_from, h, H)
        return h.reshape(*x.shape[:-1], k), H.reshape(*x.shape[:-1], k, n)

    @cached_property
    def _selections(self) -> dict[int, FloatArray]:
        return {}

    @cached_property
    def selected(self) -> IntArray:
        """Indices in the state of the components of a linear model, shape (k,)."""
        return np.array([self.state_names.index(name) for name in self.components])


def measurement_model(
    components: tuple[str, ...], motion_model: MotionModel
) -> MeasurementModel:
    """Return the measurement of `components` for the state of `motion_model`: one shared object for each
    combination.
    """
    return _shared_model(components, motion_model.state_names)


@cache
def _shared_model(
    components: tuple[str, ...], state_names: tuple[str, ...]
) -> MeasurementModel:
    return MeasurementModel(components, state_names)


def measured_position(
    components: tuple[str, ...], z: FloatArray, R: FloatArray, pose: SensorPose
) -> tuple[FloatArray, FloatArray] | None:
    """Return the measured position in the map (2,) and its covariance (2, 2); None if z has no position.

    The position comes from x and y, or to first order from range and bearing.
    """
    if components[:2] == ("x_m", "y_m"):
        return z[:2], R[:2, :2]
    G = position_gradient(components, z, pose)
    if G is None:
        return None
    direction_range = z[_polar_rows(components)] + np.array([pose.yaw_rad, 0.0])
    return np.array([pose.x_m, pose.y_m]) + cartesian(direction_range), G @ R @ G.T


def position_gradient(
    components: tuple[str, ...], z: FloatArray, pose: SensorPose
) -> FloatArray | None:
    """Derivative of the position from `measured_position` by z, shape (2, k); None if z has no position."""
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

"""What a sensor that moves and turns sees of a state."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg
from support.oracle.dynamics import FloatArray

_STEP = 1e-5
_ANGLES = ("yaw_rad", "bearing_rad")


class Vehicle(NamedTuple):
    """Pose of a vehicle in the map and how it moves, along its heading, and turns."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    yaw_rate_radps: float


class Eye(NamedTuple):
    """Pose and velocity of a sensor in the map."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0


_AT_ORIGIN = Eye()


def mounted(vehicle: Vehicle, forward_m: float, left_m: float, yaw_rad: float) -> Eye:
    """A sensor on `vehicle`; what turns with it moves across its arm."""
    c, s = math.cos(vehicle.yaw_rad), math.sin(vehicle.yaw_rad)
    east_m, north_m = c * forward_m - s * left_m, s * forward_m + c * left_m
    return Eye(
        vehicle.x_m + east_m,
        vehicle.y_m + north_m,
        vehicle.yaw_rad + yaw_rad,
        vehicle.speed_mps * c - vehicle.yaw_rate_radps * north_m,
        vehicle.speed_mps * s + vehicle.yaw_rate_radps * east_m,
    )


def slopes(function: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Derivative of `function`, (n,) -> (k,), at `x` (n,): difference quotients, shape (k, n)."""
    steps = _STEP * np.eye(len(x))
    return np.stack([(function(x + step) - function(x - step)) / (2.0 * _STEP) for step in steps], axis=-1)


@dataclass(frozen=True)
class Sighting:
    """z of `names` at a stamp, shape (k,), with covariance `R`, (k, k)."""

    stamp_ns: int
    names: tuple[str, ...]
    z: FloatArray
    R: FloatArray
    eye: Eye = _AT_ORIGIN
    loss: tuple[str, float] | None = None
    """Robust loss on the length of the whitened residual, huber, cauchy or tukey, and its width; None: a Gaussian."""

    def residual(self, x: FloatArray, state_names: tuple[str, ...]) -> FloatArray:
        """z - h(x), whitened, shape (k,); angles go the short way round."""
        y = self.z - seen(self.names, x, state_names, self.eye)
        for k, name in enumerate(self.names):
            if name in _ANGLES:
                y[k] = math.remainder(y[k], 2.0 * math.pi)
        return np.asarray(linalg.solve_triangular(linalg.cholesky(self.R, lower=True), y, lower=True))

    def slope(self, x: FloatArray, state_names: tuple[str, ...]) -> FloatArray:
        """Derivative of h by x, whitened, shape (k, n): difference quotients."""
        return -slopes(lambda there: self.residual(there, state_names), x)

    def weight(self, y: FloatArray) -> float:
        """What the sighting counts at the whitened residual `y`."""
        if self.loss is None:
            return 1.0
        kind, width = self.loss
        far = float(np.linalg.norm(y)) / width
        if kind == "cauchy":
            return 1.0 / (1.0 + far**2)
        if kind == "tukey":
            return max(1.0 - far**2, 0.0) ** 2 if far < 1.0 else 0.0
        return 1.0 / max(far, 1.0)


def seen(names: tuple[str, ...], x: FloatArray, state_names: tuple[str, ...], eye: Eye) -> FloatArray:
    """What `eye` sees of the state `x` (n,), without noise, shape (k,); angles are not wrapped."""
    state = dict(zip(state_names, x.tolist(), strict=True))
    if "vx_mps" in state:
        vx_mps, vy_mps = state["vx_mps"], state["vy_mps"]
        yaw_rad, speed_mps = math.atan2(vy_mps, vx_mps), math.hypot(vx_mps, vy_mps)
    else:
        yaw_rad, speed_mps = state["yaw_rad"], state["speed_mps"]
        vx_mps, vy_mps = speed_mps * math.cos(yaw_rad), speed_mps * math.sin(yaw_rad)
    east_m, north_m = state["x_m"] - eye.x_m, state["y_m"] - eye.y_m
    range_m = math.hypot(east_m, north_m)
    closing = (vx_mps - eye.vx_mps) * east_m + (vy_mps - eye.vy_mps) * north_m
    everything = {
        "x_m": state["x_m"],
        "y_m": state["y_m"],
        "yaw_rad": yaw_rad,
        "speed_mps": speed_mps,
        "range_m": range_m,
        "bearing_rad": math.atan2(north_m, east_m) - eye.yaw_rad,
        "range_rate_mps": closing / range_m if range_m else 0.0,
    }
    return np.array([everything[name] for name in names])

"""States as they are published: x, y, yaw, speed, yaw rate and, of a model that has one, acceleration."""

import math
from collections.abc import Sequence

import numpy as np
from support.oracle.dynamics import FloatArray
from support.oracle.problem import Estimate

_NAMES = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2")


def from_published(names: tuple[str, ...], mean: FloatArray, P: FloatArray) -> Estimate:
    """The state of entries `names` that is published as `mean` (m,) and `P` (m, m).

    A velocity (vx, vy) is linearised; across the heading it has the product of the errors of yaw and speed as well.
    """
    own = dict(zip(_NAMES, mean.tolist(), strict=False))
    c, s, speed = math.cos(own["yaw_rad"]), math.sin(own["yaw_rad"]), own["speed_mps"]
    own.update(vx_mps=speed * c, vy_mps=speed * s)
    J = np.array([[float(name == shown) for shown in _NAMES[: len(mean)]] for name in names])
    covariance = np.zeros((len(names), len(names)))
    if "vx_mps" in names:
        J[2:4, 2:4] = [[-speed * s, c], [speed * c, s]]
        across = np.array([-s, c])
        covariance[2:4, 2:4] += (P[2, 2] * P[3, 3] + P[2, 3] ** 2) * np.outer(across, across)
    return Estimate(np.array([own.get(name, 0.0) for name in names]), covariance + J @ P @ J.T)


def kinematic_start(names: tuple[str, ...], values: Sequence[float], std: Sequence[float]) -> Estimate:
    """The start of a state `names` from x, y, yaw, speed, yaw rate and acceleration that are not correlated."""
    return from_published(names, np.array(values, dtype=np.float64), np.diag(np.square(std)))

"""Motion as differential equations, integrated by SciPy."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

FloatArray = npt.NDArray[np.float64]

_ACCURACY = 1e-12
#: In units of the state over 1 s, and of the densities.
_SMALLEST = 1e-15


class Flow(NamedTuple):
    """Where m states are after their durations."""

    mean: FloatArray
    """Shape (m, n); angles are not wrapped."""
    F: FloatArray
    """Derivative by the state before, shape (m, n, n)."""
    Q: FloatArray
    """Covariance of the accumulated noise, shape (m, n, n)."""


@dataclass(frozen=True)
class Dynamics:
    """dx = f(x) dt + noise, white, independent of the state and of that of the other entries.

    `names` of the state are those of CTRV (x, y, yaw, speed, yaw rate), CTRA (and acceleration) or CV (x, y, vx, vy).
    """

    names: tuple[str, ...]
    densities: tuple[float, ...]
    """Spectral density of the noise of each entry."""

    @classmethod
    def of(cls, names: tuple[str, ...], density: Mapping[str, float]) -> "Dynamics":
        """From densities by what they drive: position, yaw, speed, yaw_rate, accel or velocity."""
        drives = {"x_m": "position", "y_m": "position", "vx_mps": "velocity", "vy_mps": "velocity"}
        keys = [drives.get(name, name.rpartition("_")[0]) for name in names]
        return cls(names, tuple(density.get(key, 0.0) for key in keys))

    @property
    def _column(self) -> dict[str, int]:
        return {name: k for k, name in enumerate(self.names)}

    def rates(self, x: FloatArray) -> FloatArray:
        """f(x), shape (m, n)."""
        at, f = self._column, np.zeros_like(x)
        if "vx_mps" in at:
            f[:, 0], f[:, 1] = x[:, at["vx_mps"]], x[:, at["vy_mps"]]
            return f
        yaw, speed = x[:, at["yaw_rad"]], x[:, at["speed_mps"]]
        f[:, 0], f[:, 1] = speed * np.cos(yaw), speed * np.sin(yaw)
        f[:, at["yaw_rad"]] = x[:, at["yaw_rate_radps"]]
        if "accel_mps2" in at:
            f[:, at["speed_mps"]] = x[:, at["accel_mps2"]]
        return f

    def slopes(self, x: FloatArray) -> FloatArray:
        """Derivative A of f by x, shape (m, n, n)."""
        at, A = self._column, np.zeros((*x.shape, x.shape[1]))
        if "vx_mps" in at:
            A[:, 0, at["vx_mps"]] = A[:, 1, at["vy_mps"]] = 1.0
            return A
        yaw, speed = x[:, at["yaw_rad"]], x[:, at["speed_mps"]]
        A[:, 0, at["yaw_rad"]], A[:, 0, at["speed_mps"]] = -speed * np.sin(yaw), np.cos(yaw)
        A[:, 1, at["yaw_rad"]], A[:, 1, at["speed_mps"]] = speed * np.cos(yaw), np.sin(yaw)
        A[:, at["yaw_rad"], at["yaw_rate_radps"]] = 1.0
        if "accel_mps2" in at:
            A[:, at["speed_mps"], at["accel_mps2"]] = 1.0
        return A

    def flow(self, x: FloatArray, t: FloatArray) -> Flow:
        """The states `x`, shape (m, n), after `t`, shape (m,).

        Integrates x' = f, F' = A F and Q' = A Q + Q A' + D together, the last one in the unit of t, so that small
        durations keep their digits.
        """
        m, n = x.shape
        D = np.diag(self.densities)
        start = np.concatenate([x, np.tile(np.eye(n).ravel(), (m, 1)), np.zeros((m, n * n))], axis=1)

        def derivative(_: float, flat: FloatArray) -> FloatArray:
            packed = flat.reshape(m, -1)
            F, Q = packed[:, n : n + n * n].reshape(m, n, n), packed[:, n + n * n :].reshape(m, n, n)
            A = self.slopes(packed[:, :n]) * t[:, None, None]
            AQ = A @ Q
            rates = self.rates(packed[:, :n]) * t[:, None]
            return np.concatenate(
                [rates, (A @ F).reshape(m, -1), (AQ + np.swapaxes(AQ, 1, 2) + D).reshape(m, -1)], axis=1
            ).ravel()

        found = solve_ivp(derivative, (0.0, 1.0), start.ravel(), method="DOP853", rtol=_ACCURACY, atol=_SMALLEST)
        packed = found.y[:, -1].reshape(m, -1)
        F, Q = packed[:, n : n + n * n].reshape(m, n, n), packed[:, n + n * n :].reshape(m, n, n)
        return Flow(packed[:, :n], F, Q * t[:, None, None])

    def move(self, x: FloatArray, t: float) -> Flow:
        """`flow` of one state, shapes (n,), (n, n) and (n, n)."""
        return Flow(*(part[0] for part in self.flow(x[None], np.array([t]))))

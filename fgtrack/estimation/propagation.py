"""Propagators: many equal time steps of many objects at once, as the state storage of the paper needs them."""

from typing import Protocol

import numpy as np

from fgtrack.core.geometry import rotations, wrap_angles
from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import SPEED, YAW, YAW_RATE, FloatArray
from fgtrack.models.motion import MotionModel


class Propagator(Protocol):
    """Takes m objects through equal steps and gives every state on the way."""

    motion: MotionModel
    """Names and conversions of the state; its equations too, where the propagator has none of its own."""

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: int, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """States after 1 ... `steps` steps of `dt_s`: shapes (steps, m, n) and (steps, m, n, n)."""

    def settle(self, mean: FloatArray) -> FloatArray:
        """Means, shape (m, n), with the angles brought back to their range after a correction."""


class ExactPropagator:
    """Every step straight from the start: exact, because flow and process noise of a motion model compose."""

    def __init__(self, motion: MotionModel) -> None:
        self.motion = motion
        self._yawed = "yaw_rad" in motion.state_names

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: int, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """See `Propagator.propagate`."""
        dts_s = dt_s * np.arange(1, steps + 1, dtype=float)[:, None]
        starts = np.broadcast_to(mean, (steps, *mean.shape))
        F = self.motion.jacobian(starts, dts_s)
        Q = self.motion.process_noise(starts, dts_s)
        spread = F @ covariance @ np.swapaxes(F, -1, -2) + Q
        return self.motion.predict(starts, dts_s), symmetrise(spread)

    def settle(self, mean: FloatArray) -> FloatArray:
        """See `Propagator.settle`."""
        return wrapped_yaw(mean) if self._yawed else mean


class EulerCtrv:
    """CTRV in Euler steps (Karle et al. 2023, eq. 10), all of them in closed form.

    The transition of one step differs from the identity in five entries, so the product of k steps is made of
    running sums, and so is its inverse. With Phi_k the product, P_k = Phi_k (P_0 + sum_j Phi_j^-1 Q Phi_j^-T) Phi_k'.
    States beyond the yaw rate are carried along unchanged.
    """

    def __init__(self, motion: MotionModel, density: FloatArray) -> None:
        """`density`: diagonal of Q per second, shape (n,), along and across the heading first."""
        self.motion = motion
        self._density = density
        self._isotropic = bool(density[0] == density[1])

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: int, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """See `Propagator.propagate`."""
        before = np.arange(steps, dtype=float)[:, None]
        yaw = self.yaws(mean, before * dt_s)
        speed = self.speeds(mean, before * dt_s)
        c, s = dt_s * np.cos(yaw), dt_s * np.sin(yaw)
        dx, dy = speed * c, speed * s

        out = np.repeat(mean[None], steps, axis=0)
        out[:, :, 0] += np.cumsum(dx, axis=0)
        out[:, :, 1] += np.cumsum(dy, axis=0)
        out[:, :, YAW] = self.yaws(mean, (before + 1.0) * dt_s)
        out[:, :, SPEED] = self.speeds(mean, (before + 1.0) * dt_s)

        elapsed = (before + 1.0) * dt_s
        turn = np.array([-dy, dx])  # one step's dx'/dyaw and dy'/dyaw, shape (2, steps, m)
        by_yaw = np.cumsum(turn, axis=1)
        by_speed = np.cumsum(np.array([c, s]), axis=1)
        by_rate = np.cumsum(turn * (before * dt_s), axis=1)
        n = mean.shape[-1]
        forward = np.zeros((2, *yaw.shape, n, n))  # Phi and its inverse
        forward[..., range(n), range(n)] = 1.0
        phi, psi = forward
        phi[:, :, :2, YAW] = np.moveaxis(by_yaw, 0, -1)
        phi[:, :, :2, SPEED] = np.moveaxis(by_speed, 0, -1)
        phi[:, :, :2, YAW_RATE] = np.moveaxis(by_rate, 0, -1)
        phi[:, :, YAW, YAW_RATE] = elapsed
        psi[:, :, :2, YAW : YAW_RATE + 1] = -phi[:, :, :2, YAW : YAW_RATE + 1]
        psi[:, :, :2, YAW_RATE] += np.moveaxis(by_yaw * elapsed, 0, -1)
        psi[:, :, YAW, YAW_RATE] = -elapsed

        if self._isotropic:
            noise = (psi * (self._density * dt_s)) @ np.swapaxes(psi, -1, -2)
        else:
            noise = psi @ self._turned_noise(yaw, dt_s) @ np.swapaxes(psi, -1, -2)
        gathered = covariance + np.cumsum(noise, axis=0)
        return out, symmetrise(phi @ gathered @ np.swapaxes(phi, -1, -2))

    def _turned_noise(self, yaw: FloatArray, dt_s: float) -> FloatArray:
        """Q of one step with its position block turned from the heading to the map, shape (..., n, n)."""
        Q = np.zeros((*yaw.shape, len(self._density), len(self._density)))
        Q[...] = np.diag(self._density * dt_s)
        turn = rotations(yaw)
        Q[..., :2, :2] = turn @ Q[..., :2, :2] @ np.swapaxes(turn, -1, -2)
        return Q

    def yaws(self, mean: FloatArray, elapsed_s: FloatArray) -> FloatArray:
        """Yaw after `elapsed_s` (k, 1), shape (k, m)."""
        return np.asarray(mean[:, YAW] + elapsed_s * mean[:, YAW_RATE])

    def speeds(self, mean: FloatArray, elapsed_s: FloatArray) -> FloatArray:
        """Speed after `elapsed_s` (k, 1), shape (k, m)."""
        return np.broadcast_to(mean[:, SPEED], (len(elapsed_s), len(mean)))

    def settle(self, mean: FloatArray) -> FloatArray:
        """See `Propagator.settle`."""
        return wrapped_yaw(mean)


def wrapped_yaw(mean: FloatArray) -> FloatArray:
    """A copy of means (..., n) with the yaw in (-pi, pi]."""
    settled = mean.copy()
    settled[..., YAW] = wrap_angles(mean[..., YAW])
    return settled

"""Propagators: many objects through equal time steps, each through its own number of them."""

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fgtrack.core.geometry import rotations, wrap_angles
from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import SPEED, YAW, YAW_RATE, FloatArray, IntArray
from fgtrack.estimation.ekf import predict
from fgtrack.models.motion import MotionModel

ComplexArray = npt.NDArray[np.complex128]


class Propagator(Protocol):
    """Predicts m objects at once."""

    motion: MotionModel
    """Names and conversions of the state; its equations too, where the propagator has none of its own."""

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """States (m, n) and (m, n, n), each after its own number of `steps` (m,) of `dt_s`; yaw is not wrapped."""

    def settle(self, mean: FloatArray) -> FloatArray:
        """Means, shape (..., n), with the angles brought back to their range after a correction."""


class ExactPropagator:
    """All steps in one: exact, because flow and process noise of a motion model compose."""

    def __init__(self, motion: MotionModel) -> None:
        self.motion = motion
        self._yawed = "yaw_rad" in motion.state_names

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """See `Propagator.propagate`."""
        return predict(mean, covariance, self.motion, steps * np.float64(dt_s))

    def settle(self, mean: FloatArray) -> FloatArray:
        """See `Propagator.settle`."""
        return wrapped_yaw(mean) if self._yawed else mean


class EulerCtrv:
    """CTRV in Euler steps (Karle et al. 2023, eq. 10), all of them in closed form.

    The transition of one step differs from the identity in five entries, so the product Phi(K, j) of the steps from
    j to K is made of differences of running sums; the noise gathered is the sum of Phi(K, j) Q Phi(K, j)' over j.
    States beyond the yaw rate are carried along unchanged, and so is their noise.
    """

    def __init__(self, motion: MotionModel, density: FloatArray) -> None:
        """`density`: diagonal of Q per second, shape (n,), along and across the heading first."""
        self.motion = motion
        self._density = density
        self._root = np.sqrt(density[YAW : YAW_RATE + 1])
        self._isotropic = bool(density[0] == density[1])
        self._undirected = np.diag(density)  # noise of what nothing else depends on, and of an isotropic position
        self._undirected[YAW : YAW_RATE + 1] = 0.0
        if not self._isotropic:
            self._undirected[:2] = 0.0
        self._identity = np.eye(len(density))

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """See `Propagator.propagate`."""
        longest = int(steps.max(initial=0))
        if not longest:
            return mean, covariance
        index = np.arange(longest, dtype=np.float64)
        start_s = index * np.float64(dt_s)  # of each step
        going = (index < steps[:, None]).astype(np.float64)  # (m, K); 0 where an object has arrived
        yaw = self.yaws(mean, start_s)
        # Displacements are complex, x + i y: by a speed of 1, by the speed, and by the speed times the time.
        paths = np.empty((3, *yaw.shape), dtype=np.complex128)
        np.multiply(np.exp(1j * yaw), dt_s * going, out=paths[0])
        np.multiply(self.speeds(mean, start_s), paths[0], out=paths[1])
        np.multiply(start_s, paths[1], out=paths[2])
        paths.cumsum(axis=2, out=paths)
        total = paths[:, :, -1]
        elapsed_s = steps * np.float64(dt_s)

        after = mean.copy()
        after[:, 0] += total[1].real
        after[:, 1] += total[1].imag
        after[:, YAW] = self.yaws(mean, elapsed_s[:, None])[:, 0]
        after[:, SPEED] = self.speeds(mean, elapsed_s[:, None])[:, 0]

        Phi = np.zeros(covariance.shape)
        Phi[:] = self._identity
        by_state = np.array([1j * total[1], total[0], 1j * total[2]]).T  # by yaw, speed and yaw rate
        Phi[:, 0, YAW : YAW_RATE + 1] = by_state.real
        Phi[:, 1, YAW : YAW_RATE + 1] = by_state.imag
        Phi[:, YAW, YAW_RATE] = elapsed_s
        spread = Phi @ covariance @ np.swapaxes(Phi, -1, -2)
        spread += self._gathered(total[:, :, None] - paths, start_s + dt_s, yaw, going, elapsed_s, dt_s)
        return after, symmetrise(spread)

    def _gathered(
        self,
        rest: ComplexArray,
        end_s: FloatArray,
        yaw: FloatArray,
        going: FloatArray,
        elapsed_s: FloatArray,
        dt_s: float,
    ) -> FloatArray:
        """Noise gathered, the sum over j of G_j G_j': G_j holds the driven columns of Phi(K, j) times sqrt(Q).

        `rest` (3, m, K): displacements from the end of step j, at `end_s` (K,), on.
        """
        m, K = yaw.shape
        driven = np.zeros((m, 5, 3, K))  # x, y, yaw, speed, yaw rate; by the noise of yaw, speed, yaw rate
        rest[2] -= end_s * rest[1]  # the yaw rate at j turns only what comes later
        driven[:, 0, 0], driven[:, 1, 0] = -rest[1].imag, rest[1].real
        driven[:, 0, 1], driven[:, 1, 1] = rest[0].real, rest[0].imag
        driven[:, 0, 2], driven[:, 1, 2] = -rest[2].imag, rest[2].real
        driven[:, 2, 0] = driven[:, 3, 1] = driven[:, 4, 2] = going
        driven[:, 2, 2] = (elapsed_s[:, None] - end_s) * going
        driven *= math.sqrt(dt_s) * self._root[:, None]
        flat = driven.reshape(m, 5, 3 * K)
        gathered = np.zeros((m, len(self._density), len(self._density)))
        gathered[:, :5, :5] = flat @ np.swapaxes(flat, -1, -2)
        gathered += self._undirected * elapsed_s[:, None, None]
        if not self._isotropic:
            turn = rotations(yaw)
            turned = turn @ np.diag(self._density[:2] * dt_s) @ np.swapaxes(turn, -1, -2)
            gathered[:, :2, :2] += np.sum(turned * going[:, :, None, None], axis=1)
        return gathered

    def yaws(self, mean: FloatArray, elapsed_s: FloatArray) -> FloatArray:
        """Yaw of each object after `elapsed_s`, (k,) or (m, k); shape (m, k)."""
        return np.asarray(mean[:, YAW, None] + elapsed_s * mean[:, YAW_RATE, None])

    def speeds(self, mean: FloatArray, elapsed_s: FloatArray) -> FloatArray:
        """Speed of each object after `elapsed_s`, (k,) or (m, k); shape (m, k) or (m, 1)."""
        return mean[:, SPEED, None]

    def settle(self, mean: FloatArray) -> FloatArray:
        """See `Propagator.settle`."""
        return wrapped_yaw(mean)


def wrapped_yaw(mean: FloatArray) -> FloatArray:
    """A copy of means (..., n) with the yaw in (-pi, pi]."""
    settled = mean.copy()
    settled[..., YAW] = wrap_angles(mean[..., YAW])
    return settled

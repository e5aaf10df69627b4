"""Propagators: many objects through equal time steps, each through its own number of them."""

from typing import Protocol

import numpy as np

from fgtrack.core.geometry import rotations, wrap_angles
from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import SPEED, YAW, YAW_RATE, FloatArray, IntArray
from fgtrack.estimation.ekf import predict
from fgtrack.models.motion import MotionModel


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
        return predict(mean, covariance, self.motion, steps * dt_s)

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

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """See `Propagator.propagate`."""
        longest = int(steps.max(initial=0))
        if not longest:
            return mean, covariance
        before_s = dt_s * np.arange(longest, dtype=float)  # elapsed before each step
        going = (np.arange(longest) < steps[:, None]).astype(float)  # (m, K); 0 where an object has arrived
        yaw = self.yaws(mean, before_s)
        speed = self.speeds(mean, before_s)
        sums = np.empty((6, *yaw.shape))
        c, s, x, y, x_late, y_late = sums
        step_s = dt_s * going
        np.multiply(np.cos(yaw), step_s, out=c)
        np.multiply(np.sin(yaw), step_s, out=s)
        np.multiply(speed, c, out=x)
        np.multiply(speed, s, out=y)
        np.multiply(x, before_s, out=x_late)
        np.multiply(y, before_s, out=y_late)
        sums.cumsum(axis=2, out=sums)
        total = sums[:, :, -1]

        elapsed_s = np.asarray(steps * dt_s)
        after = mean.copy()
        after[:, 0] += total[2]
        after[:, 1] += total[3]
        after[:, YAW] = self.yaws(mean, elapsed_s[:, None])[:, 0]
        after[:, SPEED] = self.speeds(mean, elapsed_s[:, None])[:, 0]

        Phi = np.zeros(covariance.shape)
        Phi[:, range(len(self._density)), range(len(self._density))] = 1.0
        Phi[:, 0, YAW : YAW_RATE + 1] = np.array([-total[3], total[0], -total[5]]).T
        Phi[:, 1, YAW : YAW_RATE + 1] = np.array([total[2], total[1], total[4]]).T
        Phi[:, YAW, YAW_RATE] = elapsed_s
        spread = Phi @ covariance @ np.swapaxes(Phi, -1, -2)
        spread += self._gathered(sums, total, yaw, going, elapsed_s, before_s + dt_s, dt_s)
        return after, symmetrise(spread)

    def _gathered(
        self,
        sums: FloatArray,
        total: FloatArray,
        yaw: FloatArray,
        going: FloatArray,
        elapsed_s: FloatArray,
        passed_s: FloatArray,
        dt_s: float,
    ) -> FloatArray:
        """Noise gathered: the sum over j of G_j G_j', with G_j the driven columns of Phi(K, j) times sqrt(Q)."""
        n = len(self._density)
        rest = total[:, :, None] - sums  # from step j to the end
        rest_s = elapsed_s[:, None] - passed_s
        driven = np.zeros((len(yaw), 5, 3, yaw.shape[1]))  # rows x, y, yaw, speed, rate; by yaw, speed, rate
        np.negative(rest[3], out=driven[:, 0, 0])
        driven[:, 1, 0] = rest[2]
        driven[:, 0, 1] = rest[0]
        driven[:, 1, 1] = rest[1]
        # the yaw rate at j turns only what comes later: sum over i >= j of dx_i (t_i - t_j)
        driven[:, 0, 2] = passed_s * rest[3] - rest[5]
        driven[:, 1, 2] = rest[4] - passed_s * rest[2]
        driven[:, 2, 0] = going
        driven[:, 3, 1] = going
        driven[:, 2, 2] = rest_s * going
        driven[:, 4, 2] = going
        driven *= np.sqrt(dt_s) * self._root[:, None]
        flat = driven.reshape(len(yaw), 5, -1)
        gathered = np.zeros((len(yaw), n, n))
        gathered[:, :5, :5] = flat @ np.swapaxes(flat, -1, -2)
        if self._isotropic:
            gathered[:, 0, 0] += self._density[0] * elapsed_s
            gathered[:, 1, 1] += self._density[0] * elapsed_s
        else:
            turn = rotations(yaw)
            turned = turn @ np.diag(self._density[:2] * dt_s) @ np.swapaxes(turn, -1, -2)
            gathered[:, :2, :2] += np.sum(turned * going[:, :, None, None], axis=1)
        for rest_of_state in range(5, n):
            gathered[:, rest_of_state, rest_of_state] = self._density[rest_of_state] * elapsed_s
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

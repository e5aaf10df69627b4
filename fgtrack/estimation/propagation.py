"""Propagators: many objects through equal time steps, each through its own number of them."""

from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from fgtrack.core.geometry import rotations, wrap_angles
from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import SPEED, YAW, YAW_RATE, FloatArray, IntArray, TrackState
from fgtrack.estimation.ekf import predict
from fgtrack.models.measurement import MeasurementModel
from fgtrack.models.motion import MotionModel

_QUARTER_TURN = np.array([[-1.0], [1.0]])  # of x and y in reverse order


class Propagator(Protocol):
    """Predicts m objects at once."""

    motion: MotionModel
    """Names and conversions of the state; its equations too, where the propagator has none of its own."""

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """States (m, n) and (m, n, n), each after its own number of `steps` (m,) of `dt_s`; yaw is not wrapped."""

    def wrap(self, mean: FloatArray) -> FloatArray:
        """Means, shape (..., n), with the angles brought back to their range after a correction."""

    def residual(self, model: MeasurementModel, z: FloatArray, z_predicted: FloatArray) -> FloatArray:
        """Measured minus predicted, shape (..., k), in the angles' range."""


class ExactPropagator:
    """All steps in one: exact, because flow and process noise of a motion model compose."""

    def __init__(self, motion: MotionModel) -> None:
        self.motion = motion

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """See `Propagator.propagate`."""
        return predict(mean, covariance, self.motion, steps * np.float64(dt_s))

    def wrap(self, mean: FloatArray) -> FloatArray:
        """See `Propagator.wrap`."""
        return wrapped(self.motion, mean)

    def residual(self, model: MeasurementModel, z: FloatArray, z_predicted: FloatArray) -> FloatArray:
        """See `Propagator.residual`: the model's own."""
        return model.residual(z, z_predicted)


class _Times(NamedTuple):
    """When steps begin and end, read-only, each of shape (m, K + 1), or (1, K + 1) where all objects take as many.

    After an object's last step all is at its end.
    """

    at_s: FloatArray
    left_s: FloatArray
    """Until the end of the last step."""
    lasts_s: FloatArray
    """Duration of the step that begins there."""
    noise_s: FloatArray
    """Duration of the step that ends there: its noise enters at its end."""


@lru_cache(maxsize=128)
def _times(steps: tuple[int, ...], dt_s: float) -> _Times:
    """Times of `steps` of `dt_s` for each object; shared, because the same ones come again and again."""
    end_s = np.array(steps)[:, None] * dt_s
    at_s = np.minimum(np.arange(max(steps) + 1) * dt_s, end_s)
    left_s = end_s - at_s
    lasts_s = np.minimum(left_s, dt_s)
    noise_s = np.zeros(at_s.shape)
    noise_s[:, 1:] = lasts_s[:, :-1]
    times = _Times(at_s, left_s, lasts_s, noise_s)
    for array in times:
        array.flags.writeable = False
    return times


class EulerCtrv:
    """CTRV in Euler steps (Karle et al. 2023, eq. 10), all of them in closed form.

    The transition of one step differs from the identity in five entries, so the product Phi(K, j) of the steps from
    j to K is made of running sums from the end, and P' = Phi(K, 0) P Phi(K, 0)' + sum over j > 0 of
    Phi(K, j) Q Phi(K, j)'. States beyond the yaw rate are carried along unchanged, and so is their noise.
    """

    def __init__(self, motion: MotionModel, density: FloatArray) -> None:
        """`density`: diagonal of Q per second, shape (n,), along and across the heading first."""
        self.motion = motion
        self._identity = np.eye(len(density))[..., None]
        self._along_across = density[:2]
        self._undirected = density[:, None].copy()  # what does not turn with the heading
        self._isotropic = bool(density[0] == density[1])
        if not self._isotropic:
            self._undirected[:2] = 0.0

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """See `Propagator.propagate`."""
        counts = steps.tolist()
        if not any(counts):
            return mean, covariance
        alike = counts.count(counts[0]) == len(counts)
        times = _times(tuple(counts[:1] if alike else counts), dt_s)
        yaw, speed = self.yaws(mean, times.at_s), self.speeds(mean, times.at_s)

        Phi = np.empty((*covariance.shape, times.at_s.shape[-1]))  # Phi(K, j) for each j
        Phi[:] = self._identity
        Phi[:, YAW, YAW_RATE] = times.left_s
        self._fill_ways(Phi[:, :2, YAW : YAW_RATE + 1], yaw, speed, times.lasts_s, dt_s)
        start = Phi[..., 0]

        after = mean.copy()
        after[:, :2] -= _QUARTER_TURN[:, 0] * start[:, 1::-1, YAW]  # turned back: the derivative of a way by yaw
        after[:, YAW], after[:, SPEED] = yaw[:, -1], speed[:, -1]

        driven = Phi * (self._undirected * times.noise_s[:, None, None])
        flat = (*mean.shape, -1)
        spread = start @ covariance @ start.mT + driven.reshape(flat) @ Phi.reshape(flat).mT
        if not self._isotropic:
            spread[:, :2, :2] += self._turned(yaw, times.lasts_s)
        return after, symmetrise(spread)

    @staticmethod
    def _fill_ways(ways: FloatArray, yaw: FloatArray, speed: FloatArray, lasts_s: FloatArray, dt_s: float) -> None:
        """Write the derivatives of x and y at the end by yaw, speed and yaw rate before each step, (m, 2, 3, K + 1).

        Those by yaw and speed are sums over the steps to come. The yaw rate turns the yaw from the next step on.
        """
        by_yaw, by_speed, by_yaw_rate = ways[:, :, 0], ways[:, :, 1], ways[:, :, 2]
        np.cos(yaw, out=by_speed[:, 0])
        np.sin(yaw, out=by_speed[:, 1])
        by_speed *= lasts_s[:, None]
        np.multiply(speed[:, None] * _QUARTER_TURN, by_speed[:, ::-1], out=by_yaw)
        backwards = ways[..., ::-1]
        np.add.accumulate(backwards[:, :, :2], axis=-1, out=backwards[:, :, :2])
        np.multiply(by_yaw[..., 1:], dt_s, out=by_yaw_rate[..., :-1])
        np.add.accumulate(backwards[:, :, 2], axis=-1, out=backwards[:, :, 2])

    def _turned(self, yaw: FloatArray, lasts_s: FloatArray) -> FloatArray:
        """Position noise along and across the headings `yaw` (m, K) of steps that last so long, shape (m, 2, 2)."""
        turn = rotations(yaw)
        along_across = turn * self._along_across @ turn.mT
        return np.asarray((along_across * lasts_s[:, :, None, None]).sum(axis=1))

    def yaws(self, mean: FloatArray, elapsed_s: FloatArray) -> FloatArray:
        """Yaw of each object after `elapsed_s`, (k,) or (m, k); shape (m, k)."""
        return np.asarray(mean[:, YAW, None] + elapsed_s * mean[:, YAW_RATE, None])

    def speeds(self, mean: FloatArray, elapsed_s: FloatArray) -> FloatArray:
        """Speed of each object after `elapsed_s`, (k,) or (m, k); shape (m, k) or (m, 1)."""
        return mean[:, SPEED, None]

    def wrap(self, mean: FloatArray) -> FloatArray:
        """See `Propagator.wrap`."""
        return wrapped_yaw(mean)

    def residual(self, model: MeasurementModel, z: FloatArray, z_predicted: FloatArray) -> FloatArray:
        """See `Propagator.residual`: the model's own."""
        return model.residual(z, z_predicted)


def track_state(motion: MotionModel, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> TrackState:
    """A state of `motion` as it is handed out, with the yaw in (-pi, pi]."""
    return TrackState(stamp_ns, wrapped(motion, mean), covariance)


def wrapped(motion: MotionModel, mean: FloatArray) -> FloatArray:
    """Means of `motion`, or differences of them, (..., n), with the yaw, if they have one, in (-pi, pi]."""
    return mean if motion.cartesian else wrapped_yaw(mean)


def wrapped_yaw(mean: FloatArray) -> FloatArray:
    """Means (..., n) with the yaw in (-pi, pi]: `mean` itself where it lies there already, else a copy."""
    yaw = mean[..., YAW]
    wrapped = wrap_angles(yaw)
    if wrapped is yaw:
        return mean
    found = mean.copy()
    found[..., YAW] = wrapped
    return found

"""Prediction of many objects in equal time steps, and the kinematic states that a bank publishes."""

import math
from collections.abc import Sequence

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.linalg import kernels
from fgtrack.core.types import YAW, FloatArray, IntArray, TrackState
from fgtrack.estimation.base import Lazy
from fgtrack.estimation.filters.ekf import predict
from fgtrack.models.measurement import MeasurementModel
from fgtrack.models.motion import MotionModel, WhiteNoise


class ExactPropagator:
    """Predicts many objects, all time steps of an object in one transition.

    The result is exact, because flow and process noise of a motion model compose.
    """

    def __init__(self, motion: MotionModel) -> None:
        self.motion = motion

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return states (m, n) and (m, n, n), each after its own number of `steps` (m,) of `dt_s`. Yaws are not
        wrapped.
        """
        if not (isinstance(self.motion, WhiteNoise) and self.motion.is_compiled):
            return predict(mean, covariance, self.motion, steps * np.float64(dt_s))
        x, P = mean.copy(), covariance.copy()
        kernels("fgtrack.estimation.kernels.kalman").propagate(
            self.motion.kind, self.motion.noise, x, P, steps, dt_s
        )
        return x, P

    def wrap(self, mean: FloatArray) -> FloatArray:
        """Return corrected means, shape (..., n), with the angles wrapped into their range."""
        return wrapped(self.motion, mean)

    def residual(
        self, model: MeasurementModel, z: FloatArray, z_predicted: FloatArray
    ) -> FloatArray:
        """Return measured minus predicted values, shape (..., k), with wrapped angles."""
        return model.residual(z, z_predicted)


def track_state(
    motion: MotionModel, stamp_ns: int, mean: FloatArray, covariance: FloatArray
) -> TrackState:
    """Return a state of `motion` as `TrackState`, with the yaw in (-pi, pi].

    Raises `CallError` for a state that is not finite, for example after a prediction over a very long time.
    """
    if not math.isfinite(mean.sum() + covariance.sum()):
        raise CallError(
            f"stamp_ns: the state at {stamp_ns} ns is not finite, give a stamp closer to the measurements"
        )
    return TrackState(stamp_ns, wrapped(motion, mean), covariance)


def wrapped(motion: MotionModel, mean: FloatArray) -> FloatArray:
    """Return means of `motion`, or differences of means, shape (..., n), with the yaw in (-pi, pi] if there is a
    yaw.
    """
    return mean if motion.cartesian else wrapped_yaw(mean)


def wrapped_yaw(mean: FloatArray) -> FloatArray:
    """Return means (..., n) with the yaw in (-pi, pi]. If it lies there already, `mean` itself is returned, else a
    copy.
    """
    yaw = mean[..., YAW]
    wrapped = wrap_angles(yaw)
    if wrapped is yaw:
        return mean
    result = mean.copy()
    result[..., YAW] = wrapped
    return result


class States(Lazy[TrackState]):
    """Kinematic states of several objects, made at the access to an item."""

    def __init__(
        self, stamps_ns: Sequence[int], means: FloatArray, covariances: FloatArray
    ) -> None:
        self.stamps_ns, self.means, self.covariances = stamps_ns, means, covariances
        """Shapes (m,), (m, n) and (m, n, n)."""

    def __len__(self) -> int:
        return len(self.means)

    def item(self, index: int) -> TrackState:
        """See `Lazy.item`."""
        return TrackState(
            self.stamps_ns[index], self.means[index], self.covariances[index]
        )


def kinematic_states(
    motion: MotionModel,
    stamps_ns: int | Sequence[int],
    means: FloatArray,
    covariances: FloatArray,
) -> States:
    """Return the published kinematic states of m states of `motion`, shapes (m, n) and (m, n, n).

    `stamps_ns` has a stamp for each state, or one stamp for all states.
    """
    means, covariances = motion.published(means, covariances)
    stamps_ns = [stamps_ns] * len(means) if isinstance(stamps_ns, int) else stamps_ns
    return States(stamps_ns, wrapped_yaw(means), covariances)

"""The replaying EKF: rewind to a late measurement, and apply again what came after it."""

import bisect
import math
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import YAW, FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start, UpdateResult, UpdateStatus
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.ekf import OneCorrection, correct_one, predict_one
from fgtrack.models.motion import MotionModel

_Order = tuple[int, tuple[str, ...], tuple[float, ...]]


@dataclass(slots=True)
class _Stored:
    """A measurement with the state after it."""

    order: _Order
    """Place among all measurements: by stamp, and at one stamp by content, so that arrival does not matter."""
    measurement: Measurement | None
    """None of the oldest step, which is the prior."""
    mean: FloatArray
    covariance: FloatArray


class ReplayEkf:
    """An EKF that keeps the measurements of a window, and gives the answer of their time order whatever the order
    of arrival (rewind and replay, as in robot_localization; see docs/baseline.md).

    Parameters
    ----------
    motion
        Motion model; its process noise composes, so a late measurement may split a stretch of time.
    prior
        First state; nothing older than it can be fused.
    lag_s
        Length of the window behind the newest stamp or the clock.
    """

    exact = "any lag, any number"

    def __init__(self, motion: MotionModel, prior: Start, lag_s: float) -> None:
        self._motion = motion
        self._yawed = "yaw_rad" in motion.state_names
        self._lag_ns = nanoseconds(lag_s)
        mean, covariance = initial_state(motion, prior)
        self._steps = [_Stored((prior.stamp_ns, (), ()), None, mean, covariance)]
        self._start_ns = prior.stamp_ns
        self._newest_ns = prior.stamp_ns

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return self._start_ns, self._newest_ns

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        self._start_ns = max(self._start_ns, max(now_ns, self._newest_ns) - self._lag_ns)
        kept = bisect.bisect_right(self._steps, self._start_ns, key=_stamp) - 1
        del self._steps[: max(kept, 0)]

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: the filter's state, from the measurements up to that stamp."""
        before = max(bisect.bisect_right(self._steps, stamp_ns, key=_stamp) - 1, 0)
        mean, covariance = self._predicted(self._steps[before], stamp_ns)
        return TrackState(stamp_ns, mean, covariance)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        if measurement.stamp_ns < self._start_ns:
            return UpdateResult(UpdateStatus.TOO_OLD)
        measurement = measurement.seen_by(self._motion)
        order = (measurement.stamp_ns, measurement.model.components, tuple(measurement.z.tolist()))
        place = bisect.bisect_right(self._steps, order, lo=1, key=_order)
        try:
            step, correction = self._fused(self._steps[place - 1], order, measurement)
            steps = [step]
            for later in self._steps[place:]:
                if later.measurement is not None:
                    steps.append(self._fused(steps[-1], later.order, later.measurement)[0])
        except np.linalg.LinAlgError:
            return UpdateResult(UpdateStatus.FAILED)
        late = measurement.stamp_ns < self._newest_ns
        self._steps[place:] = steps
        self._newest_ns = max(self._newest_ns, measurement.stamp_ns)
        self.advance(self._newest_ns)
        status = UpdateStatus.OUT_OF_SEQUENCE if late else UpdateStatus.IN_SEQUENCE
        return UpdateResult(status, correction.innovation, correction.nis)

    def _fused(self, before: _Stored, order: _Order, measurement: Measurement) -> tuple[_Stored, OneCorrection]:
        """The step after `before` with `measurement`; `numpy.linalg.LinAlgError` where it is not finite."""
        mean, covariance = self._predicted(before, measurement.stamp_ns)
        corrected = correct_one(mean, covariance, measurement)
        mean, covariance = corrected.mean, corrected.covariance
        if not math.isfinite(mean.dot(mean) + np.vdot(covariance, covariance)):  # one number instead of a mask
            raise np.linalg.LinAlgError("posterior is not finite")
        if self._yawed:
            mean[YAW] = wrap_angle(mean[YAW])
        return _Stored(order, measurement, mean, covariance), corrected

    def _predicted(self, before: _Stored, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance at `stamp_ns`, from the step before it."""
        if stamp_ns == before.order[0]:
            return before.mean, before.covariance
        return predict_one(before.mean, before.covariance, self._motion, seconds(stamp_ns - before.order[0]))


def _order(step: _Stored) -> _Order:
    return step.order


def _stamp(step: _Stored) -> int:
    return step.order[0]

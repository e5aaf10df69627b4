"""The replaying EKF: rewind to a late measurement, and apply again what came after it."""

import bisect
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import BirthPrior, Measurement, UpdateResult, UpdateStatus
from fgtrack.estimation.birth import birth_state
from fgtrack.estimation.ekf import Correction, correct, predict
from fgtrack.estimation.propagation import wrapped_yaw
from fgtrack.models.motion import MotionModel

_Order = tuple[int, tuple[str, ...], tuple[float, ...]]


@dataclass(slots=True)
class _Step:
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

    def __init__(self, motion: MotionModel, prior: BirthPrior, lag_s: float) -> None:
        self._motion = motion
        self._lag_ns = nanoseconds(lag_s)
        mean, covariance = birth_state(motion, prior)
        self._steps = [_Step((prior.stamp_ns, (), ()), None, mean, covariance)]
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
        mean, covariance = self._predicted(bisect.bisect_right(self._steps, stamp_ns, key=_stamp) - 1, stamp_ns)
        return TrackState(stamp_ns, mean, covariance)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        if measurement.stamp_ns < self._start_ns:
            return UpdateResult(UpdateStatus.TOO_OLD)
        order = (measurement.stamp_ns, measurement.model.components, tuple(measurement.z.tolist()))
        place = bisect.bisect_right(self._steps, order, lo=1, key=lambda step: step.order)
        replayed = [measurement, *(step.measurement for step in self._steps[place:] if step.measurement is not None)]
        steps, first = self._applied(place - 1, order, replayed)
        if first is None:
            return UpdateResult(UpdateStatus.FAILED)
        late = measurement.stamp_ns < self._newest_ns
        self._steps[place:] = steps
        self._newest_ns = max(self._newest_ns, measurement.stamp_ns)
        self.advance(self._newest_ns)
        status = UpdateStatus.OUT_OF_SEQUENCE if late else UpdateStatus.IN_SEQUENCE
        return UpdateResult(status, first.innovation[0], float(first.nis[0]))

    def _applied(
        self, before: int, order: _Order, measurements: list[Measurement]
    ) -> tuple[list[_Step], Correction | None]:
        """Steps of `measurements` after the step `before`, and the first correction; None where one fails."""
        orders = [order, *(step.order for step in self._steps[before + 1 :])]
        stamp_ns, mean, covariance = (
            _stamp(self._steps[before]),
            self._steps[before].mean,
            self._steps[before].covariance,
        )
        steps: list[_Step] = []
        first: Correction | None = None
        for place, measurement in zip(orders, measurements, strict=True):
            if measurement.stamp_ns != stamp_ns:
                dt_s = seconds(measurement.stamp_ns - stamp_ns)
                mean, covariance = predict(mean, covariance, self._motion, dt_s)
                stamp_ns = measurement.stamp_ns
            try:
                corrected = correct(
                    mean[None],
                    covariance[None],
                    measurement.z[None],
                    measurement.R[None],
                    measurement.model,
                    measurement.pose,
                )
            except np.linalg.LinAlgError:
                return [], None
            if not np.isfinite(corrected.mean).all() or not np.isfinite(corrected.covariance).all():
                return [], None
            first = first or corrected
            mean = corrected.mean[0]
            if "yaw_rad" in self._motion.state_names:
                mean = wrapped_yaw(mean)
            covariance = corrected.covariance[0]
            steps.append(_Step(place, measurement, mean, covariance))
        return steps, first

    def _predicted(self, before: int, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        step = self._steps[max(before, 0)]
        dt_s = seconds(stamp_ns - _stamp(step))
        if not dt_s:
            return step.mean, step.covariance
        return predict(step.mean, step.covariance, self._motion, dt_s)


def _stamp(step: _Step) -> int:
    return step.order[0]

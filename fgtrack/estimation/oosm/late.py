"""EKFs that step through what arrives in sequence, and differ in what they do with a late measurement."""

from abc import ABC, abstractmethod

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import YAW, FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start, UpdateResult, UpdateStatus
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.ekf import OneCorrection
from fgtrack.estimation.oosm.crossing import Past, fuse_across
from fgtrack.estimation.oosm.history import History
from fgtrack.models.motion import MotionModel


class LateEkf(ABC):
    """An EKF for measurements in sequence; `_fuse_late` says what becomes of the others.

    Exact and approximate are meant for a linear model throughout the package; in a nonlinear one all is linearised at
    the stored means.

    Parameters
    ----------
    motion
        Motion model; its process noise composes, so a late measurement may split a stretch of time.
    prior
        First state; nothing older than it can be fused.
    lag_s
        Length of the window behind the newest stamp or the clock.
    """

    def __init__(self, motion: MotionModel, prior: Start, lag_s: float) -> None:
        self._motion = motion
        self._yawed = "yaw_rad" in motion.state_names
        self._lag_ns = nanoseconds(lag_s)
        self._history = History(motion, prior.stamp_ns, *initial_state(motion, prior))
        self._start_ns = prior.stamp_ns
        self._newest_ns = prior.stamp_ns

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return self._start_ns, self._newest_ns

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        self._start_ns = max(self._start_ns, now_ns - self._lag_ns)
        self._history.forget_before(self._start_ns)

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: predicted from the last stored step before that stamp."""
        step = self._history.steps[self._history.left(stamp_ns)]
        mean = step.mean
        if self._yawed:
            mean = mean.copy()
            mean[YAW] = wrap_angle(mean[YAW])
        return TrackState(stamp_ns, *self._history.moved(mean, step.covariance, step.stamp_ns, stamp_ns))

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        if measurement.stamp_ns < self._start_ns:
            return UpdateResult(UpdateStatus.TOO_OLD)
        measurement = measurement.seen_by(self._motion)
        late = measurement.stamp_ns < self._newest_ns
        try:
            result = self._fuse_late(measurement) if late else self._fuse_next(measurement)
        except np.linalg.LinAlgError:
            return UpdateResult(UpdateStatus.FAILED)
        if result is None:
            return UpdateResult(UpdateStatus.TOO_OLD)
        self._newest_ns = max(self._newest_ns, measurement.stamp_ns)
        self.advance(self._newest_ns)
        status = UpdateStatus.OUT_OF_SEQUENCE if late else UpdateStatus.IN_SEQUENCE
        return UpdateResult(status, result.innovation, result.nis)

    def _fuse_next(self, measurement: Measurement) -> OneCorrection:
        """The ordinary step from the present."""
        step, result = self._history.stepped(len(self._history.steps) - 1, measurement)
        self._history.append(step)
        return result

    @abstractmethod
    def _fuse_late(self, measurement: Measurement) -> OneCorrection | None:
        """Fuse a measurement that is older than the newest; None where the method ignores it.

        Raises `numpy.linalg.LinAlgError`, with all as it was, for one that cannot be fused.
        """


class CrossingEkf(LateEkf):
    """A `LateEkf` that corrects the present through its cross-covariance with the past (see `fuse_across`).

    The corrected present enters the history with an equivalent measurement there (see `History.absorb`), so a second
    late measurement finds the state that the first one made. What lies between the first one's stamp and the present
    keeps the state it had.
    """

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        now = self._history.newest
        past = self._past(measurement.stamp_ns)
        result = fuse_across(now.mean, now.covariance, past, measurement)
        np.linalg.cholesky(result.covariance)  # an approximate cross-covariance may take away more than there is
        self._history.absorb(result.mean, result.covariance)
        return result

    @abstractmethod
    def _past(self, stamp_ns: int) -> Past:
        """What is known of the state at `stamp_ns`, and its cross-covariance with the present."""

    def _predicted(self, stamp_ns: int) -> tuple[int, FloatArray, FloatArray, FloatArray]:
        """Place m of the last step before `stamp_ns`; x_{tau|m}, P_{tau|m} and F(m + 1, tau)."""
        place = self._history.left(stamp_ns)
        mean, covariance = self._history.predicted(place, stamp_ns)
        after = self._history.steps[place + 1]
        return place, mean, covariance, self._history.transition(mean, stamp_ns, after.stamp_ns)

"""EKFs that step through what arrives in sequence, and differ in what they do with a late measurement."""

from abc import abstractmethod

import numpy as np

from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import OneCorrection
from fgtrack.estimation.filters.propagation import track_state
from fgtrack.estimation.filters.windowed import WindowedFilter
from fgtrack.estimation.oosm.crossing import Past, fuse_across
from fgtrack.estimation.oosm.history import History
from fgtrack.models.motion import MotionModel


class LateEkf(WindowedFilter):
    """An EKF for measurements in sequence; `_fuse_late` says what becomes of the others.

    Exact and approximate are meant for a linear model throughout the package; in a nonlinear one all is linearised at
    the stored means.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    """

    def __init__(self, motion: MotionModel, prior: Start, lag_s: float) -> None:
        super().__init__(motion, prior, lag_s)
        self._history = History(motion, prior.stamp_ns, *initial_state(motion, prior))

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: predicted from the last stored step before that stamp."""
        step = self._history.steps[self._history.left(stamp_ns)]
        moved = self._history.moved(self._wrapped(step.mean), step.covariance, step.stamp_ns, stamp_ns)
        return track_state(self._motion, stamp_ns, *moved)

    def _forget_before(self, stamp_ns: int) -> None:
        self._history.forget_before(stamp_ns)

    def _fuse(self, measurement: Measurement) -> OneCorrection | None:
        late = measurement.stamp_ns < self._newest_ns
        return self._fuse_late(measurement) if late else self._fuse_next(measurement)

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

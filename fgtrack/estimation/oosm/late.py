"""EKFs that step through what arrives in sequence: ignore late measurements, take them as current, or rewind."""

from abc import abstractmethod
from dataclasses import replace

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import OneCorrection
from fgtrack.estimation.filters.propagation import track_state
from fgtrack.estimation.filters.windowed import WindowedFilter
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


class Drop(LateEkf):
    """Ignore a late measurement: it is `too_old`.

    The floor of every comparison ("neglect" in the Sensor Fusion and Tracking Toolbox of MathWorks).

    Exact for: nothing; but consistent, for what is left is in sequence.
    """

    def _fuse_late(self, measurement: Measurement) -> None:
        """Nothing."""


class AsCurrent(LateEkf):
    """Take a late measurement as if it had been made at the newest stamp fused.

    What a filter without stamps does (no source): x+ = x_k + K (z - h(x_k)). The object has moved on by speed times
    lag since, which the covariance leaves out.

    Exact for: nothing; overconfident.
    """

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        return self._fuse_next(replace(measurement, stamp_ns=self._newest_ns))


class RewindForget(LateEkf):
    """Update at the late stamp, and forget what was fused after it.

    Karle, Fent, Huch, Sauerbeck and Lienkamp, Multi-modal sensor fusion and object tracking for autonomous racing, IEEE
    Transactions on Intelligent Vehicles, 2023, section III-G: x_1 = f(x_{tau|tau}), P_1 = F P_{tau|tau} F' + Q from tau
    to now. Here at the stamp itself; `fgtrack.estimation.filters.backward_forward` has the paper's time grid.

    Exact for: nothing. For what it keeps it is the filter in order of stamps, so it stays consistent, but all
    measurements between the late stamp and the present are lost.
    """

    def _fuse_next(self, measurement: Measurement) -> OneCorrection:
        place = self._history.left(measurement.stamp_ns)
        step, result = self._history.stepped(place, measurement)
        self._history.forget_after(place)
        self._history.append(step)
        return result

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        return self._fuse_next(measurement)

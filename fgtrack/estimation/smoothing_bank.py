"""A bank of smoothers, and what they smooth."""

from collections.abc import Callable, Sequence

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import SmoothedReport, TrackState
from fgtrack.estimation.base import Smoother, Start
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.estimation.propagation import wrapped_yaw
from fgtrack.models.motion import MotionModel


class SmoothingBank(ObjectBank):
    """One `Smoother` per object.

    Parameters
    ----------
    motion, start, lag_s
        See `ObjectBank`.
    lagged_s
        Lags of the lagged output.
    """

    def __init__(
        self,
        motion: MotionModel,
        start: Callable[[Start], Smoother],
        lag_s: float,
        lagged_s: Sequence[float],
    ) -> None:
        super().__init__(motion, start, lag_s)
        self._smoothers: dict[int, Smoother] = {}
        self._start_smoother = start
        self._lagged_s = tuple(lagged_s)
        self._ended: list[SmoothedReport] = []

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        smoother = self._start_smoother(prior)
        self._smoothers[track_id] = self._estimators[track_id] = smoother

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`; what was still inside the window becomes final."""
        self._ended += self._reports(track_id, self._smoothers.pop(track_id).take_rest())
        super().remove(track_id)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        reports, self._ended = self._ended, []
        for track_id, smoother in self._smoothers.items():
            reports += self._reports(track_id, smoother.take_final())
        for lag_s in self._lagged_s:
            stamp_ns = self.present_ns - nanoseconds(lag_s)
            for track_id, smoother in self._smoothers.items():
                if smoother.window_ns[0] <= stamp_ns:
                    reports += self._reports(track_id, [smoother.state_at(stamp_ns)], lag_s)
        return reports

    def _reports(self, track_id: int, states: list[TrackState], lag_s: float | None = None) -> list[SmoothedReport]:
        if not states:
            return []
        means, covariances = self._motion.kinematic(
            np.array([state.mean for state in states]), np.array([state.covariance for state in states])
        )
        return [
            SmoothedReport(track_id, TrackState(state.stamp_ns, mean, covariance), lag_s)
            for state, mean, covariance in zip(states, wrapped_yaw(means), covariances, strict=True)
        ]

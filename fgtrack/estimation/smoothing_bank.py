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
        self._ended += self._reports([(track_id, state) for state in self._smoothers.pop(track_id).take_rest()])
        super().remove(track_id)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        reports, self._ended = self._ended, []
        final = [(track_id, state) for track_id, one in self._smoothers.items() for state in one.take_final()]
        reports += self._reports(final)
        for lag_s in self._lagged_s:
            stamp_ns = self.present_ns - nanoseconds(lag_s)
            known = [each for each in self._smoothers.items() if each[1].window_ns[0] <= stamp_ns]
            reports += self._reports([(track_id, one.state_at(stamp_ns)) for track_id, one in known], lag_s)
        return reports

    def _reports(self, states: Sequence[tuple[int, TrackState]], lag_s: float | None = None) -> list[SmoothedReport]:
        """Reports of states in the motion model's own form, each with its track."""
        if not states:
            return []
        means, covariances = self._motion.kinematic(
            np.array([state.mean for _, state in states]), np.array([state.covariance for _, state in states])
        )
        return [
            SmoothedReport(track_id, TrackState(state.stamp_ns, mean, covariance), lag_s)
            for (track_id, state), mean, covariance in zip(states, wrapped_yaw(means), covariances, strict=True)
        ]

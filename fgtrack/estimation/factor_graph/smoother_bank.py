"""The smoothers of all objects."""

from collections.abc import Callable

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray, SmoothedReport, TrackState
from fgtrack.estimation.base import Start, StatesAt
from fgtrack.estimation.factor_graph.backends.base import Backend
from fgtrack.estimation.factor_graph.backends.incremental import IncrementalBackend
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother
from fgtrack.estimation.initiation import DEFAULT
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.estimation.propagation import wrapped_yaw
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.models.motion import MotionModel


class SmootherBank(ObjectBank):
    """One `FixedLagSmoother` per object, and what they smooth.

    Parameters
    ----------
    motion
        The motion model of all smoothers.
    settings, make_backend, initiation
        See `FixedLagSmoother`.
    """

    def __init__(
        self,
        motion: MotionModel,
        settings: SmootherSettings,
        make_backend: Callable[[FloatArray], Backend] = IncrementalBackend,
        initiation: str = DEFAULT,
    ) -> None:
        def start(prior: Start) -> FixedLagSmoother:
            return FixedLagSmoother(motion, prior, settings, make_backend, initiation)

        super().__init__(motion, start, settings.lag_s + (settings.ring_s if settings.late == "fuse" else 0.0))
        self._smoothers: dict[int, FixedLagSmoother] = {}
        self._start_smoother = start
        self._settings = settings
        self._ended: list[SmoothedReport] = []

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`; where late measurements are an error, they must come as far as here."""
        return 0 if self._settings.late == "raise" else super().window_start_ns

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`. Raises `DataError` for a stamp before the window where the policy is `raise`."""
        if self._settings.late == "raise" and stamp_ns < super().window_start_ns:
            raise DataError(
                f"detections at {stamp_ns} ns are {seconds(self.present_ns - stamp_ns):g} s late, older than the "
                "window: lengthen smoother.lag_s, or set smoother.late to fuse or drop"
            )
        return super().states_at(stamp_ns)

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
        for lag_s in self._settings.lagged_s:
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

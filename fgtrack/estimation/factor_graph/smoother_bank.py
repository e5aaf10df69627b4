"""The smoothers of all objects."""

from collections.abc import Callable

from fgtrack.core.errors import DataError
from fgtrack.core.time import seconds
from fgtrack.estimation.base import Start, StatesAt
from fgtrack.estimation.factor_graph.backends.base import Backend
from fgtrack.estimation.factor_graph.backends.incremental import IncrementalBackend
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother
from fgtrack.estimation.initiation import DEFAULT
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.estimation.smoothing_bank import SmoothingBank
from fgtrack.models.motion import MotionModel


class SmootherBank(SmoothingBank):
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
        make_backend: Callable[[], Backend] = IncrementalBackend,
        initiation: str = DEFAULT,
    ) -> None:
        def one(prior: Start) -> FixedLagSmoother:
            return FixedLagSmoother(motion, prior, settings, make_backend, initiation)

        lag_s = settings.lag_s + (settings.ring_s if settings.late == "fuse" else 0.0)
        super().__init__(motion, one, lag_s, settings.lagged_s)
        self._settings = settings

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

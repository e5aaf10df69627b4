"""The smoothers of all objects."""

from collections.abc import Callable, Sequence

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Start, StatesAt, UpdateResult
from fgtrack.estimation.factor_graph import together
from fgtrack.estimation.factor_graph.backends.base import Backend
from fgtrack.estimation.factor_graph.backends.incremental import IncrementalBackend
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother
from fgtrack.estimation.failures import Failures
from fgtrack.estimation.initiation import DEFAULT
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.estimation.smoothing_bank import SmoothingBank
from fgtrack.models.motion import MotionModel


class SmootherBank(SmoothingBank[FixedLagSmoother]):
    """One `FixedLagSmoother` per object, and what they smooth.

    Parameters
    ----------
    motion
        The motion model of all smoothers.
    settings, make_backend, initiation, failures
        See `FixedLagSmoother`.
    """

    def __init__(
        self,
        motion: MotionModel,
        settings: SmootherSettings,
        make_backend: Callable[[], Backend] = IncrementalBackend,
        initiation: str = DEFAULT,
        failures: Failures | None = None,
    ) -> None:
        def one(prior: Start) -> FixedLagSmoother:
            return FixedLagSmoother(motion, prior, settings, make_backend, initiation, failures)

        super().__init__(motion, one, settings.lag_s + settings.behind_s, settings.lagged_s)
        self._settings = settings

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`; where late measurements are an error, they must come as far as here."""
        return 0 if self._settings.late == "raise" else super().window_start_ns

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`. Raises `DataError` for a stamp before the window where the policy is `raise`."""
        self._settings.refuse_older(stamp_ns, super().window_start_ns)
        self._look_up(stamp_ns)
        return super().states_at(stamp_ns)

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        if len(track_ids) > 1:
            return together.update([self._estimators[track_id] for track_id in track_ids], measurements)
        return super().update(stamp_ns, track_ids, measurements)

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`."""
        self._look_up(self.present_ns)
        return super().present()

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        for lag_s in self._settings.lagged_s:
            self._look_up(self.present_ns - nanoseconds(lag_s))
        return super().smoothed()

    def _look_up(self, stamp_ns: int) -> None:
        """Find the states at `stamp_ns` of all objects that are known there, at once."""
        known = [one for one in self._estimators.values() if one.window_ns[0] <= stamp_ns]
        if len(known) > 1:
            together.look_up(known, [stamp_ns] * len(known))

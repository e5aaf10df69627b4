"""A bank of smoothers, and what they smooth."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import SmoothedReport
from fgtrack.estimation.base import Smoother, Start
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.estimation.present import final_reports, smoothed_reports
from fgtrack.models.motion import MotionModel

_S = TypeVar("_S", bound=Smoother)


class SmoothingBank(ObjectBank[_S]):
    """One `Smoother` per object.

    Parameters
    ----------
    motion, start, lag_s
        See `ObjectBank`.
    lagged_s
        Lags of the lagged output.
    """

    def __init__(
        self, motion: MotionModel, start: Callable[[Start], _S], lag_s: float, lagged_s: Sequence[float]
    ) -> None:
        super().__init__(motion, start, lag_s)
        self._lagged_s = tuple(lagged_s)
        self._ended: list[SmoothedReport] = []

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`; what was still inside the window becomes final."""
        try:
            rest = self._ask(lambda _, one: one.take_rest(), [track_id])[track_id]
            self._ended += final_reports(self._motion, [(track_id, state) for state in rest])
        finally:
            super().remove(track_id)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        final = self._ask(lambda _, one: one.take_final())
        reports, self._ended = self._ended, []
        reports += final_reports(
            self._motion, [(track_id, state) for track_id, states in final.items() for state in states]
        )
        for lag_s in self._lagged_s:
            stamp_ns = self.present_ns - nanoseconds(lag_s)
            known = super().states_at(stamp_ns)
            stamps_ns = [stamp_ns] * len(known.track_ids)
            reports += smoothed_reports(self._motion, known.track_ids, stamps_ns, known.means, known.covariances, lag_s)
        return reports

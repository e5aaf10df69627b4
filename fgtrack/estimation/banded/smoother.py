"""The smoother of one object, by name."""

from typing import Any

from fgtrack.core.types import TrackState
from fgtrack.estimation.banded.bank import BandedBank
from fgtrack.estimation.base import Measurement, Start, UpdateResult
from fgtrack.estimation.initiation import DEFAULT
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.models.motion import MotionModel


class BandedSmoother:
    """Fixed-lag smoother, solved in covariance form by compiled code, all objects of a tracker together."""

    exact = "any lag, any number"
    nonlinear = "at convergence"
    smooths = True
    initiates = True

    # Any: an option may be any value that `SmootherSettings` takes.
    def __init__(
        self, motion: MotionModel, start: Start, lag_s: float, initiation: str = DEFAULT, **options: Any
    ) -> None:
        settings = SmootherSettings.of_options(lag_s, options)
        self._bank = BandedBank(motion, settings, initiation)
        self._bank.birth(0, start)

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return self._bank.window_ns(0)

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`; the nodes that leave are marginalised at the next update."""
        self._bank.advance(now_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        return self._bank.update(measurement.stamp_ns, [0], [measurement])[0]

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: smoothed in the past, interpolated under the motion model, predicted ahead."""
        return self._bank.state_at(0, stamp_ns)

    def take_final(self) -> list[TrackState]:
        """Smoothed states of the nodes that have left the window since the last call, in order."""
        return self._bank.take_final(0)

    def take_rest(self) -> list[TrackState]:
        """Like `take_final`, and of the nodes that are still inside: for when the track ends."""
        return self._bank.take_rest(0)

    def converge(self, max_iterations: int = 50) -> None:
        """Relinearise until nothing moves; for comparisons."""
        self._bank.converge(0, max_iterations)

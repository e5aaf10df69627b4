"""Methods that hold measurements back until the late measurements have come, as in industry."""

from typing import ClassVar

from fgtrack.core.checks import as_stamp
from fgtrack.core.errors import CallError
from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import (
    Measurement,
    Start,
    UpdateResult,
    UpdateStatus,
    described,
)
from fgtrack.estimation.filters.ekf import predict
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.filters.propagation import track_state
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.models.motion import MotionModel


class DelayedHorizon(Stateful):
    """Filter at the front, now - D, with a prediction from the front to now.

    Now is the clock, or the newest stamp if that is later. So D = `horizon_s` has to cover the longest delay. Flight
    controllers work like this (the delayed fusion horizon of the PX4 EKF). Measurements after the front are held in
    order of their stamps. Measurements before the front are too old. Innovation and NIS are predicted from all
    measurements that have arrived, held measurements included.

    Exact for: the state at now - D, linear model, any number of measurements with delays up to D.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_now_ns",
        "_ordered",
    )

    exact = "up to now - D: any lag, any number"
    held_s = 0.2
    initiates = True

    def __init__(
        self,
        motion: MotionModel,
        prior: Start,
        lag_s: float,
        horizon_s: float = 0.2,
        initiation: str = DEFAULT,
    ) -> None:
        if not 0.0 <= horizon_s <= lag_s:
            raise CallError(
                f"measurements held for {horizon_s} s: give a time from 0 to the window's {lag_s} s"
            )
        self._motion = motion
        self._hold_ns = nanoseconds(horizon_s)
        self._now_ns = prior.stamp_ns
        self._ordered = ReplayEkf(motion, prior, lag_s, initiation)

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`. States before the front are available, but no measurement before it is fused."""
        return self._ordered.window_ns

    @property
    def _front_ns(self) -> int:
        """Stamp up to which measurements are filtered."""
        return self._now_ns - self._hold_ns

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        now_ns = as_stamp("now_ns", now_ns)
        self._now_ns = max(self._now_ns, now_ns)
        self._ordered.advance(now_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        if measurement.stamp_ns < self._front_ns:
            return UpdateResult(UpdateStatus.TOO_OLD)
        result = self._ordered.update(measurement)
        if result.status is not UpdateStatus.FAILED:
            self._now_ns = max(self._now_ns, measurement.stamp_ns)
        return result

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`; a state after the front is a prediction."""
        stamp_ns = as_stamp("stamp_ns", stamp_ns)
        front_ns = max(self._front_ns, self.window_ns[0])
        if stamp_ns <= front_ns:
            return self._ordered.state_at(stamp_ns)
        front = self._ordered.state_at(front_ns)
        dt_s = seconds(stamp_ns - front_ns)
        return track_state(
            self._motion,
            stamp_ns,
            *predict(front.mean, front.covariance, self._motion, dt_s),
        )

    def __repr__(self) -> str:
        return described(type(self).__name__, self._motion, self.window_ns)


class ReorderBuffer(DelayedHorizon):
    """Filter that holds every measurement until a stamp D later has arrived, and fuses in order of stamps.

    The newest stamp moves the front; the clock does not. So D = `hold_s` has to cover only the disorder: the time by
    which a measurement arrives after measurements with later stamps. Stream processing has the same watermark (Akidau
    et al., The dataflow model, Proceedings of the VLDB Endowment, 2015).

    Exact for: the state D before the newest stamp, linear model, any number of measurements at most D behind it.
    """

    exact = "up to D before the newest stamp: any lag, any number"
    held_s = 0.1

    def __init__(
        self,
        motion: MotionModel,
        prior: Start,
        lag_s: float,
        hold_s: float = 0.1,
        initiation: str = DEFAULT,
    ) -> None:
        super().__init__(motion, prior, lag_s, hold_s, initiation)

    @property
    def _front_ns(self) -> int:
        return self._ordered.window_ns[1] - self._hold_ns

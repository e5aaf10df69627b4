"""Base of the filters of one object: a window behind the newest stamp, and the outcome of a measurement."""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from fgtrack.core.checks import as_stamp
from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds
from fgtrack.estimation.base import (
    Measurement,
    Start,
    UpdateResult,
    UpdateStatus,
    described,
)
from fgtrack.estimation.filters.ekf import OneCorrection
from fgtrack.models.motion import MotionModel


class WindowedFilter(Stateful, ABC):
    """Base of an `Estimator` that refuses measurements older than its window and fuses all others by `_fuse`.

    The window reaches `lag_s` behind the newest stamp or the clock, but not behind the stamp of the `prior`. The
    process noise of a motion model composes, so a late measurement may split an interval.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_start_ns",
        "_newest_ns",
    )

    def __init__(self, motion: MotionModel, prior: Start, lag_s: float) -> None:
        self._motion = motion
        self._lag_ns = nanoseconds(lag_s)
        self._start_ns = self._newest_ns = prior.stamp_ns

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return self._start_ns, self._newest_ns

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        self._start_ns = max(self._start_ns, as_stamp("now_ns", now_ns) - self._lag_ns)
        self._forget_before(self._start_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        if measurement.stamp_ns < self._start_ns:
            return UpdateResult(UpdateStatus.TOO_OLD)
        try:
            result = self._fuse(measurement.seen_by(self._motion))
        except np.linalg.LinAlgError:
            return UpdateResult(UpdateStatus.FAILED)
        if result is None:
            return UpdateResult(UpdateStatus.TOO_OLD)
        return UpdateResult(
            self.moved_on(measurement.stamp_ns), result.innovation, result.nis, result.S
        )

    def moved_on(self, stamp_ns: int) -> UpdateStatus:
        """Return the status of a measurement that was fused at `stamp_ns`. A newest stamp also moves the window."""
        if stamp_ns < self._newest_ns:
            return UpdateStatus.OUT_OF_SEQUENCE
        self._newest_ns = stamp_ns
        self.advance(stamp_ns)
        return UpdateStatus.IN_SEQUENCE

    def __repr__(self) -> str:
        return described(type(self).__name__, self._motion, self.window_ns)

    @abstractmethod
    def _fuse(self, measurement: Measurement) -> OneCorrection | None:
        """Fuse a measurement inside the window. Return None if the method ignores the measurement.

        Raises `numpy.linalg.LinAlgError` if the measurement cannot be fused; the state is then unchanged.
        """

    @abstractmethod
    def _forget_before(self, stamp_ns: int) -> None:
        """Drop the states that are not needed for stamps from `stamp_ns` on."""

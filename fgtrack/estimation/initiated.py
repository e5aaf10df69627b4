"""Initiation for estimators that know nothing of it."""

import bisect
from collections.abc import Callable

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateResult
from fgtrack.estimation.initiation import checked_initiation
from fgtrack.estimation.opening import Opening
from fgtrack.models.motion import MotionModel


def initiated(motion: MotionModel, start: Start, method: str, make: Callable[[Start], Estimator]) -> Estimator:
    """What `make` gives for `start`, by itself or as `Initiated`. Raises `CallError` for an unknown `method`."""
    opening = Opening.of(motion, start, checked_initiation(method))
    return make(start) if opening is None else Initiated(opening, make)


class Initiated:
    """An `Estimator` that begins again, in the direction of the first positions, until that is certain.

    What it has fused so far is given in order of the stamps to a new one, which starts along the line (see
    `Opening.turned`). From then on it is the last of these.

    Parameters
    ----------
    opening
        Before the first measurement.
    make
        Makes the estimator of an object.
    """

    def __init__(self, opening: Opening, make: Callable[[Start], Estimator]) -> None:
        self._make = make
        self._nothing: Opening | None = opening
        self._fused: list[Measurement] = []
        self._clock_ns = opening.start.stamp_ns
        self._inner = make(opening.start)

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return self._inner.window_ns

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`; the innovation is that before it begins again."""
        result = self._inner.update(measurement)
        if self._nothing is not None and result.innovation is not None:
            place = bisect.bisect_right(self._fused, _order(measurement), key=_order)
            self._fused.insert(place, measurement.seen_by(self._nothing.motion))
            self._begin_again(self._nothing)
        return result

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`."""
        return self._inner.state_at(stamp_ns)

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        self._clock_ns = max(self._clock_ns, now_ns)
        self._inner.advance(now_ns)

    def _begin_again(self, opening: Opening) -> None:
        """Let a new estimator that starts along the first positions take the place of the present one, if it can."""
        count = 0
        for measurement in self._fused:
            longer = opening.with_measurement(measurement)
            if longer is None:
                break
            opening, count = longer, count + 1
        ended = opening.over or count < len(self._fused)
        if opening.line is not None:
            inner = self._make(opening.turned())
            fused = all(inner.update(measurement).innovation is not None for measurement in self._fused)
            if fused:
                inner.advance(self._clock_ns)
                self._inner = inner
            ended |= not fused  # the window has moved on
        if ended:
            self._nothing = None
            self._fused.clear()


def _order(measurement: Measurement) -> tuple[int, tuple[str, ...], tuple[float, ...]]:
    return measurement.stamp_ns, measurement.model.components, tuple(measurement.z.tolist())

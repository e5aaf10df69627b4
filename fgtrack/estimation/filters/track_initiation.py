"""The first measurements of an object with an unknown direction of travel, in filters."""

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import ClassVar

import numpy as np

from fgtrack.core.checks import as_stamp
from fgtrack.core.errors import CallError
from fgtrack.core.geometry import cartesian, polar
from fgtrack.core.state import Snapshot, Stateful, stateful
from fgtrack.core.time import seconds
from fgtrack.core.types import YAW, FloatArray, TrackState
from fgtrack.estimation.base import (
    KNOWN_YAW_STD_RAD,
    UNKNOWN_YAW_STD_RAD,
    Estimator,
    Measurement,
    Start,
    UpdateResult,
)
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import Prediction, correct_one, propagated
from fgtrack.estimation.filters.initiation import (
    Fix,
    Initiation,
    Line,
    checked_initiation,
    fix_of,
    over,
    sought,
    straight_lines,
)
from fgtrack.estimation.rts import Link, smoothed_back
from fgtrack.models.motion import MotionModel

#: A direction is certain at this number of standard deviations: a filter may linearise in this direction.
CERTAIN = 1.0 / KNOWN_YAW_STD_RAD
#: After this time, or this number of measurements, a filter no longer seeks the direction. The object may be at rest,
#: and each further measurement costs as much as all measurements before it.
LONGEST_S, MOST_MEASUREMENTS = 2.0, 25


@dataclass(frozen=True)
class TrackInitiation:
    """Measurements of a new object, ordered by stamp, while its direction of travel is sought. Immutable."""

    motion: MotionModel
    start: Start
    method: Initiation
    measurements: tuple[Measurement, ...] = ()
    fixes: tuple[Fix, ...] = ()
    """Measured positions; the first one is the position of the start."""
    line: Line | None = None
    """Line through the fixes; None if all fixes have the same time, or if a fix has no error."""

    @classmethod
    def of(
        cls, motion: MotionModel, start: Start, method: str
    ) -> "TrackInitiation | None":
        """Return the initiation before the first measurement; None if no direction is sought.

        Raises `CallError` for an unknown `method`.
        """
        checked = checked_initiation(method)
        if not sought(motion, start, checked):
            return None
        x, P = initial_state(motion, start)
        return cls(motion, start, checked, fixes=(Fix(0.0, x[:2], P[:2, :2]),))

    def with_measurement(self, measurement: Measurement) -> "TrackInitiation | None":
        """Return the initiation with one more measurement, the newest; None if the direction is no longer sought."""
        time_s = seconds(measurement.stamp_ns - self.start.stamp_ns)
        if (
            self.over
            or time_s > LONGEST_S
            or len(self.measurements) == MOST_MEASUREMENTS
        ):
            return None
        fix = fix_of(measurement, time_s)
        fixes = self.fixes if fix is None else (*self.fixes, fix)
        line = self.line
        if fix is not None and time_s > 0.0:
            try:
                [line] = straight_lines(fixes, len(fixes))
            except np.linalg.LinAlgError:  # a position without error has no weight
                line = None
        return replace(
            self, measurements=(*self.measurements, measurement), fixes=fixes, line=line
        )

    @property
    def over(self) -> bool:
        """True if the direction is known. The filter itself then fuses all further measurements."""
        return self.line is not None and over(self.line, self.method, CERTAIN)

    def state(self) -> tuple[FloatArray, FloatArray]:
        """Return mean (n,) and covariance (n, n) after the newest measurement, filtered along the line.

        A Kalman filter is linearised at a nominal trajectory that starts on the line, instead of at its own
        estimates (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation,
        2001, section 10.3):

            x' = f(x_n) + F (x - x_n),   P' = F P F' + Q,   F = df/dx at x_n

        Each measurement counts once: the line gives only the trajectory and the direction, with the wide
        standard deviation of `start`. Raises `numpy.linalg.LinAlgError` if the state is not finite, and if
        there is no line.
        """
        _, mean, covariance, _ = self._filtered()[-1]
        if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
            raise np.linalg.LinAlgError("the state of a new object is not finite")
        return mean, covariance

    def turned(self) -> Start:
        """Return the start with the direction and the speed of the line, and with the standard deviations of the start.

        The estimator fuses the measurements again from the returned start. The speed of the line comes from these
        measurements, too: if the start was about as certain of the speed as the line, this
        speed counts a little more than once. Raises the exceptions of `state`.
        """
        yaw_rad, speed_mps = self._course()
        std_rad = (
            UNKNOWN_YAW_STD_RAD
            if self.start.yaw_std_rad is None
            else self.start.yaw_std_rad
        )
        return replace(
            self.start, yaw_rad=yaw_rad, yaw_std_rad=std_rad, speed_mps=speed_mps
        )

    def retrodicted(
        self, stamp_ns: int, mean: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the state at `stamp_ns` given all measurements.

        `mean` (n,) and `covariance` (n, n) are the smoothed state at the newest measurement.
        """
        links = [
            link for link in self._filtered((stamp_ns, None)) if link[0] >= stamp_ns
        ]
        return smoothed_back(self.motion, links, mean, covariance)

    def _filtered(self, *others: tuple[int, None]) -> list[Link]:
        """Return the states at the start, after each measurement, and at the stamps of `others`, in order of
        the stamps.
        """
        x, P = initial_state(self.motion, self.start)
        nominal = self.nominal(x)
        if not self.motion.cartesian:
            x = x.copy()
            x[YAW] = nominal[YAW]
        at_ns = self.start.stamp_ns
        links: list[Link] = [(at_ns, x, P, Prediction(x, P, P))]
        stamped = [*((each.stamp_ns, each) for each in self.measurements), *others]
        for stamp_ns, measurement in sorted(stamped, key=itemgetter(0)):
            predicted = Prediction(x, P, P)
            if stamp_ns > at_ns:
                moved, F, Q = self.motion.transition(nominal, seconds(stamp_ns - at_ns))
                predicted = Prediction(
                    moved + F @ (x - nominal), propagated(F, P, Q), F @ P
                )
                nominal, at_ns = moved, stamp_ns
            x, P = predicted.mean, predicted.covariance
            if measurement is not None:
                x, P = correct_one(x, P, measurement)[:2]
            links.append((stamp_ns, x, P, predicted))
        return links

    def nominal(self, x: FloatArray) -> FloatArray:
        """Return the state (n,) on the line at the start. Entries that the line does not determine are taken
        from x (n,).

        Raises `numpy.linalg.LinAlgError` if there is no line.
        """
        yaw_rad, speed_mps = self._course()
        motion = (
            cartesian(np.array([yaw_rad, speed_mps]))
            if self.motion.cartesian
            else (yaw_rad, speed_mps)
        )
        nominal = x.copy()
        if self.line is not None:
            nominal[:2] = self.line.position_m
        nominal[2:4] = motion
        return nominal

    def _course(self) -> tuple[float, float]:
        """Return the direction of the line, and the speed: a weighted mean of the speeds of the line and the start.

        A short line may have a wrong speed.

        Raises `numpy.linalg.LinAlgError` without a line.
        """
        if self.line is None:
            raise np.linalg.LinAlgError(
                "the first positions determine no line: they have the same time, or one has no error"
            )
        yaw_rad, speed_mps = polar(self.line.velocity_mps).tolist()
        along = np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
        P, R = self.start.speed_std_mps**2, float(along @ self.line.covariance @ along)
        return yaw_rad, self.start.speed_mps + P / (P + R) * (
            speed_mps - self.start.speed_mps
        )


def initiated(
    motion: MotionModel, start: Start, method: str, make: Callable[[Start], Estimator]
) -> Estimator:
    """Return the estimator that `make` gives for `start`, wrapped in `Initiated` if its direction of travel is
    sought.

    Raises `CallError` for an unknown `method`.
    """
    search = TrackInitiation.of(motion, start, method)
    return make(start) if search is None else Initiated(search, make)


class Initiated(Stateful):
    """Wrapper that restarts an `Estimator` along its first positions until the direction of travel is certain.

    The new estimator starts along the line, see `TrackInitiation.turned`. It fuses all measurements so far in the
    order of their stamps.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_search",
        "_fused",
        "_clock_ns",
        "_inner",
    )

    def __init__(
        self, search: TrackInitiation, make: Callable[[Start], Estimator]
    ) -> None:
        self._make = make
        self._search: TrackInitiation | None = search
        self._fused: list[Measurement] = []
        self._clock_ns = search.start.stamp_ns
        self._inner = make(search.start)

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Raises `CallError` for an estimator that has no checkpoint."""
        stateful(self._inner)
        return super().checkpoint()

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return self._inner.window_ns

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`. The innovation is that of the estimator before the restart."""
        result = self._inner.update(measurement)
        if self._search is not None and result.innovation is not None:
            bisect.insort(
                self._fused,
                measurement.seen_by(self._search.motion),
                key=lambda each: each.order,
            )
            self._begin_again(self._search)
        return result

    def withdraw(self, measurement: Measurement) -> None:
        """Undo the fusion of a measurement.

        Raises `CallError` while the direction of travel is sought, and for an estimator that cannot do it.
        """
        withdraw = getattr(self._inner, "withdraw", None)
        if self._search is not None or withdraw is None:
            raise CallError("withdraw: this estimator cannot withdraw the measurement")
        withdraw(measurement)

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`."""
        return self._inner.state_at(stamp_ns)

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        self._clock_ns = max(self._clock_ns, as_stamp("now_ns", now_ns))
        self._inner.advance(now_ns)

    def __repr__(self) -> str:
        return repr(self._inner)

    def _begin_again(self, search: TrackInitiation) -> None:
        """Replace the estimator by a new one that starts along the first positions, if that is possible."""
        count = 0
        for measurement in self._fused:
            longer = search.with_measurement(measurement)
            if longer is None:
                break
            search, count = longer, count + 1
        ended = search.over or count < len(self._fused)
        if search.line is not None:
            inner = self._make(search.turned())
            fused = all(
                inner.update(measurement).innovation is not None
                for measurement in self._fused
            )
            if fused:
                inner.advance(self._clock_ns)
                self._inner = inner
            ended |= not fused  # the window has moved on
        if ended:
            self._search = None
            self._fused.clear()

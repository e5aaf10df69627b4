"""Direction and speed of a new object from its first positions, for smoothers and filters."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, cast, get_args

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import polar
from fgtrack.core.linalg import psd_solve
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.models.measurement import measured_position
from fgtrack.models.motion import MotionModel

Initiation = Literal["one-point", "two-point", "regression"]
"""Methods that estimate the direction of travel of a new object if neither the map nor the sensor gives a direction.

- `one-point`: no estimate; the state starts at yaw 0 with a wide standard deviation.
- `two-point`: from the first two positions (Bar-Shalom, Li and Kirubarajan 2001, section 5.5.3).
- `regression`: from a weighted least-squares line through the first positions (the same, section 3.5). The line is
  repeated until its velocity is significantly different from zero: by three standard deviations for a smoother, which
  relinearises, and by ten (0.1 rad) for a filter.
"""
DEFAULT: Initiation = "regression"
#: For a smoother, a line is the last one if its velocity is this number of standard deviations from zero. The solver
#: then converges in at most this number of Gauss-Newton steps.
CERTAIN_TO_SMOOTHER, SMOOTHER_ITERATIONS = 3.0, 10


def checked_initiation(method: str) -> Initiation:
    """Return `method`. Raises `CallError` for an unknown method."""
    if method not in get_args(Initiation):
        raise CallError(
            f"initiation: must be {', '.join(get_args(Initiation))}, is {method!r}"
        )
    return cast(Initiation, method)


class Fix(NamedTuple):
    """A measured position in the map."""

    time_s: float
    position_m: FloatArray
    """Shape (2,)."""
    covariance: FloatArray
    """Shape (2, 2)."""


class Line(NamedTuple):
    """A straight line: position and velocity at time 0, with the covariance of the velocity."""

    position_m: FloatArray
    velocity_mps: FloatArray
    covariance: FloatArray
    """Covariance of the velocity, shape (2, 2)."""


def fix_of(measurement: Measurement, time_s: float) -> Fix | None:
    """Return the position in `measurement`; None if it has no position, for example a bearing or a range alone."""
    position = measured_position(
        measurement.model.components, measurement.z, measurement.R, measurement.pose
    )
    return None if position is None else Fix(time_s, *position)


def fixes_of(
    mean: FloatArray, covariance: FloatArray, later: Iterable[tuple[float, Measurement]]
) -> list[Fix]:
    """Return the position of a first state, (n,) and (n, n), at time 0, and the positions of the `later`
    measurements.
    """
    fixes = [fix_of(measurement, time_s) for time_s, measurement in later]
    return [
        Fix(0.0, mean[:2], covariance[:2, :2]),
        *(fix for fix in fixes if fix is not None),
    ]


def straight_lines(fixes: Sequence[Fix], least: int) -> Iterator[Line]:
    """Return least-squares lines at constant velocity: through the first `least` fixes, and through each further
    fix.

    Raises `numpy.linalg.LinAlgError` if all fixes have the same time, or if a fix has no uncertainty.
    """
    information, vector = (
        np.zeros((4, 4)),
        np.zeros(4),
    )  # of the position at time 0 and the velocity
    for count, fix in enumerate(fixes, start=1):
        H = np.hstack([np.eye(2), fix.time_s * np.eye(2)])
        weighted = psd_solve(fix.covariance, H).T
        information += weighted @ H
        vector += weighted @ fix.position_m
        if count >= least:
            spread = psd_solve(information, np.eye(4))
            solution = spread @ vector
            yield Line(solution[:2], solution[2:], spread[2:, 2:])


@dataclass(frozen=True)
class Search:
    """Initiation of a track of a smoother, which restarts along a straight line through the first positions.

    A state with an unknown heading was linearised at a wrong heading, from which the solver may not converge.
    """

    first_ns: int
    """Stamp of the start, at which the time of a fix is 0."""
    method: Initiation
    until_ns: int | None = None
    """Stamp of the last fix of a line that is certain; newer fixes do not change the line. None if no line is
    certain.
    """

    @classmethod
    def of(cls, motion: MotionModel, start: Start, method: str) -> "Search | None":
        """Return the search before the first measurement; None if no direction is sought.

        Raises `CallError` for an unknown `method`.
        """
        checked = checked_initiation(method)
        return cls(start.stamp_ns, checked) if sought(motion, start, checked) else None

    def next_line(
        self, fixes: Callable[[], Iterable[Fix]], oldest_ns: int
    ) -> "tuple[Line, Search] | None":
        """Return the line to restart along and the following search, after new measurements from the stamp
        `oldest_ns` on.

        The line leads through the first `fixes`, as many as the method needs. It does not depend on the order
        of arrival. None if the last line is still valid, if all fixes have the same time, or if a fix has no
        uncertainty.
        """
        if self.until_ns is not None and oldest_ns > self.until_ns:
            return None
        line, until_ns = None, None
        ordered = sorted(
            fixes(),
            key=lambda fix: (
                fix.time_s,
                *fix.position_m.tolist(),
                *fix.covariance.flat,
            ),
        )
        simultaneous = sum(fix.time_s == ordered[0].time_s for fix in ordered)
        try:
            for fix, line in zip(
                ordered[simultaneous:],
                straight_lines(ordered, simultaneous + 1),
                strict=True,
            ):
                if over(line, self.method, CERTAIN_TO_SMOOTHER):
                    until_ns = self.first_ns + nanoseconds(fix.time_s)
                    break
        except np.linalg.LinAlgError:
            return None
        return None if line is None else (line, replace(self, until_ns=until_ns))


def along(line: Line, time_s: float, state_names: Sequence[str]) -> FloatArray:
    """Return the state (n,) of an object on `line` at `time_s`. Entries that the line does not determine are 0."""
    yaw_rad, speed_mps = polar(line.velocity_mps).tolist()
    vx_mps, vy_mps = line.velocity_mps.tolist()
    x_m, y_m = (line.position_m + time_s * line.velocity_mps).tolist()
    values = {
        "x_m": x_m,
        "y_m": y_m,
        "yaw_rad": yaw_rad,
        "speed_mps": speed_mps,
        "vx_mps": vx_mps,
        "vy_mps": vy_mps,
    }
    return np.array([values.get(name, 0.0) for name in state_names])


def sought(motion: MotionModel, start: Start, method: Initiation) -> bool:
    """True if the direction of travel must be sought: it is unknown, and `motion` must be linearised."""
    return method != "one-point" and start.yaw_rad is None and not motion.linear


def over(line: Line, method: Initiation, certain: float) -> bool:
    """True if `line` is the last line of `method`: its velocity is `certain` standard deviations from zero."""
    sigmas = math.sqrt(
        line.velocity_mps @ psd_solve(line.covariance, line.velocity_mps)
    )
    return method == "two-point" or sigmas > certain

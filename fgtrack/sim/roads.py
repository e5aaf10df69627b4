"""Vehicles with roads of their own: through waypoints, or along a recorded path."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, NonNegativeFloat

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_text
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.settings import require, settings
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import STATE_NAMES, BoolArray, FloatArray
from fgtrack.models.path import Path
from fgtrack.sim.vehicles import DrawnVehicle, LaneChange, SpeedKnots, TrackVehicle

#: Pieces of a road between two waypoints; short pieces make the parameter of the path its arc length.
_PIECES = 20
# Below this speed the direction of a recorded path is unknown.
_SLOW_MPS = 0.1
_SAME_POINT_M = 1e-6


@settings
class WaypointVehicle:
    """A vehicle on a road of its own: a smooth curve through waypoints.

    The curve is a cubic spline. A road whose last waypoint repeats the first is driven
    in laps. Beyond the ends of an open road the vehicle drives straight on.
    """

    speed: SpeedKnots
    """Knots (time [s], speed along the road [m/s]); the speed is smooth between them and constant outside.

    A vehicle with speed 0 stands.
    """
    waypoints: tuple[tuple[float, float], ...] = ()
    """Points (x [m], y [m]) of the road in the map frame, in driving order; either these or `file` is required."""
    file: str | None = None
    """CSV file with the waypoints, in the columns `x_m` and `y_m`."""
    arc_m: float = 0.0
    """Distance along the road from the first waypoint at the start."""
    lateral_m: float = 0.0
    """Lateral offset at the start, positive to the left."""
    lane_changes: tuple[LaneChange, ...] = ()
    """Lane changes in the order of time, without overlap."""
    kind: Literal["waypoints"] = "waypoints"

    def __post_init__(self) -> None:
        require(
            (self.file is None) == bool(self.waypoints),
            "waypoints",
            "give either waypoints or a file",
            self.file,
        )
        if self.waypoints:
            problem = _problem(np.array(self.waypoints))
            require(problem is None, "waypoints", str(problem), len(self.waypoints))
        assert self._driver  # raises for speeds and lane changes that are not in order

    @cached_property
    def _driver(self) -> TrackVehicle:
        return TrackVehicle(self.arc_m, self.speed, self.lateral_m, self.lane_changes)

    @cached_property
    def road(self) -> Path:
        """Path through the waypoints.

        Raises `DataError` if the file cannot be read, or has no road.
        """
        points_m = np.array(self.waypoints)
        if self.file is not None:
            x_m, y_m = read_columns(FilePath(self.file), ("x_m", "y_m"))
            points_m = np.stack([x_m, y_m], axis=1)
            if (problem := _problem(points_m)) is not None:
                raise DataError(f"{self.file}: the waypoints {problem}")
        is_closed = _same(points_m[0], points_m[-1]) and len(points_m) > 3
        make = Path.through if is_closed else Path.open_through
        coarse = make(points_m)
        knots_m = coarse.u_m if is_closed else coarse.u_m[1:-1]
        shares = np.linspace(0.0, 1.0, _PIECES, endpoint=False)
        fine_m = (knots_m[:-1, None] + np.diff(knots_m)[:, None] * shares).ravel()
        frame = coarse.frame(fine_m)
        fine = np.stack([frame.x_m, frame.y_m], axis=1)
        return make(
            np.concatenate([fine, points_m[:1] if is_closed else points_m[-1:]])
        )

    def states(self, times_s: FloatArray) -> FloatArray:
        """Return the states at `times_s` as `TrackVehicle.states`."""
        return self._driver.states(self.road, times_s)


def _problem(points_m: FloatArray) -> str | None:
    """Return the reason why `points_m`, shape (n, 2), are no road, or None."""
    if len(points_m) < 2:
        return "must be at least two points"
    steps_m = np.hypot(*np.diff(points_m, axis=0).T)
    if (steps_m <= _SAME_POINT_M).any():
        number = int(np.argmax(steps_m <= _SAME_POINT_M)) + 2
        return f"must differ from point to point, but number {number} repeats the one before"
    return None


def _same(one: FloatArray, other: FloatArray) -> bool:
    return bool(np.hypot(*(one - other)) <= _SAME_POINT_M)


@settings
class RecordedVehicle:
    """A vehicle on the path of a recorded object, at the recorded times; it exists while the path lasts."""

    file: str
    """Recording with truth; or a CSV file with `x_m`, `y_m`, and `t_s` [s] or `stamp_ns`, and perhaps `object_id`."""
    object_id: int | None = None
    """Object of the truth; -1 is the ego, whose poses serve without truth. Null: a file with a single path."""
    start_s: float = 0.0
    """Time in the file at which the scenario starts; the first stamp of the file has time 0, as has `t_s` = 0."""
    std_m: NonNegativeFloat = 0.0
    """Standard deviation of the recorded positions; the path is smoothed by this much, 0 goes through every point."""
    kind: Literal["recorded"] = "recorded"


@dataclass(frozen=True, eq=False)
class TimedPath:
    """Positions over time, smoothed by a cubic spline in each coordinate."""

    times_s: FloatArray
    """Ascending distinct times, shape (n,), at least two."""
    points_m: FloatArray
    """Positions, shape (n, 2)."""
    std_m: float = 0.0
    """Standard deviation of the positions."""

    def states(self, times_s: FloatArray) -> FloatArray:
        """Return the states at `times_s`, shape (m, 6), as `STATE_NAMES`; NaN before the first and after the last time.

        Yaw, speed, yaw rate and acceleration are derivatives of the positions. An object
        that stands keeps its last direction.
        """
        states = np.full((len(times_s), len(STATE_NAMES)), np.nan)
        exists = (times_s >= self.times_s[0]) & (times_s <= self.times_s[-1])
        at_s = times_s[exists]
        (x, vx, ax), (y, vy, ay) = (self._derivatives(k, at_s) for k in (0, 1))
        speed = np.hypot(vx, vy)
        slow = speed < _SLOW_MPS
        divisor = np.where(slow, 1.0, speed)
        yaw = np.where(slow, self._last_yaw(at_s), np.arctan2(vy, vx))
        yaw_rate = np.where(slow, 0.0, (vx * ay - vy * ax) / divisor**2)
        accel = np.where(slow, 0.0, (vx * ax + vy * ay) / divisor)
        states[exists] = np.stack([x, y, wrap_angles(yaw), speed, yaw_rate, accel], 1)
        return states

    def _last_yaw(self, times_s: FloatArray) -> FloatArray:
        """Return the direction of the last fast recorded time up to each of `times_s`, else of the first fast one."""
        _, vx, _ = self._derivatives(0, self.times_s)
        _, vy, _ = self._derivatives(1, self.times_s)
        is_fast = np.hypot(vx, vy) >= _SLOW_MPS
        if not is_fast.any():
            return np.zeros(len(times_s))
        index = np.searchsorted(self.times_s[is_fast], times_s, side="right") - 1
        return np.asarray(np.arctan2(vy, vx)[is_fast][np.maximum(index, 0)])

    def _derivatives(self, coordinate: int, times_s: FloatArray) -> list[FloatArray]:
        """Return a coordinate and its first two derivatives at `times_s`."""
        return [np.asarray(self._splines[coordinate](times_s, k)) for k in range(3)]

    @cached_property
    def _splines(self) -> tuple[Callable[..., FloatArray], ...]:
        from scipy.interpolate import UnivariateSpline

        degree: Any = min(3, len(self.times_s) - 1)  # Any: scipy has a Literal
        residual = len(self.times_s) * self.std_m**2
        return tuple(
            UnivariateSpline(self.times_s, values, k=degree, s=residual)
            for values in self.points_m.T
        )


def timed_path(
    vehicle: RecordedVehicle, times_s: FloatArray, points_m: FloatArray
) -> TimedPath:
    """Return the path of `vehicle` through `points_m` (n, 2) at `times_s` (n,), which may have any order.

    Raises `DataError` if there are fewer than two distinct times.
    """
    times_s, first = np.unique(times_s - vehicle.start_s, return_index=True)
    if len(times_s) < 2:
        raise DataError(
            f"{vehicle.file}: object {vehicle.object_id}: a path needs positions at two times, there are {len(times_s)}"
        )
    return TimedPath(times_s, points_m[first], vehicle.std_m)


def csv_path(vehicle: RecordedVehicle) -> TimedPath:
    """Return the path of `vehicle` from its CSV file.

    Raises `DataError` if the file cannot be read, lacks a column, or has no path of the
    object.
    """
    path = FilePath(vehicle.file)
    given = read_header(path)
    clock = "t_s" if "t_s" in given else "stamp_ns"
    names = (clock, "x_m", "y_m", *(["object_id"] if "object_id" in given else []))
    times, x_m, y_m, *ids = read_columns(path, names)
    if clock == "stamp_ns" and len(times):
        times = (times - times.min()) / NS_PER_S
    chosen: BoolArray = np.ones(len(times), dtype=bool)
    if ids:
        known = np.unique(ids[0]).astype(int).tolist()
        wanted = vehicle.object_id
        if wanted is None and len(known) == 1:
            wanted = known[0]
        if wanted not in known:
            raise DataError(
                f"{path}: `object_id` must be one of {', '.join(map(str, known))}, is {wanted}"
            )
        chosen = ids[0] == wanted
    return timed_path(vehicle, times[chosen], np.stack([x_m, y_m], axis=1)[chosen])


def read_header(path: FilePath) -> list[str]:
    """Return the column names of a CSV file; raises `DataError` if it cannot be read."""
    try:
        with open_text(path, encoding="utf-8-sig") as file:
            return [name.strip() for name in file.readline().split(",")]
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "is no text file"
        raise DataError(f"{path}: cannot be read ({reason})") from error


def read_columns(path: FilePath, names: tuple[str, ...]) -> list[FloatArray]:
    """Return the columns `names` of a CSV file with a header, each of shape (n,).

    Raises `DataError` if the file cannot be read, lacks a column, or has a cell that is
    not a finite number.
    """
    given = read_header(path)
    missing = [name for name in names if name not in given]
    if missing:
        raise DataError(
            f"{path}: has no column {', '.join(missing)}; its columns are {', '.join(given)}"
        )
    import pandas as pd

    try:
        with open_text(path, encoding="utf-8-sig") as file:
            table = pd.read_csv(file, skipinitialspace=True, usecols=list(names))
        columns = [table[name].to_numpy(dtype=np.float64) for name in names]
    except (ValueError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not a table of numbers ({error})") from error
    for name, column in zip(names, columns, strict=True):
        if not np.isfinite(column).all():
            row = int(np.argmin(np.isfinite(column))) + 2
            raise DataError(f"{path}: line {row}: {name} is not a finite number")
    return columns


#: Any vehicle, selected by its kind.
AnyVehicle = Annotated[
    TrackVehicle | DrawnVehicle | WaypointVehicle | RecordedVehicle,
    Discriminator("kind"),
]

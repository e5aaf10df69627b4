"""Straight paths of objects, linked from list to list, and the motions that a sensor could report for them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import rotations
from fgtrack.core.types import FloatArray, IntArray

__all__ = ["Motions", "Scans", "StraightPath", "motions", "straight_paths"]

#: Highest speed of an object, and of an object that moves as the ego does.
_FASTEST_MPS = 90.0
#: Largest difference of the errors of two detections of one object.
_LARGEST_ERROR_M = 3.0
#: Largest acceleration across or along a path.
_LARGEST_ACCELERATION_MPS2 = 6.0
#: Duration of a path, and its fewest and most detections.
_DURATION_S = 1.0
_FEWEST_POINTS = 5
_MOST_POINTS = 30
#: Most straight paths.
_MOST = 400
#: A path whose scatter is larger than this multiple of the median has a wrong link.
_WRONG_LINK = 3.0
#: Half of the time over which the velocity of the frame is computed.
_STEP_S = 0.25


@dataclass(frozen=True)
class Scans:
    """Lists of a sensor, the raw values of their detections, and the pose of the frame in which they are given."""

    stamps_s: FloatArray
    """Ascending stamps, shape (n,)."""
    positions_m: Sequence[FloatArray]
    """Positions in each list, shape (m, 2), in the frame of the list."""
    values: Sequence[FloatArray]
    """Raw values of the detections in each list, shape (m, k); NaN where missing."""
    poses: FloatArray
    """x, y and yaw (unwrapped) of the frame in the map at each stamp, shape (n, 3); zero for lists in the map."""

    def in_map_m(self, k: int) -> FloatArray:
        """Return the positions of list `k` in the map, shape (m, 2)."""
        x_m, y_m, yaw_rad = self.poses[k]
        c = math.cos(yaw_rad)
        s = math.sin(yaw_rad)
        points = self.positions_m[k]
        turned = points @ np.array([[c, s], [-s, c]])
        return np.asarray(turned + np.array([x_m, y_m]))


@dataclass(frozen=True)
class StraightPath:
    """Successive detections of an object on a straight line at constant speed."""

    lists: IntArray
    """Index of each list, shape (p,)."""
    rows: IntArray
    """Index of the detection in each list, shape (p,)."""
    velocity_mps: FloatArray
    """Velocity in the map, shape (2,)."""
    scatter_m: float
    """Standard deviation of a detection from the line, on each axis."""
    velocity_std_mps: float
    """Standard deviation of the velocity on each axis, from the scatter."""


@dataclass(frozen=True)
class Motions:
    """Motions of the straight paths of a sensor, and the means of the raw values beside them."""

    values: FloatArray
    """Mean raw values, shape (m, k)."""
    in_map_mps: FloatArray
    """Velocity in the map, shape (m, 2)."""
    in_frame_mps: FloatArray
    """Velocity in the map along the axes of the frame, shape (m, 2)."""
    relative_mps: FloatArray
    """Velocity minus the velocity of the frame, along the axes of the frame, shape (m, 2)."""
    apparent_mps: FloatArray
    """Derivative of the position in the frame, which includes the rotation of the frame, shape (m, 2)."""
    radial_mps: FloatArray
    """Derivative of the distance from the origin of the frame, shape (m,)."""
    radial_in_map_mps: FloatArray
    """Velocity in the map along the line of sight, shape (m,)."""
    values_along_sight: FloatArray
    """Projection of vectors of two raw values onto the line of sight, shape (m,); NaN for other values."""
    std_mps: float
    """Standard deviation of the velocities on each axis."""


def straight_paths(
    scans: Scans, ids: Sequence[IntArray] | None = None
) -> list[StraightPath]:
    """Return up to 400 straight paths that begin all over the recording.

    Three detections in successive lists begin a path if they are closest to a
    straight line. The next lists continue it with their detection next to the line.
    With `ids`, shape (m,) for each list, equal ids are linked instead.
    """
    n = len(scans.stamps_s)
    if n < _FEWEST_POINTS:
        return []
    gaps_s = np.diff(scans.stamps_s)
    period_s = float(np.median(gaps_s[gaps_s > 0.0])) if (gaps_s > 0.0).any() else 1.0
    points = int(
        np.clip(round(_DURATION_S / period_s) + 1, _FEWEST_POINTS, _MOST_POINTS)
    )
    mean = max(sum(map(len, scans.positions_m)) / n, 1e-9)
    every = max(points // 2, math.ceil(mean * n / _MOST), 1)
    found = []
    for start in range(0, n - points + 1, every):
        window = range(start, start + points)
        in_map_m = [scans.in_map_m(k) for k in window]
        stamps_s = scans.stamps_s[start : start + points]
        linked = (
            _linked(stamps_s, in_map_m)
            if ids is None
            else _of_equal_ids([ids[k] for k in window])
        )
        found += [
            _straight_path(start + steps, rows, stamps_s[steps], in_map_m, steps)
            for steps, rows in linked
        ]
    if not found:
        return []
    limit_m = _WRONG_LINK * float(np.median([one.scatter_m for one in found]))
    return [one for one in found if one.scatter_m <= limit_m]


def _linked(
    stamps_s: FloatArray, points_m: Sequence[FloatArray]
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield steps (p,) and rows (p,) of each object that is detected in the first three lists and most others."""
    if min(map(len, points_m[:3])) == 0:
        return
    before_s, after_s = np.diff(stamps_s[:3])
    if min(before_s, after_s) <= 0.0:
        return
    for row, first_m in enumerate(points_m[0]):
        steps_m = points_m[1] - first_m
        predicted_m = points_m[1] + steps_m * (after_s / before_s)
        misfit_m = np.hypot(
            *np.moveaxis(predicted_m[:, None] - points_m[2][None], -1, 0)
        )
        misfit_m[np.hypot(*steps_m.T) > _FASTEST_MPS * before_s + _LARGEST_ERROR_M] = (
            np.inf
        )
        second, third = np.unravel_index(int(np.argmin(misfit_m)), misfit_m.shape)
        if misfit_m[second, third] > _reach_m(max(before_s, after_s)):
            continue
        steps = [0, 1, 2]
        rows = [row, int(second), int(third)]
        for step in range(3, len(points_m)):
            if not len(points_m[step]):
                continue
            used = np.array([points_m[k][r] for k, r in zip(steps, rows, strict=True)])
            times_s = stamps_s[steps]
            slope = _line(times_s, used)[1]
            elapsed_s = stamps_s[step] - times_s.mean()
            distances_m = np.hypot(
                *(points_m[step] - used.mean(axis=0) - slope * elapsed_s).T
            )
            nearest = int(np.argmin(distances_m))
            if distances_m[nearest] <= _reach_m(stamps_s[step] - times_s[-1]):
                steps.append(step)
                rows.append(nearest)
        if len(steps) >= max(_FEWEST_POINTS, (2 * len(points_m)) // 3):
            yield np.array(steps), np.array(rows)


def _reach_m(elapsed_s: float) -> float:
    return _LARGEST_ERROR_M + 0.5 * _LARGEST_ACCELERATION_MPS2 * elapsed_s**2


def _of_equal_ids(ids: Sequence[IntArray]) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield steps (p,) and rows (p,) of each id that the first list and most others contain once."""
    by_id: dict[int, dict[int, int]] = {}
    for step, one in enumerate(ids):
        for row, value in enumerate(one.tolist()):
            by_id.setdefault(value, {})[step] = row
    for steps in by_id.values():
        if 0 in steps and len(steps) >= max(_FEWEST_POINTS, (2 * len(ids)) // 3):
            yield np.array(list(steps)), np.array(list(steps.values()))


def _line(times_s: FloatArray, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean (2,) and slope (2,) of the straight line through `points_m` (p, 2)."""
    centred_s = times_s - times_s.mean()
    mean_m = points_m.mean(axis=0)
    spread_s2 = float(centred_s @ centred_s)
    return mean_m, centred_s @ (points_m - mean_m) / max(spread_s2, 1e-12)


def _straight_path(
    lists: IntArray,
    rows: IntArray,
    times_s: FloatArray,
    in_map_m: Sequence[FloatArray],
    steps: IntArray,
) -> StraightPath:
    points_m = np.array([in_map_m[k][row] for k, row in zip(steps, rows, strict=True)])
    mean_m, slope_mps = _line(times_s, points_m)
    centred_s = times_s - times_s.mean()
    rest_m = points_m - mean_m - centred_s[:, None] * slope_mps
    scatter_m = math.sqrt(float(np.square(rest_m).sum()) / (2.0 * (len(rows) - 2)))
    spread_s = math.sqrt(max(float(centred_s @ centred_s), 1e-12))
    return StraightPath(lists, rows, slope_mps, scatter_m, scatter_m / spread_s)


def motions(scans: Scans, found: Sequence[StraightPath]) -> Motions:
    """Return the motions of the straight paths `found`, each as the mean over its detections."""
    rates = _rates(scans)
    rows = [_motion(scans, rates, one) for one in found]
    width = scans.values[0].shape[1] if len(scans.values) else 0
    table = np.array(rows).reshape(len(found), 9 + width)
    return Motions(
        table[:, 9:],
        np.array([one.velocity_mps for one in found]).reshape(-1, 2),
        table[:, 0:2],
        table[:, 2:4],
        table[:, 4:6],
        table[:, 6],
        table[:, 7],
        table[:, 8],
        float(np.median([one.velocity_std_mps for one in found])) if found else 0.0,
    )


def _motion(scans: Scans, rates: FloatArray, one: StraightPath) -> FloatArray:
    """Return the means over the detections of a path, in the order of the fields of `Motions`."""
    pairs = list(zip(one.lists.tolist(), one.rows.tolist(), strict=True))
    values = np.array([scans.values[k][row] for k, row in pairs])
    local_m = np.array([scans.positions_m[k][row] for k, row in pairs])
    to_frame = np.swapaxes(rotations(scans.poses[one.lists, 2]), -1, -2)
    in_frame = to_frame @ one.velocity_mps
    relative = in_frame - np.einsum("kij,kj->ki", to_frame, rates[one.lists, :2])
    turned_m = np.column_stack([-local_m[:, 1], local_m[:, 0]])
    apparent = relative - rates[one.lists, 2:] * turned_m
    sight = local_m / np.maximum(np.hypot(*local_m.T), 1e-9)[:, None]
    radial = [np.sum(each * sight, axis=1) for each in (relative, in_frame)]
    along = (
        np.sum(values * sight, axis=1)
        if values.shape[1] == 2
        else np.full(len(values), np.nan)
    )
    columns = np.column_stack([in_frame, relative, apparent, *radial, along, values])
    return np.asarray(columns.mean(axis=0))


def _rates(scans: Scans) -> FloatArray:
    """Return the velocity in the map and yaw rate of the frame at each stamp, shape (n, 3)."""
    stamps_s = scans.stamps_s
    if len(stamps_s) < 2 or not scans.poses.any():
        return np.zeros((len(stamps_s), 3))
    before_s = np.maximum(stamps_s - _STEP_S, stamps_s[0])
    after_s = np.minimum(stamps_s + _STEP_S, stamps_s[-1])
    moved = [
        np.interp(after_s, stamps_s, column) - np.interp(before_s, stamps_s, column)
        for column in scans.poses.T
    ]
    elapsed_s = np.maximum(after_s - before_s, 1e-9)
    return np.asarray(np.column_stack(moved) / elapsed_s[:, None])

"""Detections of a group of sensors as the rows of a fit, with their derivatives by the mounts."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import rotation, rotations
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.meaning.mounts.groups import Group, num_detections, objects_of
from fgtrack.meaning.mounts.pose import QUARTER, Pose2
from fgtrack.meaning.mounts.sensor_tracks import SensorTracks
from fgtrack.meaning.object_fit import Rows

__all__ = ["Table", "rows_of", "table_of"]

#: Length of the stretches of the jackknife.
_STRETCH_S = 5.0
#: Most detections of all sensors in the fit.
_MOST_ROWS = 12_000
#: Number of detections before and after a detection that show its sight.
_NEIGHBOURS = 5


class Table(NamedTuple):
    """Detections of a group, in the order of object, stretch and time."""

    sensors: IntArray
    """Index of the sensor in the group, shape (n,)."""
    objects: IntArray
    stretches: IntArray
    runs: IntArray
    """Number of the object's stretch, shape (n,)."""
    times_s: FloatArray
    points_m: FloatArray
    around_m: FloatArray
    """Mean positions of the detections of the same object by the same sensor before and after, shape (n, 2)."""
    poses: FloatArray
    noise: FloatArray
    """Noise of the sensors, shape (n, 2, 2), as in `Rows`."""
    in_map: BoolArray


def table_of(sensors: Mapping[str, SensorTracks], group: Group) -> Table:
    """Return the detections of a group, with the number of the object of each."""
    owner = objects_of(sensors, group)
    parts: list[tuple[FloatArray, ...]] = []
    total = sum(num_detections(sensors[name]) for name in group.poses)
    step = max(1, math.ceil(total / _MOST_ROWS))
    for number, name in enumerate(group.poses):
        one = sensors[name]
        for k, track in enumerate(one.tracks):
            rows = track.rows[::step]
            parts.append(
                (
                    np.full(len(rows), number),
                    np.full(len(rows), owner[name, k]),
                    track.times_s[::step],
                    one.points.points_m[rows],
                    one.points.poses[rows],
                    np.tile([one.noise.along, one.noise.across], (len(rows), 1, 1)),
                    np.full(len(rows), one.points.in_map),
                )
            )
    numbers, objects, times_s, at_m, poses, noise, in_map = (
        np.concatenate([part[k] for part in parts]) for k in range(7)
    )
    stretches = ((times_s - times_s.min()) // _STRETCH_S).astype(np.int64)
    order = np.lexsort((times_s, stretches, objects))
    runs = np.unique(
        np.column_stack([objects, stretches])[order], axis=0, return_inverse=True
    )[1]
    return Table(
        numbers[order],
        objects[order],
        stretches[order],
        runs.ravel(),
        times_s[order],
        at_m[order],
        _around_m(at_m[order], runs.ravel(), numbers[order]),
        poses[order],
        noise[order],
        in_map[order],
    )


def _around_m(points_m: FloatArray, runs: IntArray, sensors: IntArray) -> FloatArray:
    """Return the mean of the detections before and after each detection in its run, shape (n, 2).

    The detection itself is left out, so that its error does not count.
    """
    order = np.lexsort((np.arange(len(runs)), sensors, runs))
    keys = np.column_stack([runs, sensors])[order]
    first = np.append(True, np.diff(keys, axis=0).any(axis=1))
    starts = np.flatnonzero(first)
    number = np.cumsum(first) - 1
    ends = np.append(starts[1:], len(runs))
    rows = np.arange(len(runs))
    low = np.maximum(rows - _NEIGHBOURS, starts[number])
    high = np.minimum(rows + _NEIGHBOURS + 1, ends[number])
    sums_m = np.concatenate([np.zeros((1, 2)), np.cumsum(points_m[order], axis=0)])
    count = np.maximum(high - low - 1, 1)[:, None]
    means_m = (sums_m[high] - sums_m[low] - points_m[order]) / count
    alone = high - low < 2
    means_m[alone] = points_m[order][alone]
    result = np.empty_like(points_m)
    result[order] = means_m
    return result


def rows_of(
    table: Table,
    poses: Sequence[Pose2],
    root: Pose2,
    still: BoolArray,
    radial: Sequence[int],
) -> Rows:
    """Return the positions in the map for mounts `poses`, and their derivatives.

    The parameters are yaw, x and y of the reference in the ego, then of each other
    sensor in the reference, then the error along the sight of each sensor in `radial`.
    """
    count = len(poses)
    n = len(table.runs)
    yaws = np.array([pose.yaw_rad for pose in poses])[table.sensors]
    shifts_m = np.array([pose.shift_m for pose in poses])[table.sensors]
    turned_m = np.einsum("nij,nj->ni", rotations(yaws), table.points_m)
    u_m = turned_m + shifts_m
    psi = np.where(table.in_map, 0.0, table.poses[:, 2])
    ego_m = np.where(table.in_map[:, None], 0.0, table.poses[:, :2])
    root_turn = np.where(table.in_map, 0.0, root.yaw_rad)
    root_m = np.where(table.in_map[:, None], 0.0, root.shift_m)
    turns = rotations(psi)
    full = rotations(psi + root_turn)
    y_m = (
        ego_m
        + np.einsum("nij,nj->ni", full, u_m)
        + np.einsum("nij,nj->ni", turns, root_m)
    )
    A = np.zeros((n, 2, 3 * count + len(radial)))
    for k in range(1, count):
        mine = (table.sensors == k) & ~table.in_map
        A[mine, :, 3 * k] = np.einsum(
            "nij,nj->ni", full[mine], turned_m[mine] @ QUARTER.T
        )
        A[mine, :, 3 * k + 1 : 3 * k + 3] = full[mine]
    # Moving objects are left out: on a bend they turn with the ego.
    body = still & ~table.in_map
    A[body, :, 0] = np.einsum("nij,nj->ni", full[body], u_m[body] @ QUARTER.T)
    A[body, :, 1:3] = turns[body]
    for column, k in enumerate(radial, start=3 * count):
        mine = table.sensors == k
        # The sight of the detection itself contains its error.
        around_m = table.around_m[mine]
        sight = around_m / np.maximum(np.hypot(*around_m.T), 1e-6)[:, None]
        A[mine, :, column] = sight @ rotation(poses[k].yaw_rad).T
        A[mine, :, column] = np.einsum("nij,nj->ni", full[mine], A[mine, :, column])
    mounts_m = np.einsum("nij,nj->ni", full, shifts_m) + np.einsum(
        "nij,nj->ni", turns, root_m
    )
    origins_m = table.poses[:, :2] + np.where(table.in_map[:, None], 0.0, mounts_m)
    return Rows(table.runs, table.times_s, y_m, A, origins_m, table.noise, still)

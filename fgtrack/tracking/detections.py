"""The detections of batches in the map frame, as arrays: errors of the pose in them, and merging."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import accumulate, chain, pairwise
from operator import attrgetter
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np

from fgtrack.core.geometry import circular_mean, rotations
from fgtrack.core.linalg import congruence, kernels
from fgtrack.core.types import BoolArray, Detection, FloatArray, IntArray
from fgtrack.models.measurement import (
    ANGULAR,
    COMPONENTS,
    MIN_RANGE_M,
    MeasurementModel,
    SensorPose,
)
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.inbox import Batch, own_covariance

X, YAW, RANGE, BEARING, CURVATURE = map(
    COMPONENTS.index, ("x_m", "yaw_rad", "range_m", "bearing_rad", "curvature_radpm")
)


class PosedBatch(NamedTuple):
    """A batch, its sensor, and the sensor pose from which its detections are measured."""

    batch: Batch
    sensor: SensorModel
    ego: EgoPose | None
    """Pose of the ego at the stamp of the batch; None if it is unknown."""
    pose: SensorPose


class MapDetections(NamedTuple):
    """Detections of one or several batches, one batch after another, with their components in the map frame."""

    batches: Sequence[PosedBatch]
    poses: FloatArray
    """Sensor poses of the batches, shape (batches, 5)."""
    starts: IntArray
    """First row of each batch, and the number m of all rows, shape (batches + 1,)."""
    indices: IntArray
    """Indices of the detections in their messages, shape (m,)."""
    values: FloatArray
    """Values in the order of `COMPONENTS`, shape (m, 8); NaN for a missing value."""
    points_m: FloatArray
    """Positions in the map, shape (m, 2); NaN if only a bearing was measured."""
    map_yaw: BoolArray
    """True if the yaw is taken from the map, shape (m,)."""
    merged: Mapping[tuple[int, int], tuple[int, ...]] = MappingProxyType({})
    """Indices of the merged detections, by the batch and the index of the detection that leads them."""
    averaged: "Mapping[tuple[int, int], MapDetections]" = MappingProxyType({})
    """Detections whose values were averaged, by the batch and the index of the detection that leads them."""

    @property
    def of(self) -> IntArray:
        """Indices of the batches of all detections, shape (m,)."""
        return np.arange(len(self.batches)).repeat(np.diff(self.starts))

    def at(self, rows: IntArray | BoolArray) -> "MapDetections":
        """Return the detections at `rows`: ascending indices, or a mask, over the detections of all batches.

        Each detection stays in its batch.
        """
        return self._replace(
            starts=self.of[rows].searchsorted(np.arange(len(self.starts))),
            indices=self.indices[rows],
            values=self.values[rows],
            points_m=self.points_m[rows],
            map_yaw=self.map_yaw[rows],
        )


def in_map_frame(batches: Sequence[PosedBatch]) -> MapDetections:
    """Return the detections of `batches` in the map, with the components that their sensors measure."""
    starts = [0, *accumulate([len(each.batch.indices) for each in batches])]
    numbers: list[Any] = []  # numbers or None
    columns: list[tuple[int, ...]] = []
    indices: list[int] = []
    for batch, sensor, _, _ in batches:
        read, own = _reading(tuple(sensor.std))
        numbers += chain.from_iterable(
            map(read, map(batch.message.objects.__getitem__, batch.indices))
        )
        columns.append(own)
        indices += batch.indices
    poses, first_rows = np.array([each.pose for each in batches]), np.array(starts)
    moves = np.array([each.batch.message.frame != "map" for each in batches])
    read_values = np.array(numbers, dtype=np.float64), np.array(columns)
    arrays = kernels("fgtrack.tracking.kernels").to_map(
        *read_values, first_rows, poses, moves
    )
    return MapDetections(
        batches, poses, first_rows, np.array(indices, dtype=np.int64), *arrays
    )


def move_back(items: MapDetections, by_m: FloatArray) -> None:
    """Move all positions away from the sensor by `by_m` (batches,), along the line of sight."""
    of = items.of
    offsets_m, own_m = items.points_m - items.poses[of, :2], by_m[of]
    ranges_m = np.hypot(offsets_m[:, 0], offsets_m[:, 1])
    moves_m = own_m[:, None] * offsets_m / np.maximum(ranges_m, MIN_RANGE_M)[:, None]
    items.points_m[:] += moves_m
    items.values[:, :2] += moves_m
    items.values[:, RANGE] += own_m


def merged(items: MapDetections, merge: "Merge") -> MapDetections:
    """Return `items` in which the detections of each object are averaged.

    The averages are in the order of the merge; detections with a bearing alone are last. An average has the components
    that all detections of the object have. If these give no position, the leading detection represents the object.
    """
    bearing, apart = (
        np.isnan(items.points_m[:, 0]),
        merge.apart(items.points_m, items.starts),
    )
    if all(apart) and not len(bearing.nonzero()[0]):
        return items
    rows, members_of = list[int](), dict[int, list[int]]()  # by the row that leads
    for k, (first, end) in enumerate(pairwise(items.starts.tolist())):
        placed = (first + np.flatnonzero(~bearing[first:end])).tolist()
        groups = (
            {row: (row,) for row in range(len(placed))}
            if apart[k]
            else merge.groups(items.points_m[placed])
        )
        for row, group in groups.items():
            if len(group) > 1:
                members_of[len(rows)] = [placed[member] for member in group]
            rows.append(placed[row])
        rows += (first + np.flatnonzero(bearing[first:end])).tolist()
    result, claimed, of = items.at(np.array(rows, dtype=np.int64)), set(rows), items.of
    others, averaged = (
        dict[tuple[int, int], tuple[int, ...]](),
        dict[tuple[int, int], MapDetections](),
    )
    for row, members in members_of.items():
        key = int(of[rows[row]]), int(result.indices[row])
        new = [member for member in members if member not in claimed]
        claimed.update(new)
        others[key] = tuple(items.indices[new].tolist())
        parts = items.at(np.array(members))
        columns = np.flatnonzero(~np.isnan(parts.values).any(axis=0)).tolist()
        if X in columns or (RANGE in columns and BEARING in columns):
            averaged[key] = parts
            result.values[row] = np.nan
            result.values[row, columns] = [
                merge.mean(COMPONENTS[k], parts.values[:, k]) for k in columns
            ]
            result.points_m[row] = parts.points_m.mean(axis=0)
            result.map_yaw[row] = parts.map_yaw.any()
    return result._replace(merged=others, averaged=averaged)


def covariances(
    items: MapDetections, k: int, rows: IntArray | slice, names: tuple[str, ...]
) -> FloatArray:
    """Return the covariances of the components `names` in the map, shape (m, k, k), for `rows` of `items` from one
    batch.

    The covariance of a detection has priority over the covariance R of the sensor. A component from the map has the
    standard deviation of the sensor, without correlation. An average has the mean of the covariances of its detections.
    """
    (batch, sensor, _, pose), indices, points_m = (
        items.batches[k],
        items.indices[rows].tolist(),
        items.points_m[rows],
    )
    m = len(indices)
    R = np.empty((m, len(names), len(names)))
    R[:] = sensor.noise(names)
    turns = "x_m" in names and not sensor.is_isotropic
    offsets_m = (
        points_m - np.array(pose[:2]) if turns or sensor.std_growth else points_m
    )
    more = (
        sensor.variance_growth(names, np.hypot(offsets_m[:, 0], offsets_m[:, 1]))
        if sensor.std_growth
        else None
    )
    if more is not None:
        R.reshape(m, -1)[:, :: len(names) + 1] += more
    carrying = []
    for row, index in enumerate(indices if sensor.message_covariance else ()):
        detection = batch.message.objects[index]
        if detection.covariance is not None:
            carrying.append(row)
            carried = [
                name
                for name in names
                if name in detection.measured and name in sensor.std
            ]
            here = [names.index(name) for name in carried]
            R[row][np.ix_(here, here)] = own_covariance(detection, carried)
    if carrying and "x_m" in names and batch.message.frame != "map":
        R[carrying] = _turned(R[carrying], np.full(len(carrying), pose.yaw_rad))
    if turns and len(carrying) < m:
        rest = np.delete(np.arange(m), carrying)
        R[rest] = _turned(R[rest], np.arctan2(offsets_m[rest, 1], offsets_m[rest, 0]))
    for row, index in enumerate(indices if items.averaged else ()):
        if (k, index) in items.averaged:
            R[row] = covariances(items.averaged[k, index], k, slice(None), names).mean(
                axis=0
            )
    return R


@cache
def _reading(
    names: tuple[str, ...],
) -> tuple[Callable[[Detection], Any], tuple[int, ...]]:
    """Return a function that reads the components `names` of a detection, and their indices in `COMPONENTS`.

    The indices are filled up with -1 to the length of `COMPONENTS`.
    """
    columns = [*map(COMPONENTS.index, names), *[-1] * (len(COMPONENTS) - len(names))]
    read = attrgetter(*names)
    return read if len(names) > 1 else lambda detection: (read(detection),), tuple(
        columns
    )


def _turned(R: FloatArray, yaws_rad: FloatArray) -> FloatArray:
    """Return the covariances R (m, k, k) after the first two components, the positions, are turned by `yaws_rad`."""
    turns = np.zeros(R.shape)
    diagonal = np.arange(R.shape[-1])
    turns[:, diagonal, diagonal] = 1.0
    turns[:, :2, :2] = rotations(yaws_rad)
    return congruence(turns, R)


class PoseError(NamedTuple):
    """Error e of a sensor pose in the innovation z - h(x, pose) = ... + G e of a detection.

    e is the estimated minus the true pose (x, y, yaw, vx, vy of the sensor). All detections of a batch share it. It
    enters z where the pose placed the detection in the map, and h where the measurement is relative to the sensor.
    """

    covariance: FloatArray
    """Covariance of e, shape (5, 5)."""
    placement: FloatArray
    """Derivative by the pose of the detections z in the map, shape (m, k, 5)."""
    R: FloatArray
    """Covariances of the detections themselves, without e, shape (m, k, k)."""

    def at(self, rows: IntArray | list[int]) -> "PoseError":
        """Return the pose error of the detections in `rows`."""
        return PoseError(self.covariance, self.placement[rows], self.R[rows])

    def noise(
        self, model: MeasurementModel, pose: SensorPose, x: FloatArray
    ) -> FloatArray:
        """Return the covariances R + G P_e G' at the states `x` (m, n), shape (m, k, k)."""
        R, G = self.R.copy(), self.placement
        if model.relative:
            G = G - model.pose_jacobian(x, pose)
        kernels("fgtrack.tracking.kernels").add_pose_error(G, self.covariance, R)
        return R


class Merge:
    """Recognises detections of a list that are the same object, and averages them."""

    def apart(self, points_m: FloatArray, starts: IntArray) -> list[bool]:
        """Return True for each list in which all detections are different objects.

        The points of a list are the rows of `points_m` (n, 2) between two successive `starts`.
        """
        return [True] * (len(starts) - 1)

    def groups(self, points_m: FloatArray) -> dict[int, tuple[int, ...]]:
        """Return the indices of all groups of `points_m` (n, 2), by the index of the point that leads the group."""
        return {row: (row,) for row in range(len(points_m))}

    def mean(self, name: str, values: FloatArray) -> float:
        """Return the average of the component `name`; angles are averaged on the circle."""
        return (
            circular_mean(values)
            if name in ANGULAR
            else float(values.sum() / len(values))
        )


@dataclass(frozen=True)
class NoMerge(Merge):
    """Merges no detections: each detection is an object."""

    kind: Literal["none"] = "none"


@dataclass(frozen=True)
class ConnectedMerge(Merge):
    """Merges detections that are linked by steps of at most a distance."""

    distance_m: float
    """Detections at most this far apart are linked."""
    kind: Literal["connected"] = "connected"

    def apart(self, points_m: FloatArray, starts: IntArray) -> list[bool]:
        """See `Merge.apart`."""
        if len(points_m) < 2:
            return super().apart(points_m, starts)
        apart: list[bool] = self._linked(points_m, starts, 1.0 + 1e-9)[1].tolist()
        return apart

    def _linked(
        self, points_m: FloatArray, starts: IntArray, margin: float = 1.0
    ) -> tuple[IntArray, BoolArray]:
        by_x = points_m[:, 0].argsort()
        if len(starts) > 2:
            by_x = by_x[starts.searchsorted(by_x, side="right").argsort(kind="stable")]
        linked = kernels("fgtrack.tracking.kernels").linked
        leads, apart = linked(points_m, by_x, starts, self.distance_m * margin)
        return leads, apart

    def groups(self, points_m: FloatArray) -> dict[int, tuple[int, ...]]:
        """See `Merge.groups`. The first member leads a group; groups are in the order of their first members."""
        leads, _ = self._linked(points_m, np.array([0, len(points_m)]))
        members: dict[int, list[int]] = {}
        for index, lead in enumerate(leads.tolist()):
            members.setdefault(lead, []).append(index)
        return {lead: tuple(group) for lead, group in members.items()}

"""The detections of one batch in the map frame, as arrays: errors of the pose in them, and merging."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fgtrack.core.geometry import circular_mean, rotations
from fgtrack.core.linalg import congruence, kernels
from fgtrack.core.types import BoolArray, Detection, FloatArray, IntArray
from fgtrack.models.measurement import ANGULAR, COMPONENTS, MIN_RANGE_M, MeasurementModel, SensorPose
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.inbox import Batch, own_covariance

X, YAW, RANGE, BEARING, CURVATURE = map(
    COMPONENTS.index, ("x_m", "yaw_rad", "range_m", "bearing_rad", "curvature_radpm")
)


class MapDetections(NamedTuple):
    """Detections of one batch with their components in the map frame."""

    batch: Batch
    sensor: SensorModel
    pose: SensorPose
    """Pose that they are seen from."""
    indices: IntArray
    """Positions in the message, shape (m,)."""
    values: FloatArray
    """In the order of `COMPONENTS`, shape (m, 8); NaN where there is none."""
    points_m: FloatArray
    """Positions in the map, shape (m, 2); NaN where only a bearing was measured."""
    map_yaw: BoolArray
    """True where the yaw is that of the map, shape (m,)."""
    merged: Mapping[int, tuple[int, ...]] = MappingProxyType({})
    """Positions of the detections that end as merged, by that of the detection which leads them."""
    averaged: "Mapping[int, MapDetections]" = MappingProxyType({})
    """Detections of which the values are averages, by the position of the leading one."""

    @property
    def placed(self) -> IntArray:
        """Indices of those with a position."""
        x_m = self.points_m[:, 0]
        return np.asarray((x_m == x_m).nonzero()[0])  # NaN is not equal to itself

    @property
    def detections(self) -> list[Detection]:
        """The detections as received."""
        return list(map(self.batch.message.objects.__getitem__, self.indices.tolist()))

    def at(self, rows: IntArray | BoolArray) -> "MapDetections":
        """Return the detections at `rows`."""
        return self._replace(
            indices=self.indices[rows],
            values=self.values[rows],
            points_m=self.points_m[rows],
            map_yaw=self.map_yaw[rows],
        )


def in_map_frame(batch: Batch, sensor: SensorModel, pose: SensorPose) -> MapDetections:
    """The detections of `batch`, what `sensor` measures of them, seen from `pose`."""
    values = np.full((len(batch.indices), len(COMPONENTS)), np.nan)
    measured = tuple(sensor.std)
    if batch.indices:
        read = map(attrgetter(*measured), map(batch.message.objects.__getitem__, batch.indices))
        values[:, _columns(measured)] = np.array(list(read), dtype=np.float64).reshape(len(values), -1)
    points_m = kernels("fgtrack.tracking.kernels").to_map(values, *pose[:3], batch.message.frame != "map")
    none = np.zeros(len(values), dtype=bool)
    return MapDetections(batch, sensor, pose, np.array(batch.indices, dtype=np.int64), values, points_m, none)


def move_back(items: MapDetections, by_m: float) -> None:
    """Move all positions away from the sensor by `by_m`, along the line of sight."""
    offsets_m = items.points_m - np.array(items.pose[:2])
    ranges_m = np.hypot(offsets_m[:, 0], offsets_m[:, 1])
    moves_m = by_m * offsets_m / np.maximum(ranges_m, MIN_RANGE_M)[:, None]
    items.points_m[:] += moves_m
    items.values[:, :2] += moves_m
    items.values[:, RANGE] += by_m


def merged(items: MapDetections, merge: "Merge") -> MapDetections:
    """Return `items` with those of one object averaged, in the order of the merge; bearings alone are last.
    Averaged are the components that all have; where none of these gives a position, the leading one stands for all.
    """
    placed = items.placed.tolist()
    groups = merge.groups(items.points_m if len(placed) == len(items.indices) else items.points_m[placed])
    if groups is None:
        if len(placed) == len(items.indices):
            return items
        groups = dict(enumerate(zip(range(len(placed)))))
    rows = list(map(placed.__getitem__, groups))
    if len(placed) < len(items.indices):
        rows += np.isnan(items.points_m[:, 0]).nonzero()[0].tolist()
    result, claimed = items.at(np.array(rows, dtype=np.int64)), set(groups)
    others, averaged = dict[int, tuple[int, ...]](), dict[int, MapDetections]()
    for row, members in enumerate(groups.values()):
        if len(members) == 1:
            continue
        index = int(result.indices[row])
        new = [member for member in members if member not in claimed]
        claimed.update(new)
        others[index] = tuple(items.indices[[placed[member] for member in new]].tolist())
        parts = items.at(np.array([placed[member] for member in members]))
        columns = np.flatnonzero(~np.isnan(parts.values).any(axis=0)).tolist()
        if X in columns or (RANGE in columns and BEARING in columns):
            averaged[index] = parts
            result.values[row] = np.nan
            result.values[row, columns] = [merge.mean(COMPONENTS[k], parts.values[:, k]) for k in columns]
            result.points_m[row] = parts.points_m.mean(axis=0)
            result.map_yaw[row] = parts.map_yaw.any()
    return result._replace(merged=others, averaged=averaged)


def covariances(items: MapDetections, names: tuple[str, ...]) -> FloatArray:
    """Covariances of `names` in the map, shape (m, k, k): a detection's own where it has one, else the sensor's R.
    What the map gave has the sensor's standard deviation for it and is not correlated with the rest. The covariance of
    an average is the mean of those of its detections.
    """
    sensor, pose, m = items.sensor, items.pose, len(items.indices)
    R = np.repeat(sensor.noise(names)[None], m, axis=0)
    turns = "x_m" in names and not sensor.round
    offsets_m = items.points_m - np.array(pose[:2]) if turns or sensor.std_growth else items.points_m
    more = sensor.growth(names, np.hypot(offsets_m[:, 0], offsets_m[:, 1])) if sensor.std_growth else None
    if more is not None:
        R[:, np.arange(len(names)), np.arange(len(names))] += more
    carrying = []
    for row, detection in enumerate(items.detections if sensor.message_covariance else ()):
        if detection.covariance is not None:
            carrying.append(row)
            carried = [name for name in names if name in detection.measured and name in sensor.std]
            here = [names.index(name) for name in carried]
            R[row][np.ix_(here, here)] = own_covariance(detection, carried)
    if carrying and "x_m" in names and items.batch.message.frame != "map":
        R[carrying] = _turned(R[carrying], np.full(len(carrying), pose.yaw_rad))
    if turns and len(carrying) < m:
        rest = np.delete(np.arange(m), carrying)
        R[rest] = _turned(R[rest], np.arctan2(offsets_m[rest, 1], offsets_m[rest, 0]))
    for row, index in enumerate(items.indices.tolist() if items.averaged else ()):
        if index in items.averaged:
            R[row] = covariances(items.averaged[index], names).mean(axis=0)
    return R


@cache
def _columns(names: tuple[str, ...]) -> list[int]:
    return [COMPONENTS.index(name) for name in names]


def _turned(R: FloatArray, yaws_rad: FloatArray) -> FloatArray:
    """R with its position blocks, and the correlations of the position with the rest, turned by `yaws_rad` (m,)."""
    turns = np.zeros(R.shape)
    diagonal = np.arange(R.shape[-1])
    turns[:, diagonal, diagonal] = 1.0
    turns[:, :2, :2] = rotations(yaws_rad)
    return congruence(turns, R)


class PoseError(NamedTuple):
    """The error e of a sensor pose in the innovation z - h(x, pose) = ... + G e of a detection.
    e is the estimated pose minus the true one, of x, y, yaw, vx and vy of the sensor, the same for all detections of a
    batch. It enters z where the detection was placed in the map by the pose, and h where it is relative to the sensor.
    """

    covariance: FloatArray
    """Covariance of e, shape (5, 5)."""
    placement: FloatArray
    """Derivative of z by the pose, shape (m, k, 5)."""
    R: FloatArray
    """Covariances of the detections themselves, without e, shape (m, k, k)."""

    def at(self, rows: IntArray | list[int]) -> "PoseError":
        """Return that of some detections."""
        return PoseError(self.covariance, self.placement[rows], self.R[rows])

    def noise(self, model: MeasurementModel, pose: SensorPose, x: FloatArray) -> FloatArray:
        """R + G P_e G' at the states `x` (m, n), shape (m, k, k)."""
        G = self.placement - model.pose_jacobian(x, pose) if model.relative else self.placement
        return np.asarray(kernels("fgtrack.tracking.kernels").with_pose_error(G, self.covariance, self.R))


class Merge:
    """Finds detections of one list that are the same object, and averages them."""

    def groups(self, points_m: FloatArray) -> dict[int, tuple[int, ...]] | None:
        """Members of all groups of `points_m` (n, 2), by the point that leads it; None if each stands for itself."""
        return None

    def mean(self, name: str, values: FloatArray) -> float:
        """Average of component `name`; of angles on the circle."""
        return circular_mean(values) if name in ANGULAR else float(values.sum() / len(values))


@dataclass(frozen=True)
class NoMerge(Merge):
    """Every detection stands for itself."""

    kind: Literal["none"] = "none"


@dataclass(frozen=True)
class ConnectedMerge(Merge):
    """Joins detections that are linked by steps of at most a distance."""

    distance_m: float
    """Detections at most this far apart are linked."""
    kind: Literal["connected"] = "connected"

    def groups(self, points_m: FloatArray) -> dict[int, tuple[int, ...]] | None:
        """See `Merge.groups`; in the order of their first members, which lead."""
        num, far = len(points_m), True
        if num > 1:
            by_x = points_m[np.argsort(points_m[:, 0])]
            far = kernels("fgtrack.tracking.kernels").are_apart(by_x, self.distance_m * (1.0 + 1e-9))
        if far:
            return None
        links = cKDTree(points_m).query_pairs(self.distance_m, output_type="ndarray")
        graph = coo_array((np.ones(len(links), dtype=np.int8), links.T), shape=(num, num))
        labels = connected_components(graph, directed=False)[1]
        members: dict[int, list[int]] = {}
        for index, label in enumerate(labels.tolist()):
            members.setdefault(label, []).append(index)
        return {group[0]: tuple(group) for group in members.values()}

"""The detections of one batch in the map frame, as arrays."""

import math
from collections.abc import Sequence
from functools import cache
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import Real, rotations, wrap_angles
from fgtrack.core.linalg import congruence
from fgtrack.core.types import MEASURABLE, BoolArray, Detection, FloatArray, Frame, IntArray
from fgtrack.models.measurement import COMPONENTS, MIN_RANGE_M, SensorPose
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.inbox import Batch, own_covariance

X, Y, YAW, RANGE, BEARING, CURVATURE = (
    COMPONENTS.index(name) for name in ("x_m", "y_m", "yaw_rad", "range_m", "bearing_rad", "curvature_radpm")
)
_VALUES = attrgetter(*MEASURABLE)
_FEW = 6  # so many points are moved faster one by one


class MapDetections(NamedTuple):
    """Detections with their components in the map frame."""

    indices: IntArray
    """Positions in the message, shape (m,)."""
    detections: list[Detection]
    values: FloatArray
    """In the order of `COMPONENTS`, shape (m, 8); NaN where there is none."""
    points_m: FloatArray
    """Positions in the map, shape (m, 2); NaN where only a bearing was measured."""
    map_yaw: BoolArray
    """True where the yaw is that of the map, shape (m,)."""

    @property
    def placed(self) -> IntArray:
        """Indices of those with a position."""
        x_m = self.points_m[:, 0]
        return np.asarray((x_m == x_m).nonzero()[0])  # NaN is not equal to itself

    def at(self, rows: IntArray | BoolArray) -> "MapDetections":
        """Return the detections at `rows`."""
        chosen = np.arange(len(self.indices))[rows].tolist()
        detections = [self.detections[row] for row in chosen]
        return MapDetections(self.indices[rows], detections, self.values[rows], self.points_m[rows], self.map_yaw[rows])

    def kinds(self) -> list[tuple[int, ...]]:
        """Columns of the components that each has."""
        known = self.values == self.values  # NaN is not equal to itself
        if len(known) and (len(known) == 1 or bool((known == known[0]).all())):
            return [tuple(known[0].nonzero()[0].tolist())] * len(known)
        rows, columns = known.nonzero()
        found: list[list[int]] = [[] for _ in self.detections]
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            found[row].append(column)
        return list(map(tuple, found))


def in_map_frame(batch: Batch, sensor: SensorModel, pose: SensorPose) -> MapDetections:
    """The detections of `batch`, what `sensor` measures of them, seen from `pose`."""
    detections = [batch.message.objects[index] for index in batch.indices]
    values = np.full((len(detections), len(COMPONENTS)), np.nan)
    if detections:
        values[:, : len(MEASURABLE)] = [_VALUES(detection) for detection in detections]
    for column in _unmeasured(tuple(sensor.std)):
        values[:, column] = np.nan
    if batch.frame != "map":
        if "yaw_rad" in sensor.std:
            values[:, YAW] = wrap_angles(values[:, YAW] + pose.yaw_rad)
        if "x_m" in sensor.std:
            _move_to_map(values[:, :2], pose)
    points_m = values[:, :2].copy()
    if "range_m" in sensor.std:
        polar = np.isnan(points_m[:, 0])
        range_m, bearing_rad = values[polar, RANGE], values[polar, BEARING]
        points_m[polar, 0], points_m[polar, 1] = _in_map(
            range_m * np.cos(bearing_rad), range_m * np.sin(bearing_rad), pose
        )
    none = np.zeros(len(detections), dtype=bool)
    return MapDetections(np.array(batch.indices, dtype=np.int64), detections, values, points_m, none)


def move_back(items: MapDetections, pose: SensorPose, by_m: float) -> None:
    """Move all positions away from the sensor at `pose` by `by_m`, along the line of sight."""
    offsets_m = items.points_m - np.array([pose.x_m, pose.y_m])
    ranges_m = np.hypot(offsets_m[:, 0], offsets_m[:, 1])
    moves_m = by_m * offsets_m / np.maximum(ranges_m, MIN_RANGE_M)[:, None]
    items.points_m[:] += moves_m
    items.values[:, :2] += moves_m
    items.values[:, RANGE] += by_m


def take_map_yaw(items: MapDetections, rows: IntArray | slice, yaw_rad: FloatArray) -> None:
    """Give those of `rows` that have no yaw that of the map, shape (m,)."""
    given = items.values[rows, YAW]
    lack = given != given  # NaN is not equal to itself
    if False in lack.tolist():
        rows, yaw_rad = np.arange(len(items.indices))[rows][lack], yaw_rad[lack]
    items.values[rows, YAW] = yaw_rad
    items.map_yaw[rows] = True


def covariances(
    items: MapDetections, names: tuple[str, ...], frame: Frame, sensor: SensorModel, pose: SensorPose
) -> FloatArray:
    """Covariances of `names` in the map, shape (m, k, k): a detection's own where it has one, else the sensor's R.

    What the map gave has the sensor's standard deviation for it and is not correlated with the rest.
    """
    shared = sensor.noise(names)
    R = np.empty((len(items.indices), *shared.shape))
    R[:] = shared
    offsets_m = items.points_m - np.array([pose.x_m, pose.y_m])
    more = sensor.growth(names, np.hypot(offsets_m[:, 0], offsets_m[:, 1])) if sensor.std_growth else None
    if more is not None:
        R[:, np.arange(len(names)), np.arange(len(names))] += more
    carrying = []
    if sensor.message_covariance:
        carrying = [row for row, detection in enumerate(items.detections) if detection.covariance is not None]
        for row in carrying:
            measured = items.detections[row].measured
            carried = [name for name in names if name in measured and name in sensor.std]
            here = [names.index(name) for name in carried]
            R[row][np.ix_(here, here)] = own_covariance(items.detections[row], carried)
    if "x_m" not in names:
        return R
    if frame != "map" and carrying:
        R[carrying] = _turned(R[carrying], np.full(len(carrying), pose.yaw_rad))
    if not sensor.round and len(carrying) < len(R):
        rest = np.delete(np.arange(len(R)), carrying)
        R[rest] = _turned(R[rest], np.arctan2(offsets_m[rest, 1], offsets_m[rest, 0]))
    return R


def common(kinds: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    """The columns that are in all of `kinds`."""
    return tuple(column for column in kinds[0] if all(column in other for other in kinds[1:]))


@cache
def _unmeasured(names: tuple[str, ...]) -> tuple[int, ...]:
    """Columns of what is not among `names`."""
    return tuple(column for column, name in enumerate(MEASURABLE) if name not in names)


def _move_to_map(points_m: FloatArray, pose: SensorPose) -> None:
    """Let `points_m` (m, 2), seen from `pose`, be points of the map."""
    if len(points_m) > _FEW:
        points_m[:, 0], points_m[:, 1] = _in_map(points_m[:, 0], points_m[:, 1], pose)
        return
    for point_m, (x_m, y_m) in zip(points_m, points_m.tolist(), strict=True):
        point_m[0], point_m[1] = _in_map(x_m, y_m, pose)


def _in_map(x_m: Real, y_m: Real, pose: SensorPose) -> tuple[Real, Real]:
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return pose.x_m + c * x_m - s * y_m, pose.y_m + s * x_m + c * y_m


def _turned(R: FloatArray, yaws_rad: FloatArray) -> FloatArray:
    """R with its position blocks, and the correlations of the position with the rest, turned by `yaws_rad` (m,)."""
    turns = np.zeros(R.shape)
    places = np.arange(R.shape[-1])
    turns[:, places, places] = 1.0
    turns[:, :2, :2] = rotations(yaws_rad)
    return congruence(turns, R)

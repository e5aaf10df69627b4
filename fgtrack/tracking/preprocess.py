"""From the detections of one batch to what can be associated: map frame, on the road, merged."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple, Protocol

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fgtrack.core.geometry import circular_mean, rotation, wrap_angle
from fgtrack.core.types import MEASURABLE, Detection, Disposition, FloatArray, UpdateRecord
from fgtrack.estimation.base import Measurement
from fgtrack.models.measurement import SensorPose, measured_position, measurement_model
from fgtrack.models.motion import MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.inbox import Batch


@dataclass(frozen=True, slots=True)
class Candidate:
    """A detection, or several merged ones, ready for association."""

    index: int
    """Position, in the message, of the detection that carries the outcome."""
    merged: tuple[int, ...]
    """Positions of the others that were merged into it and have no outcome of their own."""
    measurement: Measurement
    position_m: FloatArray | None
    """Position in the map, shape (2,); None where only a bearing was measured."""
    position_covariance: FloatArray | None
    """Shape (2, 2)."""
    values: Mapping[str, float]
    """Measured components by name, in the map frame."""


class Group(NamedTuple):
    """Detections that count as one."""

    first: int
    members: tuple[int, ...]


class Merge(Protocol):
    """Finds detections of one list that are the same object, and averages them."""

    def groups(self, points_m: FloatArray) -> list[Group]:
        """All of `points_m` (n, 2), in groups; a single point is a group of its own."""

    def mean(self, name: str, values: FloatArray) -> float:
        """Average of component `name`."""


@dataclass(frozen=True)
class ConnectedMerge:
    """Joins detections that are linked by steps of at most a distance; yaw is averaged on the circle."""

    kind: Literal["connected"] = "connected"
    distance_m: float = 5.1

    def groups(self, points_m: FloatArray) -> list[Group]:
        """See `Merge.groups`; in the order of their first members."""
        count = len(points_m)
        if count < 2:
            return [Group(i, (i,)) for i in range(count)]
        pairs = cKDTree(points_m).query_pairs(self.distance_m, output_type="ndarray")
        if not len(pairs):
            return [Group(i, (i,)) for i in range(count)]
        links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        _, labels = connected_components(links, directed=False)
        members: dict[int, list[int]] = {}
        for index, label in enumerate(labels.tolist()):
            members.setdefault(label, []).append(index)
        return [Group(group[0], tuple(group)) for group in members.values()]

    def mean(self, name: str, values: FloatArray) -> float:
        """See `Merge.mean`."""
        if name in ("yaw_rad", "bearing_rad"):
            return circular_mean(values)
        return float(values.sum() / len(values))


@dataclass(frozen=True)
class NoMerge:
    """Every detection stands for itself."""

    kind: Literal["none"] = "none"

    def groups(self, points_m: FloatArray) -> list[Group]:
        """See `Merge.groups`."""
        return [Group(i, (i,)) for i in range(len(points_m))]

    def mean(self, name: str, values: FloatArray) -> float:
        """See `Merge.mean`; of one value."""
        return float(values[0])


@dataclass(frozen=True, slots=True)
class _MapDetection:
    """A detection with its components in the map frame."""

    index: int
    values: dict[str, float]
    point_m: tuple[float, float] | None
    """Position in the map; None where only a bearing was measured."""


class Preprocess:
    """Transformation to the map, false-positive filter and merge (Karle et al. 2023, sections III-B and III-C)."""

    def __init__(self, road: Road, merge: Merge, motion: MotionModel, detection_origin_m: tuple[float, float]) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point."""
        self._road = road
        self._merge = merge
        self._motion = motion
        self._origin_m = detection_origin_m
        self._noises: dict[tuple[int, tuple[str, ...]], tuple[SensorModel, FloatArray]] = {}

    def __call__(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> tuple[list[Candidate], list[UpdateRecord]]:
        """Candidates in the order of the merge, and the records of detections that are out of bounds.

        `ego` is the pose at the batch's stamp; it may be None for detections in the map frame.
        """
        pose = self._sensor_pose(batch, sensor, ego)
        located = [self._locate(index, batch, sensor, pose) for index in batch.indices]
        near, records = _in_range(located, batch, sensor, pose) if ego is not None else (located, [])
        inside, outside = self._on_road(near, batch, sensor)
        return self._candidates(inside, batch, sensor, pose), records + outside

    def _sensor_pose(self, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> SensorPose:
        """Pose of the frame that the detections are given in."""
        if ego is None:
            return SensorPose()
        yaw_rad = ego.yaw_rad
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        x_m, y_m = self._origin_m
        if batch.frame == "sensor":
            x_m, y_m = x_m + sensor.mount.x_m, y_m + sensor.mount.y_m
            yaw_rad += sensor.mount.yaw_rad
        return SensorPose(
            ego.x_m + c * x_m - s * y_m,
            ego.y_m + s * x_m + c * y_m,
            yaw_rad,
            ego.speed_mps * c,
            ego.speed_mps * s,
        )

    def _locate(self, index: int, batch: Batch, sensor: SensorModel, pose: SensorPose) -> _MapDetection:
        detection = batch.message.objects[index]
        values: dict[str, float] = {}
        for name in sensor.std:
            value = getattr(detection, name)
            if value is not None:
                values[name] = float(value)
        if "x_m" in values:
            if batch.frame != "map":
                values["x_m"], values["y_m"] = _in_map(values["x_m"], values["y_m"], pose)
                if "yaw_rad" in values:
                    values["yaw_rad"] = wrap_angle(values["yaw_rad"] + pose.yaw_rad)
            return _MapDetection(index, values, (values["x_m"], values["y_m"]))
        if "range_m" not in values:
            return _MapDetection(index, values, None)
        range_m, bearing_rad = values["range_m"], values["bearing_rad"]
        ahead, left = range_m * math.cos(bearing_rad), range_m * math.sin(bearing_rad)
        return _MapDetection(index, values, _in_map(ahead, left, pose))

    def _on_road(
        self, located: list[_MapDetection], batch: Batch, sensor: SensorModel
    ) -> tuple[list[_MapDetection], list[UpdateRecord]]:
        """Drop what lies outside the bounds, and take the map heading for a yaw that was not measured."""
        placed = [item for item in located if item.point_m is not None]
        if not self._road.known or not placed:
            return located, []
        view = self._road.view(np.array([item.point_m for item in placed]))
        outside = [item.index for item, out in zip(placed, view.outside.tolist(), strict=True) if out]
        if sensor.yaw_from_map_std_rad is not None:
            for item, yaw_rad in zip(placed, view.yaw_rad.tolist(), strict=True):
                item.values.setdefault("yaw_rad", yaw_rad)
        if not outside:
            return located, []
        records = [batch.record(index, Disposition.OUT_OF_BOUNDS) for index in outside]
        gone = set(outside)
        return [item for item in located if item.index not in gone], records

    def _candidates(
        self, located: list[_MapDetection], batch: Batch, sensor: SensorModel, pose: SensorPose
    ) -> list[Candidate]:
        placed = [item for item in located if item.point_m is not None]
        groups = self._merge.groups(np.array([item.point_m for item in placed]).reshape(-1, 2))
        led = {group.first for group in groups}
        candidates = []
        claimed: set[int] = set()
        for group in groups:
            others = [i for i in group.members if i not in led and i not in claimed]
            claimed.update(others)
            merged = tuple(placed[i].index for i in others)
            parts = [placed[i] for i in group.members]
            candidates.append(self._candidate(placed[group.first].index, merged, parts, batch, sensor, pose))
        bearings = [item for item in located if item.point_m is None]
        return candidates + [self._candidate(item.index, (), [item], batch, sensor, pose) for item in bearings]

    def _candidate(
        self,
        index: int,
        merged: tuple[int, ...],
        parts: Sequence[_MapDetection],
        batch: Batch,
        sensor: SensorModel,
        pose: SensorPose,
    ) -> Candidate:
        """One detection, or the average of several over what all of them measure, if that says where they are."""
        names = _common_names(parts)
        if len(parts) > 1 and "x_m" not in names and not {"range_m", "bearing_rad"} <= set(names):
            parts = [part for part in parts if part.index == index]
            names = _common_names(parts)
        R = self._noise(sensor, names)
        covariances = [_covariance(batch.message.objects[p.index], sensor, R, names, p, batch, pose) for p in parts]
        if len(parts) == 1:
            values, R, point_m = parts[0].values, covariances[0], parts[0].point_m
        else:
            values = {n: self._merge.mean(n, np.array([part.values[n] for part in parts])) for n in names}
            R = np.asarray(np.mean(covariances, axis=0))
            x_m, y_m = np.mean([part.point_m for part in parts if part.point_m is not None], axis=0).tolist()
            point_m = (x_m, y_m)
        values = {name: values[name] for name in names}
        z = np.array(list(values.values()))
        position = measured_position(names, z, R, pose)
        return Candidate(
            index,
            merged,
            Measurement(batch.stamp_ns, measurement_model(names, self._motion), z, R, pose, sensor.loss),
            None if point_m is None else np.array(point_m),
            None if position is None else position[1],
            values,
        )

    def _noise(self, sensor: SensorModel, names: tuple[str, ...]) -> FloatArray:
        """The sensor's own R of `names`, read-only: one array for each sensor and set of components."""
        key = id(sensor), names
        if key not in self._noises:
            R = sensor.noise(names)
            R.flags.writeable = False
            self._noises[key] = sensor, R  # an id is unique as long as its owner is kept
        return self._noises[key][1]


def _in_range(
    located: list[_MapDetection], batch: Batch, sensor: SensorModel, pose: SensorPose
) -> tuple[list[_MapDetection], list[UpdateRecord]]:
    """Drop what lies further from the sensor than it can be trusted."""
    limit_m = sensor.max_range_m
    if limit_m is None:
        return located, []
    far = {
        item.index
        for item in located
        if item.point_m is not None and math.hypot(item.point_m[0] - pose.x_m, item.point_m[1] - pose.y_m) > limit_m
    }
    records = [batch.record(item.index, Disposition.OUT_OF_BOUNDS) for item in located if item.index in far]
    return [item for item in located if item.index not in far], records


def _common_names(parts: Sequence[_MapDetection]) -> tuple[str, ...]:
    return _in_order(frozenset(parts[0].values).intersection(*[part.values for part in parts[1:]]))


@cache
def _in_order(names: frozenset[str]) -> tuple[str, ...]:
    """`names` in the order of `MEASURABLE`."""
    return tuple(name for name in MEASURABLE if name in names)


def _in_map(x_m: float, y_m: float, pose: SensorPose) -> tuple[float, float]:
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return pose.x_m + c * x_m - s * y_m, pose.y_m + s * x_m + c * y_m


def _covariance(
    detection: Detection,
    sensor: SensorModel,
    R: FloatArray,
    names: tuple[str, ...],
    item: _MapDetection,
    batch: Batch,
    pose: SensorPose,
) -> FloatArray:
    """Covariance of `names` in the map: the detection's own where it has one, else the sensor's R.

    A yaw that the map gave has the sensor's standard deviation for it and is not correlated with the rest.
    """
    if detection.covariance is None or not sensor.message_covariance:
        if "x_m" in names and item.point_m is not None and sensor.std["x_m"] != sensor.std["y_m"]:
            x_m, y_m = item.point_m
            R = _turned(R, math.atan2(y_m - pose.y_m, x_m - pose.x_m))
        return R
    measured = detection.measured
    own = np.array(detection.covariance).reshape(len(measured), len(measured))
    common = [name for name in names if name in measured and name in sensor.std]
    here = [names.index(name) for name in common]
    there = [measured.index(name) for name in common]
    R = R.copy()
    R[np.ix_(here, here)] = own[np.ix_(there, there)]
    return _turned(R, pose.yaw_rad) if "x_m" in names and batch.frame != "map" else R


def _turned(R: FloatArray, yaw_rad: float) -> FloatArray:
    """R with its position block, and the correlations of the position with the rest, turned by `yaw_rad`."""
    turn = np.eye(len(R))
    turn[:2, :2] = rotation(yaw_rad)
    return turn @ R @ turn.T

"""From the detections of one batch to what can be associated: map frame, on the road, merged."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fgtrack.core.geometry import circular_mean, parent_from_child, rotation, wrap_angle
from fgtrack.core.types import MEASURABLE, Detection, Disposition, FloatArray, UpdateRecord
from fgtrack.estimation.base import Measurement
from fgtrack.models.measurement import SensorPose, measurement_model
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


@dataclass(frozen=True, slots=True)
class Group:
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
class Located:
    """A detection with its components in the map frame."""

    index: int
    values: dict[str, float]
    R: FloatArray
    position_m: FloatArray | None
    position_covariance: FloatArray | None


class Preprocess:
    """Transformation to the map, false-positive filter and merge (Karle et al. 2023, sections III-B and III-C)."""

    def __init__(self, road: Road, merge: Merge, motion: MotionModel, detection_origin_m: tuple[float, float]) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point."""
        self._road = road
        self._merge = merge
        self._motion = motion
        self._origin_m = np.array([detection_origin_m])

    def __call__(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> tuple[list[Candidate], list[UpdateRecord]]:
        """Candidates in the order of the merge, and the records of detections that are out of bounds.

        `ego` is the pose at the batch's stamp; it may be None for detections in the map frame.
        """
        pose = self._sensor_pose(batch, sensor, ego)
        located = [
            self._locate(index, batch.message.objects[index], sensor, pose, batch.frame == "map")
            for index in batch.indices
        ]
        inside, records = self._on_road(located, batch, sensor)
        return self._merged(inside, batch, pose), records

    def _sensor_pose(self, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> SensorPose:
        if ego is None:
            return SensorPose()
        vx, vy = ego.speed_mps * math.cos(ego.yaw_rad), ego.speed_mps * math.sin(ego.yaw_rad)
        origin = parent_from_child(self._origin_m, (ego.x_m, ego.y_m), ego.yaw_rad)
        yaw_rad = ego.yaw_rad
        if batch.frame == "sensor":
            mount = sensor.mount
            origin = parent_from_child(np.array([[mount.x_m, mount.y_m]]), tuple(origin[0]), yaw_rad)
            yaw_rad += mount.yaw_rad
        return SensorPose(float(origin[0, 0]), float(origin[0, 1]), yaw_rad, vx, vy)

    def _locate(self, index: int, detection: Detection, sensor: SensorModel, pose: SensorPose, in_map: bool) -> Located:
        names = tuple(name for name in sensor.components if getattr(detection, name) is not None)
        values = {name: float(getattr(detection, name)) for name in names}
        R = _noise(detection, sensor, names)
        if "x_m" not in values:
            return _located_polar(index, values, R, names, pose)
        point = np.array([[values["x_m"], values["y_m"]]])
        if not in_map:
            point = parent_from_child(point, (pose.x_m, pose.y_m), pose.yaw_rad)
            values["x_m"], values["y_m"] = float(point[0, 0]), float(point[0, 1])
            if "yaw_rad" in values:
                values["yaw_rad"] = wrap_angle(values["yaw_rad"] + pose.yaw_rad)
        _turn_position(R, _axes_yaw(detection, sensor, point[0], pose, in_map))
        return Located(index, values, R, point[0], R[:2, :2])

    def _on_road(
        self, located: list[Located], batch: Batch, sensor: SensorModel
    ) -> tuple[list[Located], list[UpdateRecord]]:
        """Drop what lies outside the bounds, and take the map heading for a yaw that was not measured."""
        placed = [i for i, item in enumerate(located) if item.position_m is not None]
        if not self._road.known or not placed:
            return located, []
        view = self._road.view(np.array([located[i].position_m for i in placed]))
        outside = {i for i, out in zip(placed, view.outside.tolist(), strict=True) if out}
        records = [batch.record(located[i].index, Disposition.OUT_OF_BOUNDS) for i in sorted(outside)]
        if sensor.yaw_from_map_std_rad is not None:
            for i, yaw_rad in zip(placed, view.yaw_rad.tolist(), strict=True):
                if i not in outside and "yaw_rad" not in located[i].values:
                    located[i] = _with_yaw(located[i], yaw_rad, sensor.yaw_from_map_std_rad)
        return [item for i, item in enumerate(located) if i not in outside], records

    def _merged(self, located: list[Located], batch: Batch, pose: SensorPose) -> list[Candidate]:
        placed = [item for item in located if item.position_m is not None]
        bearings = [item for item in located if item.position_m is None]
        groups = self._merge.groups(np.array([item.position_m for item in placed]).reshape(-1, 2))
        led = {group.first for group in groups}
        candidates = []
        claimed: set[int] = set()
        for group in groups:
            others = [i for i in group.members if i not in led and i not in claimed]
            claimed.update(others)
            parts = [placed[i] for i in group.members]
            candidates.append(
                self._candidate(placed[group.first].index, [placed[i].index for i in others], parts, batch, pose)
            )
        candidates += [self._candidate(item.index, [], [item], batch, pose) for item in bearings]
        return candidates

    def _candidate(
        self, index: int, merged: list[int], parts: Sequence[Located], batch: Batch, pose: SensorPose
    ) -> Candidate:
        names = tuple(name for name in parts[0].values if all(name in part.values for part in parts))
        if len(parts) == 1:
            values, R, position_m = parts[0].values, parts[0].R, parts[0].position_m
            position_covariance = parts[0].position_covariance
        else:
            values = {name: self._merge.mean(name, np.array([part.values[name] for part in parts])) for name in names}
            R = np.mean([_select(part, names) for part in parts], axis=0)
            position_m = _average([part.position_m for part in parts])
            position_covariance = _average([part.position_covariance for part in parts])
        measurement = Measurement(
            batch.stamp_ns,
            measurement_model(names, self._motion),
            np.array([values[name] for name in names]),
            R,
            pose,
        )
        return Candidate(index, tuple(merged), measurement, position_m, position_covariance, values)


def _noise(detection: Detection, sensor: SensorModel, names: tuple[str, ...]) -> FloatArray:
    """R of the used components: the detection's own covariance where it has one, else the sensor's deviations."""
    if detection.covariance is None or not sensor.message_covariance:
        return sensor.noise(names)
    measured = detection.measured
    own = np.array(detection.covariance).reshape(len(measured), len(measured))
    used = [measured.index(name) for name in names]
    return np.ascontiguousarray(own[np.ix_(used, used)])


def _axes_yaw(detection: Detection, sensor: SensorModel, point_m: FloatArray, pose: SensorPose, in_map: bool) -> float:
    """Direction, in the map, of the axes that R's position block is given in; 0 where it does not matter."""
    if detection.covariance is not None and sensor.message_covariance:
        return 0.0 if in_map else pose.yaw_rad
    if sensor.std["x_m"] == sensor.std["y_m"]:
        return 0.0
    return math.atan2(point_m[1] - pose.y_m, point_m[0] - pose.x_m)


def _turn_position(R: FloatArray, yaw_rad: float) -> None:
    """Turn the position block of R, and its correlations with the rest, by `yaw_rad`, in place."""
    if yaw_rad:
        turn = rotation(yaw_rad)
        R[:2] = turn @ R[:2]
        R[:, :2] = R[:, :2] @ turn.T


def _located_polar(
    index: int, values: dict[str, float], R: FloatArray, names: tuple[str, ...], pose: SensorPose
) -> Located:
    """A detection by range and bearing, or by a bearing alone; its measurement stays in the sensor frame."""
    if "range_m" not in values:
        return Located(index, values, R, None, None)
    yaw_rad = pose.yaw_rad + values["bearing_rad"]
    axes = rotation(yaw_rad)
    range_m = values["range_m"]
    point = np.array([pose.x_m, pose.y_m]) + range_m * axes[:, 0]
    polar = [names.index("range_m"), names.index("bearing_rad")]
    arm = axes * np.array([1.0, range_m])
    return Located(index, values, R, point, arm @ R[np.ix_(polar, polar)] @ arm.T)


def _with_yaw(item: Located, yaw_rad: float, std_rad: float) -> Located:
    """`item` with a yaw that is not correlated with the rest."""
    names = [name for name in MEASURABLE if name in item.values or name == "yaw_rad"]
    values = {name: item.values.get(name, yaw_rad) for name in names}
    place = names.index("yaw_rad")
    R = np.zeros((len(values), len(values)))
    rest = [i for i in range(len(values)) if i != place]
    R[np.ix_(rest, rest)] = item.R
    R[place, place] = std_rad**2
    return Located(item.index, values, R, item.position_m, item.position_covariance)


def _average(arrays: Sequence[FloatArray | None]) -> FloatArray:
    return np.asarray(np.mean([array for array in arrays if array is not None], axis=0))


def _select(part: Located, names: tuple[str, ...]) -> FloatArray:
    own = tuple(part.values)
    used = [own.index(name) for name in names]
    return part.R[np.ix_(used, used)]

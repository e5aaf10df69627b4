"""From the detections of one batch to what can be associated: map frame, on the road, merged."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import body_point, body_point_jacobian, rotation, wrap_angle
from fgtrack.core.linalg import congruence
from fgtrack.core.types import MEASURABLE, Detection, Disposition, FloatArray, UpdateRecord
from fgtrack.estimation.base import Measurement
from fgtrack.models.correlated_errors import split_error
from fgtrack.models.measurement import RELATIVE, SensorPose, measured_position, measurement_model
from fgtrack.models.motion import MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.inbox import Batch, own_covariance, record
from fgtrack.tracking.merge import Merge
from fgtrack.tracking.pose_error import PoseError, placement

_FAR_M = 1e6


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
    pose_error: PoseError | None = None
    """What the ego's uncertainty does to the measurement; None where it is not considered. `measurement.R` includes it
    as far as the detection alone tells."""

    def noise_at(self, x: FloatArray) -> FloatArray:
        """Covariance of the measurement of an object at the states `x` (..., n), (..., k, k) or (k, k) for all."""
        own = self.measurement
        if self.pose_error is None or not own.model.relative:
            return own.R
        return self.pose_error.noise(own.model, own.pose, x)

    def measurement_at(self, x: FloatArray) -> Measurement:
        """The measurement of an object at the state `x`, shape (n,)."""
        R = self.noise_at(x)
        return self.measurement if R is self.measurement.R else replace(self.measurement, R=R)


@dataclass(frozen=True, slots=True)
class MapDetection:
    """A detection with its components in the map frame."""

    index: int
    detection: Detection
    values: dict[str, float]
    point_m: tuple[float, float] | None
    """Position in the map; None where only a bearing was measured."""


class _View(NamedTuple):
    """A batch, and where its sensor saw it from."""

    batch: Batch
    sensor: SensorModel
    pose: SensorPose
    pose_covariance: FloatArray | None
    """Of the entries of `pose`, shape (5, 5); None where it is not considered, or matters to no detection."""


class Preprocess:
    """Transformation to the map, false-positive filter and merge (Karle et al. 2023, sections III-B and III-C)."""

    def __init__(self, road: Road, merge: Merge, motion: MotionModel, detection_origin_m: tuple[float, float]) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point."""
        self._road = road
        self._merge = merge
        self._motion = motion
        self._origin_m = detection_origin_m

    def __call__(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> tuple[list[Candidate], list[UpdateRecord]]:
        """Candidates in the order of the merge, and the records of detections that are out of bounds.

        `ego` is the pose at the batch's stamp; it may be None for detections in the map frame.
        """
        pose = self._sensor_pose(batch, sensor, ego)
        view = _View(batch, sensor, pose, _pose_covariance(pose, batch, sensor, ego))
        located = [_located(index, batch, sensor, pose) for index in batch.indices]
        far = [] if ego is None else _out_of_range(located, sensor, pose)
        located = [item for item in located if item.index not in far]
        outside = self._off_road(located, sensor)
        located = [item for item in located if item.index not in outside]
        records = [record(batch.message, index, Disposition.OUT_OF_BOUNDS) for index in far + outside]
        return self._candidates(located, view), records

    def _sensor_pose(self, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> SensorPose:
        """Pose of the frame that the detections are given in, and the velocity of its origin."""
        if ego is None:
            return SensorPose()
        yaw_rad = ego.yaw_rad
        x_m, y_m = self._origin_m
        if batch.frame == "sensor":
            x_m, y_m = x_m + sensor.mount.x_m, y_m + sensor.mount.y_m
            yaw_rad += sensor.mount.yaw_rad
        x_m, y_m, vx_mps, vy_mps = body_point(*ego[:5], x_m, y_m)
        return SensorPose(float(x_m), float(y_m), yaw_rad, float(vx_mps), float(vy_mps))

    def _off_road(self, located: list[MapDetection], sensor: SensorModel) -> list[int]:
        """Indices of what lies outside the bounds; a yaw that was not measured becomes the map heading."""
        placed = [item for item in located if item.point_m is not None]
        if not self._road.known or not placed:
            return []
        view = self._road.view(np.array([item.point_m for item in placed]))
        if sensor.yaw_from_map_std_rad is not None:
            for item, yaw_rad in zip(placed, view.yaw_rad.tolist(), strict=True):
                item.values.setdefault("yaw_rad", yaw_rad)
        return [item.index for item, out in zip(placed, view.outside.tolist(), strict=True) if out]

    def _candidates(self, located: list[MapDetection], view: _View) -> list[Candidate]:
        placed = [item for item in located if item.point_m is not None]
        groups = self._merge.groups(np.array([item.point_m for item in placed]).reshape(-1, 2))
        candidates = []
        claimed = set(groups)
        for leader, members in groups.items():
            merged = [i for i in members if i not in claimed]
            claimed.update(merged)
            others = tuple(placed[i].index for i in merged)
            parts = [placed[i] for i in members]
            candidates.append(self._candidate(placed[leader], others, parts, view))
        bearings = [item for item in located if item.point_m is None]
        return candidates + [self._candidate(item, (), [item], view) for item in bearings]

    def _candidate(
        self, leader: MapDetection, merged: tuple[int, ...], parts: Sequence[MapDetection], view: _View
    ) -> Candidate:
        """One detection, or the average of several over what all of them measure, if that says where they are."""
        batch, sensor, pose, _ = view
        names = _common_names(parts)
        if len(parts) > 1 and "x_m" not in names and not {"range_m", "bearing_rad"} <= set(names):
            parts = [leader]
            names = _common_names(parts)
        covariances = [_covariance(part, names, batch, sensor, pose) for part in parts]
        if len(parts) == 1:
            values, R, point_m = leader.values, covariances[0], leader.point_m
        else:
            values = {n: self._merge.mean(n, np.array([part.values[n] for part in parts])) for n in names}
            R = np.asarray(np.mean(covariances, axis=0))
            x_m, y_m = np.mean([part.point_m for part in parts if part.point_m is not None], axis=0).tolist()
            point_m = (x_m, y_m)
        values = {name: values[name] for name in names}
        assumed = self._assumed(parts, names, sensor)
        z = np.array(list(values.values()))
        model = measurement_model(names, self._motion)
        model, white = split_error(batch.sensor, sensor, model, R, self._motion.state_names)
        measurement = Measurement(batch.stamp_ns, model, z, white, pose, sensor.loss, assumed)
        error = self._pose_error(measurement, point_m, view)
        if error is not None:
            x = np.zeros(self._motion.dim)
            x[:2] = _far_along(values["bearing_rad"], pose) if point_m is None else point_m
            measurement = replace(measurement, R=error.noise(model, pose, x))
            R = R + (measurement.R - white)
        found = measured_position(names, z, R, pose)
        return Candidate(
            leader.index,
            merged,
            measurement,
            None if point_m is None else np.array(point_m),
            None if found is None else found[1],
            values,
            error,
        )

    def _pose_error(
        self, measurement: Measurement, point_m: tuple[float, float] | None, view: _View
    ) -> PoseError | None:
        """How the error of the sensor pose enters a measurement at `point_m` in the map."""
        if view.pose_covariance is None:
            return None
        names, pose = measurement.model.components, view.pose
        if view.batch.frame == "map":
            placed = np.zeros((len(names), len(pose)))
        else:
            offset_m = (0.0, 0.0) if point_m is None else (point_m[0] - pose.x_m, point_m[1] - pose.y_m)
            placed = placement(names, offset_m, measurement.assumed)
        return PoseError(view.pose_covariance, placed, measurement.R)

    def _assumed(self, parts: Sequence[MapDetection], names: tuple[str, ...], sensor: SensorModel) -> tuple[str, ...]:
        """Those of `names` that not all `parts` measured: a yaw that the map gave."""
        if sensor.yaw_from_map_std_rad is None or "yaw_rad" not in names:
            return ()
        measured = "yaw_rad" in sensor.std and all(part.detection.yaw_rad is not None for part in parts)
        return () if measured else ("yaw_rad",)


def _located(index: int, batch: Batch, sensor: SensorModel, pose: SensorPose) -> MapDetection:
    detection = batch.message.objects[index]
    values = {name: float(value) for name in sensor.std if (value := getattr(detection, name)) is not None}
    if "yaw_rad" in values and batch.frame != "map":
        values["yaw_rad"] = wrap_angle(values["yaw_rad"] + pose.yaw_rad)
    point_m = None
    if "x_m" in values:
        if batch.frame != "map":
            values["x_m"], values["y_m"] = _in_map(values["x_m"], values["y_m"], pose)
        point_m = values["x_m"], values["y_m"]
    elif "range_m" in values:
        range_m, bearing_rad = values["range_m"], values["bearing_rad"]
        point_m = _in_map(range_m * math.cos(bearing_rad), range_m * math.sin(bearing_rad), pose)
    return MapDetection(index, detection, values, point_m)


def _pose_covariance(pose: SensorPose, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> FloatArray | None:
    """Covariance of `pose` by that of the ego, shape (5, 5); None where it matters to no detection of `batch`."""
    if ego is None or ego.covariance is None:
        return None
    if batch.frame == "map" and not any(name in RELATIVE for name in sensor.std):
        return None
    arm_m, velocity_mps = (pose.x_m - ego.x_m, pose.y_m - ego.y_m), (pose.vx_mps, pose.vy_mps)
    return congruence(body_point_jacobian(ego.yaw_rad, arm_m, velocity_mps), ego.covariance)


def _far_along(bearing_rad: float, pose: SensorPose) -> tuple[float, float]:
    """A place in the map so far along a line of sight that the place of the sensor no longer matters."""
    angle_rad = pose.yaw_rad + bearing_rad
    return pose.x_m + _FAR_M * math.cos(angle_rad), pose.y_m + _FAR_M * math.sin(angle_rad)


def _out_of_range(located: list[MapDetection], sensor: SensorModel, pose: SensorPose) -> list[int]:
    """Indices of what lies further from the sensor than it can be trusted."""
    limit_m = math.inf if sensor.max_range_m is None else sensor.max_range_m
    return [
        item.index
        for item in located
        if item.point_m is not None and math.hypot(item.point_m[0] - pose.x_m, item.point_m[1] - pose.y_m) > limit_m
    ]


def _common_names(parts: Sequence[MapDetection]) -> tuple[str, ...]:
    return _in_order(frozenset(parts[0].values).intersection(*[part.values for part in parts[1:]]))


@cache
def _in_order(names: frozenset[str]) -> tuple[str, ...]:
    """`names` in the order of `MEASURABLE`."""
    return tuple(name for name in MEASURABLE if name in names)


def _in_map(x_m: float, y_m: float, pose: SensorPose) -> tuple[float, float]:
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return pose.x_m + c * x_m - s * y_m, pose.y_m + s * x_m + c * y_m


def _covariance(
    item: MapDetection, names: tuple[str, ...], batch: Batch, sensor: SensorModel, pose: SensorPose
) -> FloatArray:
    """Covariance of `names` in the map: the detection's own where it has one, else the sensor's R.

    A yaw that the map gave has the sensor's standard deviation for it and is not correlated with the rest.
    """
    R = sensor.noise(names)
    if item.detection.covariance is None or not sensor.message_covariance:
        if "x_m" in names and item.point_m is not None and sensor.std["x_m"] != sensor.std["y_m"]:
            x_m, y_m = item.point_m
            R = _turned(R, math.atan2(y_m - pose.y_m, x_m - pose.x_m))
        return R
    measured = item.detection.measured
    common = [name for name in names if name in measured and name in sensor.std]
    here = [names.index(name) for name in common]
    R = R.copy()
    R[np.ix_(here, here)] = own_covariance(item.detection, common)
    return _turned(R, pose.yaw_rad) if "x_m" in names and batch.frame != "map" else R


def _turned(R: FloatArray, yaw_rad: float) -> FloatArray:
    """R with its position block, and the correlations of the position with the rest, turned by `yaw_rad`."""
    turn = np.eye(len(R))
    turn[:2, :2] = rotation(yaw_rad)
    return congruence(turn, R)

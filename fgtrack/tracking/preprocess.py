"""From the detections of one batch to candidates for association: map frame, on the road, merged."""

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import body_point, body_point_jacobian
from fgtrack.core.linalg import congruence, equal_ones
from fgtrack.core.types import BoolArray, Disposition, FloatArray, UpdateRecord
from fgtrack.estimation.base import Measurement
from fgtrack.models.correlated_errors import split_error
from fgtrack.models.measurement import (
    COMPONENTS,
    RELATIVE,
    SensorPose,
    measured_position,
    measurement_model,
)
from fgtrack.models.motion import MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.detections import (
    CURVATURE,
    YAW,
    MapDetections,
    Merge,
    PoseError,
    covariances,
    in_map_frame,
    merged,
    move_back,
    placement,
)
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.inbox import Batch, record

_FAR_M = 1e6


class Candidate(NamedTuple):
    """A detection, or several merged ones, ready for association."""

    leader: int
    """Position, in the message, of the detection that carries the outcome."""
    merged: tuple[int, ...]
    """Positions of the others that were merged into it and have no outcome of their own."""
    measurement: Measurement
    position_m: FloatArray | None
    """Position in the map, shape (2,); None where only a bearing was measured."""
    position_covariance: FloatArray | None
    """Shape (2, 2)."""
    pose_error: PoseError | None = None
    """Error of the ego in the measurement; None where it is not considered. `measurement.R` includes it
    as far as the detection alone tells."""

    @property
    def values(self) -> dict[str, float]:
        """Measured components by name, in the map frame."""
        return dict(zip(self.measurement.model.components, self.measurement.z.tolist(), strict=True))

    def measurement_at(self, x: FloatArray) -> Measurement:
        """The measurement of an object at the state `x` (n,); its R is (..., k, k) at states (..., n)."""
        own = self.measurement
        if self.pose_error is None or not own.model.relative:
            return own
        return replace(own, R=self.pose_error.noise(own.model, own.pose, x))


class Preprocess:
    """Transformation to the map, false-positive filter and merge (Karle et al. 2023, sections III-B and III-C)."""

    def __init__(
        self,
        road: Road,
        merge: Merge,
        motion: MotionModel,
        detection_origin_m: tuple[float, float],
        assumes_map_yaw: bool = True,
    ) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point.

        `assumes_map_yaw`: a yaw that the map gave is prior knowledge; as published it counts as measured, in the
        innovations and their NIS.
        """
        self._road = road
        self._merge = merge
        self._motion = motion
        self._origin_m = detection_origin_m
        self._assumes_map_yaw = assumes_map_yaw

    def __call__(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> tuple[list[Candidate], list[UpdateRecord]]:
        """Candidates in the order of the merge, and the records of detections that are out of bounds.

        `ego` is the pose at the batch's stamp; it may be None for detections in the map frame.
        """
        pose = self._sensor_pose(batch, sensor, ego)
        items, lost = in_map_frame(batch, sensor, pose), dict[int, str]()
        if sensor.filters:
            names = [sensor.refusing(detection) for detection in items.detections]
            lost = {index: f"filters.{name}" for index, name in zip(batch.indices, names, strict=True) if name}
            items = items.at(np.array([name is None for name in names], dtype=bool)) if lost else items
        if ego is not None and sensor.max_range_m is not None:
            offsets_m = items.points_m - np.array(pose[:2])
            far = np.hypot(offsets_m[:, 0], offsets_m[:, 1]) > sensor.max_range_m
            items = _without(items, far, "max_range_m", lost)
        if ego is not None and sensor.near_side_m:
            move_back(items, sensor.near_side_m)
        items = merged(self._on_road(items, lost), self._merge)
        records = []
        for index, reason in lost.items():
            records.append(replace(record(batch.message, index, Disposition.OUT_OF_BOUNDS), reason=reason))
        return self._candidates(items, _pose_covariance(pose, batch, sensor, ego)), records

    def _sensor_pose(self, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> SensorPose:
        """Pose of the frame that the detections are given in, and the velocity of its origin.

        Of detections in the map the pose that they are seen from: that of the ego, without one the map's origin.
        """
        if ego is None:
            return SensorPose()
        yaw_rad = ego.yaw_rad
        x_m, y_m = self._origin_m
        if batch.message.frame == "sensor":
            x_m, y_m = x_m + sensor.placed.x_m, y_m + sensor.placed.y_m
            yaw_rad += sensor.placed.yaw_rad
        x_m, y_m, vx_mps, vy_mps = body_point(*ego[:5], x_m, y_m)
        return SensorPose(float(x_m), float(y_m), yaw_rad, float(vx_mps), float(vy_mps))

    def _on_road(self, items: MapDetections, lost: dict[int, str]) -> MapDetections:
        """Return the detections inside the bounds, with yaw and curvature of the map; `lost` gets the rest."""
        placed = items.placed
        if not self._road.known or not len(placed):
            return items
        view = self._road.view(items.points_m[placed])
        if items.sensor.yaw_from_map_std_rad is not None:
            lack = np.isnan(items.values[placed, YAW])
            items.values[placed[lack], YAW] = view.yaw_rad[lack]
            items.map_yaw[placed[lack]] = True
        if items.sensor.curvature_from_map_std_radpm is not None:
            items.values[placed, CURVATURE] = view.curvature_radpm
        outside = np.zeros(len(items.indices), dtype=bool)
        outside[placed] = view.outside
        return _without(items, outside, "map.track", lost)

    def _candidates(self, items: MapDetections, pose_covariance: FloatArray | None) -> list[Candidate]:
        """Candidates of `items` in their order; those that measure the same components are made together."""
        measured = ~np.isnan(items.values)
        kinds = list(zip(map(tuple, measured.tolist()), (items.map_yaw & measured[:, YAW]).tolist(), strict=True))
        if len(set(kinds)) <= 1:
            return self._alike(items, pose_covariance) if kinds else []
        candidates: dict[int, Candidate] = {}
        for rows in equal_ones(kinds):
            candidates.update(zip(rows, self._alike(items.at(np.array(rows)), pose_covariance), strict=True))
        return [candidates[row] for row in range(len(kinds))]

    def _alike(self, items: MapDetections, pose_covariance: FloatArray | None) -> list[Candidate]:
        """Candidates of `items`, which all measure the same components; `pose_covariance` is that of the pose."""
        batch, sensor, pose, points_m = items.batch, items.sensor, items.pose, items.points_m
        columns = (items.values[0] == items.values[0]).nonzero()[0]  # NaN is not equal to itself
        names = _names(tuple(columns.tolist()))
        assumed: tuple[str, ...] = ("yaw_rad",) if self._assumes_map_yaw and YAW in columns and items.map_yaw[0] else ()
        assumed += ("curvature_radpm",) if CURVATURE in columns else ()
        z, R, model = (
            items.values.take(columns, axis=1),
            covariances(items, names),
            measurement_model(names, self._motion),
        )
        models, white = [model] * len(z), R
        if sensor.correlation is not None:
            split = [split_error(batch.message.sensor, sensor, model, one, self._motion.state_names) for one in R]
            models, white = [each for each, _ in split], np.array([noise for _, noise in split])
        total, is_placed = white, not math.isnan(points_m[0, 0])  # all or none
        own: Iterable[PoseError | None] = [None] * len(z)
        if pose_covariance is not None:
            G = np.zeros((len(z), len(names), len(pose)))
            if batch.message.frame != "map":
                G = placement(names, points_m - np.array(pose[:2]), assumed)
            x = points_m
            if models[0].relative:
                x = np.zeros((len(z), self._motion.dim))
                x[:, :2] = points_m if is_placed else _far_along(z[:, names.index("bearing_rad")], pose)
            total = PoseError(pose_covariance, G, white).noise(models[0], pose, x)
            R, own = R + (total - white), map(partial(PoseError, pose_covariance), G, white)
        spreads: Iterable[FloatArray | None]
        spreads = R[:, :2, :2] if names[:2] == ("x_m", "y_m") else map(partial(_spread, names, pose), z, R)
        positions_m: Iterable[FloatArray | None] = points_m if is_placed else [None] * len(z)
        candidates, indices = [], items.indices.tolist()
        for index, each, mean, noise, point_m, spread, error in zip(
            indices, models, z, total, positions_m, spreads, own, strict=True
        ):
            measurement = Measurement(batch.stamp_ns, each, mean, noise, pose, sensor.loss, assumed)
            candidates.append(Candidate(index, items.merged.get(index, ()), measurement, point_m, spread, error))
        return candidates


def _without(items: MapDetections, outside: BoolArray, reason: str, lost: dict[int, str]) -> MapDetections:
    """`items` without those `outside`, shape (m,), whose indices `lost` gets with the `reason`."""
    if not outside.any():
        return items
    lost |= dict.fromkeys(items.indices[outside].tolist(), reason)
    return items.at(~outside)


@cache
def _names(columns: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(COMPONENTS[column] for column in columns)


def _spread(names: tuple[str, ...], pose: SensorPose, z: FloatArray, R: FloatArray) -> FloatArray | None:
    position = measured_position(names, z, R, pose)
    return None if position is None else position[1]


def _pose_covariance(pose: SensorPose, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> FloatArray | None:
    """Covariance of `pose` by that of the ego, shape (5, 5); None where it matters to no detection of `batch`."""
    if ego is None or ego.covariance is None:
        return None
    if batch.message.frame == "map" and not any(name in RELATIVE for name in sensor.std):
        return None
    arm_m, velocity_mps = (pose.x_m - ego.x_m, pose.y_m - ego.y_m), (pose.vx_mps, pose.vy_mps)
    return congruence(body_point_jacobian(ego.yaw_rad, arm_m, velocity_mps), ego.covariance)


def _far_along(bearings_rad: FloatArray, pose: SensorPose) -> list[tuple[float, float]]:
    """Points so far along lines of sight (m,) that the position of the sensor no longer matters."""
    angles_rad = [pose.yaw_rad + bearing_rad for bearing_rad in bearings_rad.tolist()]
    return [(pose.x_m + _FAR_M * math.cos(angle), pose.y_m + _FAR_M * math.sin(angle)) for angle in angles_rad]

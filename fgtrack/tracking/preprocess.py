"""From the detections of one batch to candidates for association: map frame, on the road, merged."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import body_point, body_point_jacobian
from fgtrack.core.linalg import congruence
from fgtrack.core.types import BoolArray, Disposition, FloatArray, UpdateRecord
from fgtrack.estimation.base import Measurement
from fgtrack.models.areas import ExclusionAreas
from fgtrack.models.correlated_errors import split_error
from fgtrack.models.measurement import (
    COMPONENTS,
    RELATIVE,
    MeasurementModel,
    SensorPose,
    measured_position,
    measurement_model,
)
from fgtrack.models.motion import MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.detections import (
    BEARING,
    CURVATURE,
    RANGE,
    YAW,
    MapDetections,
    Merge,
    PoseError,
    X,
    covariances,
    in_map_frame,
    move_back,
    placement,
    take_map_yaw,
)
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.inbox import Batch, record

_FAR_M = 1e6
_NO_AREAS = ExclusionAreas(())


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
    """Error of the ego in the measurement; None where it is not considered. `measurement.R` includes it
    as far as the detection alone tells."""

    def noise_at(self, x: FloatArray) -> FloatArray:
        """Covariance of the measurement of an object at the states `x` (..., n), (..., k, k) or (k, k) for all."""
        own = self.measurement
        if self.pose_error is None or not own.model.relative:
            return own.R
        return self.pose_error.noise(own.model, own.pose, x)

    def measurement_at(self, x: FloatArray) -> Measurement:
        """The measurement of an object at the state `x`, shape (n,)."""
        if self.pose_error is None or not self.measurement.model.relative:
            return self.measurement
        return replace(self.measurement, R=self.noise_at(x))


class _View(NamedTuple):
    """A batch, and where its sensor saw it from."""

    batch: Batch
    sensor: SensorModel
    pose: SensorPose
    pose_covariance: FloatArray | None
    """Covariance of the entries of `pose`, shape (5, 5); None where not considered, or of no effect."""


class _Group(NamedTuple):
    """Detections that are one object, as rows of `MapDetections`."""

    leader: int
    merged: tuple[int, ...]
    """Detections without an outcome of their own."""
    parts: tuple[int, ...]
    """Detections that are averaged."""
    columns: tuple[int, ...]
    """Components that are averaged."""


class Preprocess:
    """Transformation to the map, false-positive filter and merge (Karle et al. 2023, sections III-B and III-C)."""

    def __init__(
        self,
        road: Road,
        merge: Merge,
        motion: MotionModel,
        detection_origin_m: tuple[float, float],
        excluded: ExclusionAreas = _NO_AREAS,
    ) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point."""
        self._road = road
        self._merge = merge
        self._motion = motion
        self._origin_m = detection_origin_m
        self._excluded = excluded

    def __call__(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> tuple[list[Candidate], list[UpdateRecord]]:
        """Candidates in the order of the merge, and the records of detections that are out of bounds.

        `ego` is the pose at the batch's stamp; it may be None for detections in the map frame.
        """
        pose = self._sensor_pose(batch, sensor, ego)
        view = _View(batch, sensor, pose, _pose_covariance(pose, batch, sensor, ego))
        items = in_map_frame(batch, sensor, pose)
        lost = dict[int, str]()
        if sensor.filters:
            names = [sensor.refusing(detection) for detection in items.detections]
            lost = {index: f"filters.{name}" for index, name in zip(batch.indices, names, strict=True) if name}
            items = items.at(np.array([name is None for name in names], dtype=bool)) if lost else items
        if ego is not None and sensor.max_range_m is not None:
            offsets_m = items.points_m - np.array([pose.x_m, pose.y_m])
            far = np.hypot(offsets_m[:, 0], offsets_m[:, 1]) > sensor.max_range_m
            items = _without(items, far, "max_range_m", lost)
        if self._excluded.polygons_m:
            items = _without(items, self._excluded.contain(items.points_m), "map.excluded", lost)
        if ego is not None and sensor.near_side_m:
            move_back(items, pose, sensor.near_side_m)
        items = self._on_road(items, sensor, lost)
        records = []
        for index, reason in lost.items():
            records.append(replace(record(batch.message, index, Disposition.OUT_OF_BOUNDS), reason=reason))
        return self._candidates(items, view), records

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

    def _on_road(self, items: MapDetections, sensor: SensorModel, lost: dict[int, str]) -> MapDetections:
        """Return the detections inside the bounds, with yaw and curvature of the map; `lost` gets the rest."""
        placed = items.placed
        if not self._road.known or not len(placed):
            return items
        all_placed = len(placed) == len(items.indices)
        view = self._road.view(items.points_m if all_placed else items.points_m[placed])
        if sensor.yaw_from_map_std_rad is not None:
            take_map_yaw(items, slice(None) if all_placed else placed, view.yaw_rad)
        if sensor.curvature_from_map_std_radpm is not None:
            items.values[placed, CURVATURE] = view.curvature_radpm
        if not any(view.outside.tolist()):
            return items
        outside = np.zeros(len(items.indices), dtype=bool)
        outside[placed[view.outside]] = True
        return _without(items, outside, "map.track", lost)

    def _candidates(self, items: MapDetections, view: _View) -> list[Candidate]:
        placed = items.placed
        groups = self._merge.groups(items.points_m if len(placed) == len(items.indices) else items.points_m[placed])
        kinds = items.kinds()
        found: list[_Group] = []
        claimed = set(groups)
        rows = placed.tolist()
        for leader, members in groups.items():
            if len(members) == 1:
                row = rows[leader]
                found.append(_Group(row, (), (row,), kinds[row]))
                continue
            merged = [i for i in members if i not in claimed]
            claimed.update(merged)
            parts = tuple(rows[i] for i in members)
            columns = tuple(column for column in kinds[parts[0]] if all(column in kinds[row] for row in parts))
            if X not in columns and not {RANGE, BEARING} <= set(columns):  # nothing that all have says where they are
                parts = (rows[leader],)
                columns = kinds[rows[leader]]
            found.append(_Group(rows[leader], tuple(rows[i] for i in merged), parts, columns))
        if len(placed) < len(items.indices):
            found += [
                _Group(row, (), (row,), kinds[row]) for row in np.flatnonzero(np.isnan(items.points_m[:, 0])).tolist()
            ]
        return self._finished(items, found, view)

    def _finished(self, items: MapDetections, groups: Sequence[_Group], view: _View) -> list[Candidate]:
        """The candidates of `groups`; those that measure the same are made together."""
        map_yaw = items.map_yaw.tolist()
        alike: dict[tuple[tuple[int, ...], bool], list[int]] = {}
        for place, group in enumerate(groups):
            assumed = YAW in group.columns and any(map_yaw[row] for row in group.parts)
            alike.setdefault((group.columns, assumed), []).append(place)
        if len(alike) == 1:
            [(columns, assumed)] = alike
            return self._alike(items, groups, columns, assumed, view)
        candidates: dict[int, Candidate] = {}
        for (columns, assumed), places in alike.items():
            chosen = [groups[place] for place in places]
            candidates.update(zip(places, self._alike(items, chosen, columns, assumed, view), strict=True))
        return [candidates[place] for place in range(len(groups))]

    def _alike(
        self, items: MapDetections, groups: Sequence[_Group], columns: tuple[int, ...], assumed: bool, view: _View
    ) -> list[Candidate]:
        """Candidates that measure the same: one detection each, or the average of several."""
        names, pose = _names(columns), view.pose
        z, R, points_m = self._measured(items, groups, columns, view)
        bearings = math.isnan(points_m[0, 0])  # all or none: what measures the same is placed or not
        curved = ("curvature_radpm",) if CURVATURE in columns else ()
        assumes = self._assumed(assumed) + curved
        models, white = self._models(names, R, view)
        whole, errors = white, self._pose_errors(names, models[0], points_m, white, assumes, view)
        if errors is not None:
            x = points_m
            if models[0].relative:
                x = np.zeros((len(groups), self._motion.dim))
                x[:, :2] = points_m
                if bearings:
                    bearings_rad = z[:, names.index("bearing_rad")].tolist()
                    x[:, :2] = [_far_along(bearing_rad, pose) for bearing_rad in bearings_rad]
            whole = errors.noise(models[0], pose, x)
            R = R + (whole - white)
        spreads: Iterable[FloatArray | None]
        spreads = R[:, :2, :2] if names[:2] == ("x_m", "y_m") else map(partial(_spread, names, pose), z, R)
        places: Iterable[FloatArray | None] = [None] * len(groups) if bearings else points_m
        own: Iterable[PoseError | None] = [None] * len(groups)
        if errors is not None:
            own = map(partial(PoseError, errors.covariance), errors.placement, white)
        stamp_ns, loss, indices = view.batch.stamp_ns, view.sensor.loss, items.indices.tolist()
        return [
            Candidate(
                indices[group.leader],
                tuple([indices[row] for row in group.merged]) if group.merged else (),
                Measurement(stamp_ns, model, one, noise, pose, loss, assumes),
                point_m,
                spread,
                dict(zip(names, numbers, strict=True)),
                error,
            )
            for group, model, one, noise, point_m, spread, numbers, error in zip(
                groups, models, z, whole, places, spreads, z.tolist(), own, strict=True
            )
        ]

    def _measured(
        self, items: MapDetections, groups: Sequence[_Group], columns: tuple[int, ...], view: _View
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Means z (m, k), covariances R (m, k, k) and positions (m, 2) of `groups`, averaged over each."""
        names, frame, sensor, pose = _names(columns), view.batch.message.frame, view.sensor, view.pose
        leaders = np.array([group.leader for group in groups])
        z, points_m = items.values[leaders].take(columns, axis=1), items.points_m[leaders]
        order = leaders.tolist()
        every = len(order) == len(items.indices) and order == sorted(order)
        R = covariances(items if every else items.at(leaders), names, frame, sensor, pose)
        for place, group in enumerate(groups):
            if len(group.parts) > 1:
                parts = items.at(np.array(group.parts))
                z[place] = [
                    self._merge.mean(name, parts.values[:, column]) for name, column in zip(names, columns, strict=True)
                ]
                R[place] = covariances(parts, names, frame, sensor, pose).mean(axis=0)
                points_m[place] = parts.points_m.mean(axis=0)
        return z, R, points_m

    def _models(
        self, names: tuple[str, ...], R: FloatArray, view: _View
    ) -> tuple[Sequence[MeasurementModel], FloatArray]:
        """Measurement models of measurements with the covariances R (m, k, k), and those of the errors that are new."""
        model = measurement_model(names, self._motion)
        if view.sensor.correlation is None:
            return [model] * len(R), R
        split = [split_error(view.batch.message.sensor, view.sensor, model, one, self._motion.state_names) for one in R]
        return [each for each, _ in split], np.array([white for _, white in split])

    def _pose_errors(
        self,
        names: tuple[str, ...],
        model: MeasurementModel,
        points_m: FloatArray,
        white: FloatArray,
        assumed: tuple[str, ...],
        view: _View,
    ) -> PoseError | None:
        """Error of the sensor pose in measurements at `points_m` in the map, all stacked."""
        if view.pose_covariance is None:
            return None
        pose = view.pose
        if view.batch.message.frame == "map":
            placed = np.zeros((len(white), len(names), len(pose)))
        else:
            placed = placement(names, points_m - np.array([pose.x_m, pose.y_m]), assumed)
        return PoseError(view.pose_covariance, placed, white)

    def _assumed(self, map_yaw: bool) -> tuple[str, ...]:
        """Components that are prior knowledge: a yaw that the map gave."""
        return ("yaw_rad",) if map_yaw else ()


def _without(items: MapDetections, outside: BoolArray, reason: str, lost: dict[int, str]) -> MapDetections:
    """`items` without those `outside`, shape (m,), whose indices `lost` gets with the `reason`."""
    if True not in outside.tolist():
        return items
    lost |= dict.fromkeys(items.indices[outside].tolist(), reason)
    return items.at(~outside)


@cache
def _names(columns: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(COMPONENTS[column] for column in columns)


def _spread(names: tuple[str, ...], pose: SensorPose, z: FloatArray, R: FloatArray) -> FloatArray | None:
    found = measured_position(names, z, R, pose)
    return None if found is None else found[1]


def _pose_covariance(pose: SensorPose, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> FloatArray | None:
    """Covariance of `pose` by that of the ego, shape (5, 5); None where it matters to no detection of `batch`."""
    if ego is None or ego.covariance is None:
        return None
    if batch.message.frame == "map" and not any(name in RELATIVE for name in sensor.std):
        return None
    arm_m, velocity_mps = (pose.x_m - ego.x_m, pose.y_m - ego.y_m), (pose.vx_mps, pose.vy_mps)
    return congruence(body_point_jacobian(ego.yaw_rad, arm_m, velocity_mps), ego.covariance)


def _far_along(bearing_rad: float, pose: SensorPose) -> tuple[float, float]:
    """A place in the map so far along a line of sight that the place of the sensor no longer matters."""
    angle_rad = pose.yaw_rad + bearing_rad
    return pose.x_m + _FAR_M * math.cos(angle_rad), pose.y_m + _FAR_M * math.sin(angle_rad)

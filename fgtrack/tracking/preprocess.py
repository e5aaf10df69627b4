"""From the detections of one batch to candidates for association: map frame, on the road, merged."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from fgtrack.core.geometry import body_point
from fgtrack.core.linalg import congruence, equal_ones, kernels, symmetrise
from fgtrack.core.types import BoolArray, Disposition, FloatArray, IntArray, UpdateRecord
from fgtrack.estimation.base import Measurement, Measurements
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
    YAW,
    MapDetections,
    Merge,
    PoseError,
    covariances,
    in_map_frame,
    merged,
    move_back,
)
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.inbox import Batch, record

_FAR_M = 1e6
_STEP_S = 1e-3  # short enough for any motion, long enough for float64


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
    stamp_std_s: float = 0.0
    """Standard deviation of its stamp, of which nothing is in the covariances."""

    @property
    def values(self) -> dict[str, float]:
        """Measured components by name, in the map frame."""
        return dict(zip(self.measurement.model.components, self.measurement.z.tolist(), strict=True))


class StampError(NamedTuple):
    """The error of a stamp in the innovation: an object has moved by its velocity times the error."""

    motion: MotionModel
    std_s: float

    def rate(self, model: MeasurementModel, pose: SensorPose, x: FloatArray) -> FloatArray:
        """Derivative of h(x) by the stamp at the states `x` (..., n), shape (..., k): H dx/dt."""
        moved = model.predict(self.motion.predict(x, _STEP_S), pose)
        return model.residual(moved, model.predict(x, pose)) / _STEP_S

    def noise(self, model: MeasurementModel, pose: SensorPose, x: FloatArray, P: FloatArray) -> FloatArray:
        """Covariance sigma_t^2 E[v v'] of v = H dx/dt, shape (m, k, k), at the states `x` (m, n) with covariances `P`.
        E[v v'] = v(x) v(x)' + D P D' with D = dv/dx: the velocity of a new track is its uncertainty.
        """
        v = self.rate(model, pose, x)
        steps = 1e-3 * np.eye(x.shape[-1])
        D = np.stack([(self.rate(model, pose, x + step) - v) / step.sum() for step in steps], axis=-1)
        return self.std_s**2 * (v[..., :, None] * v[..., None, :] + symmetrise(congruence(D, P)))


class Group(NamedTuple):
    """Candidates that differ in their numbers alone."""

    rows: IntArray
    """Indices of the candidates, ascending, shape (m,)."""
    stack: Measurement
    """z (m, k), and R (m, k, k) with the error of the ego as far as the detections alone tell."""
    spread: FloatArray
    """Covariances of the detections with all their errors, shape (m, k, k)."""
    error: PoseError | None
    """Error of the ego in them, stacked; None where it is not considered."""
    stamp_error: StampError | None = None
    """Error of the stamp, of which nothing is in `stack` and `spread`; None where it is not considered."""

    def seen_at(self, members: IntArray, x: FloatArray, P: FloatArray, of: IntArray) -> Measurement:
        """The stack of some `members` (p,), of objects at the states `x` (p, n) with covariances P[of] (p, n, n)."""
        own, R = self.stack, self.stack.R[members]
        if self.error is not None and own.model.relative:
            R = self.error.at(members).noise(own.model, own.pose, x)
        if self.stamp_error is not None:
            R = R + self.stamp_error.noise(own.model, own.pose, x, P[of])
        return Measurement(own.stamp_ns, own.model, own.z[members], R, own.pose, own.loss, own.assumed)

    def position_covariances(self, members: IntArray) -> FloatArray:
        """Covariances of the positions in the map of some `members` (p,), which have one, shape (p, 2, 2)."""
        own, R = self.stack, self.spread[members]
        if own.model.components[:2] == ("x_m", "y_m"):
            return R[:, :2, :2]
        positions = [
            measured_position(own.model.components, z, C, own.pose) for z, C in zip(own.z[members], R, strict=True)
        ]
        return np.array([each[1] for each in positions if each is not None])


class Candidates(Sequence[Candidate]):
    """The candidates of a batch, in the order of the merge; each is made when it is asked for."""

    def __init__(
        self, leaders: list[int], merged: Mapping[int, tuple[int, ...]], lines: FloatArray, groups: list[Group]
    ) -> None:
        self.leaders, self.merged = leaders, merged
        """See `Candidate`; by leader."""
        self.lines = lines
        """Positions in the map and NaN, or the position of the sensor and the direction of a bearing, shape (m, 3)."""
        self.placed: list[bool] = np.isnan(lines[:, 2]).tolist()
        """True of those with a position."""
        self.groups = groups

    def __len__(self) -> int:
        return len(self.leaders)

    def __getitem__(self, index: Any) -> Any:  # Any: there are no slices
        leader, point = self.leaders[index], self.lines[index]
        [(group, members, _)] = self.split(np.array([index]))
        own = Measurements(group.stack)[members[0]]
        position = measured_position(own.model.components, own.z, group.spread[members[0]], own.pose)
        return Candidate(
            leader,
            self.merged.get(leader, ()),
            own,
            point[:2] if self.placed[index] else None,
            None if position is None else position[1],
            0.0 if group.stamp_error is None else group.stamp_error.std_s,
        )

    def split(self, chosen: IntArray) -> list[tuple[Group, IntArray, IntArray]]:
        """Return the groups, and of those of the candidates `chosen` (p,) in each the indices there and here."""
        if len(self.groups) == 1:
            return [(self.groups[0], chosen, np.arange(len(chosen)))]
        parts = []
        for group in self.groups:
            members = np.searchsorted(group.rows, chosen)
            here = np.flatnonzero(group.rows.take(members, mode="clip") == chosen)
            if len(here):
                parts.append((group, members[here], here))
        return parts

    def at(self, indices: Sequence[int]) -> "Candidates":
        """Return the candidates at `indices`."""
        groups = [
            Group(here, replace(own, z=own.z[m], R=own.R[m]), spread[m], error and error.at(m), stamp_error)
            for (_, own, spread, error, stamp_error), m, here in self.split(np.array(indices))
        ]
        return Candidates([self.leaders[i] for i in indices], self.merged, self.lines[indices], groups)


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

    def __call__(self, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> tuple[Candidates, list[UpdateRecord]]:
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
        if not self._road.known:
            return items
        view, x_m = self._road.view(items.points_m), items.points_m[:, 0]
        placed = x_m == x_m  # NaN, of a bearing alone, is not equal to itself
        if items.sensor.yaw_from_map_std_rad is not None:
            yaw_rad = items.values[:, YAW]
            items.map_yaw[:] = placed & (yaw_rad != yaw_rad)
            items.values[:, YAW] = np.where(items.map_yaw, view.yaw_rad, yaw_rad)
        if items.sensor.curvature_from_map_std_radpm is not None:
            items.values[placed, CURVATURE] = view.curvature_radpm[placed]
        return _without(items, view.outside & placed, "map.track", lost)

    def _candidates(self, items: MapDetections, pose_covariance: FloatArray | None) -> Candidates:
        """Candidates of `items` in their order; those that measure the same components are one group."""
        m = len(items.values)
        kinds = np.empty((m, len(COMPONENTS) + 1), dtype=bool)
        np.equal(items.values, items.values, out=kinds[:, :-1])  # NaN is not equal to itself
        np.logical_and(items.map_yaw, kinds[:, YAW], out=kinds[:, -1])
        if m < 2 or (kinds == kinds[0]).all():
            groups = list(self._groups(items, np.arange(m), pose_covariance))
        else:
            alike = map(np.array, equal_ones(list(map(tuple, kinds.tolist()))))
            groups = [group for rows in alike for group in self._groups(items.at(rows), rows, pose_covariance)]
        pose, lines = items.pose, np.full((m, 3), np.nan)
        lines[:, :2] = items.points_m
        for row in np.isnan(lines[:, 0]).nonzero()[0].tolist():
            lines[row] = pose.x_m, pose.y_m, pose.yaw_rad + items.values[row, BEARING]
        return Candidates(items.indices.tolist(), items.merged, lines, groups)

    def _groups(self, items: MapDetections, rows: IntArray, pose_covariance: FloatArray | None) -> Iterator[Group]:
        """Yield `items`, which are the candidates `rows` and all measure the same; one by one where errors last."""
        if not len(rows):
            return
        batch, sensor, pose, points_m = items.batch, items.sensor, items.pose, items.points_m
        measures = tuple((items.values[0] == items.values[0]).tolist())  # NaN is not equal to itself
        names, columns, assumed, placed = _components(measures, self._assumes_map_yaw and bool(items.map_yaw[0]))
        z, R = items.values.take(columns, axis=1), covariances(items, names)
        model = measurement_model(names, self._motion)
        models, white = [model], R
        if sensor.correlation is not None:
            split = [split_error(batch.message.sensor, sensor, model, item, self._motion.state_names) for item in R]
            models, white = [each for each, _ in split], np.array([noise for _, noise in split])
        total, error = white, None
        if pose_covariance is not None:
            placed = np.full(len(names), -1) if batch.message.frame == "map" else placed
            G = kernels("fgtrack.tracking.kernels").placement(points_m, pose.x_m, pose.y_m, placed)
            x = points_m
            if model.relative:
                x, is_placed = np.zeros((len(z), self._motion.dim)), not math.isnan(points_m[0, 0])  # all or none
                x[:, :2] = points_m if is_placed else _far_along(z[:, names.index("bearing_rad")], pose)
            error = PoseError(pose_covariance, G, white)
            total = error.noise(models[0], pose, x)
            R = total if white is R else R + (total - white)
        late = StampError(self._motion, sensor.stamp_std_s) if sensor.stamp_std_s else None
        whole = Group(
            rows, Measurement(batch.stamp_ns, models[0], z, total, pose, sensor.loss, assumed), R, error, late
        )
        if sensor.correlation is None:
            yield whole
            return
        for k, each in enumerate(models):
            item, m = Measurement(batch.stamp_ns, each, z[k : k + 1], total[k : k + 1], pose, sensor.loss, assumed), [k]
            yield Group(rows[m], item, R[m], error and error.at(m), late)


def _without(items: MapDetections, outside: BoolArray, reason: str, lost: dict[int, str]) -> MapDetections:
    """`items` without those `outside`, shape (m,), whose indices `lost` gets with the `reason`."""
    if not outside.any():
        return items
    lost |= dict.fromkeys(items.indices[outside].tolist(), reason)
    return items.at(~outside)


@cache
def _components(
    measures: tuple[bool, ...], assumes_yaw: bool
) -> tuple[tuple[str, ...], IntArray, tuple[str, ...], IntArray]:
    """Names and columns of the `COMPONENTS` that are measured, which are assumed, and columns; -1 of an assumed one."""
    names = tuple(compress(COMPONENTS, measures))
    known = {"curvature_radpm", "yaw_rad"} if assumes_yaw else {"curvature_radpm"}
    assumed, columns = tuple(name for name in names if name in known), np.flatnonzero(measures)
    return names, columns, assumed, np.where([name in assumed for name in names], -1, columns)


def _pose_covariance(pose: SensorPose, batch: Batch, sensor: SensorModel, ego: EgoPose | None) -> FloatArray | None:
    """Covariance of `pose` by that of the ego, shape (5, 5); None where it matters to no detection of `batch`."""
    if ego is None or ego.covariance is None:
        return None
    if batch.message.frame == "map" and not any(name in RELATIVE for name in sensor.std):
        return None
    body = ego.yaw_rad, pose.x_m - ego.x_m, pose.y_m - ego.y_m, pose.vx_mps, pose.vy_mps, ego.covariance
    return np.asarray(kernels("fgtrack.tracking.kernels").sensor_pose_covariance(*body))


def _far_along(bearings_rad: FloatArray, pose: SensorPose) -> list[tuple[float, float]]:
    """Points so far along lines of sight (m,) that the position of the sensor no longer matters."""
    angles_rad = [pose.yaw_rad + bearing_rad for bearing_rad in bearings_rad.tolist()]
    return [(pose.x_m + _FAR_M * math.cos(angle), pose.y_m + _FAR_M * math.sin(angle)) for angle in angles_rad]

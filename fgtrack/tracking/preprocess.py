"""From the detections of one batch to candidates for association: map frame, on the road, merged."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from fgtrack.core.geometry import body_point
from fgtrack.core.linalg import congruence, kernels, symmetrise
from fgtrack.core.types import (
    BoolArray,
    Detection,
    Disposition,
    FloatArray,
    IntArray,
    UpdateRecord,
)
from fgtrack.estimation.base import Lazy, Measurement, Measurements
from fgtrack.models.correlated_errors import split_error
from fgtrack.models.measurement import (
    COMPONENTS,
    MeasurementModel,
    SensorPose,
    measured_position,
    measurement_model,
)
from fgtrack.models.motion import MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.detections import (
    MapDetections,
    Merge,
    PosedBatch,
    PoseError,
    covariances,
    in_map_frame,
    merged,
    move_back,
)
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.inbox import Batch, merged_records, record

_FAR_M = 1e6
_STEP_S = 1e-5  # short enough for any motion, long enough for float64


class Candidate(NamedTuple):
    """A detection, or several merged ones, ready for association."""

    leader: int
    """Index in the message of the detection whose record has the outcome."""
    merged: tuple[int, ...]
    """Indices in the message of the detections that were merged into the leader and have no outcome of their own."""
    measurement: Measurement
    position_m: FloatArray | None
    """Position in the map, shape (2,); None if no position was measured."""
    position_covariance: FloatArray | None
    """Shape (2, 2)."""
    stamp_std_s: float = 0.0
    """Standard deviation of the stamp, which is not contained in the covariances."""

    @property
    def values(self) -> dict[str, float]:
        """Measured components by name, in the map frame."""
        return dict(
            zip(
                self.measurement.model.components,
                self.measurement.z.tolist(),
                strict=True,
            )
        )


class StampError(NamedTuple):
    """Part of the innovation that an error of the stamp causes: the velocity of the object times the error."""

    motion: MotionModel
    std_s: float

    def rate(
        self, model: MeasurementModel, pose: SensorPose, x: FloatArray
    ) -> FloatArray:
        """Return the derivative of h(x) by the stamp at the states `x` (..., n), shape (..., k)."""
        moved = model.predict(self.motion.predict(x, _STEP_S), pose)
        return model.residual(moved, model.predict(x, pose)) / _STEP_S

    def noise(
        self, model: MeasurementModel, pose: SensorPose, x: FloatArray, P: FloatArray
    ) -> FloatArray:
        """Return the covariance sigma_t^2 E[v v'], shape (m, k, k), at the states `x` (m, n) with covariances `P`.

        E[v v'] = v v' + D P D', where v is `rate` and D = dv/dx is the derivative of H F by time. For a new track D P
        D' is the larger part: its velocity is unknown.
        """
        v, (moved, F, _) = self.rate(model, pose, x), self.motion.transition(x, _STEP_S)
        D = (model.jacobian(moved, pose) @ F - model.jacobian(x, pose)) / _STEP_S
        return self.std_s**2 * (
            v[..., :, None] * v[..., None, :] + symmetrise(congruence(D, P))
        )


class Group(NamedTuple):
    """Candidates with the same components, which differ only in their numbers."""

    rows: IntArray
    """Indices of the candidates, ascending, shape (m,)."""
    stack: Measurement
    """z (m, k), and R (m, k, k) with the error of the ego as far as the detections alone give it."""
    spread: FloatArray
    """Covariances of the detections with all their errors, shape (m, k, k)."""
    error: PoseError | None
    """Error of the ego pose in the detections, stacked; None if it is not considered."""
    stamp_error: StampError | None = None
    """Error of the stamp, which is not contained in `stack` and `spread`; None if it is not considered."""

    def noise(
        self, members: IntArray, x: FloatArray, P: FloatArray, of: IntArray
    ) -> FloatArray:
        """Return R of `members` (p,) for objects at the states `x` (p, n) with covariances P[of] (p, n, n)."""
        own = self.stack
        R = own.R.take(members, axis=0)
        if self.error is not None and own.model.relative:
            R = self.error.at(members).noise(own.model, own.pose, x)
        if self.stamp_error is not None:
            R = R + self.stamp_error.noise(own.model, own.pose, x, P[of])
        return R

    @property
    def depends_on_state(self) -> bool:
        """True if `noise` depends on the states of the objects."""
        return self.stamp_error is not None or (
            self.error is not None and bool(self.stack.model.relative)
        )

    def seen_at(
        self, members: IntArray, x: FloatArray, P: FloatArray, of: IntArray
    ) -> Measurement:
        """Return the measurements of `members`, ascending, as one stack. The arguments are those of `noise`."""
        own = self.stack
        if len(members) == len(own.z) and not self.depends_on_state:
            return own
        z, R = own.z.take(members, axis=0), self.noise(members, x, P, of)
        return Measurement(
            own.stamp_ns, own.model, z, R, own.pose, own.loss, own.assumed
        )

    def position_covariances(self, members: IntArray) -> FloatArray:
        """Return the covariances of the positions of `members` (p,) in the map, shape (p, 2, 2).

        All members must have a position.
        """
        own, R = self.stack, self.spread.take(members, axis=0)
        if own.model.components[:2] == ("x_m", "y_m"):
            return R[:, :2, :2]
        positions = [
            measured_position(own.model.components, z, C, own.pose)
            for z, C in zip(own.z[members], R, strict=True)
        ]
        return np.array([each[1] for each in positions if each is not None]).reshape(
            -1, 2, 2
        )


class Candidates(Lazy[Candidate]):
    """The candidates of a batch, in the order of the merge."""

    def __init__(
        self,
        leaders: list[int],
        merged: Mapping[int, tuple[int, ...]],
        lines: FloatArray,
        groups: list[Group],
    ) -> None:
        self.leaders, self.merged = leaders, merged
        """See `Candidate`; by leader."""
        self.lines = lines
        """Positions in the map and NaN, or the position of the sensor and the direction of a bearing, shape (m, 3).
        The direction is infinity where there is neither."""
        self.placed: list[bool] = np.isnan(lines[:, 2]).tolist()
        """True of those with a position."""
        self.groups = groups

    def __len__(self) -> int:
        return len(self.leaders)

    def item(self, index: int) -> Candidate:
        """See `Lazy.item`."""
        leader, point = self.leaders[index], self.lines[index]
        [(group, members, _)] = self.split(np.array([index]))
        own = Measurements(group.stack)[members[0]]
        position = measured_position(
            own.model.components, own.z, group.spread[members[0]], own.pose
        )
        return Candidate(
            leader,
            self.merged.get(leader, ()),
            own,
            point[:2] if self.placed[index] else None,
            None if position is None else position[1],
            0.0 if group.stamp_error is None else group.stamp_error.std_s,
        )

    def records(
        self,
        batch: Batch,
        positions: Iterable[int],
        disposition: Disposition,
        track_id: int | None = None,
    ) -> list[tuple[UpdateRecord, ...]]:
        """Return the records of candidates of `batch`, each with the records of the detections that were merged into
        it.
        """
        message = batch.message
        return [
            (
                record(message, leader, disposition, track_id),
                *merged_records(message, self.merged.get(leader, ()), track_id),
            )
            for leader in [self.leaders[position] for position in positions]
        ]

    def described(self, batch: Batch, position: int) -> list[Detection]:
        """Return the detections of `batch` that were merged into the candidate at `position`."""
        leader, objects = self.leaders[position], batch.message.objects
        return [objects[index] for index in (leader, *self.merged.get(leader, ()))]

    def split(self, chosen: IntArray) -> list[tuple[Group, IntArray, IntArray]]:
        """Return each group that has candidates of `chosen` (p,), with their indices in the group and in `chosen`."""
        if len(self.groups) == 1:
            return [(self.groups[0], chosen, np.arange(len(chosen)))]
        parts = []
        for group in self.groups:
            members = np.searchsorted(group.rows, chosen)
            here = np.flatnonzero(group.rows.take(members, mode="clip") == chosen)
            if len(here):
                parts.append((group, members[here], here))
        return parts

    def renew(self, chosen: set[int]) -> None:
        """Count the whole errors of the `chosen` candidates as new, not as errors that are correlated in time."""
        for k, group in enumerate(self.groups):
            if not chosen.isdisjoint(
                group.rows.tolist()
            ):  # with correlated errors each is a group
                self.groups[k] = group._replace(
                    stack=replace(group.stack, R=group.spread), error=None
                )

    def at(self, indices: Sequence[int]) -> "Candidates":
        """Return the candidates at `indices`."""
        groups = [
            Group(
                here,
                replace(own, z=own.z[m], R=own.R[m]),
                spread[m],
                error and error.at(m),
                stamp_error,
            )
            for (_, own, spread, error, stamp_error), m, here in self.split(
                np.array(indices)
            )
        ]
        return Candidates(
            [self.leaders[i] for i in indices], self.merged, self.lines[indices], groups
        )


Preprocessed = tuple[Candidates, list[UpdateRecord]]
"""Candidates in the order of the merge, and the records of detections that are out of bounds."""


class Preprocessing(Protocol):
    """Step of a tracker that turns detections into candidates; `Preprocess` is the step of the paper."""

    def posed(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> PosedBatch:
        """See `Preprocess.posed`."""

    def together(self, batches: Sequence[PosedBatch]) -> list[Preprocessed]:
        """See `Preprocess.together`."""


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
        """Prepare the step.

        `detection_origin_m` is the origin of the ego frame of detections, seen from the ego reference point. With
        `assumes_map_yaw` a yaw from the map is prior knowledge. Without it the yaw counts as measured in the
        innovations and their NIS, as published.
        """
        self._road = road
        self._merge = merge
        self._motion = motion
        self._origin_m = detection_origin_m
        self._assumes_map_yaw = assumes_map_yaw

    def __call__(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> Preprocessed:
        """Return the candidates of a batch, and the records of the rejected detections.

        `ego` is the pose at the stamp of the batch; it may be None for detections in the map frame.
        """
        return self.together([self.posed(batch, sensor, ego)])[0]

    def posed(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> PosedBatch:
        """Return `batch` with the pose of the frame of its detections, and the velocity of the frame's origin.

        Detections in the map are measured from the ego frame; without an `ego`, from the origin of the map.
        """
        if ego is None:
            return PosedBatch(batch, sensor, None, SensorPose())
        yaw_rad = ego.yaw_rad
        x_m, y_m = self._origin_m
        if batch.message.frame == "sensor":
            x_m, y_m = (
                x_m + sensor.mount_or_origin.x_m,
                y_m + sensor.mount_or_origin.y_m,
            )
            yaw_rad += sensor.mount_or_origin.yaw_rad
        x_m, y_m, vx_mps, vy_mps = body_point(*ego[:5], x_m, y_m)
        return PosedBatch(
            batch, sensor, ego, SensorPose(x_m, y_m, yaw_rad, vx_mps, vy_mps)
        )

    def together(self, batches: Sequence[PosedBatch]) -> list[Preprocessed]:
        """Return the result of `__call__` for each of `batches`, computed in one pass over the arrays of all
        batches.
        """
        lost: list[dict[int, str]] = [{} for _ in batches]
        items = in_map_frame(batches)
        if any(
            s.filters or s.near_side_m or s.max_range_m is not None
            for _, s, _, _ in batches
        ):
            items = _restricted(items, lost)
        items = merged(self._on_road(items, lost), self._merge)
        return [
            (candidates, [_out_of_bounds(each.batch, *one) for one in out.items()])
            for each, candidates, out in zip(
                batches, self._candidates(items), lost, strict=True
            )
        ]

    def _on_road(
        self, items: MapDetections, lost: Sequence[dict[int, str]]
    ) -> MapDetections:
        """Return the detections inside the road bounds, with yaw and curvature of the map. `lost` gets the other
        detections.
        """
        if not self._road.has_track:
            return items
        takes = [
            (
                sensor.yaw_from_map_std_rad is not None,
                sensor.curvature_from_map_std_radpm is not None,
            )
            for _, sensor, _, _ in items.batches
        ]
        arrays = (
            items.values,
            items.points_m,
            items.map_yaw,
            items.starts,
            np.array(takes),
        )
        outside = kernels("fgtrack.tracking.kernels").on_road(
            *arrays, *self._road.view(items.points_m)
        )
        return _without(items, outside, "map.track", lost)

    def _candidates(self, items: MapDetections) -> Iterator[Candidates]:
        """Yield the candidates of each batch in their order. Candidates that measure the same components are one
        group.
        """
        arrays = items.values, items.points_m, items.map_yaw, items.starts, items.poses
        codes, lines = kernels("fgtrack.tracking.kernels").described(*arrays)
        for k, (first, end) in enumerate(pairwise(items.starts.tolist())):
            own = codes[first:end]
            kinds, groups = dict.fromkeys(own.tolist()), []
            for code in kinds:
                rows = (
                    np.arange(end - first)
                    if len(kinds) == 1
                    else (own == code).nonzero()[0]
                )
                groups += self._groups(items, k, first, rows, code)
            others = {
                index: others
                for (batch, index), others in items.merged.items()
                if batch == k
            }
            yield Candidates(
                items.indices[first:end].tolist(), others, lines[first:end], groups
            )

    def _groups(
        self, items: MapDetections, k: int, first: int, rows: IntArray, code: int
    ) -> list[Group]:
        """Return the groups of the candidates `rows` of batch k, which all measure the same components `code`.

        `first` is the first row of the batch. If errors are correlated in time, each candidate is a group of its own.
        """
        here = slice(first, first + len(rows)) if rows[-1] < len(rows) else first + rows
        (batch, sensor, ego, pose), points_m = items.batches[k], items.points_m[here]
        names, columns, assumed, placed = _components(code, self._assumes_map_yaw)
        z, R = (
            items.values[here].take(columns, axis=1),
            covariances(items, k, here, names),
        )
        model = measurement_model(names, self._motion)
        models, white = [model], R
        if sensor.correlation is not None:
            split = [
                split_error(
                    batch.message.sensor, sensor, model, item, self._motion.state_names
                )
                for item in R
            ]
            models, white = (
                [each for each, _ in split],
                np.array([noise for _, noise in split]),
            )
        total, error, is_moved = white, None, batch.message.frame != "map"
        if (
            ego is not None
            and ego.covariance is not None
            and (is_moved or model.relative)
        ):
            P, G, components = (
                np.zeros((5, 5)),
                np.zeros((*z.shape, 5)),
                placed if is_moved else np.full(len(names), -1),
            )
            body = ego.yaw_rad, ego.x_m, ego.y_m, ego.covariance
            kernels("fgtrack.tracking.kernels").pose_error(
                points_m, components, items.poses[k], *body, P, G
            )
            x, error = points_m, PoseError(P, G, white)
            if model.relative:
                x, is_placed = (
                    np.zeros((len(z), self._motion.dim)),
                    not math.isnan(points_m[0, 0]),
                )  # all or none
                x[:, :2] = (
                    points_m
                    if is_placed
                    else _far_along(_directions_rad(names, z), pose)
                )
            total = error.noise(models[0], pose, x)
            R = total if white is R else R + (total - white)
        late = (
            StampError(self._motion, sensor.stamp_std_s) if sensor.stamp_std_s else None
        )
        whole = Group(
            rows,
            Measurement(
                batch.stamp_ns, models[0], z, total, pose, sensor.loss, assumed
            ),
            R,
            error,
            late,
        )
        if sensor.correlation is None:
            return [whole]
        groups = []
        for i, each in enumerate(models):
            item, m = (
                Measurement(
                    batch.stamp_ns,
                    each,
                    z[i : i + 1],
                    total[i : i + 1],
                    pose,
                    sensor.loss,
                    assumed,
                ),
                [i],
            )
            groups.append(Group(rows[m], item, R[m], error and error.at(m), late))
        return groups


def _out_of_bounds(batch: Batch, index: int, reason: str) -> UpdateRecord:
    return replace(
        record(batch.message, index, Disposition.OUT_OF_BOUNDS), reason=reason
    )


def _restricted(items: MapDetections, lost: Sequence[dict[int, str]]) -> MapDetections:
    """Return the detections that pass the filters and the ranges of their sensors.

    If a sensor shows the near side of objects, the positions are moved back. `lost` gets the other detections.
    """
    batches, passes = items.batches, list[bool]()
    for k, index in zip(items.of.tolist(), items.indices.tolist(), strict=True):
        batch, sensor, _, _ = batches[k]
        name = sensor.refusing_filter(batch.message.objects[index])
        passes.append(name is None)
        if name is not None:
            lost[k][index] = f"filters.{name}"
    items = items.at(np.array(passes, dtype=bool))
    ranges_m = [
        each.sensor.max_range_m if each.ego is not None else None for each in batches
    ]
    of, most_m = (
        items.of,
        np.array([math.inf if range_m is None else range_m for range_m in ranges_m]),
    )
    offsets_m = items.points_m - items.poses[of, :2]
    far = np.hypot(offsets_m[:, 0], offsets_m[:, 1]) > most_m[of]
    items = _without(items, far, "max_range_m", lost)
    move_back(
        items,
        np.array(
            [0.0 if each.ego is None else each.sensor.near_side_m for each in batches]
        ),
    )
    return items


def _without(
    items: MapDetections,
    outside: BoolArray,
    reason: str,
    lost: Sequence[dict[int, str]],
) -> MapDetections:
    """Return the detections that are not `outside` (m,).

    `lost` holds a dictionary for each batch, which gets the `reason` by the index of each other detection.
    """
    rows = outside.nonzero()[0]
    if not len(rows):
        return items
    for k, index in zip(
        items.of[rows].tolist(), items.indices[rows].tolist(), strict=True
    ):
        lost[k][index] = reason
    return items.at(~outside)


@cache
def _components(
    code: int, map_yaw_is_assumed: bool
) -> tuple[tuple[str, ...], IntArray, tuple[str, ...], IntArray]:
    """Return the names of the measured components, their columns, the names that are assumed, and the columns again.

    Columns are indices in `COMPONENTS`. In the second columns an assumed component has -1. An assumed component
    comes from the map: the curvature, and the yaw if `map_yaw_is_assumed`. `code` is the number that the kernel
    `described` returns.
    """
    columns = np.array([k for k in range(len(COMPONENTS)) if code >> k & 1])
    names = tuple(COMPONENTS[k] for k in columns)
    known = (
        {"curvature_radpm", "yaw_rad"}
        if map_yaw_is_assumed and code >> len(COMPONENTS)
        else {"curvature_radpm"}
    )
    assumed = tuple(name for name in names if name in known)
    return (
        names,
        columns,
        assumed,
        np.where([name in assumed for name in names], -1, columns),
    )


def _directions_rad(names: Sequence[str], z: FloatArray) -> FloatArray:
    """Return the bearings among the components of z (m, k), shape (m,); 0, the axis of the sensor, without bearings."""
    return z[:, names.index("bearing_rad")] if "bearing_rad" in names else 0.0 * z[:, 0]


def _far_along(bearings_rad: FloatArray, pose: SensorPose) -> list[tuple[float, float]]:
    """Return points on lines of sight (m,), so far that the position of the sensor no longer matters."""
    angles_rad = [pose.yaw_rad + bearing_rad for bearing_rad in bearings_rad.tolist()]
    return [
        (pose.x_m + _FAR_M * math.cos(angle), pose.y_m + _FAR_M * math.sin(angle))
        for angle in angles_rad
    ]

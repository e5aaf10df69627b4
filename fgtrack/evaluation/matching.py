"""Matching of tracks with true objects at every tick, and the errors of the matched tracks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import BoolArray, FloatArray, IntArray, TrackStatus
from fgtrack.evaluation.near_pairs import NearPairs, Scenes, assigned
from fgtrack.evaluation.settings import EvaluationConfig, evaluation_settings
from fgtrack.evaluation.truth import (
    TruePath,
    in_ignored_regions,
    present_objects,
    states_of,
    true_paths,
    visible,
)
from fgtrack.runs import NO_TRACK, Columns, Run

NO_OBJECT = -1
"""Object index of a track row without a true object."""
# Number of pairs of a row and an object that are computed together.
_BLOCK_PAIRS = 1 << 18


@dataclass(frozen=True)
class Matching:
    """Pairs of track rows and true objects. Objects are numbered by ascending id, without the ego."""

    paths: tuple[TruePath, ...]
    """Truth of each object."""
    tracks: Columns
    """The r evaluated rows of tracks.csv, during the time with truth."""
    object_index: IntArray
    """Index of the paired object of each row, shape (r,); `NO_OBJECT` if no object is paired."""
    near: NearPairs
    """Pairs of a row and an object at the row's stamp, nearer than twice the gate."""
    now_ns: IntArray
    """Time of each tick, shape (ticks,)."""
    tick_index: IntArray
    """Tick of each row, shape (r,)."""
    present: BoolArray
    """Mask of objects with truth at each tick, shape (ticks, objects)."""
    track_ids: IntArray
    """Track of each object at each tick, shape (ticks, objects); `NO_TRACK` if no track is paired."""
    in_view: BoolArray
    """Mask of objects that some sensor could detect, shape (ticks, objects), see `visible`."""

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Id of each object in the truth."""
        return tuple(path.object_id for path in self.paths)

    @property
    def paired(self) -> BoolArray:
        """Mask of the rows with an object, shape (r,)."""
        return np.asarray(self.object_index != NO_OBJECT)

    @property
    def true_states(self) -> FloatArray:
        """x, y, yaw, speed and yaw rate of the row's object at the row's stamp, shape (r, 5).

        NaN for a row without an object. The array is made at each use.
        """
        return states_of(self.paths, self.object_index, self.tracks["stamp_ns"])

    def truth_of(self, rows: BoolArray | IntArray) -> FloatArray:
        """Return `true_states` of the rows selected by a mask, shape (r,), or by indices."""
        return states_of(
            self.paths, self.object_index[rows], self.tracks["stamp_ns"][rows]
        )


@dataclass(frozen=True)
class TrackErrors:
    """Errors, track minus truth, of the p paired rows."""

    stamps_ns: IntArray
    """Stamp of each row, shape (p,)."""
    object_index: IntArray
    """Object of each row, shape (p,)."""
    track_ids: IntArray
    """Track of each row, shape (p,)."""
    values: Mapping[str, FloatArray]
    """Errors by name of `ERROR_NAMES`, shape (p,) each; NaN where the truth has no value."""


#: Position distance; error along and across the true heading (left positive); yaw in (-pi, pi]; speed.
ERROR_NAMES = ("position_m", "along_m", "across_m", "yaw_rad", "speed_mps")


def match(run: Run, options: EvaluationConfig | None = None) -> Matching | None:
    """Pair the tracks of `run` with its true objects at every tick; None without truth.

    The method is CLEAR (Bernardin and Stiefelhagen 2008). A pair of the previous tick
    stays while it is inside the gate. The Hungarian method assigns the rest: first as
    many pairs as possible, then the least sum of distances. Tracks of ignored objects,
    and in ignored regions, are excluded.
    """
    options = options or evaluation_settings(run)
    paths = true_paths(run.tables["truth"])
    if not paths:
        return None
    timing = run.tables["timing"]
    tracks = run.tables["tracks"]
    # A tick without a row in timing.csv was interrupted.
    kept = during_truth(run, tracks["stamp_ns"]) & np.isin(
        tracks["tick"], timing["tick"]
    )
    tracks = tracks.where(kept & confirmed(tracks) if options.confirmed_only else kept)
    if run.tables["ignored"].num_rows:
        tracks = tracks.where(~_ignored(run, tracks, paths, options.gate_m))
    near = near_pairs(tracks, paths, 2.0 * options.gate_m)
    tick_index = np.searchsorted(timing["tick"], tracks["tick"])
    object_index = nearest_objects(
        near,
        tracks["track_id"],
        tick_index,
        timing.num_rows,
        len(paths),
        options.gate_m,
    )
    paired = np.flatnonzero(object_index != NO_OBJECT)
    track_ids = np.full((timing.num_rows, len(paths)), NO_TRACK)
    track_ids[tick_index[paired], object_index[paired]] = tracks["track_id"][paired]
    return Matching(
        paths=tuple(paths),
        tracks=tracks,
        object_index=object_index,
        near=near,
        now_ns=timing["now_ns"],
        tick_index=tick_index,
        present=present_objects(paths, timing["now_ns"]),
        track_ids=track_ids,
        in_view=visible(run, paths, timing["now_ns"]),
    )


def track_errors(matching: Matching) -> TrackErrors:
    """Return the errors of the paired rows against the truth at their stamps."""
    tracks = matching.tracks.where(matching.paired)
    values = state_errors(tracks, matching.truth_of(matching.paired))
    return TrackErrors(
        tracks["stamp_ns"],
        matching.object_index[matching.paired],
        tracks["track_id"],
        values,
    )


def state_errors(states: Columns, truth: FloatArray) -> dict[str, FloatArray]:
    """Return the errors of n `states` against `truth` by name of `ERROR_NAMES`, shape (n,) each.

    `truth` (n, 5) has the columns x, y, yaw, speed, yaw rate.
    """
    dx_m = states["x_m"] - truth[:, 0]
    dy_m = states["y_m"] - truth[:, 1]
    c, s = np.cos(truth[:, 2]), np.sin(truth[:, 2])
    yaw_rad = wrap_angles(states["yaw_rad"] - truth[:, 2])
    along_m = c * dx_m + s * dy_m
    across_m = c * dy_m - s * dx_m
    errors = (
        np.hypot(dx_m, dy_m),
        along_m,
        across_m,
        yaw_rad,
        states["speed_mps"] - truth[:, 3],
    )
    return dict(zip(ERROR_NAMES, errors, strict=True))


def position_nees(matching: Matching) -> FloatArray:
    """Return the position NEES of every paired row, shape (p,).

    NaN where the covariance is not positive definite.
    """
    return position_squares(
        matching.tracks.where(matching.paired), matching.truth_of(matching.paired)
    )


def position_squares(states: Columns, truth: FloatArray) -> FloatArray:
    """Return the normalised squared error e' P^-1 e of x and y, shape (n,).

    NaN where P is not positive definite.
    """
    x, y = states["x_m"] - truth[:, 0], states["y_m"] - truth[:, 1]
    P_x, P_xy, P_y = (states[name] for name in ("p_x_x", "p_x_y", "p_y_y"))
    # Covariances may be indefinite.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        gain = P_xy / P_x
        rest = P_y - gain * P_xy  # variance of y given x
        squares = x**2 / P_x + (y - gain * x) ** 2 / rest
    return np.where((P_x > 0.0) & (rest > 0.0) & np.isfinite(squares), squares, np.nan)


def scenes(run: Run, matching: Matching) -> Scenes:
    """Return the ticks of `run` during the time with truth, with their evaluated rows.

    Distances are those at the stamps of the rows.
    """
    scored = during_truth(run, matching.now_ns)
    rows = np.flatnonzero(scored[matching.tick_index])
    rows = rows[np.argsort(matching.tick_index[rows], kind="stable")]
    tick_index = (np.cumsum(scored) - 1)[matching.tick_index[rows]]
    present = matching.present[scored]
    row_of = np.full(matching.tracks.num_rows, -1)
    row_of[rows] = np.arange(len(rows))
    near = matching.near
    own = row_of[near.rows]
    kept = np.flatnonzero(own >= 0)
    kept = kept[present[tick_index[own[kept]], near.objects[kept]]]
    if (np.diff(own[kept]) < 0).any():
        kept = kept[np.lexsort((near.objects[kept], own[kept]))]
    return Scenes(
        tick_index,
        matching.tracks["track_id"][rows],
        replace(near.where(kept), rows=own[kept]),
        present,
        matching.in_view[scored],
    )


def confirmed(tracks: Columns) -> BoolArray:
    """Mask of the rows of tracks.csv that are not tentative, shape (rows,)."""
    return np.asarray(tracks["status"] != TrackStatus.TENTATIVE.value)


def published_rows(tracks: Columns, ticks: IntArray, track_ids: IntArray) -> IntArray:
    """Return the row of `tracks` for each tick and track, shape (n,); -1 if the track was not published at the tick."""
    before, after = neighbours(tracks, "tick", ticks, track_ids)
    return np.where(before == after, before, -1)


def neighbours(
    tracks: Columns, name: str, values: IntArray, track_ids: IntArray
) -> tuple[IntArray, IntArray]:
    """Rows of each track before and after a value: two arrays of shape (n,); -1 for a missing row.

    The first is the last row whose column `name` is at most `values`. The second is the
    first row whose column is at least `values`.
    """
    every = np.unique(tracks[name])
    size = max(len(every), 1)
    keys = tracks["track_id"] * size + np.searchsorted(every, tracks[name])
    order = np.argsort(keys, kind="stable")
    keys = np.append(keys[order], -1)
    order = np.append(order, -1)
    not_after = track_ids * size + np.searchsorted(every, values, side="right") - 1
    not_before = track_ids * size + np.searchsorted(every, values)
    at = (
        np.searchsorted(keys[:-1], not_after, side="right") - 1,
        np.searchsorted(keys[:-1], not_before),
    )
    before, after = (np.where(keys[k] // size == track_ids, order[k], -1) for k in at)
    return before, after


def during_truth(run: Run, stamps_ns: IntArray) -> BoolArray:
    """Mask of `stamps_ns` between the first and the last stamp of the truth, shape (n,)."""
    truth_ns = run.tables["truth"]["stamp_ns"]
    return np.asarray((stamps_ns >= truth_ns.min()) & (stamps_ns <= truth_ns.max()))


def _ignored(
    run: Run, tracks: Columns, paths: list[TruePath], gate_m: float
) -> BoolArray:
    """Mask of the rows of `tracks` that KITTI's rules ignore, shape (rows,).

    These are rows paired with an ignored object, and rows without any object in an
    ignored region.
    """
    objects = run.tables["ignored"].where(run.tables["ignored"]["outline_m"] == "")
    unknown = dict.fromkeys(
        ("yaw_rad", "speed_mps", "yaw_rate_radps"), np.full(objects.num_rows, np.nan)
    )
    paths = [*paths]
    known = len(paths)
    paths += true_paths(Columns({**objects, **unknown}))
    timing = run.tables["timing"]
    stamps_ns = tracks["stamp_ns"]
    tick_index = np.searchsorted(timing["tick"], tracks["tick"])
    near = near_pairs(tracks, paths, 2.0 * gate_m)
    index = nearest_objects(
        near, tracks["track_id"], tick_index, timing.num_rows, len(paths), gate_m
    )
    in_regions = in_ignored_regions(
        run, stamps_ns, np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    )
    return np.asarray((index >= known) | ((index == NO_OBJECT) & in_regions))


def near_pairs(tracks: Columns, paths: Sequence[TruePath], limit_m: float) -> NearPairs:
    """Return the pairs of a row of `tracks` and an object of `paths` that are nearer than `limit_m`.

    The truth is that at the stamp of the row. The rows are processed in blocks.
    """
    xy = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    parts = []
    size = max(1, _BLOCK_PAIRS // len(paths))
    for first in range(0, len(xy), size):
        block = slice(first, first + size)
        true_m = np.stack(
            [path.at(tracks["stamp_ns"][block])[:, :2] for path in paths], axis=1
        )
        distances_m = np.linalg.norm(true_m - xy[block, None], axis=-1)
        part = NearPairs.of(distances_m, limit_m)
        parts.append(replace(part, rows=part.rows + first))
    if not parts:
        return NearPairs.of(np.empty((0, len(paths))), limit_m)
    return NearPairs(
        np.concatenate([part.rows for part in parts]),
        np.concatenate([part.objects for part in parts]),
        np.concatenate([part.distances_m for part in parts]),
        limit_m,
    )


def nearest_objects(
    near: NearPairs,
    ids: IntArray,
    tick_index: IntArray,
    num_ticks: int,
    num_objects: int,
    gate_m: float,
) -> IntArray:
    """Return the object of every row: as many pairs as possible, then the least sum of distances.

    No pair is farther apart than `gate_m`. Pairs of the previous tick stay, see
    `assigned`. `NO_OBJECT` for a row without an object.
    """
    # One more pair outweighs all distances, which are at most 1 in units of the gate.
    share = near.distances_m / gate_m
    scores = np.where(near.distances_m <= gate_m, num_objects + 1.0 - share, 0.0)
    previous = np.arange(num_ticks) - 1
    pairs = near.where(assigned(near, scores, ids, tick_index, previous, num_objects))
    object_index = np.full(len(ids), NO_OBJECT)
    object_index[pairs.rows] = pairs.objects
    return object_index

"""Matching of tracks with true objects at every tick, and the errors of the matched tracks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import BoolArray, FloatArray, IntArray, TrackStatus
from fgtrack.evaluation.settings import EvaluationConfig, evaluation_settings
from fgtrack.evaluation.truth import (
    TRUE_STATE,
    TruePath,
    in_ignored_regions,
    true_paths,
    visible,
)
from fgtrack.runs import NO_TRACK, Columns, Run

NO_OBJECT = -1
"""Object index of a track row without a true object."""


@dataclass(frozen=True)
class Matching:
    """Pairs of track rows and true objects. Objects are numbered by ascending id, without the ego."""

    object_ids: tuple[int, ...]
    """Id of each object in the truth."""
    tracks: Columns
    """The r evaluated rows of tracks.csv, during the time with truth."""
    object_index: IntArray
    """Index of the paired object of each row, shape (r,); `NO_OBJECT` if no object is paired."""
    true_states: FloatArray
    """x, y, yaw, speed and yaw rate of the row's object at the row's stamp, shape (r, 5).

    NaN for a row without an object.
    """
    distances_m: FloatArray
    """Distance of each row from every object at the row's stamp, shape (r, objects).

    NaN where the object has no truth.
    """
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
    def paired(self) -> BoolArray:
        """Mask of the rows with an object, shape (r,)."""
        return np.asarray(self.object_index != NO_OBJECT)


@dataclass(frozen=True)
class Scenes:
    """Tracks and true objects at t ticks; r rows of tracks by ascending tick."""

    tick_index: IntArray
    """Tick of each row in ascending order, shape (r,)."""
    track_ids: IntArray
    """Track of each row, shape (r,)."""
    distances_m: FloatArray
    """Distance of each row from every object, shape (r, objects); infinity for an absent object."""
    present: BoolArray
    """Mask of present objects, shape (t, objects)."""
    in_view: BoolArray
    """Mask of present objects that some sensor could detect, shape (t, objects)."""


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
    candidates, distances_m = distances(tracks, paths)
    tick_index = np.searchsorted(timing["tick"], tracks["tick"])
    object_index = nearest_pairs(
        distances_m, tracks["track_id"], tick_index, timing.num_rows, options.gate_m
    )
    paired = np.flatnonzero(object_index != NO_OBJECT)
    track_ids = np.full((timing.num_rows, len(paths)), NO_TRACK)
    track_ids[tick_index[paired], object_index[paired]] = tracks["track_id"][paired]
    true_states = np.full((tracks.num_rows, len(TRUE_STATE)), np.nan)
    true_states[paired] = candidates[paired, object_index[paired]]
    return Matching(
        object_ids=tuple(path.object_id for path in paths),
        tracks=tracks,
        object_index=object_index,
        true_states=true_states,
        distances_m=distances_m,
        now_ns=timing["now_ns"],
        tick_index=tick_index,
        present=np.stack(
            [np.isfinite(path.at(timing["now_ns"])[:, 0]) for path in paths], axis=-1
        ),
        track_ids=track_ids,
        in_view=visible(run, paths, timing["now_ns"]),
    )


def pair(
    scores: FloatArray, ids: IntArray, tick_index: IntArray, previous: IntArray
) -> IntArray:
    """Return the object of every row, shape (rows,), with the largest sum of scores at each tick.

    `NO_OBJECT` for a row without an object. `scores` (rows, objects) are 0 for pairs
    that are not allowed. `ids` and `tick_index` (rows,) are the track and the tick of
    each row. Allowed pairs of the tick `previous` (ticks,) stay.
    """
    from scipy.optimize import linear_sum_assignment

    num_ticks = len(previous)
    num_objects = scores.shape[1]
    inside = scores > 0.0
    object_index = np.full(len(ids), NO_OBJECT)
    # A tick is clear if each row has at most one allowed object, and each object one allowed row.
    rows, columns = np.nonzero(inside)
    rows_per_object = np.bincount(
        tick_index[rows] * num_objects + columns, minlength=num_ticks * num_objects
    ).reshape(num_ticks, num_objects)
    unclear = np.asarray((rows_per_object > 1).any(axis=1))
    unclear[tick_index[inside.sum(axis=1) > 1]] = True
    clear_rows, columns = np.nonzero(inside & ~unclear[tick_index, None])
    object_index[clear_rows] = columns
    order = np.argsort(tick_index, kind="stable")
    edges = np.searchsorted(tick_index[order], np.arange(num_ticks + 1)).tolist()
    for k in np.flatnonzero(unclear).tolist():
        rows = order[edges[k] : edges[k + 1]]
        last = int(previous[k])
        before = order[edges[last] : edges[last + 1]] if last >= 0 else rows[:0]
        before = before[object_index[before] != NO_OBJECT]
        track_of = np.full(scores.shape[1], NO_TRACK)
        track_of[object_index[before]] = ids[before]
        mine = scores[rows]
        stays = inside[rows] & (ids[rows, None] == track_of)
        chosen, columns = linear_sum_assignment(
            mine + (1.0 + mine.sum()) * stays, maximize=True
        )
        allowed = inside[rows][chosen, columns]
        object_index[rows[chosen[allowed]]] = columns[allowed]
    return object_index


def track_errors(matching: Matching) -> TrackErrors:
    """Return the errors of the paired rows against the truth at their stamps."""
    tracks = matching.tracks.where(matching.paired)
    values = state_errors(tracks, matching.true_states[matching.paired])
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
        matching.tracks.where(matching.paired), matching.true_states[matching.paired]
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
    distances_m = matching.distances_m[rows]
    distances_m = np.where(
        present[tick_index] & np.isfinite(distances_m), distances_m, np.inf
    )
    return Scenes(
        tick_index,
        matching.tracks["track_id"][rows],
        distances_m,
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
    every = np.unique(np.concatenate([tracks[name], values]))
    ranks, wanted = (np.searchsorted(every, each) for each in (tracks[name], values))
    keys = tracks["track_id"] * len(every) + ranks
    wanted = track_ids * len(every) + wanted
    order = np.argsort(keys, kind="stable")
    keys = np.append(keys[order], -1)
    order = np.append(order, -1)
    at = (
        np.searchsorted(keys[:-1], wanted, side="right") - 1,
        np.searchsorted(keys[:-1], wanted),
    )
    before, after = (
        np.where(keys[k] // max(len(every), 1) == track_ids, order[k], -1) for k in at
    )
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
    _, distances_m = distances(
        tracks, [*paths, *true_paths(Columns({**objects, **unknown}))]
    )
    timing = run.tables["timing"]
    stamps_ns = tracks["stamp_ns"]
    tick_index = np.searchsorted(timing["tick"], tracks["tick"])
    index = nearest_pairs(
        distances_m, tracks["track_id"], tick_index, timing.num_rows, gate_m
    )
    in_regions = in_ignored_regions(
        run, stamps_ns, np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    )
    return np.asarray((index >= len(paths)) | ((index == NO_OBJECT) & in_regions))


def distances(
    tracks: Columns, paths: Sequence[TruePath]
) -> tuple[FloatArray, FloatArray]:
    """Return true states (rows, objects, 5) at the stamps of `tracks`, and distances (rows, objects).

    NaN where an object has no truth.
    """
    candidates = np.stack([path.at(tracks["stamp_ns"]) for path in paths], axis=1)
    xy = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    return candidates, np.linalg.norm(candidates[..., :2] - xy[:, None], axis=-1)


def nearest_pairs(
    distances_m: FloatArray,
    ids: IntArray,
    tick_index: IntArray,
    num_ticks: int,
    gate_m: float,
) -> IntArray:
    """Return the object of every row: as many pairs as possible, then the least sum of distances.

    No pair is farther apart than `gate_m`. Pairs of the previous tick stay, see `pair`.
    """
    # One more pair outweighs all distances, which are at most 1 in units of the gate.
    objects = distances_m.shape[1]
    scores = np.where(distances_m <= gate_m, objects + 1.0 - distances_m / gate_m, 0.0)
    return pair(scores, ids, tick_index, np.arange(num_ticks) - 1)

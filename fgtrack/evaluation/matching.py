"""Pairs of tracks and true objects, tick by tick, and the errors of these tracks."""

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
"""Object index of a track row that is paired with no true object."""


@dataclass(frozen=True)
class Matching:
    """Pairs of track rows and true objects, which are numbered by rising id, without the ego."""

    object_ids: tuple[int, ...]
    tracks: Columns
    """The evaluated rows of tracks.csv: r rows while truth was recorded."""
    object_index: IntArray
    """Object that each row is paired with, shape (r,); `NO_OBJECT` without one."""
    true_states: FloatArray
    """x, y, yaw, speed, yaw rate of that object at the row's stamp, shape (r, 5); NaN without one."""
    distances_m: FloatArray
    """Distance of each row from every object at the row's stamp, shape (r, objects); NaN where unknown."""
    now_ns: IntArray
    """Time of every tick, shape (ticks,)."""
    tick_index: IntArray
    """Index of each row's tick, shape (r,)."""
    present: BoolArray
    """True where there is truth at the tick's `now_ns`, shape (ticks, objects)."""
    track_ids: IntArray
    """Track paired with each object, shape (ticks, objects); `NO_TRACK` without one."""
    in_view: BoolArray
    """True where some sensor could see the object, shape (ticks, objects), see `visible`."""

    @property
    def paired(self) -> BoolArray:
        """True for the paired rows, shape (r,)."""
        return np.asarray(self.object_index != NO_OBJECT)


@dataclass(frozen=True)
class Scenes:
    """Tracks and true objects at t ticks; r rows of tracks by rising tick."""

    tick_index: IntArray
    """Tick of each row, shape (r,), rising."""
    track_ids: IntArray
    """Shape (r,)."""
    distances_m: FloatArray
    """Distance of each row from every object, shape (r, objects); infinite where the object is not present."""
    present: BoolArray
    """True where an object is present, shape (t, objects)."""
    in_view: BoolArray
    """True where it is present and some sensor could see it, shape (t, objects)."""


@dataclass(frozen=True)
class TrackErrors:
    """Track minus truth of the p paired rows."""

    stamps_ns: IntArray
    object_index: IntArray
    track_ids: IntArray
    """Shape (p,) each."""
    values: Mapping[str, FloatArray]
    """By name of `ERROR_NAMES`, each of shape (p,); NaN where the truth has no value."""


#: Distance; along and across the true heading (left positive); yaw in (-pi, pi]; speed.
ERROR_NAMES = ("position_m", "along_m", "across_m", "yaw_rad", "speed_mps")


def match(run: Run, options: EvaluationConfig | None = None) -> Matching | None:
    """Pair the tracks of `run` to its true objects at every tick; None for a run without truth.
    As CLEAR does (Bernardin and Stiefelhagen 2008): a pair of the tick before stays while it lies inside the gate, the
    rest is assigned by the Hungarian method, first as many pairs as possible, then the least sum of distances. Tracks
    of ignored objects and in ignored regions are left out.
    """
    options = options or evaluation_settings(run)
    paths = true_paths(run.tables["truth"])
    if not paths:
        return None
    timing = run.tables["timing"]
    tracks = run.tables["tracks"]
    kept = recorded(run, tracks["stamp_ns"]) & np.isin(
        tracks["tick"], timing["tick"]
    )  # not of a tick that was killed
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
    """Object of every row, shape (rows,), so that each tick has the largest sum of scores; `NO_OBJECT` without one.
    `scores`, shape (rows, objects), are 0 for pairs that are not allowed; pairs of the tick `previous`, (ticks,), stay.
    """
    from scipy.optimize import linear_sum_assignment

    num_ticks, inside = len(previous), scores > 0.0
    object_index = np.full(len(ids), NO_OBJECT)
    rows, columns = np.nonzero(inside)
    ways = (
        tick_index[rows] * scores.shape[1] + columns
    )  # elsewhere a row has one object, and an object one row
    ways_per_object = np.bincount(ways, minlength=num_ticks * scores.shape[1]).reshape(
        num_ticks, scores.shape[1]
    )
    unclear = np.asarray((ways_per_object > 1).any(axis=1))
    unclear[tick_index[inside.sum(axis=1) > 1]] = True
    clear_rows, columns = np.nonzero(inside & ~unclear[tick_index, None])
    object_index[clear_rows] = columns
    order = np.argsort(tick_index, kind="stable")
    edges = np.searchsorted(tick_index[order], np.arange(num_ticks + 1)).tolist()
    for k in np.flatnonzero(unclear).tolist():
        rows, last = order[edges[k] : edges[k + 1]], int(previous[k])
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
    """Errors of the paired rows against the truth at their own stamps."""
    tracks = matching.tracks.where(matching.paired)
    values = state_errors(tracks, matching.true_states[matching.paired])
    return TrackErrors(
        tracks["stamp_ns"],
        matching.object_index[matching.paired],
        tracks["track_id"],
        values,
    )


def state_errors(states: Columns, truth: FloatArray) -> dict[str, FloatArray]:
    """Errors by name of `ERROR_NAMES`, shape (n,) each, of n rows against x, y, yaw, speed ..., shape (n, 5)."""
    dx_m, dy_m = states["x_m"] - truth[:, 0], states["y_m"] - truth[:, 1]
    c, s = np.cos(truth[:, 2]), np.sin(truth[:, 2])
    yaw_rad = wrap_angles(states["yaw_rad"] - truth[:, 2])
    along_m, across_m = c * dx_m + s * dy_m, c * dy_m - s * dx_m
    errors = (
        np.hypot(dx_m, dy_m),
        along_m,
        across_m,
        yaw_rad,
        states["speed_mps"] - truth[:, 3],
    )
    return dict(zip(ERROR_NAMES, errors, strict=True))


def position_nees(matching: Matching) -> FloatArray:
    """Return the NEES of the position of every paired row, shape (p,); NaN where there is none."""
    return position_squares(
        matching.tracks.where(matching.paired), matching.true_states[matching.paired]
    )


def position_squares(states: Columns, truth: FloatArray) -> FloatArray:
    """Return the normalised error squared e' P^-1 e of x and y, shape (n,); NaN where P is not positive definite."""
    x, y = states["x_m"] - truth[:, 0], states["y_m"] - truth[:, 1]
    P_x, P_xy, P_y = (states[name] for name in ("p_x_x", "p_x_y", "p_y_y"))
    with np.errstate(
        over="ignore", invalid="ignore", divide="ignore"
    ):  # of indefinite covariances
        gain = P_xy / P_x
        rest = P_y - gain * P_xy  # variance of y given x
        squares = x**2 / P_x + (y - gain * x) ** 2 / rest
    return np.where((P_x > 0.0) & (rest > 0.0) & np.isfinite(squares), squares, np.nan)


def scenes(run: Run, matching: Matching) -> Scenes:
    """The ticks of `run` while truth was recorded, with the evaluated rows; distances are at the stamps of the rows."""
    scored = recorded(run, matching.now_ns)
    rows = np.flatnonzero(scored[matching.tick_index])
    rows = rows[np.argsort(matching.tick_index[rows], kind="stable")]
    tick_index, present = (
        (np.cumsum(scored) - 1)[matching.tick_index[rows]],
        matching.present[scored],
    )
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
    """True for the rows of tracks.csv that are not tentative, shape (rows,)."""
    return np.asarray(tracks["status"] != TrackStatus.TENTATIVE.value)


def published_rows(tracks: Columns, ticks: IntArray, track_ids: IntArray) -> IntArray:
    """Row of `tracks` of each of these ticks and tracks, shape (n,); -1 where there is none."""
    before, after = neighbours(tracks, "tick", ticks, track_ids)
    return np.where(before == after, before, -1)


def neighbours(
    tracks: Columns, name: str, values: IntArray, track_ids: IntArray
) -> tuple[IntArray, IntArray]:
    """Rows of these tracks whose column `name` is the last up to, and the first from `values` on; -1 without one."""
    every = np.unique(np.concatenate([tracks[name], values]))
    ranks, wanted = (np.searchsorted(every, each) for each in (tracks[name], values))
    keys, wanted = (
        tracks["track_id"] * len(every) + ranks,
        track_ids * len(every) + wanted,
    )
    order = np.argsort(keys, kind="stable")
    keys, order = np.append(keys[order], -1), np.append(order, -1)
    at = (
        np.searchsorted(keys[:-1], wanted, side="right") - 1,
        np.searchsorted(keys[:-1], wanted),
    )
    before, after = (
        np.where(keys[k] // max(len(every), 1) == track_ids, order[k], -1) for k in at
    )
    return before, after


def recorded(run: Run, stamps_ns: IntArray) -> BoolArray:
    """True for those of `stamps_ns` between the first and the last stamp of the truth, shape (n,)."""
    truth_ns = run.tables["truth"]["stamp_ns"]
    return np.asarray((stamps_ns >= truth_ns.min()) & (stamps_ns <= truth_ns.max()))


def _ignored(
    run: Run, tracks: Columns, paths: list[TruePath], gate_m: float
) -> BoolArray:
    """True for the rows of no true object that follow an ignored one or lie in an ignored region, as in KITTI."""
    objects = run.tables["ignored"].where(run.tables["ignored"]["outline_m"] == "")
    unknown = dict.fromkeys(
        ("yaw_rad", "speed_mps", "yaw_rate_radps"), np.full(objects.num_rows, np.nan)
    )
    _, distances_m = distances(
        tracks, [*paths, *true_paths(Columns({**objects, **unknown}))]
    )
    timing, stamps_ns = run.tables["timing"], tracks["stamp_ns"]
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
    """True states at the stamps of `tracks`, shape (rows, objects, 5), and distances, shape (rows, objects), or NaN."""
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
    """Object of every row: as many pairs as possible, then the least sum of distances, none beyond the gate."""
    objects = distances_m.shape[
        1
    ]  # one more pair counts for more than all distances, which are below 1 here
    scores = np.where(distances_m <= gate_m, objects + 1.0 - distances_m / gate_m, 0.0)
    return pair(scores, ids, tick_index, np.arange(num_ticks) - 1)

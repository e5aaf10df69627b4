"""Which track follows which true object, tick by tick, and how far off it is."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import BoolArray, FloatArray, IntArray, TrackStatus
from fgtrack.evaluation.ignoring import ignored_objects, in_regions
from fgtrack.evaluation.sight import in_sight
from fgtrack.evaluation.truth import TRUE_STATE, TruePath, true_paths
from fgtrack.io.run import NO_TRACK, EvaluationConfig, Run, Table

NO_OBJECT = -1
"""Object index of a track row that is paired with no true object."""


@dataclass(frozen=True)
class Matching:
    """Pairs of track rows and true objects. Objects are numbered by rising id; the ego is none of them."""

    object_ids: tuple[int, ...]
    tracks: Table
    """The judged rows of tracks.csv: r rows with truth being recorded at their stamp."""
    object_index: IntArray
    """Object that each row is paired with, shape (r,); `NO_OBJECT` where none."""
    true_states: FloatArray
    """x, y, yaw, speed, yaw rate of that object at the row's stamp, shape (r, 5); NaN where none."""
    distances_m: FloatArray
    """Distance of each row from every object at the row's stamp, shape (r, objects); NaN where one is not known."""
    now_ns: IntArray
    """Time of every tick, shape (ticks,)."""
    tick_index: IntArray
    """Number of each row's tick among the ticks, shape (r,)."""
    present: BoolArray
    """Whether there is truth at the tick's `now_ns`, shape (ticks, objects)."""
    track_ids: IntArray
    """Track paired with each object, shape (ticks, objects); `NO_TRACK` where none."""
    in_sight: BoolArray
    """Whether some sensor could see each object there, shape (ticks, objects), see `in_sight`."""
    is_sight_known: bool
    """Whether the sensors and the ego's path are known; else every object counts as seen."""

    @property
    def paired(self) -> BoolArray:
        """Whether each row is paired, shape (r,)."""
        return np.asarray(self.object_index != NO_OBJECT)


@dataclass(frozen=True)
class Scenes:
    """Tracks and true objects at t ticks; rows are those of the tracks, r in all, by rising tick."""

    tick_index: IntArray
    """Tick of each row, shape (r,), rising."""
    track_ids: IntArray
    """Shape (r,)."""
    distances_m: FloatArray
    """Distance of each row from every object, shape (r, objects); infinite from what is not there."""
    present: BoolArray
    """Whether an object is there, shape (t, objects)."""
    in_sight: BoolArray
    """Whether it is there and some sensor could see it, shape (t, objects)."""

    @property
    def num_ticks(self) -> int:
        """Number of ticks t."""
        return len(self.present)

    def per_tick(self, values: FloatArray | IntArray) -> FloatArray:
        """Sum of `values`, one of each row, over the rows of every tick, shape (t,)."""
        return np.bincount(self.tick_index, values, self.num_ticks).astype(np.float64)

    def __iter__(self) -> Iterator[slice]:
        """The rows of every tick."""
        edges = np.searchsorted(self.tick_index, np.arange(self.num_ticks + 1)).tolist()
        return map(slice, edges[:-1], edges[1:])


@dataclass(frozen=True)
class TrackErrors:
    """Track minus truth of every paired row, each of shape (p,); NaN where the truth has no value."""

    stamps_ns: IntArray
    object_index: IntArray
    track_ids: IntArray
    values: Mapping[str, FloatArray]
    """By name of `ERROR_NAMES`."""


#: Distance; along and across the true heading (left positive); yaw in (-pi, pi]; speed.
ERROR_NAMES = ("position_m", "along_m", "across_m", "yaw_rad", "speed_mps")


def match(run: Run, options: EvaluationConfig | None = None) -> Matching | None:
    """Pair the tracks of `run` to its true objects at every tick; None for a run without truth.

    Without `options` it is judged as its configuration says.

    Tracks of ignored objects and in ignored regions are none of its rows, see `fgtrack.evaluation.ignoring`.

    As CLEAR does (Bernardin and Stiefelhagen 2008): a pair of the tick before stays while it lies inside the
    gate, the rest is assigned by the Hungarian method, first as many pairs as possible, then the least sum of
    distances. Ticks are those of timing.csv, so ticks without any track count as well.
    """
    options = options or run.evaluation
    paths = true_paths(run.tables["truth"])
    if not paths:
        return None
    ticks, now_ns = run.tables["timing"]["tick"], run.tables["timing"]["now_ns"]
    tracks = run.tables["tracks"].where(_judged(run, options))
    if run.tables["ignored"].num_rows:
        tracks = tracks.where(~_ignored(run, tracks, paths, options.gate_m))
    candidates = np.stack([path.at(tracks["stamp_ns"]) for path in paths], axis=1)
    xy = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    distances_m = np.linalg.norm(candidates[..., :2] - xy[:, None], axis=-1)
    inside = distances_m <= options.gate_m  # not where NaN: no truth or no finite state
    tick_index = np.searchsorted(ticks, tracks["tick"])
    object_index = _pair(np.where(inside, distances_m, np.inf), tracks["track_id"], tick_index, len(ticks))
    paired = np.flatnonzero(object_index != NO_OBJECT)
    track_ids = np.full((len(ticks), len(paths)), NO_TRACK)
    track_ids[tick_index[paired], object_index[paired]] = tracks["track_id"][paired]
    true_states = np.full((tracks.num_rows, len(TRUE_STATE)), np.nan)
    true_states[paired] = candidates[paired, object_index[paired]]
    seen, is_known = in_sight(run, paths, now_ns)
    return Matching(
        object_ids=tuple(path.object_id for path in paths),
        tracks=tracks,
        object_index=object_index,
        true_states=true_states,
        distances_m=distances_m,
        now_ns=now_ns,
        tick_index=tick_index,
        present=_present(paths, now_ns),
        track_ids=track_ids,
        in_sight=seen,
        is_sight_known=is_known,
    )


def contested(inside: BoolArray, tick_index: IntArray, num_ticks: int) -> BoolArray:
    """Ticks at which there is a choice: a row with several objects, or an object with several rows; shape (ticks,).

    At every other tick the pairs are those of `inside`, shape (rows, objects), whatever the distances are.
    """
    rows, columns = np.nonzero(inside)
    objects = inside.shape[1]
    rows_of = np.bincount(tick_index[rows] * objects + columns, minlength=num_ticks * objects)
    several = np.asarray((rows_of.reshape(num_ticks, objects) > 1).any(axis=1))
    several[tick_index[inside.sum(axis=1) > 1]] = True
    return several


def track_errors(matching: Matching) -> TrackErrors:
    """Errors of the paired rows against the truth at their own stamps."""
    tracks = matching.tracks.where(matching.paired)
    return TrackErrors(
        stamps_ns=tracks["stamp_ns"],
        object_index=matching.object_index[matching.paired],
        track_ids=tracks["track_id"],
        values=state_errors(tracks, matching.true_states[matching.paired]),
    )


def state_errors(states: Table, truth: FloatArray) -> dict[str, FloatArray]:
    """Errors by name of `ERROR_NAMES`, shape (n,) each, of n rows against x, y, yaw, speed ..., shape (n, 5)."""
    dx_m, dy_m = states["x_m"] - truth[:, 0], states["y_m"] - truth[:, 1]
    c, s = np.cos(truth[:, 2]), np.sin(truth[:, 2])
    yaw_rad = states["yaw_rad"] - truth[:, 2]
    known = np.isfinite(yaw_rad)
    yaw_rad[known] = wrap_angles(yaw_rad[known])
    errors = (
        np.hypot(dx_m, dy_m),
        c * dx_m + s * dy_m,
        c * dy_m - s * dx_m,
        yaw_rad,
        states["speed_mps"] - truth[:, 3],
    )
    return dict(zip(ERROR_NAMES, errors, strict=True))


def scenes(run: Run, matching: Matching) -> Scenes:
    """The ticks of `run` between the first and the last stamp of its truth, with the judged rows there.

    An object is there where its truth is known at the tick. A row is as far from it as it is at the row's own stamp.
    """
    scored = recorded(run, matching)
    number = np.cumsum(scored) - 1
    rows = np.flatnonzero(scored[matching.tick_index])
    rows = rows[np.argsort(matching.tick_index[rows], kind="stable")]
    tick_index, present = number[matching.tick_index[rows]], matching.present[scored]
    distances_m = matching.distances_m[rows]
    known = present[tick_index] & np.isfinite(distances_m)
    distances_m = np.where(known, distances_m, np.inf)
    return Scenes(tick_index, matching.tracks["track_id"][rows], distances_m, present, matching.in_sight[scored])


def recorded(run: Run, matching: Matching) -> BoolArray:
    """Whether each tick of `matching` lies between the first and the last stamp of the truth, shape (ticks,)."""
    truth_ns = run.tables["truth"]["stamp_ns"]
    return np.asarray((matching.now_ns >= truth_ns.min()) & (matching.now_ns <= truth_ns.max()))


def confirmed(tracks: Table) -> BoolArray:
    """Rows of tracks.csv that count: those that the tracker does not call tentative, shape (rows,)."""
    return np.asarray(tracks["status"] != TrackStatus.TENTATIVE.value)


def _judged(run: Run, options: EvaluationConfig) -> BoolArray:
    """Rows of tracks.csv to judge: stamped while truth was recorded, of a finished tick, confirmed if asked.

    Only a run that was killed has rows of a tick that timing.csv does not know.
    """
    tracks, truth_ns = run.tables["tracks"], run.tables["truth"]["stamp_ns"]
    judged = (tracks["stamp_ns"] >= truth_ns.min()) & (tracks["stamp_ns"] <= truth_ns.max())
    judged &= np.isin(tracks["tick"], run.tables["timing"]["tick"])
    if options.confirmed_only:
        judged &= confirmed(tracks)
    return np.asarray(judged)


def _ignored(run: Run, tracks: Table, paths: list[TruePath], gate_m: float) -> BoolArray:
    """Whether each row of `tracks` is neither right nor false, shape (rows,): it is no true object's, and ignored."""
    ignored = true_paths(ignored_objects(run.tables["ignored"]))
    both = np.stack([path.at(tracks["stamp_ns"])[:, :2] for path in [*paths, *ignored]], axis=1)
    xy = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    distances_m = np.linalg.norm(both - xy[:, None], axis=-1)
    tick_index = np.searchsorted(run.tables["timing"]["tick"], tracks["tick"])
    inside = np.where(distances_m <= gate_m, distances_m, np.inf)
    found = _pair(inside, tracks["track_id"], tick_index, run.tables["timing"].num_rows)
    return np.asarray((found >= len(paths)) | ((found == NO_OBJECT) & in_regions(run, tracks["stamp_ns"], xy)))


def _present(paths: list[TruePath], now_ns: IntArray) -> BoolArray:
    return np.stack([np.isfinite(path.at(now_ns)[:, 0]) for path in paths], axis=-1)


def _pair(distances_m: FloatArray, ids: IntArray, tick_index: IntArray, num_ticks: int) -> IntArray:
    """Object of every row, shape (rows,); `distances_m`, shape (rows, objects), is infinite outside the gate."""
    object_index = np.full(len(ids), NO_OBJECT)
    inside = np.isfinite(distances_m)
    unclear = contested(inside, tick_index, num_ticks)
    clear_rows, columns = np.nonzero(inside & ~unclear[tick_index, None])
    object_index[clear_rows] = columns
    order = np.argsort(tick_index, kind="stable")
    edges = np.searchsorted(tick_index[order], np.arange(num_ticks + 1)).tolist()
    for k in np.flatnonzero(unclear).tolist():
        before, rows = order[edges[max(k - 1, 0)] : edges[k]], order[edges[k] : edges[k + 1]]
        before = before[object_index[before] != NO_OBJECT]
        previous = np.full(distances_m.shape[1], NO_TRACK)
        previous[object_index[before]] = ids[before]
        for row, column in _assign(distances_m[rows], ids[rows], previous):
            object_index[rows[row]] = column
    return object_index


def _assign(distances_m: FloatArray, ids: IntArray, previous: IntArray) -> list[tuple[int, int]]:
    """Pairs (row, object) of one tick; `distances_m`, shape (rows, objects), is infinite outside the gate."""
    keep = (ids[:, None] == previous) & np.isfinite(distances_m)
    kept_rows, kept_columns = np.nonzero(keep)
    free_rows = np.flatnonzero(~keep.any(axis=1))
    free_columns = np.flatnonzero(~keep.any(axis=0))
    pairs = list(zip(kept_rows.tolist(), kept_columns.tolist(), strict=True))
    cost = distances_m[np.ix_(free_rows, free_columns)]
    inside = np.isfinite(cost)
    if inside.any():
        # A forbidden pair costs more than all allowed ones together, so the number of pairs is the largest.
        forbidden = 1.0 + 2.0 * float(cost[inside].max()) * min(cost.shape)
        rows, columns = linear_sum_assignment(np.where(inside, cost, forbidden))
        allowed = inside[rows, columns]
        chosen = zip(free_rows[rows[allowed]].tolist(), free_columns[columns[allowed]].tolist(), strict=True)
        pairs.extend(chosen)
    return pairs

"""Published decisions and states that are taken back later."""

import math
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, Disposition, FloatArray, IntArray
from fgtrack.evaluation.matching import confirmed, neighbours, position_squares
from fgtrack.evaluation.scores.statistics import CHI_SQUARE_2_95, Distribution
from fgtrack.evaluation.settings import EvaluationConfig
from fgtrack.runs import NO_TRACK, Columns, Run

#: Columns that name a detection.
_KEY = ("sensor", "stamp_ns", "receipt_ns", "index")


@dataclass(frozen=True)
class RevisionMetrics:
    """Decisions and states of a run that were taken back. All counts are 0 for a tracker that decides once."""

    changes: int = 0
    """Number of changes of a detection's track by late data."""
    detections: int = 0
    """Number of received detections."""
    revised_detections: int = 0
    """Number of detections whose track has changed at least once."""
    other_track: int = 0
    """Number of detections that have another track in the end than at arrival."""
    new_track: int = 0
    """Number of detections that have a track in the end, and none at arrival."""
    no_track: int = 0
    """Number of detections that have a track at arrival, and none in the end."""
    time_to_final_s: Distribution = field(default_factory=Distribution)
    """Time from the arrival of a revised detection to the last change of its track."""
    compared_states: int = 0
    """Number of published states with a later state of the same track at the same stamp."""
    moved_states: int = 0
    """Number of compared states whose later position is outside of the published 95 % ellipse."""
    withdrawn_states: int = 0
    """Number of published states of a track that in the end does not exist at their stamp, or was never confirmed."""

    @property
    def revised_share(self) -> float:
        """Share of the detections whose track has changed at least once; NaN without detections."""
        return (
            self.revised_detections / self.detections if self.detections else math.nan
        )

    @property
    def moved_share(self) -> float:
        """Share of the compared states that have moved outside of their 95 % ellipse; NaN without compared states.

        It is below 5 % if the published covariances are right.
        """
        return (
            self.moved_states / self.compared_states
            if self.compared_states
            else math.nan
        )


@dataclass(frozen=True)
class TracksOfDetections:
    """Tracks of detections over time: one row for each detection and each track that it had."""

    update: IntArray
    """Row of the detection in updates.csv, shape (n,)."""
    track_ids: IntArray
    """Number of the track, shape (n,); `NO_TRACK` for a detection without a track."""
    from_ns: IntArray
    """Time of the tick at which the detection got this track, shape (n,)."""
    until_ns: IntArray
    """Time of the tick at which the detection lost this track, shape (n,); the largest integer for the last track."""

    @property
    def is_last(self) -> BoolArray:
        """Mask of the rows with the last track of a detection, shape (n,)."""
        return np.asarray(self.until_ns == FOREVER_NS)

    @property
    def is_first(self) -> BoolArray:
        """Mask of the rows with the track of a detection at its arrival, shape (n,)."""
        first = np.ones(len(self.update), dtype=np.bool_)
        first[1:] = self.update[1:] != self.update[:-1]
        return first


FOREVER_NS = int(np.iinfo(np.int64).max)


def revision_metrics(run: Run, options: EvaluationConfig) -> RevisionMetrics:
    """Return the decisions and states of `run` that late data has changed. No truth is needed."""
    own = tracks_of_detections(run)
    last = own.is_last
    at_arrival, in_the_end = own.track_ids[own.is_first], own.track_ids[last]
    arrival_ns, final_ns = own.from_ns[own.is_first], own.from_ns[last]
    revised = ~own.is_first[last]
    had, has = at_arrival != NO_TRACK, in_the_end != NO_TRACK
    moved = _moved(run, options)
    return RevisionMetrics(
        changes=int((~own.is_first).sum()),
        detections=run.tables["updates"].num_rows,
        revised_detections=int(revised.sum()),
        other_track=int((had & has & (at_arrival != in_the_end)).sum()),
        new_track=int((has & ~had).sum()),
        no_track=int((had & ~has).sum()),
        time_to_final_s=Distribution.of((final_ns - arrival_ns)[revised] / NS_PER_S),
        compared_states=len(moved),
        moved_states=int(moved.sum()),
        withdrawn_states=_withdrawn(run, options),
    )


def tracks_of_detections(run: Run) -> TracksOfDetections:
    """Return the tracks of all detections over time, in the order of updates.csv and then of time.

    Detections of a repeated list (`duplicate`) have no track. A change in a tick that is missing in timing.csv counts
    at the next tick.
    """
    updates, revisions = run.tables["updates"], run.tables["revisions"]
    number, of_revision = _same(updates, revisions)
    changed = np.flatnonzero(of_revision >= 0)
    update = np.concatenate([number, of_revision[changed]])
    tracks = np.concatenate([updates["track_id"], revisions["track_id"][changed]])
    ticks = np.concatenate([updates["tick"], revisions["tick"][changed]])
    order = np.argsort(update, kind="stable")
    update, from_ns = update[order], _times_ns(run, ticks)[order]
    until_ns = np.full(len(update), FOREVER_NS)
    goes_on = update[1:] == update[:-1]
    until_ns[:-1][goes_on] = from_ns[1:][goes_on]
    return TracksOfDetections(update, tracks[order], from_ns, until_ns)


def later_states(run: Run) -> Columns:
    """Return the final states, or the states with the longest lag if there are no final states. May be empty."""
    smoothed, lagged = run.tables["smoothed"], run.tables["lagged"]
    final = smoothed.where(smoothed["kind"] == "final")
    if final.num_rows or not lagged.num_rows:
        return final
    return lagged.where(lagged["lag_s"] == lagged["lag_s"].max())


def _same(updates: Columns, revisions: Columns) -> tuple[IntArray, IntArray]:
    """Return the row of each update, and the row of the update that each revision changes; -1 without a row."""
    n = updates.num_rows
    codes = np.zeros(n + revisions.num_rows, dtype=np.int64)
    for name in _KEY:
        _, own = np.unique(
            np.concatenate([updates[name], revisions[name]]), return_inverse=True
        )
        _, codes = np.unique(
            codes * (own.max(initial=0) + 1) + own, return_inverse=True
        )
    of_code = np.full(codes.max(initial=-1) + 1, -1)
    kept = np.flatnonzero(updates["disposition"] != Disposition.DUPLICATE.value)[::-1]
    of_code[codes[kept]] = kept
    return np.arange(n), of_code[codes[n:]]


def _times_ns(run: Run, ticks: IntArray) -> IntArray:
    """Return the times of `ticks`, shape (n,)."""
    timing = run.tables["timing"]
    if not timing.num_rows:
        return np.zeros(len(ticks), dtype=np.int64)
    rows = np.searchsorted(timing["tick"], ticks)
    return np.asarray(timing["now_ns"][np.minimum(rows, timing.num_rows - 1)])


def _published(run: Run, options: EvaluationConfig) -> Columns:
    tracks = run.tables["tracks"]
    return tracks.where(confirmed(tracks)) if options.confirmed_only else tracks


def _moved(run: Run, options: EvaluationConfig) -> BoolArray:
    """Return a mask of the compared states: True if the later position is outside of the published 95 % ellipse."""
    later, states = later_states(run), _published(run, options)
    before, after = neighbours(
        later, "stamp_ns", states["stamp_ns"], states["track_id"]
    )
    both = (before >= 0) & (after >= 0)
    states, before, after = states.where(both), before[both], after[both]
    squares = position_squares(
        states, _between(later, before, after, states["stamp_ns"])
    )
    return np.asarray(squares[np.isfinite(squares)] > CHI_SQUARE_2_95)


def _between(
    later: Columns, before: IntArray, after: IntArray, stamps_ns: IntArray
) -> FloatArray:
    """Return the positions (n, 2) at `stamps_ns`, linearly interpolated between two rows of `later`."""
    first_ns = later["stamp_ns"][before]
    length_ns = np.maximum(later["stamp_ns"][after] - first_ns, 1)
    share = ((stamps_ns - first_ns) / length_ns)[:, None]
    positions_m = np.stack([later["x_m"], later["y_m"]], axis=-1)
    return np.asarray((1.0 - share) * positions_m[before] + share * positions_m[after])


def _withdrawn(run: Run, options: EvaluationConfig) -> int:
    """Return the number of published states whose track, in the end, begins later or was never confirmed."""
    final, states = run.tables["final_tracks"], _published(run, options)
    if not final.num_rows:
        return 0
    if options.confirmed_only:
        final = final.where(final["is_confirmed"] == 1)
    order = np.argsort(final["track_id"], kind="stable")
    ids, first_ns = final["track_id"][order], final["first_stamp_ns"][order]
    at = np.searchsorted(ids, states["track_id"])
    known = at < len(ids)
    known[known] = ids[at[known]] == states["track_id"][known]
    known[known] = first_ns[at[known]] <= states["stamp_ns"][known]
    return int((~known).sum())

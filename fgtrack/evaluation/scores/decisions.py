"""Wrong decisions about detections, and the parts of decisions and of estimates in the errors.

The true object of a detection is the nearest object within `evaluation.gate_m`. Two objects that are nearer to each
other than the noise of a sensor are distinguished by chance.
"""

import math
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, Disposition, IntArray
from fgtrack.evaluation.matching import (
    NO_OBJECT,
    Matching,
    TrackErrors,
    near_pairs,
    track_errors,
)
from fgtrack.evaluation.placement import detections_in_map, update_rows
from fgtrack.evaluation.scores.lagged import final_errors
from fgtrack.evaluation.scores.revisions import (
    TracksOfDetections,
    tracks_of_detections,
)
from fgtrack.evaluation.settings import EvaluationConfig
from fgtrack.runs import NO_TRACK, Columns, Run

RECENT_S = 1.0
"""A state counts as hit by a wrong decision for this time."""

#: Dispositions about which no decision was made.
_UNDECIDED = (
    Disposition.MERGED,
    Disposition.OUT_OF_BOUNDS,
    Disposition.DUPLICATE,
    Disposition.SUPERSEDED,
    Disposition.INVALID,
)


@dataclass(frozen=True)
class DecisionErrors:
    """Outcomes of decisions. The object of a track is the object of most of its detections."""

    right: int = 0
    """Number of detections of an object that the track of the object has."""
    other_object: int = 0
    """Number of detections of an object that the track of another object, or of no object, has."""
    clutter: int = 0
    """Number of detections of no object that a track has."""
    without_track: int = 0
    """Number of detections of an object that no track has."""

    @property
    def wrong_share(self) -> float:
        """Share of the wrong decisions; NaN without decisions."""
        wrong = self.other_object + self.clutter + self.without_track
        return wrong / (wrong + self.right) if wrong + self.right else math.nan


@dataclass(frozen=True)
class ErrorParts:
    """Mean squared position error, divided into the parts of estimates and of decisions."""

    states: int = 0
    """Number of states with truth."""
    hit_share: float = math.nan
    """Share of the states whose track has a detection of something else than their object, at most `RECENT_S` away."""
    estimation_m2: float = math.nan
    """Mean squared error of the states that no wrong decision has hit."""
    association_m2: float = math.nan
    """Mean squared error of all states minus `estimation_m2`: what wrong decisions add."""


@dataclass(frozen=True)
class DecisionMetrics:
    """Wrong decisions, and the parts of decisions and of estimates in the errors."""

    at_arrival: DecisionErrors
    """Decisions at the arrival of each detection."""
    in_the_end: DecisionErrors
    """Decisions after all revisions."""
    present: ErrorParts
    """Errors of the present states, with the decisions at their ticks."""
    final: ErrorParts
    """Errors of the final states, with the decisions in the end."""


def decision_metrics(
    run: Run, matching: Matching | None, options: EvaluationConfig
) -> DecisionMetrics | None:
    """Return the errors by wrong decisions; None without truth or without the values of detections."""
    if matching is None or not run.tables["detections"].num_rows:
        return None
    objects = _objects(run, matching, options)
    own = tracks_of_detections(run)
    of_update = objects[own.update]
    first, last = own.is_first, own.is_last
    stamps_ns = run.tables["updates"]["stamp_ns"][own.update]
    recent_ns = round(RECENT_S * NS_PER_S)
    judged = _judged(run)[own.update]
    has = own.track_ids != NO_TRACK
    present, final = track_errors(matching), final_errors(run, matching)
    present_ns = matching.now_ns[matching.tick_index[matching.paired]]
    now = _Spans(
        own.track_ids[has],
        of_update[has],
        own.from_ns[has],
        np.minimum(own.until_ns, stamps_ns + recent_ns)[has],
    )
    ends = has & last
    later = _Spans(
        own.track_ids[ends],
        of_update[ends],
        stamps_ns[ends] - recent_ns,
        stamps_ns[ends] + recent_ns,
    )
    return DecisionMetrics(
        _decision_errors(own, of_update, first & judged),
        _decision_errors(own, of_update, last & judged),
        _parts(present, present_ns, now),
        _parts(final, final.stamps_ns, later),
    )


def _judged(run: Run) -> BoolArray:
    """Mask of the updates about which a decision was made."""
    return ~np.isin(run.tables["updates"]["disposition"], list(_UNDECIDED))


def _objects(run: Run, matching: Matching, options: EvaluationConfig) -> IntArray:
    """Return the index of the true object of each update; `NO_OBJECT` without any."""
    detections = run.tables["detections"]
    rows = update_rows(run)
    position_m = detections_in_map(run).position_m
    usable = np.flatnonzero((rows >= 0) & np.isfinite(position_m).all(axis=1))
    points = Columns(
        {
            "x_m": position_m[usable, 0],
            "y_m": position_m[usable, 1],
            "stamp_ns": detections["stamp_ns"][usable],
        }
    )
    nearest = near_pairs(points, matching.paths, options.gate_m).nearest()
    objects = np.full(run.tables["updates"].num_rows, NO_OBJECT)
    objects[rows[usable[nearest.rows]]] = nearest.objects
    return objects


def _decision_errors(
    own: TracksOfDetections, objects: IntArray, chosen: BoolArray
) -> DecisionErrors:
    """Return the outcomes of the `chosen` decisions. `objects` (n,) are the true objects."""
    tracks, objects = own.track_ids[chosen], objects[chosen]
    has, known = tracks != NO_TRACK, objects != NO_OBJECT
    right = objects == _of_tracks(tracks, objects)
    return DecisionErrors(
        right=int((has & known & right).sum()),
        other_object=int((has & known & ~right).sum()),
        clutter=int((has & ~known).sum()),
        without_track=int((known & ~has).sum()),
    )


def _of_tracks(tracks: IntArray, objects: IntArray) -> IntArray:
    """Return for each detection the object of most detections of its track. A tie is won by the first object."""
    if not len(tracks):
        return objects
    size = int(objects.max()) + 2
    _, track = np.unique(tracks, return_inverse=True)
    pairs, counts = np.unique(track * size + objects + 1, return_counts=True)
    order = np.lexsort((pairs, -counts, pairs // size))
    _, first = np.unique(pairs[order] // size, return_index=True)
    return np.asarray(pairs[order][first][track] % size - 1)


@dataclass(frozen=True)
class _Spans:
    """Spans of time in which detections count for states of their tracks, shape (n,) each."""

    track_ids: IntArray
    objects: IntArray
    from_ns: IntArray
    until_ns: IntArray


def _parts(errors: TrackErrors, times_ns: IntArray, spans: _Spans) -> ErrorParts:
    """Return the parts of the error of states at `times_ns` (p,)."""
    squares_m2 = np.square(errors.values["position_m"])
    if not len(squares_m2):
        return ErrorParts()
    every = _count(errors.track_ids, times_ns, spans, spans.track_ids)
    size = int(max(errors.object_index.max(), spans.objects.max(initial=0))) + 2
    right = _count(
        errors.track_ids * size + errors.object_index + 1,
        times_ns,
        spans,
        spans.track_ids * size + spans.objects + 1,
    )
    hit = every > right
    total_m2 = float(squares_m2.mean())
    estimation_m2 = float(squares_m2[~hit].mean()) if not hit.all() else math.nan
    return ErrorParts(
        len(squares_m2), float(hit.mean()), estimation_m2, total_m2 - estimation_m2
    )


def _count(
    keys: IntArray, times_ns: IntArray, spans: _Spans, span_keys: IntArray
) -> IntArray:
    """Return the number of spans with the key of each state that contain its time, shape (p,)."""
    begun, ended = (
        _not_after(keys, times_ns, span_keys, ends_ns)
        for ends_ns in (spans.from_ns, spans.until_ns)
    )
    return begun - ended


def _not_after(
    keys: IntArray, times_ns: IntArray, event_keys: IntArray, event_ns: IntArray
) -> IntArray:
    """Return the number of events with the key of each state at or before its time, shape (p,)."""
    distinct, key = np.unique(event_keys, return_inverse=True)
    distinct_ns, rank = np.unique(event_ns, return_inverse=True)
    size = len(distinct_ns) + 1
    events = np.sort(key * size + rank)
    firsts = np.searchsorted(distinct, keys)
    known = np.isin(keys, distinct)
    until = firsts * size + np.searchsorted(distinct_ns, times_ns, side="right")
    counts = np.searchsorted(events, until) - np.searchsorted(events, firsts * size)
    return np.where(known, counts, 0)

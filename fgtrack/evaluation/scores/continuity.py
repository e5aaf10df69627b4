"""Continuity of tracking: breaks, identity switches, time to the first confirmed track."""

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FUSED, FloatArray, IntArray
from fgtrack.evaluation.matching import (
    Matching,
    confirmed,
    near_pairs,
    published_rows,
)
from fgtrack.runs import NO_TRACK, Run

_SHORTEST_ABSENCE_NS = NS_PER_S


def breaks(track_ids: IntArray) -> int:
    """Number of times that tracking resumes after a loss or with another track.

    `track_ids` are the paired tracks at each tick at which the object is present;
    `NO_TRACK` if no track is paired.
    """
    before = np.concatenate([[NO_TRACK], track_ids])[:-1]
    return max(int(((track_ids != NO_TRACK) & (track_ids != before)).sum()) - 1, 0)


def switches(track_ids: IntArray) -> IntArray:
    """Indices of `track_ids` at which tracking continues with another track than before, shape (switches,)."""
    tracked = np.flatnonzero(track_ids != NO_TRACK)
    sequence = track_ids[tracked]
    return np.asarray(tracked[1:][sequence[1:] != sequence[:-1]])


def times_to_confirm(run: Run, matching: Matching, gate_m: float) -> FloatArray:
    """Time [s] from the first detection of every object to its first confirmed track, shape (objects,).

    It begins at the stamp of the first detection that a track fuses near the object.
    The track must then be within `gate_m` of the object, which is its nearest object.
    It ends at the first tick at which the object is paired with a confirmed track. NaN
    without a confirmed track.
    """
    import pandas as pd

    tracks = run.tables["tracks"]
    updates = run.tables["updates"]
    updates = updates.where(
        np.isin(updates["disposition"], list(FUSED)) & (updates["track_id"] != NO_TRACK)
    )
    rows = published_rows(tracks, updates["tick"], updates["track_id"])
    near = near_pairs(
        tracks.where(rows[rows >= 0]),
        matching.paths,
        2.0 * gate_m,
    )
    first_ns = run.tables["truth"]["stamp_ns"].min()
    near = near.where(near.distances_m <= gate_m).nearest()
    paired = matching.paired & confirmed(matching.tracks)
    detected_ns = pd.Series(updates["stamp_ns"][rows >= 0][near.rows] - first_ns)
    confirmed_ns = pd.Series(matching.now_ns[matching.tick_index[paired]] - first_ns)
    begin_ns = detected_ns.groupby(near.objects).min()
    times_s = (
        confirmed_ns.groupby(matching.object_index[paired]).min() - begin_ns
    ) / NS_PER_S
    return np.asarray(
        times_s.reindex(range(len(matching.object_ids))), dtype=np.float64
    )


def tracked_visits(matching: Matching) -> int:
    """Number of visits with a confirmed track, over all objects.

    A visit is a time in view. Two visits of an object are at least a second apart. "A
    TP object gets a unique identifier while it's inside the detectable area" (Karle et
    al. 2023, section IV-A).
    """
    paired = matching.paired & confirmed(matching.tracks)
    tracked = np.zeros_like(matching.in_view)
    tracked[matching.tick_index[paired], matching.object_index[paired]] = True
    count = 0
    for in_view, has_track in zip(matching.in_view.T, tracked.T, strict=True):
        ticks = np.flatnonzero(in_view)
        comes = (
            np.diff(matching.now_ns[ticks], prepend=-_SHORTEST_ABSENCE_NS)
            >= _SHORTEST_ABSENCE_NS
        )
        count += len(np.unique(np.cumsum(comes)[has_track[ticks]]))
    return count

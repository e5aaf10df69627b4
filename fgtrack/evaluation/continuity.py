"""Time to the first confirmed track, and identity switches caused by late measurements."""

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FUSED, LATE, BoolArray, Disposition, FloatArray, IntArray
from fgtrack.evaluation.matching import Matching
from fgtrack.evaluation.matching import confirmed as is_confirmed
from fgtrack.evaluation.truth import true_paths
from fgtrack.io.run import NO_TRACK, Run, Table

_SHORTEST_ABSENCE_NS = NS_PER_S


def late_switches(run: Run, matching: Matching, within_s: float) -> IntArray:
    """Identity switches of every object that follow on an out-of-sequence update, shape (objects,).

    A switch counts where the track before it or the one after it had such an update in the ticks from `within_s`
    before the switch up to it.
    """
    updates = run.tables["updates"].where(with_disposition(run.tables["updates"], LATE))
    updates = updates.where(
        np.isin(updates["tick"], run.tables["timing"]["tick"])
    )  # not of a tick that was never finished
    updated_ns = matching.now_ns[np.searchsorted(run.tables["timing"]["tick"], updates["tick"])]
    counts = np.zeros(len(matching.object_ids), dtype=np.int64)
    for index in range(len(counts)):
        ticks = np.flatnonzero(matching.present[:, index] & (matching.track_ids[:, index] != NO_TRACK))
        sequence = matching.track_ids[ticks, index]
        for k in np.flatnonzero(sequence[1:] != sequence[:-1]).tolist():
            age_ns = matching.now_ns[ticks[k + 1]] - updated_ns
            recent = (age_ns >= 0) & (age_ns <= within_s * NS_PER_S)
            counts[index] += np.isin(updates["track_id"][recent], sequence[k : k + 2]).any()
    return counts


def times_to_confirm(run: Run, matching: Matching, gate_m: float) -> FloatArray:
    """Time from the first detection of every object to its first confirmed track in s, shape (objects,).

    It begins at the stamp of the first detection that was fused into a track which then lies on the object (nearest
    object within `gate_m`), and ends with the tick at which the object is first paired with a row that is `confirmed`.
    NaN where there is no such row.
    """
    count = len(matching.object_ids)
    updates = run.tables["updates"].where(
        with_disposition(run.tables["updates"], FUSED) & (run.tables["updates"]["track_id"] != NO_TRACK)
    )
    rows = _published(run.tables["tracks"], updates)
    stamps_ns, rows = updates["stamp_ns"][rows >= 0], rows[rows >= 0]
    xy = np.stack([run.tables["tracks"]["x_m"][rows], run.tables["tracks"]["y_m"][rows]], axis=-1)
    truth = np.stack(
        [path.at(run.tables["tracks"]["stamp_ns"][rows])[:, :2] for path in true_paths(run.tables["truth"])], axis=1
    )
    distances_m = np.linalg.norm(truth - xy[:, None], axis=-1)
    distances_m[~(distances_m <= gate_m)] = np.inf
    near = np.isfinite(distances_m).any(axis=1)
    never = np.iinfo(np.int64).max
    seen_ns, confirmed_ns = np.full(count, never), np.full(count, never)
    np.minimum.at(seen_ns, distances_m[near].argmin(axis=1), stamps_ns[near])
    confirmed = matching.paired & is_confirmed(matching.tracks)
    at_ns = matching.now_ns[matching.tick_index[confirmed]]
    np.minimum.at(confirmed_ns, matching.object_index[confirmed], at_ns)
    known = (seen_ns != never) & (confirmed_ns != never)
    times_s = np.full(count, np.nan)
    times_s[known] = (confirmed_ns[known] - seen_ns[known]) / NS_PER_S
    return times_s


def tracked_visits(matching: Matching) -> int:
    """How often an object came into sight and was tracked there by a confirmed track, over all objects.

    "A TP object gets a unique identifier while it's inside the detectable area" (Karle et al. 2023, section IV-A): one
    that leaves the sight of all sensors for a second or longer, and comes back, counts again.
    """
    confirmed = matching.paired & is_confirmed(matching.tracks)
    tracked = np.zeros_like(matching.in_sight)
    tracked[matching.tick_index[confirmed], matching.object_index[confirmed]] = True
    count = 0
    for in_sight, has_track in zip(matching.in_sight.T, tracked.T, strict=True):
        ticks = np.flatnonzero(in_sight)
        comes = np.diff(matching.now_ns[ticks], prepend=-_SHORTEST_ABSENCE_NS) >= _SHORTEST_ABSENCE_NS
        count += len(np.unique(np.cumsum(comes)[has_track[ticks]]))
    return count


def with_disposition(updates: Table, dispositions: tuple[Disposition, ...]) -> BoolArray:
    """Whether each row of `updates` has one of `dispositions`, shape (rows,)."""
    return np.isin(updates["disposition"], [name.value for name in dispositions])


def _published(tracks: Table, updates: Table) -> IntArray:
    """The row of `tracks` with tick and track of each of `updates`, shape (updates,); -1 where there is none."""
    if not tracks.num_rows:
        return np.full(updates.num_rows, -1)
    step = 1 + max(int(tracks["track_id"].max()), int(updates["track_id"].max(initial=0)))
    keys = tracks["tick"] * step + tracks["track_id"]
    wanted = updates["tick"] * step + updates["track_id"]
    order = np.argsort(keys)
    rows = order[np.searchsorted(keys[order], wanted).clip(max=len(keys) - 1)]
    return np.where(keys[rows] == wanted, rows, -1)

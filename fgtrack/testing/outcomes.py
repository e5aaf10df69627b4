"""Final tracks of a tracker, and their differences from the final tracks of another tracker."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import (
    Disposition,
    FinalTrack,
    FloatArray,
    Revision,
    TrackReport,
    UpdateRecord,
)
from fgtrack.pipeline.build import build_tracker
from fgtrack.testing.drawn_scenes import HORIZON_S, Scene
from fgtrack.tracking.tracker import MultiObjectTracker

_TICK_HZ = 20
#: A track that is less probable at present ends without any list, once the lists up to now are usually there.
_LEAST_EXISTENCE = 0.02
_SURE_EXISTENCE = 0.6
_AGES_S = (0.0, 0.5, 1.0)
Key = tuple[str, int, int]
"""Sensor, stamp and index of a detection."""
Build = Callable[[Config], MultiObjectTracker]
"""Function that makes the tracker of a configuration."""
USED = frozenset(
    {
        Disposition.BIRTH,
        Disposition.IN_SEQUENCE,
        Disposition.OUT_OF_SEQUENCE,
        Disposition.BEYOND_WINDOW,
        Disposition.MERGED,
    }
)
"""Dispositions of detections that belong to a track and are no copies."""


@dataclass
class Outcome:
    """Final tracks and states of a tracker. A track is named by its first detection."""

    states: dict[tuple[Key, int], tuple[FloatArray, FloatArray]]
    """Mean and covariance of each track at several stamps, by the track and the stamp."""
    tracks: list[tuple[Any, ...]]
    """Final tracks without their numbers, sorted."""
    of: dict[Key, Key | None]
    """Track of each detection; None without a track."""
    statuses: dict[Key, tuple[Any, ...]]
    """Status and description of each probable track at the end."""
    records: list[UpdateRecord] = field(repr=False, default_factory=list)
    revisions: list[Revision] = field(repr=False, default_factory=list)


def outcome(scene: Scene, build: Build = build_tracker) -> Outcome:
    """Return the final tracks in a scene of the tracker that `build` makes."""
    tracker = build(Config.from_dict(scene.config))
    records, revisions, tracks = _fed(tracker, scene)
    reports: list[tuple[int, TrackReport]] = []
    for age_s in _AGES_S:
        stamp_ns = round((scene.length_s - age_s) * NS_PER_S)
        reports += [
            (stamp_ns, each)
            for each in tracker.tracks_at(stamp_ns)
            if (each.score or 0.0) > _LEAST_EXISTENCE
        ]
    tracker.finish()
    revisions += tracker.revised()
    tracks += [*tracker.settled_tracks(), *tracker.final_tracks()]
    assert not tracker.failures.ended
    of = _last_tracks(records, revisions)
    first: dict[int, Key] = {}
    for key, track_id in of.items():
        if track_id is not None:
            first[track_id] = min(first.get(track_id, key), key, key=_by_stamp)
    states = {
        (first[each.track_id], stamp_ns): (each.state.mean, each.state.covariance)
        for stamp_ns, each in reports
        if each.track_id in first
    }
    statuses = {
        first[each.track_id]: (each.status, each.object)
        for _, each in reports
        if each.track_id in first and (each.score or 0.0) > _SURE_EXISTENCE
    }
    return Outcome(
        states,
        sorted(tuple(each[1:]) for each in tracks),
        {key: None if i is None else first[i] for key, i in of.items()},
        statuses,
        records,
        revisions,
    )


def _fed(
    tracker: MultiObjectTracker, scene: Scene
) -> tuple[list[UpdateRecord], list[Revision], list[FinalTrack]]:
    """Give a tracker all messages in the order of their receipt. Return its records and revisions."""
    messages = sorted(scene.messages, key=lambda each: each.receipt_ns)
    records: list[UpdateRecord] = []
    revisions: list[Revision] = []
    tracks: list[FinalTrack] = []
    at, end_s = 0, scene.length_s + HORIZON_S - 1.0
    for tick in range(round(end_s * _TICK_HZ)):
        now_ns = tick * NS_PER_S // _TICK_HZ
        while at < len(messages) and messages[at].receipt_ns <= now_ns:
            tracker.receive(messages[at])
            at += 1
        report = tracker.tick(now_ns)
        records += report.updates
        revisions += report.revisions
        tracks += report.final_tracks
    assert at == len(messages)
    return records, revisions, tracks


def _by_stamp(key: Key) -> tuple[int, str, int]:
    return key[1], key[0], key[2]


def _last_tracks(
    records: Sequence[UpdateRecord], revisions: Sequence[Revision]
) -> dict[Key, int | None]:
    """Return the track of each detection in the end."""
    found = {
        (each.sensor, each.stamp_ns, each.index): each.track_id for each in records
    }
    assert len(found) == len(records)
    for each in revisions:
        key = each.sensor, each.stamp_ns, each.index
        assert found[key] == each.old_track_id
        found[key] = each.track_id
    return found


class Tolerance(NamedTuple):
    """Largest difference between two states: the larger one of a number and of a share of the standard deviation."""

    absolute: float
    """In the units of the state."""
    of_std: float


CONVERGED = Tolerance(1e-3, 0.02)
"""Of the states of a smoother that is nearly converged."""


def difference(
    found: Outcome, expected: Outcome, tolerance: Tolerance | None = None
) -> str:
    """Return the first difference between two outcomes as a sentence; empty for equal outcomes.

    States may differ by `tolerance`. Without one they are equal to the bit, with their covariances.
    """
    others = [key for key in expected.of if found.of.get(key) != expected.of[key]]
    if others or len(found.of) != len(expected.of):
        [key] = others[:1] or [next(iter(found.of.keys() - expected.of.keys()))]
        return (
            f"{len(others)} of {len(expected.of)} detections have another track: {_detection(key)} "
            f"{_belongs(found.of.get(key))} instead of {_belongs(expected.of.get(key))}"
        )
    unlike = sorted(found.states.keys() ^ expected.states.keys())
    if unlike:
        track, stamp_ns = unlike[0]
        which = "late" if unlike[0] in found.states else "in-order"
        return (
            f"at {seconds(stamp_ns):.3f} s only the {which} stream has the track that begins with "
            f"{_detection(track)}"
        )
    for (track, stamp_ns), (mean, P) in found.states.items():
        other_mean, other_P = expected.states[track, stamp_ns]
        if tolerance is None:
            is_equal = np.array_equal(mean, other_mean) and np.array_equal(P, other_P)
        else:
            std = np.sqrt(np.maximum(np.diag(other_P), 0.0))
            limits = np.maximum(tolerance.absolute, tolerance.of_std * std)
            is_equal = bool((np.abs(mean - other_mean) <= limits).all())
        if not is_equal:
            return (
                f"the state at {seconds(stamp_ns):.3f} s of the track that begins with "
                f"{_detection(track)} is {mean} instead of {other_mean}"
            )
    for track, status in expected.statuses.items():
        if found.statuses.get(track) != status:
            return (
                f"the track that begins with {_detection(track)} is {found.statuses.get(track)} "
                f"instead of {status}"
            )
    if found.tracks != expected.tracks:
        unlike_tracks = sorted(set(found.tracks) ^ set(expected.tracks))
        return f"the final tracks differ: {unlike_tracks[:2]}"
    return ""


def _detection(key: Key) -> str:
    sensor, stamp_ns, index = key
    return f"detection {index} of {sensor} at {seconds(stamp_ns):.3f} s"


def _belongs(track: Key | None) -> str:
    if track is None:
        return "belongs to no track"
    return f"belongs to the track that begins with {_detection(track)}"

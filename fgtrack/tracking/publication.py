"""Tracks as a tracker publishes them: at present, smoothed, and at any stamp."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

from fgtrack.core.types import SmoothedReport, TrackReport, TrackState
from fgtrack.estimation.base import StatesAt
from fgtrack.estimation.filters.propagation import kinematic_states
from fgtrack.tracking.guarded_bank import faults
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.tracks import Tracks


class Publication:
    """Makes the reports of tracks, with the yaw of their fronts. Suspended tracks have no report."""

    def __init__(self, parts: TrackerParts, tracks: Tracks) -> None:
        self._parts, self._tracks = parts, tracks

    def present(self) -> Callable[[], Iterable[TrackReport]]:
        """Return a function that makes the reports of all tracks at present. Their states are fixed at this call.

        Tracks whose states cannot be published end.
        """
        parts = self._parts
        states = parts.bank.present()
        track_ids: Sequence[int] = parts.bank.track_ids
        if parts.facing is not None:
            states = parts.facing.published(parts.bank.track_ids, states)
        suspended = parts.lifecycle.suspended()
        if suspended:
            rows = [row for row, each in enumerate(track_ids) if each not in suspended]
            track_ids, states = (
                [track_ids[row] for row in rows],
                [states[row] for row in rows],
            )
        return self._reports(track_ids, states)

    def smoothed(self) -> Sequence[SmoothedReport]:
        """Return the smoothed states that are due."""
        reports, facing = self._parts.bank.smoothed(), self._parts.facing
        turned = reports if facing is None else facing.smoothed(reports)
        return self._tracks.published(turned)

    def at(self, states: StatesAt, stamp_ns: int) -> tuple[TrackReport, ...]:
        """Return the reports of tracks at a stamp, from their `states` at this stamp.

        Suspended tracks, and states with a fault (see `faults`), are left out.
        """
        parts = self._parts
        states = states.without(parts.lifecycle.suspended())
        if not states.track_ids:
            return ()
        present: Sequence[TrackState] = kinematic_states(
            parts.motion, stamp_ns, states.means, states.covariances
        )
        if parts.facing is not None:
            present = parts.facing.seen(states.track_ids, present)
        unsound, reports = faults(present), self._reports(states.track_ids, present)()
        return tuple(report for row, report in enumerate(reports) if row not in unsound)

    def _reports(
        self, track_ids: Sequence[int], states: Sequence[TrackState]
    ) -> Callable[[], Iterable[TrackReport]]:
        """Return a function that makes track reports. Status, probability and counters are fixed at this call."""
        parts = self._parts
        statuses, probabilities = parts.lifecycle.reported(track_ids)
        horizon_ns = parts.bank.present_ns - parts.bank.window_start_ns
        open_until_ns = [
            each.stamp_ns + horizon_ns
            if each.stamp_ns >= parts.bank.window_start_ns
            else None
            for each in states
        ]
        num_measured = list(map(self._tracks.num_measured.__getitem__, track_ids))
        objects = parts.objects.reports(track_ids)
        return partial(
            map,
            TrackReport,
            [self._tracks.public(each) for each in track_ids],
            statuses,
            states,
            num_measured,
            objects,
            probabilities,
            open_until_ns,
        )

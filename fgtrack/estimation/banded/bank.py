"""The smoothers of all objects, solved together."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.estimation.banded.windows import Leaving, States, Windows
from fgtrack.estimation.base import Measurement, Start, StatesAt, UpdateResult, UpdateStatus, no_states
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.failures import Failure, Failures
from fgtrack.estimation.histories import grown
from fgtrack.estimation.initiation import DEFAULT, SMOOTHER_ITERATIONS, Search, checked_initiation
from fgtrack.estimation.present import PresentStates, smoothed_reports
from fgtrack.estimation.propagation import track_state
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.estimation.whitening import Innovations, innovations
from fgtrack.models.motion import MotionModel

_TOO_OLD, _FAILED = UpdateResult(UpdateStatus.TOO_OLD), UpdateResult(UpdateStatus.FAILED)


class _Births(NamedTuple):
    """The m tracks in order of birth."""

    track_ids: tuple[int, ...]
    tracks: IntArray
    """Where the arrays hold them, shape (m,)."""
    ranks: IntArray
    """Position in that order of each track of the arrays."""


class _Times(NamedTuple):
    """Stamps of m tracks, each of shape (m,)."""

    newest: IntArray
    """Of the newest nodes."""
    start: IntArray
    """Where the windows start, by the clock and the newest stamps."""
    reach: IntArray
    """The oldest that may be fused."""
    oldest: IntArray
    """The oldest that can be fused or asked for."""

    def at(self, rows: IntArray) -> "_Times":
        """Those of some tracks."""
        return _Times(*(values[rows] for values in self))


def _joined(parts: Sequence[Leaving]) -> Leaving:
    """All of `parts`, one after the other."""
    if len(parts) == 1:
        return parts[0]
    tracks, stamps_ns, states = zip(*parts, strict=True)
    means, covariances = zip(*states, strict=True)
    return Leaving(
        np.concatenate(tracks), np.concatenate(stamps_ns), States(np.concatenate(means), np.concatenate(covariances))
    )


class BandedBank:
    """The fixed-lag smoothers of all objects in arrays: factors, window and outputs are those of `SmootherBank`.

    Parameters
    ----------
    motion
        The motion model of all objects.
    settings
        Window, late policy, relinearisation and outputs.
    initiation
        How the direction of travel of a new object is found where nothing else gives one, see `Initiation`.
    failures
        Counts how often windows are built anew and steps are damped.
    """

    def __init__(
        self,
        motion: MotionModel,
        settings: SmootherSettings,
        initiation: str = DEFAULT,
        failures: Failures | None = None,
    ) -> None:
        self._motion = motion
        self._settings = settings
        self._lag_ns, self._behind_ns = nanoseconds(settings.lag_s), nanoseconds(settings.behind_s)
        self.windows = Windows(motion, settings, failures or Failures())
        self._numbers: dict[int, int] = {}
        """Where the arrays hold each track, in order of birth."""
        self._known_births: _Births | None = None
        """Until a track begins or ends."""
        self._free: list[int] = []
        self._now_ns = 0
        self._clock_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._first_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._initiation = checked_initiation(initiation)
        self._searches: dict[int, Search] = {}
        """Of the tracks whose direction is sought."""
        self._states: dict[int, tuple[tuple[int, ...], IntArray, States]] = {}
        """The tracks that are known at a stamp, where the arrays hold them, and their states."""
        self._times: _Times | None = None
        """Of all tracks, in order of birth, where they are known; like `_states` until something changes."""
        self._final: list[Leaving] = []
        self._ended: list[SmoothedReport] = []

    # --- what a `TrackBank` says

    @property
    def present_ns(self) -> int:
        """See `TrackBank.present_ns`."""
        return self._now_ns

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`; where late measurements are an error, they must come as far as here."""
        return 0 if self._settings.late == "raise" else self._oldest_ns

    @property
    def _oldest_ns(self) -> int:
        return self._now_ns - self._lag_ns - self._behind_ns

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return self._births.track_ids

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self._now_ns = now_ns
        self._clock_ns = np.maximum(self._clock_ns, now_ns)
        self._changed()  # which tracks are known at a stamp depends on the clock

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`. Raises `DataError` for a stamp before the window where the policy is `raise`."""
        self._settings.refuse_older(stamp_ns, self._oldest_ns)
        track_ids, _, states = self._known_at(stamp_ns)
        if not track_ids:
            return no_states(self._motion.dim)
        return StatesAt(track_ids, states.means, states.covariances)

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        if not track_ids:
            return []
        tracks = np.array([self._numbers[track_id] for track_id in track_ids])
        measurements = [measurement.seen_by(self._motion) for measurement in measurements]
        times = self._all_times().at(self._births.ranks[tracks])
        if self._settings.late == "raise":
            self._settings.refuse_older(stamp_ns, int(times.start.max()))
        young = times.oldest <= stamp_ns
        if young.all():
            return self._update(stamp_ns, tracks, measurements, times)
        results = [_TOO_OLD] * len(tracks)
        rows = young.nonzero()[0]
        if rows.size:
            chosen = [measurements[row] for row in rows.tolist()]
            updated = self._update(stamp_ns, tracks[rows], chosen, times.at(rows))
            for row, result in zip(rows.tolist(), updated, strict=True):
                results[row] = result
        return results

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        track = self._free.pop() if self._free else len(self._numbers)
        self.windows.solver.begin(track, prior.stamp_ns, *initial_state(self._motion, prior))
        if track >= len(self._clock_ns):
            size = len(self.windows.nodes.first)
            self._clock_ns, self._first_ns = grown(self._clock_ns, size), grown(self._first_ns, size)
        self._clock_ns[track] = self._first_ns[track] = prior.stamp_ns
        self._searches.pop(track, None)
        search = Search.of(self._motion, prior, self._initiation)
        if search is not None:
            self._searches[track] = search
        self._numbers[track_id] = track
        self._renumbered()

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`; what was still inside the window becomes final."""
        rest = self.take_rest(track_id)
        if rest:
            states = States(np.array([state.mean for state in rest]), np.array([state.covariance for state in rest]))
            stamps_ns = [state.stamp_ns for state in rest]
            self._ended += smoothed_reports(self._motion, [track_id] * len(rest), stamps_ns, *states)
        self._free.append(self._numbers.pop(track_id))
        self._renumbered()

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
        if not self._numbers:
            return []
        tracks = self._births.tracks
        states = self.windows.states_at(tracks, np.maximum(self._now_ns, self._all_times().oldest))
        return PresentStates(self._motion, self._now_ns, *states)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        reports, self._ended = self._ended, []
        if self._final:
            final, self._final = _joined(self._final), []
            births = self._births
            ranks = births.ranks[final.tracks]
            order = ranks.argsort(kind="stable")
            track_ids = [births.track_ids[rank] for rank in ranks[order].tolist()]
            states = States(final.states.means[order], final.states.covariances[order])
            reports += smoothed_reports(self._motion, track_ids, final.stamps_ns[order].tolist(), *states)
        for lag_s in self._settings.lagged_s:
            stamp_ns = self.present_ns - nanoseconds(lag_s)
            known, _, states = self._known_at(stamp_ns)
            if known:
                reports += smoothed_reports(self._motion, known, [stamp_ns] * len(known), *states, lag_s)
        return reports

    # --- one track

    def window_ns(self, track_id: int) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        tracks = np.array([self._numbers[track_id]])
        return int(self._times_ns(tracks).oldest[0]), int(self.windows.newest_ns(tracks)[0])

    def state_at(self, track_id: int, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`."""
        states = self.windows.states_at(np.array([self._numbers[track_id]]), np.array([stamp_ns]))
        return track_state(self._motion, stamp_ns, states.means[0], states.covariances[0])

    def take_final(self, track_id: int) -> list[TrackState]:
        """Smoothed states of the nodes that have left the window since the last call, in order."""
        if not self._final:
            return []
        final = _joined(self._final)
        mine = final.tracks == self._numbers[track_id]
        self._final = [final.at(~mine)]
        own = final.at(mine)
        return [track_state(self._motion, *state) for state in zip(own.stamps_ns.tolist(), *own.states, strict=True)]

    def take_rest(self, track_id: int) -> list[TrackState]:
        """Like `take_final`, and of the nodes that are still inside."""
        if not self._settings.final:
            return self.take_final(track_id)
        stamps_ns = self.windows.solver.stamps_ns(self._numbers[track_id])
        return self.take_final(track_id) + [self.state_at(track_id, stamp_ns) for stamp_ns in stamps_ns]

    def converge(self, track_id: int, max_iterations: int) -> None:
        """Relinearise a track until nothing moves; for comparisons."""
        self.windows.solver.converge(self._numbers[track_id], max_iterations)
        self._changed()

    # --- inside

    def _update(
        self, stamp_ns: int, tracks: IntArray, measurements: Sequence[Measurement], times: _Times
    ) -> list[UpdateResult]:
        """`update` of tracks that reach as far back as `stamp_ns`."""
        results = [_FAILED] * len(tracks)
        statuses = [UpdateStatus.IN_SEQUENCE] * len(tracks)
        for late, status in (
            (stamp_ns < times.newest, UpdateStatus.OUT_OF_SEQUENCE),
            (stamp_ns < times.start, UpdateStatus.BEYOND_WINDOW),
        ):
            for row in late.nonzero()[0].tolist():
                statuses[row] = status
        states = self._states_of(tracks, stamp_ns)
        groups = list(innovations(measurements, *states))
        groups = [group.at(np.isfinite(group.nis)) for group in groups]
        for group in groups:
            for row, y, nis in zip(group.positions.tolist(), group.y, group.nis.tolist(), strict=True):
                results[row] = UpdateResult(statuses[row], y, nis)
        for row in self._fuse(stamp_ns, tracks, measurements, groups, states.means, times):
            results[row] = _FAILED
        return results

    def _fuse(
        self,
        stamp_ns: int,
        tracks: IntArray,
        measurements: Sequence[Measurement],
        groups: Sequence[Innovations],
        guesses: FloatArray,
        times: _Times,
    ) -> list[int]:
        """Fuse those of `measurements` that are in `groups`; gives the positions of those that cannot be."""
        positions = np.sort(np.concatenate([group.positions for group in groups]))
        if not positions.size:
            return []
        everyone = tracks, measurements, groups, guesses, times
        if len(positions) < len(tracks):
            tracks, guesses, times = tracks[positions], guesses[positions], times.at(positions)
            measurements = [measurements[position] for position in positions.tolist()]
            groups = [group.numbered(positions) for group in groups]
        self._changed()
        try:
            left = self.windows.fuse(tracks, stamp_ns, measurements, groups, guesses, times.start, times.reach)
        except np.linalg.LinAlgError:
            if len(positions) == 1:
                self.windows.failures.add(Failure.GRAPH_REBUILT)
                return [int(positions[0])]
            tracks, measurements, groups, guesses, times = everyone
            singles = [group.at(group.positions == position) for position in positions for group in groups]
            return [
                failed
                for single in singles
                if single.positions.size
                for failed in self._fuse(stamp_ns, tracks, measurements, [single], guesses, times)
            ]
        if left.tracks.size:
            self._final.append(left)
        if self._searches:
            for track in self._searches.keys() & set(tracks.tolist()):
                self._initiate(track, stamp_ns)
        self.windows.damp(tracks)
        self.windows.solver.iterate(tracks, self._settings.max_iterations - 1)
        return []

    def _initiate(self, track: int, oldest_ns: int) -> None:
        """Begin again from a straight line, where the oldest new stamp asks for it, as long as nothing has left."""
        search = self._searches.pop(track)
        if not self.windows.whole(track):
            return
        self._searches[track] = search
        found = search.next_line(partial(self.windows.fixes, track), oldest_ns)
        if found is not None:
            line, self._searches[track] = found
            self.windows.restart(track, line)
            self.windows.solver.iterate(np.array([track]), SMOOTHER_ITERATIONS)

    @property
    def _births(self) -> _Births:
        if self._known_births is None:
            tracks = np.fromiter(self._numbers.values(), dtype=np.int64, count=len(self._numbers))
            ranks = np.zeros(len(self._clock_ns), dtype=np.int64)
            ranks[tracks] = np.arange(len(tracks))
            self._known_births = _Births(tuple(self._numbers), tracks, ranks)
        return self._known_births

    def _renumbered(self) -> None:
        self._known_births = None
        self._changed()

    def _changed(self) -> None:
        """Forget what was computed of the states."""
        self._states.clear()
        self._times = None

    def _all_times(self) -> _Times:
        if self._times is None:
            self._times = self._times_ns(self._births.tracks)
        return self._times

    def _times_ns(self, tracks: IntArray) -> _Times:
        newest, first = self.windows.newest_ns(tracks), self._first_ns[tracks]
        start = np.maximum(np.maximum(self._clock_ns[tracks], newest) - self._lag_ns, first)
        reach = np.maximum(start - self._behind_ns, first)
        return _Times(newest, start, reach, np.maximum(reach, self.windows.oldest_ns(tracks)))

    def _known_at(self, stamp_ns: int) -> tuple[tuple[int, ...], IntArray, States]:
        """States at `stamp_ns` of the tracks that are known there."""
        found = self._states.get(stamp_ns)
        if found is None:
            track_ids, tracks = self._births.track_ids, self._births.tracks
            known = self._all_times().oldest <= stamp_ns
            if not known.all():
                track_ids, tracks = tuple(track_ids[row] for row in known.nonzero()[0].tolist()), tracks[known]
            states = self.windows.states_at(tracks, np.full(len(tracks), stamp_ns))
            found = self._states[stamp_ns] = track_ids, tracks, states
        return found

    def _states_of(self, tracks: IntArray, stamp_ns: int) -> States:
        found = self._states.get(stamp_ns)
        if found is None:
            return self.windows.states_at(tracks, np.full(len(tracks), stamp_ns))
        _, known, states = found
        if len(known) == len(tracks) and (known == tracks).all():
            return states
        chosen = self._births.ranks[tracks]
        if len(known) < len(self._births.tracks):
            chosen = np.searchsorted(self._births.ranks[known], chosen)
        return States(states.means[chosen], states.covariances[chosen])

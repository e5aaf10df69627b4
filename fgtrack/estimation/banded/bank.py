"""The smoothers of all objects, solved together."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.estimation.banded.whitening import Innovations, innovations
from fgtrack.estimation.banded.windows import States, Windows
from fgtrack.estimation.base import Measurement, Start, StatesAt, UpdateResult, UpdateStatus, no_states
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.initiation import DEFAULT, SMOOTHER_ITERATIONS, Search, checked_initiation
from fgtrack.estimation.propagation import wrapped_yaw
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.models.motion import MotionModel


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

    Raises `CallError` for an objective other than `reweighted`.
    """

    def __init__(self, motion: MotionModel, settings: SmootherSettings, initiation: str = DEFAULT) -> None:
        if settings.objective != "reweighted" and not motion.linear:
            raise CallError(f"smoother.objective: {settings.objective} needs the estimator smoother or smoother-batch")
        self._motion = motion
        self._settings = settings
        self._lag_ns, self._ring_ns = nanoseconds(settings.lag_s), nanoseconds(settings.ring_s)
        self._behind_ns = self._ring_ns if settings.late == "fuse" else 0
        self.windows = Windows(motion, settings)
        self._numbers: dict[int, int] = {}
        """Where the arrays hold each track, in order of birth."""
        self._free: list[int] = []
        self._now_ns = 0
        self._clock_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._first_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._initiation = checked_initiation(initiation)
        self._searches: dict[int, Search] = {}
        """Of the tracks whose direction is sought."""
        self._states: dict[int, tuple[tuple[int, ...], dict[int, int], States]] = {}
        """States by stamp, and the row of each track in them."""
        self._final: dict[int, list[TrackState]] = {}
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
        return tuple(self._numbers)

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`."""
        self._now_ns = now_ns
        self._clock_ns = np.maximum(self._clock_ns, now_ns)
        self._states.clear()  # which tracks are known at a stamp depends on the clock

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`. Raises `DataError` for a stamp before the window where the policy is `raise`."""
        if self._settings.late == "raise" and stamp_ns < self._oldest_ns:
            raise DataError(
                f"detections at {stamp_ns} ns are {seconds(self.present_ns - stamp_ns):g} s late, older than the "
                "window: lengthen smoother.lag_s, or set smoother.late to fuse or drop"
            )
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
        start_ns, newest_ns = self._start_ns(tracks), self.windows.newest_ns(tracks)
        if self._settings.late == "raise" and (stamp_ns < start_ns).any():
            raise DataError(
                f"a measurement at {stamp_ns} ns is {seconds(int(start_ns.max()) - stamp_ns):g} s older than the "
                "window: lengthen smoother.lag_s, or set smoother.late to fuse or drop"
            )
        results = [UpdateResult(UpdateStatus.TOO_OLD)] * len(tracks)
        young = np.flatnonzero(self._window_start_ns(tracks) <= stamp_ns)
        if not young.size:
            return results
        for row in young.tolist():
            results[row] = UpdateResult(UpdateStatus.FAILED)
        states = self._states_of(tracks[young], stamp_ns)
        groups = list(innovations([measurements[row] for row in young.tolist()], *states))
        groups = [group.at(np.isfinite(group.nis)) for group in groups]
        for group in groups:
            rows = young[group.positions].tolist()
            for row, y, nis in zip(rows, group.y, group.nis.tolist(), strict=True):
                status = UpdateStatus.OUT_OF_SEQUENCE if stamp_ns < newest_ns[row] else UpdateStatus.IN_SEQUENCE
                status = UpdateStatus.BEYOND_WINDOW if stamp_ns < start_ns[row] else status
                results[row] = UpdateResult(status, y, nis)
        failed = self._fuse(
            stamp_ns, tracks[young], [measurements[row] for row in young.tolist()], groups, states.means
        )
        for position in failed:
            results[young[position]] = UpdateResult(UpdateStatus.FAILED)
        return results

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        track = self._free.pop() if self._free else len(self._numbers)
        self.windows.begin(track, prior.stamp_ns, *initial_state(self._motion, prior))
        if track == len(self._clock_ns):
            self._clock_ns, self._first_ns = (np.append(values, 0) for values in (self._clock_ns, self._first_ns))
        self._clock_ns[track] = self._first_ns[track] = prior.stamp_ns
        self._searches.pop(track, None)
        search = Search.of(self._motion, prior, self._initiation)
        if search is not None:
            self._searches[track] = search
        self._numbers[track_id] = track
        self._states.clear()

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`; what was still inside the window becomes final."""
        rest = self.take_rest(track_id)
        self._ended += self._reports([track_id] * len(rest), rest)
        self._free.append(self._numbers.pop(track_id))
        self._states.clear()

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
        if not self._numbers:
            return []
        tracks = self._tracks()
        states = self.windows.states_at(tracks, np.maximum(self._now_ns, self._window_start_ns(tracks)))
        means, covariances = self._motion.kinematic(*states)
        means = wrapped_yaw(means)
        return [TrackState(self._now_ns, m, P) for m, P in zip(means, covariances, strict=True)]

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        reports, self._ended = self._ended, []
        final = [(track_id, state) for track_id in self._numbers for state in self._final.pop(track_id, ())]
        reports += self._reports([track_id for track_id, _ in final], [state for _, state in final])
        for lag_s in self._settings.lagged_s:
            stamp_ns = self.present_ns - nanoseconds(lag_s)
            track_ids, _, states = self._known_at(stamp_ns)
            if track_ids:
                reports += self._reported(track_ids, [stamp_ns] * len(track_ids), states, lag_s)
        return reports

    # --- one track

    def window_ns(self, track_id: int) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        tracks = np.array([self._numbers[track_id]])
        return int(self._window_start_ns(tracks)[0]), int(self.windows.newest_ns(tracks)[0])

    def state_at(self, track_id: int, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`."""
        states = self.windows.states_at(np.array([self._numbers[track_id]]), np.array([stamp_ns]))
        return TrackState(stamp_ns, states.means[0], states.covariances[0])

    def take_final(self, track_id: int) -> list[TrackState]:
        """Smoothed states of the nodes that have left the window since the last call, in order."""
        return self._final.pop(track_id, [])

    def take_rest(self, track_id: int) -> list[TrackState]:
        """Like `take_final`, and of the nodes that are still inside."""
        if not self._settings.final:
            return self.take_final(track_id)
        stamps_ns = self.windows.stamps_ns(self._numbers[track_id])
        return self.take_final(track_id) + [self.state_at(track_id, stamp_ns) for stamp_ns in stamps_ns]

    def converge(self, track_id: int, max_iterations: int) -> None:
        """Relinearise a track until nothing moves; for comparisons."""
        self.windows.converge(self._numbers[track_id], max_iterations)
        self._states.clear()

    # --- inside

    def _fuse(
        self,
        stamp_ns: int,
        tracks: IntArray,
        measurements: Sequence[Measurement],
        groups: Sequence[Innovations],
        guesses: FloatArray,
    ) -> list[int]:
        """Fuse those of `measurements` that are in `groups`; gives the positions of those that cannot be."""
        positions = np.sort(np.concatenate([group.positions for group in groups]))
        if not positions.size:
            return []
        chosen = tracks[positions]
        self._states.clear()
        try:
            left = self.windows.fuse(
                chosen,
                stamp_ns,
                [measurements[position] for position in positions.tolist()],
                [group.numbered(positions) for group in groups],
                guesses[positions],
                self._start_ns(chosen),
                self._reach_ns(chosen),
            )
        except np.linalg.LinAlgError:
            if len(positions) == 1:
                return [int(positions[0])]
            singles = [group.at(group.positions == position) for position in positions for group in groups]
            return [
                failed
                for single in singles
                if single.positions.size
                for failed in self._fuse(stamp_ns, tracks, measurements, [single], guesses)
            ]
        by_number = {number: track_id for track_id, number in self._numbers.items()} if left.tracks.size else {}
        for number, at_ns, mean, covariance in zip(
            left.tracks.tolist(), left.stamps_ns.tolist(), *left.states, strict=True
        ):
            self._final.setdefault(by_number[number], []).append(TrackState(at_ns, mean, covariance))
        for track in self._searches.keys() & set(chosen.tolist()):
            self._initiate(track, stamp_ns)
        self.windows.iterate(chosen, self._settings.max_iterations - 1)
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
            self.windows.iterate(np.array([track]), SMOOTHER_ITERATIONS)

    def _tracks(self) -> IntArray:
        return np.fromiter(self._numbers.values(), dtype=np.int64, count=len(self._numbers))

    def _start_ns(self, tracks: IntArray) -> IntArray:
        """Starts of the windows, by the clock and the newest stamps."""
        newest_ns = np.maximum(self._clock_ns[tracks], self.windows.newest_ns(tracks))
        return np.asarray(np.maximum(newest_ns - self._lag_ns, self._first_ns[tracks]))

    def _reach_ns(self, tracks: IntArray) -> IntArray:
        """Oldest stamps that may be fused."""
        return np.asarray(np.maximum(self._start_ns(tracks) - self._behind_ns, self._first_ns[tracks]))

    def _window_start_ns(self, tracks: IntArray) -> IntArray:
        return np.asarray(np.maximum(self._reach_ns(tracks), self.windows.oldest_ns(tracks)))

    def _known_at(self, stamp_ns: int) -> tuple[tuple[int, ...], dict[int, int], States]:
        """States at `stamp_ns` of the tracks that are known there."""
        found = self._states.get(stamp_ns)
        if found is None:
            tracks = self._tracks()
            known = self._window_start_ns(tracks) <= stamp_ns
            track_ids = tuple(i for i, inside in zip(self._numbers, known.tolist(), strict=True) if inside)
            tracks = tracks[known]
            states = self.windows.states_at(tracks, np.full(len(tracks), stamp_ns))
            rows = {track: row for row, track in enumerate(tracks.tolist())}
            found = self._states[stamp_ns] = track_ids, rows, states
        return found

    def _states_of(self, tracks: IntArray, stamp_ns: int) -> States:
        found = self._states.get(stamp_ns)
        if found is None:
            return self.windows.states_at(tracks, np.full(len(tracks), stamp_ns))
        _, rows, states = found
        chosen = [rows[track] for track in tracks.tolist()]
        return States(states.means[chosen], states.covariances[chosen])

    def _reports(self, track_ids: Sequence[int], states: Sequence[TrackState]) -> list[SmoothedReport]:
        """Final states, one of each of `track_ids`."""
        if not states:
            return []
        stack = States(np.array([state.mean for state in states]), np.array([state.covariance for state in states]))
        return self._reported(track_ids, [state.stamp_ns for state in states], stack)

    def _reported(
        self, track_ids: Sequence[int], stamps_ns: Sequence[int], states: States, lag_s: float | None = None
    ) -> list[SmoothedReport]:
        means, covariances = self._motion.kinematic(*states)
        return [
            SmoothedReport(track_id, TrackState(stamp_ns, mean, covariance), lag_s)
            for track_id, stamp_ns, mean, covariance in zip(
                track_ids, stamps_ns, wrapped_yaw(means), covariances, strict=True
            )
        ]

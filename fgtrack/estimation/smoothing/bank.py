"""The fixed-lag smoothers of all objects."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import compress, repeat
from typing import Any, ClassVar

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Measurements, Start, StatesAt, UpdateResult, UpdateStatus, stacks
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.failures import Failure, Failures
from fgtrack.estimation.filters.initiation import DEFAULT, SMOOTHER_ITERATIONS, Search, checked_initiation
from fgtrack.estimation.filters.propagation import kinematic_states
from fgtrack.estimation.smoothing.nodes import grown
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.estimation.smoothing.terms import Innovations
from fgtrack.estimation.smoothing.windows import Windows
from fgtrack.models.motion import MotionModel

_TOO_OLD, _FAILED = UpdateResult(UpdateStatus.TOO_OLD), UpdateResult(UpdateStatus.FAILED)
_STATUSES = UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE, UpdateStatus.BEYOND_WINDOW


class SmootherBank:
    """Fixed-lag smoother, solved in covariance form by compiled code, all objects of a tracker together.

    Measurements may arrive in any order: each is fused at a node at its own stamp. The oldest node of a window is the
    newest one at or before its start, so every stamp inside has a left neighbour.

    Parameters
    ----------
    motion
        Motion model; its process noise composes, so a late measurement may split a segment.
    lag_s
        Length of the windows.
    initiation
        How the direction of travel of a new object is found where nothing else gives one, see `Initiation`.
    failures
        Counts how often windows are rebuilt and steps are damped.
    options
        Further `SmootherSettings`; lagged and final states are reported on request.
    """

    make_solver: ClassVar[type[Solver]] = Solver
    bank, exact, nonlinear, smooths, initiates = True, "any lag, any number", "at convergence", True, True

    def __init__(
        self,
        motion: MotionModel,
        lag_s: float,
        initiation: str = DEFAULT,
        failures: Failures | None = None,
        **options: Any,  # any value that a setting takes
    ) -> None:
        self._motion = motion
        self._settings = settings = SmootherSettings.of_options(lag_s, options)
        self._lag_ns, self._behind_ns = nanoseconds(settings.lag_s), nanoseconds(settings.behind_s)
        self.windows = Windows(self.make_solver(motion, settings), settings.final, failures or Failures())
        self._tracks: dict[int, int] = {}
        """Row of the arrays that holds each track, by track id in order of birth."""
        self._free: list[int] = []
        self.present_ns = 0
        """See `TrackBank.present_ns`."""
        self._clock_ns, self._first_ns, self._ids = np.zeros((3, 0), dtype=np.int64)
        """Clock, stamp of the start and track id of each row."""
        self._initiation = checked_initiation(initiation)
        self._searches: dict[int, Search] = {}
        """Initiations of the tracks whose direction is sought, by row."""
        self._known: dict[int, StatesAt] = {}
        """By stamp, until something changes."""
        self._known_times: IntArray | None = None
        """See `_times`, until something changes."""
        self._final: list[SmoothedReport] = []
        """States of nodes that have left the windows since the last call of `smoothed`."""

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`."""
        return self.present_ns - self._lag_ns - self._behind_ns

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return tuple(self._tracks)

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`; the nodes that leave are marginalised at the next update."""
        self.present_ns = now_ns
        self._clock_ns = np.maximum(self._clock_ns, now_ns)
        self._changed()  # which tracks are known at a stamp depends on the clock

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`."""
        known = self._known.get(stamp_ns)
        if known is None:
            tracks = np.array([*self._tracks.values()], dtype=np.int64)
            is_known = self._times()[2, tracks] <= stamp_ns
            track_ids, tracks = tuple(compress(self._tracks, is_known.tolist())), tracks[is_known]
            states = self.windows.states_at(tracks, np.full(len(tracks), stamp_ns))
            known = self._known[stamp_ns] = StatesAt(track_ids, *states)
        return known

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        tracks = np.array([self._tracks[track_id] for track_id in track_ids], dtype=np.int64)
        newest_ns, start_ns, reach_ns = self._times().take(tracks, axis=1)
        results = [_TOO_OLD] * len(tracks)
        states = self.states_at(stamp_ns)
        positions = dict(zip(states.track_ids, range(len(states.track_ids)), strict=True))
        for indices, stack in stacks(measurements):
            inside = (reach_ns[np.array(indices)] <= stamp_ns).nonzero()[0]
            if not len(inside):
                continue
            group, alike = np.array(indices)[inside], stack.seen_by(self._motion)
            alike = replace(alike, z=alike.z[inside], R=alike.R[inside])
            at = [positions[track_ids[row]] for row in group.tolist()]
            means = states.means[at]
            innovations = Innovations.of(alike, means, states.covariances[at])
            window_ns = start_ns[group], reach_ns[group]
            is_fused = np.isfinite(innovations.nis)
            measured = [*Measurements(alike)]
            self._fuse(stamp_ns, tracks[group], measured, innovations, means, *window_ns, is_fused)
            late = (stamp_ns < newest_ns[group]) + (stamp_ns < start_ns[group]).astype(int)
            for k, (row, fused) in enumerate(zip(group.tolist(), is_fused.tolist(), strict=True)):
                y, S, nis = innovations.y[k], innovations.S[k], float(innovations.nis[k])
                results[row] = UpdateResult(_STATUSES[late[k]], y, nis, S) if fused else _FAILED
        return results

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        track = self._free.pop() if self._free else len(self._tracks)
        self.windows.solver.begin(track, prior.stamp_ns, *initial_state(self._motion, prior))
        if track >= len(self._clock_ns):
            size = len(self.windows.nodes.first)
            rows = self._clock_ns, self._first_ns, self._ids
            self._clock_ns, self._first_ns, self._ids = (grown(each, size) for each in rows)
        self._clock_ns[track] = self._first_ns[track] = prior.stamp_ns
        self._ids[track] = track_id
        self._searches.pop(track, None)
        search = Search.of(self._motion, prior, self._initiation)
        if search is not None:
            self._searches[track] = search
        self._tracks[track_id] = track
        self._changed()

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`; what was still inside the window becomes final."""
        track = self._tracks.pop(track_id)
        if self._settings.final:
            stamps_ns = self.windows.nodes.window_stamps_ns(track)
            states = self.windows.states_at(np.full(len(stamps_ns), track), stamps_ns)
            self._final += self._reports(repeat(track_id), stamps_ns.tolist(), *states)
        self._free.append(track)
        self._changed()

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
        if not self._tracks:
            return []
        tracks = np.array([*self._tracks.values()], dtype=np.int64)
        states = self.windows.states_at(tracks, np.maximum(self.present_ns, self._times()[2, tracks]))
        return kinematic_states(self._motion, self.present_ns, *states)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        reports, self._final = self._final, []
        for lag_s in self._settings.lagged_s:
            stamp_ns = self.present_ns - nanoseconds(lag_s)
            states = self.states_at(stamp_ns)
            reports += self._reports(states.track_ids, stamp_ns, states.means, states.covariances, lag_s)
        return reports

    def converge(self, max_iterations: int = 50) -> None:
        """Relinearise until nothing moves; for comparisons."""
        for track in self._tracks.values():
            self.windows.solver.converge(track, max_iterations)
        self._changed()

    def _reports(
        self,
        track_ids: Iterable[int],
        stamps_ns: int | Sequence[int],
        means: FloatArray,
        covariances: FloatArray,
        lag_s: float | None = None,
    ) -> list[SmoothedReport]:
        states = kinematic_states(self._motion, stamps_ns, means, covariances)
        return list(map(SmoothedReport, track_ids, states, repeat(lag_s)))

    def _fuse(
        self,
        stamp_ns: int,
        tracks: IntArray,
        measurements: Sequence[Measurement],
        innovations: Innovations,
        guesses: FloatArray,
        start_ns: IntArray,
        reach_ns: IntArray,
        is_fused: BoolArray,
    ) -> None:
        """Fuse those of `measurements` that `is_fused` marks; unmark those that cannot be."""
        rows = is_fused.nonzero()[0]
        if not rows.size:
            return
        self._changed()
        chosen = [measurements[row] for row in rows.tolist()]
        of, window_ns = tracks[rows], (start_ns[rows], reach_ns[rows])
        try:
            left = self.windows.fuse(of, stamp_ns, chosen, innovations.at(rows), guesses[rows], *window_ns)
        except np.linalg.LinAlgError:
            if len(rows) == 1:
                self.windows.failures.add(Failure.GRAPH_REBUILT)
                is_fused[rows] = False
                return
            for row in rows.tolist():
                alone = np.arange(len(tracks)) == row
                self._fuse(stamp_ns, tracks, measurements, innovations, guesses, start_ns, reach_ns, alone)
                is_fused[row] = alone[row]
            return
        if left is not None:
            self._final += self._reports(self._ids[left[0]].tolist(), *left[1:])
        for track in self._searches.keys() & set(of.tolist()):
            self._initiate(track, stamp_ns)
        self.windows.damp(of)
        self.windows.solver.iterate(of, self._settings.max_iterations - 1)

    def _initiate(self, track: int, oldest_ns: int) -> None:
        """Begin again from a straight line, where the oldest new stamp asks for it, as long as nothing has left."""
        if self.windows.nodes.first[track] > 0:  # a node that left stays behind the window
            del self._searches[track]
            return
        following = self._searches[track].next_line(partial(self.windows.fixes, track), oldest_ns)
        if following is not None:
            line, self._searches[track] = following
            self.windows.restart(track, line)
            self.windows.solver.iterate(np.array([track]), SMOOTHER_ITERATIONS)

    def _changed(self) -> None:
        """Forget what was computed of the states."""
        self._known.clear()
        self._known_times = None

    def _times(self) -> IntArray:
        """Return stamps of the newest nodes, of the starts of the windows, and the oldest that are fused, (3, rows)."""
        if self._known_times is None:
            nodes, first = self.windows.nodes, self._first_ns
            newest = nodes.stamps_ns[np.arange(len(first)), nodes.count[: len(first)] - 1]
            start = np.maximum(np.maximum(self._clock_ns, newest) - self._lag_ns, first)
            reach = np.maximum(start - self._behind_ns, first)
            self._known_times = np.array([newest, start, reach])
        return self._known_times

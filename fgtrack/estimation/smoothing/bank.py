"""The fixed-lag smoothers of all objects, and that of one."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import compress, repeat
from typing import Any

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.estimation.base import Measurement, Measurements, Start, StatesAt, UpdateResult, UpdateStatus, stacks
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.failures import Failure, Failures
from fgtrack.estimation.filters.initiation import DEFAULT, SMOOTHER_ITERATIONS, Search, checked_initiation
from fgtrack.estimation.filters.propagation import final_reports, kinematic_states, track_state
from fgtrack.estimation.smoothing.nodes import grown
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.estimation.smoothing.terms import Innovations
from fgtrack.estimation.smoothing.windows import Windows
from fgtrack.models.motion import MotionModel

MakeSolver = Callable[[MotionModel, SmootherSettings], Solver]

_TOO_OLD, _FAILED = UpdateResult(UpdateStatus.TOO_OLD), UpdateResult(UpdateStatus.FAILED)
_STATUSES = UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE, UpdateStatus.BEYOND_WINDOW


class SmootherBank:
    """The fixed-lag smoothers of all objects, whose windows are in arrays; see `TrackBank`.

    Parameters
    ----------
    motion
        The motion model of all objects.
    settings
        Window, late policy, relinearisation and outputs.
    make_solver
        Makes what solves the windows: `Solver`, or one of `smoothing.gtsam`.
    initiation
        How the direction of travel of a new object is found where nothing else gives one, see `Initiation`.
    failures
        Counts how often windows are rebuilt and steps are damped.
    """

    def __init__(
        self,
        motion: MotionModel,
        settings: SmootherSettings,
        make_solver: MakeSolver = Solver,
        initiation: str = DEFAULT,
        failures: Failures | None = None,
    ) -> None:
        self._motion = motion
        self._settings = settings
        self._lag_ns, self._behind_ns = nanoseconds(settings.lag_s), nanoseconds(settings.behind_s)
        self.windows = Windows(make_solver(motion, settings), settings.final, failures or Failures())
        self._tracks: dict[int, int] = {}
        """Row of the arrays that holds each track, by track id in order of birth."""
        self._free: list[int] = []
        self.present_ns = 0
        """See `TrackBank.present_ns`."""
        self._clock_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._first_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._initiation = checked_initiation(initiation)
        self._searches: dict[int, Search] = {}
        """Initiations of the tracks whose direction is sought, by row."""
        self._known: dict[int, StatesAt] = {}
        """By stamp, until something changes."""
        self._known_times: IntArray | None = None
        """See `_times`, until something changes."""
        self._final: dict[int, list[TrackState]] = {}
        """States of nodes that have left, by row."""
        self._ended: list[SmoothedReport] = []

    # --- a `TrackBank`

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
            is_known = self._times()[3, tracks] <= stamp_ns
            track_ids, tracks = tuple(compress(self._tracks, is_known.tolist())), tracks[is_known]
            states = self.windows.states_at(tracks, np.full(len(tracks), stamp_ns))
            known = self._known[stamp_ns] = StatesAt(track_ids, *states)
        return known

    def update(
        self, stamp_ns: int, track_ids: Sequence[int], measurements: Sequence[Measurement]
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        tracks = np.array([self._tracks[track_id] for track_id in track_ids], dtype=np.int64)
        newest_ns, start_ns, reach_ns, oldest_ns = self._times().take(tracks, axis=1)
        results = [_TOO_OLD] * len(tracks)
        states = self.states_at(stamp_ns)
        positions = dict(zip(states.track_ids, range(len(states.track_ids)), strict=True))
        for indices, stack in stacks(measurements):
            inside = (oldest_ns[np.array(indices)] <= stamp_ns).nonzero()[0]
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
            self._clock_ns, self._first_ns = grown(self._clock_ns, size), grown(self._first_ns, size)
        self._clock_ns[track] = self._first_ns[track] = prior.stamp_ns
        self._searches.pop(track, None)
        search = Search.of(self._motion, prior, self._initiation)
        if search is not None:
            self._searches[track] = search
        self._tracks[track_id] = track
        self._changed()

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`; what was still inside the window becomes final."""
        self._ended += final_reports(self._motion, [(track_id, state) for state in self.take_rest(track_id)])
        self._free.append(self._tracks.pop(track_id))
        self._changed()

    def present(self) -> list[TrackState]:
        """See `TrackBank.present`; of an object whose first stamp lies ahead of the clock, that first state."""
        if not self._tracks:
            return []
        tracks = np.array([*self._tracks.values()], dtype=np.int64)
        states = self.windows.states_at(tracks, np.maximum(self.present_ns, self._times()[3, tracks]))
        return kinematic_states(self._motion, repeat(self.present_ns), *states)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        reports, self._ended = self._ended, []
        reports += final_reports(
            self._motion,
            [(track_id, state) for track_id, track in self._tracks.items() for state in self._final.get(track, ())],
        )
        self._final.clear()
        for lag_s in self._settings.lagged_s:
            stamp_ns = self.present_ns - nanoseconds(lag_s)
            states = self.states_at(stamp_ns)
            shown = kinematic_states(self._motion, repeat(stamp_ns), states.means, states.covariances)
            reports += [SmoothedReport(i, state, lag_s) for i, state in zip(states.track_ids, shown, strict=True)]
        return reports

    # --- one track

    def state_at(self, track_id: int, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: smoothed in the past, interpolated under the motion model, predicted ahead."""
        means, covariances = self.windows.states_at(np.array([self._tracks[track_id]]), np.array([stamp_ns]))
        return track_state(self._motion, stamp_ns, means[0], covariances[0])

    def take_final(self, track_id: int) -> list[TrackState]:
        """Return smoothed states of the nodes that have left the window since the last call, in order."""
        return self._final.pop(self._tracks[track_id], [])

    def take_rest(self, track_id: int) -> list[TrackState]:
        """Return `take_final`, and the states of the nodes that are still inside."""
        if not self._settings.final:
            return []
        stamps_ns = self.windows.nodes.window_stamps_ns(self._tracks[track_id]).tolist()
        return self.take_final(track_id) + [self.state_at(track_id, stamp_ns) for stamp_ns in stamps_ns]

    # --- inside

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
        for track, state in left:
            self._final.setdefault(track, []).append(state)
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
        """Return four stamps of each row, shape (4, rows).

        Those of the newest nodes, where the windows start, the oldest that may be fused, and the oldest that can be.
        """
        if self._known_times is None:
            nodes, first = self.windows.nodes, self._first_ns
            newest = nodes.stamps_ns[np.arange(len(first)), nodes.count[: len(first)] - 1]
            start = np.maximum(np.maximum(self._clock_ns, newest) - self._lag_ns, first)
            reach = np.maximum(start - self._behind_ns, first)
            self._known_times = np.array([newest, start, reach, np.maximum(reach, nodes.stamps_ns[: len(first), 0])])
        return self._known_times


class FixedLagSmoother:
    """The fixed-lag smoother of one object; see `Smoother`.

    Measurements may arrive in any order: each is fused at a node at its own stamp. The oldest node is the newest one
    at or before the window's start, so every stamp inside the window has a left neighbour.

    Parameters
    ----------
    motion
        Motion model; its process noise composes, so a late measurement may split a segment.
    start
        First state; nothing older than it can be fused.
    settings, make_solver, initiation, failures
        See `SmootherBank`.
    """

    def __init__(
        self,
        motion: MotionModel,
        start: Start,
        settings: SmootherSettings,
        make_solver: MakeSolver = Solver,
        initiation: str = DEFAULT,
        failures: Failures | None = None,
    ) -> None:
        self.bank = SmootherBank(motion, settings, make_solver, initiation, failures)
        self.bank.birth(0, start)

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        newest_ns, _, _, oldest_ns = self.bank._times()[:, 0].tolist()
        return oldest_ns, newest_ns

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`; the nodes that leave are marginalised at the next update."""
        self.bank.advance(now_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`."""
        return self.bank.update(measurement.stamp_ns, [0], [measurement])[0]

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `SmootherBank.state_at`."""
        return self.bank.state_at(0, stamp_ns)

    def take_final(self) -> list[TrackState]:
        """See `SmootherBank.take_final`."""
        return self.bank.take_final(0)

    def take_rest(self) -> list[TrackState]:
        """See `SmootherBank.take_rest`: for when the track ends."""
        return self.bank.take_rest(0)

    def converge(self, max_iterations: int = 50) -> None:
        """Relinearise until nothing moves; for comparisons."""
        self.bank.windows.solver.converge(0, max_iterations)
        self.bank._changed()


# Any: an option may be any value that `SmootherSettings` takes.
def smoother_banded(
    motion: MotionModel, start: Start, lag_s: float, initiation: str = DEFAULT, **options: Any
) -> FixedLagSmoother:
    """Fixed-lag smoother, solved in covariance form by compiled code, all objects of a tracker together."""
    return FixedLagSmoother(motion, start, SmootherSettings.of_options(lag_s, options), initiation=initiation)


vars(smoother_banded).update(exact="any lag, any number", nonlinear="at convergence", smooths=True, initiates=True)

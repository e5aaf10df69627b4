"""The fixed-lag smoothers of all objects."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import compress, repeat
from typing import Any, ClassVar

import numpy as np

from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.estimation.base import (
    Measurement,
    Start,
    StatesAt,
    UpdateResult,
    UpdateStatus,
    stacks,
)
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.failures import EstimatorError, Failure, Failures
from fgtrack.estimation.filters.initiation import (
    DEFAULT,
    SMOOTHER_ITERATIONS,
    Search,
    checked_initiation,
)
from fgtrack.estimation.filters.propagation import kinematic_states
from fgtrack.estimation.kernels.kalman import innovations
from fgtrack.estimation.object_bank import Outcomes, changing_nothing
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.solver import NotFusedError, Solver
from fgtrack.estimation.smoothing.window import Window, window_of
from fgtrack.models.motion import MotionModel


class SmootherBank(Stateful):
    """Fixed-lag smoothers of all objects, solved together in covariance form by compiled loops.

    The least-squares problem is that of a factor graph (Dellaert & Kaess, IJRR 25(12), 2006), with late
    measurements as in Ranganathan, Kaess & Dellaert, IROS 2007.

    Measurements may arrive in any order: each is fused at a node at its own stamp. The oldest node of a window is
    the newest node at or before its start, so every stamp inside the window has a left neighbour.

    Parameters
    ----------
    motion
        Motion model. Its process noise composes, so a late measurement may split an interval.
    lag_s
        Length of the windows.
    initiation
        Method for the direction of travel of a new object, if nothing else gives a direction, see `Initiation`.
    failures
        Counts rebuilt windows and damped steps.
    options
        Further `SmootherSettings`. Lagged and final states are reported only if the options ask for them.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "solver",
        "_tracks",
        "_ids",
        "_free",
        "present_ns",
        "_clock_ns",
        "_searches",
        "_order",
        "_known",
        "_final",
    )

    make_solver: ClassVar[type[Solver]] = Solver
    bank, exact, nonlinear, smooths, initiates = (
        True,
        "any lag, any number",
        "at convergence",
        True,
        True,
    )

    def __init__(
        self,
        motion: MotionModel,
        lag_s: float,
        initiation: str = DEFAULT,
        failures: Failures | None = None,
        **options: Any,  # Any: each setting has its own type
    ) -> None:
        self._motion = motion
        self._settings = settings = SmootherSettings.of_options(lag_s, options)
        self._lag_ns, self._behind_ns = (
            nanoseconds(settings.lag_s),
            nanoseconds(settings.behind_s),
        )
        self._lagged = [(lag_s, nanoseconds(lag_s)) for lag_s in settings.lagged_s]
        self.solver = self.make_solver(motion, settings)
        self.failures = failures or Failures()
        self._tracks: dict[int, int] = {}
        """Row of the arrays that holds each track, by track id in order of birth."""
        self._ids: dict[int, int] = {}
        """Track id of each row."""
        self._free: list[int] = []
        self.present_ns = 0
        """See `TrackBank.present_ns`."""
        self._clock_ns = 0
        """Latest present so far."""
        self._initiation = checked_initiation(initiation)
        self._searches: dict[int, Search] = {}
        """Initiations of the tracks whose direction is sought, by row."""
        self._order: tuple[IntArray, tuple[int, ...]] | None = None
        """Rows and ids of all tracks; None after a birth or removal."""
        self._known: dict[int, StatesAt] = {}
        """States by stamp; cleared by every change."""
        self._final: list[SmoothedReport] = []
        """States of nodes that have left the windows since the last call of `smoothed`."""

    @property
    def window_start_ns(self) -> int:
        """See `TrackBank.window_start_ns`."""
        return self.present_ns - self._lag_ns - self._behind_ns

    @property
    def track_ids(self) -> tuple[int, ...]:
        """See `TrackBank.track_ids`."""
        return self._all()[1]

    def advance(self, now_ns: int) -> None:
        """See `TrackBank.advance`; the nodes that leave are marginalised at the next update."""
        self.present_ns = now_ns
        self._clock_ns = max(self._clock_ns, now_ns)
        self._known.clear()  # the clock decides which tracks have a state at a stamp

    def states_at(self, stamp_ns: int) -> StatesAt:
        """See `TrackBank.states_at`. Raises `EstimatorError` if the states of some tracks cannot be computed."""
        known = self._known.get(stamp_ns)
        if known is None:
            tracks, track_ids = self._all()
            is_known = self._windows(tracks)[2] <= stamp_ns
            if not is_known.all():
                track_ids, tracks = (
                    tuple(compress(track_ids, is_known.tolist())),
                    tracks[is_known],
                )
            states = self._states(tracks, np.full(len(tracks), stamp_ns))
            known = self._known[stamp_ns] = StatesAt(track_ids, *states)
        return known

    def _states(
        self, tracks: IntArray, stamps_ns: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return `Solver.states_at`. Raises `EstimatorError` with the tracks for which the solver raises."""
        try:
            return self.solver.states_at(tracks, stamps_ns)
        except MemoryError:
            raise
        except Exception:
            causes = dict[int, Exception]()
            for row, track in enumerate(tracks.tolist()):
                try:
                    self.solver.states_at(
                        tracks[row : row + 1], stamps_ns[row : row + 1]
                    )
                except Exception as error:
                    causes[self._ids[track]] = error
            if causes:
                raise EstimatorError(causes, {}) from None
            raise

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[UpdateResult]:
        """See `TrackBank.update`."""
        with changing_nothing(track_ids):
            states = self.states_at(stamp_ns)
            row_of = dict(
                zip(states.track_ids, range(len(states.track_ids)), strict=True)
            )
            inside = [k for k, track_id in enumerate(track_ids) if track_id in row_of]
            if len(inside) < len(track_ids):
                measurements = [measurements[k] for k in inside]
            parts = stacks(measurements)
        outcomes, outside = (
            Outcomes(),
            [track_id for track_id in track_ids if track_id not in row_of],
        )
        outcomes.add(
            outside, lambda: [UpdateResult(UpdateStatus.TOO_OLD) for _ in outside]
        )
        for indices, stack in parts:
            ids = [track_ids[inside[k]] for k in indices]
            outcomes.add(
                ids,
                partial(
                    self._update, ids, stack, states, [row_of[each] for each in ids]
                ),
            )
        return outcomes.results(track_ids)

    def _update(
        self,
        track_ids: Sequence[int],
        stack: Measurement,
        states: StatesAt,
        of: Sequence[int],
    ) -> list[UpdateResult]:
        """Return the results of a stack of measurements, one for each of `track_ids`, whose `states` are in the
        rows `of`.

        If the stack raises, the measurements of the unchanged tracks are fused one by one.
        """
        try:
            return self._fused(track_ids, stack, states, of)
        except EstimatorError as error:
            if len(track_ids) == 1:
                raise
            outcomes = Outcomes()
            alone = [
                k for k, track_id in enumerate(track_ids) if track_id in error.unchanged
            ]
            others = [
                track_id for track_id in track_ids if track_id not in error.unchanged
            ]
            outcomes.add(others, partial(_raised, error, others))
            for k in alone:
                one = replace(stack, z=stack.z[k : k + 1], R=stack.R[k : k + 1])
                outcomes.add(
                    [track_ids[k]],
                    partial(self._update, [track_ids[k]], one, states, [of[k]]),
                )
            return outcomes.results(track_ids)

    def _fused(
        self,
        track_ids: Sequence[int],
        stack: Measurement,
        states: StatesAt,
        of: Sequence[int],
    ) -> list[UpdateResult]:
        """Return the results of `_update` for all tracks together. Raises `EstimatorError` for the tracks that
        fail.
        """
        with changing_nothing(track_ids):
            alike, tracks = (
                stack.seen_by(self._motion),
                np.array([self._tracks[each] for each in track_ids]),
            )
            rows = np.array(of)
            means = states.means[rows]
            y, H = alike.model.linearised(alike.z, means, alike.pose)
            H = np.array(H, dtype=np.float64, order="C", ndmin=3)
            R = np.array(alike.R, dtype=np.float64, order="C", ndmin=3)
            (S, nis, _), times = (
                innovations(y, H, states.covariances, rows, R, alike.measured),
                self._windows(tracks),
            )
            usable, given = np.isfinite(nis).nonzero()[0], (y, H, means, R, times[3])
            if len(usable) < len(tracks):
                alike, tracks = (
                    replace(alike, z=alike.z[usable], R=alike.R[usable]),
                    tracks[usable],
                )
                given = (
                    y[usable],
                    H if len(H) == 1 else H[usable],
                    means[usable],
                    R[usable],
                    times[3, usable],
                )
        results = [UpdateResult(UpdateStatus.FAILED) for _ in track_ids]
        if not usable.size:
            return results
        self._known.clear()
        own = [track_ids[k] for k in usable.tolist()]
        try:
            left = self.solver.fuse(tracks, alike, *given)
        except NotFusedError as error:
            if (
                len(own) == 1
                and not error.lost
                and isinstance(error.cause, np.linalg.LinAlgError)
            ):
                self.failures.add(Failure.GRAPH_REBUILT)
                return results
            lost, causes = (
                {self._ids[track] for track in error.lost},
                dict.fromkeys(own, error.cause),
            )
            answers = {
                each: result
                for each, result in zip(track_ids, results, strict=True)
                if each not in causes
            }
            raise EstimatorError(causes, answers, causes.keys() - lost) from error
        made = list(zip(y, nis.tolist(), S, *times[:2].tolist(), strict=True))
        for index in usable.tolist():
            *outcome, newest_ns, start_ns = made[index]
            results[index] = UpdateResult(
                _status(alike.stamp_ns, newest_ns, start_ns), *outcome
            )
        if left is not None:
            self._final += self._reports(
                map(self._ids.__getitem__, left[0].tolist()), *left[1:]
            )
        causes = self._improved(tracks, alike.stamp_ns)
        if causes:
            answers = dict(zip(track_ids, results, strict=True))
            raise EstimatorError(
                causes,
                {each: answers[each] for each in track_ids if each not in causes},
            )
        return results

    def birth(self, track_id: int, prior: Start) -> None:
        """See `TrackBank.birth`."""
        track = self._free[-1] if self._free else len(self._tracks)
        self.solver.begin(track, prior.stamp_ns, *initial_state(self._motion, prior))
        self._searches.pop(track, None)
        search = Search.of(self._motion, prior, self._initiation)
        if search is not None:
            self._searches[track] = search
        if self._free:
            self._free.pop()
        self._tracks[track_id], self._ids[track], self._order = track, track_id, None
        self._known.clear()

    def remove(self, track_id: int) -> None:
        """See `TrackBank.remove`; the states inside the window become final.

        Raises `EstimatorError` if these states cannot be computed. The track is removed in this case, too.
        """
        track = self._tracks.pop(track_id)
        self._free.append(track)
        self._order = None
        self._known.clear()
        if self._settings.final:
            try:
                stamps_ns = self.solver.nodes.window_stamps_ns(track)
                states = self.solver.states_at(
                    np.full(len(stamps_ns), track), stamps_ns
                )
                self._final += self._reports(
                    repeat(track_id), stamps_ns.tolist(), *states
                )
            except Exception as error:
                raise EstimatorError({track_id: error}, {}) from error
        self.solver.forget(track)

    def present(self) -> Sequence[TrackState]:
        """See `TrackBank.present`. An object whose first stamp is after the present has its first state."""
        tracks, _ = self._all()
        states = self._states(
            tracks, np.maximum(self.present_ns, self._windows(tracks)[2])
        )
        return kinematic_states(self._motion, self.present_ns, *states)

    def smoothed(self) -> list[SmoothedReport]:
        """See `TrackBank.smoothed`."""
        reports = list[SmoothedReport]()
        for lag_s, lag_ns in self._lagged:
            stamp_ns = self.present_ns - lag_ns
            states = self.states_at(stamp_ns)
            reports += self._reports(
                states.track_ids, stamp_ns, states.means, states.covariances, lag_s
            )
        final, self._final = self._final, []
        return final + reports

    def window(self, track_id: int) -> Window:
        """Return a copy of the window of a track."""
        return window_of(self.solver, self._tracks[track_id])

    def has_fused(self, track_id: int, measurement: Measurement) -> bool:
        """True if the window, or the ring behind it, has an identical measurement of this track."""
        return (
            self.solver.nodes.index_of(self._tracks[track_id], measurement) is not None
        )

    def withdraw(self, track_id: int, measurement: Measurement) -> bool:
        """Solve a track without a measurement, as if it had never been fused. Return False if the window does
        not have it.

        A state that only this measurement needed is removed, too. Raises `EstimatorError` if the remaining
        window cannot be solved.
        """
        track = self._tracks[track_id]
        self._known.clear()
        if not self.solver.withdraw(track, measurement):
            return False
        causes = self._improved(np.array([track]), measurement.stamp_ns)
        if causes:
            raise EstimatorError(causes, {})
        return True

    def converge(self, max_iterations: int = 50) -> None:
        """Relinearise and solve all windows until no state moves. For comparisons."""
        for track in self._tracks.values():
            self.solver.converge(track, max_iterations)
        self._known.clear()

    def _reports(
        self,
        track_ids: Iterable[int],
        stamps_ns: int | Sequence[int],
        means: FloatArray,
        covariances: FloatArray,
        lag_s: float | None = None,
    ) -> list[SmoothedReport]:
        states = kinematic_states(self._motion, stamps_ns, means, covariances)
        return [*map(SmoothedReport, track_ids, states, repeat(lag_s))]

    def _improved(self, tracks: IntArray, stamp_ns: int) -> dict[int, Exception]:
        """Improve the windows of `tracks`. All windows are tried; return the exceptions by track id."""
        causes = dict[int, Exception]()
        try:
            self._improve(tracks, stamp_ns)
        except Exception:
            for row, track in enumerate(tracks.tolist()):
                try:
                    self.solver.relinearise(
                        track
                    )  # an exception may have stopped it between two steps
                    self._improve(tracks[row : row + 1], stamp_ns)
                except Exception as error:
                    causes[self._ids[track]] = error
        return causes

    def _improve(self, tracks: IntArray, stamp_ns: int) -> None:
        """Initiate, damp and iterate the windows of `tracks`, which have a new measurement at `stamp_ns`."""
        for track in (
            self._searches.keys() & set(tracks.tolist()) if self._searches else ()
        ):
            self._initiate(track, stamp_ns)
        if damped := self.solver.damp(tracks):
            self.failures.add(Failure.STEP_DAMPED, damped)
        self.solver.iterate(tracks, self._settings.max_iterations - 1)
        settled = tracks
        if self._searches:
            settled = tracks[[track not in self._searches for track in tracks.tolist()]]
        self.solver.reweight(settled)

    def _initiate(self, track: int, oldest_ns: int) -> None:
        """Restart a track along a straight line, if a new stamp from `oldest_ns` on changes the line.

        A track whose nodes have left the window is not initiated any more.
        """
        if self.solver.nodes.first[track] > 0:  # a node has left the window
            del self._searches[track]
            return
        following = self._searches[track].next_line(
            partial(self.solver.fixes, track), oldest_ns
        )
        if following is not None:
            line, self._searches[track] = following
            self.solver.restart(track, line)
            self.solver.iterate(np.array([track]), SMOOTHER_ITERATIONS)

    def _all(self) -> tuple[IntArray, tuple[int, ...]]:
        """Return rows and ids of all tracks in order of birth."""
        if self._order is None:
            self._order = (
                np.array([*self._tracks.values()], dtype=np.int64),
                tuple(self._tracks),
            )
        return self._order

    def _windows(self, tracks: IntArray) -> IntArray:
        """Return the windows of `tracks`, shape (4, m): newest stamps, starts of the windows, oldest stamps
        that can be fused, and indices of the nodes where the windows will begin.
        """
        return self.solver.nodes.windows(
            tracks, self._clock_ns, self._lag_ns, self._behind_ns
        )


def _status(stamp_ns: int, newest_ns: int, start_ns: int) -> UpdateStatus:
    """Return the status of a fused measurement, from the newest stamp of its track and the start of the window.

    The window follows the clock. If the latency exceeds the lag, the window begins after the newest stamp of the
    track. A measurement that is older than the window may then still be the newest measurement of the track.
    """
    if stamp_ns >= newest_ns:
        return UpdateStatus.IN_SEQUENCE
    return (
        UpdateStatus.OUT_OF_SEQUENCE
        if stamp_ns >= start_ns
        else UpdateStatus.BEYOND_WINDOW
    )


def _raised(error: EstimatorError, track_ids: Sequence[int]) -> list[UpdateResult]:
    """Return the results of these tracks in `error`. Raises an `EstimatorError` with the tracks that have no result."""
    causes = {
        track_id: error.causes[track_id]
        for track_id in track_ids
        if track_id in error.causes
    }
    if causes:
        raise EstimatorError(
            causes,
            {each: error.answers[each] for each in track_ids if each not in causes},
        )
    return [error.answers[track_id] for track_id in track_ids]

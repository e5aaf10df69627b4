"""The windows of all tracks: insert measurements, relinearise states that moved, solve, and give states at stamps."""

from collections.abc import Collection
from typing import ClassVar

import numpy as np

from fgtrack.core.linalg import mahalanobis_squared, noise_root
from fgtrack.core.state import Stateful
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import Measurement, Measurements
from fgtrack.estimation.filters.initiation import Fix, Line, along, fixes_of
from fgtrack.estimation.smoothing import (
    cost_kernels,
    insertion_kernels,
    interpolation_kernels,
    relinearisation_kernels,
    solution_kernels,
)
from fgtrack.estimation.smoothing.insertion_kernels import BEHIND, NO_ROOM, NOT_DEFINITE
from fgtrack.estimation.smoothing.node_arrays import (
    BEGIN_NS,
    INFORMED,
    NEVER,
    NONLINEAR,
    ROWS_STALE,
    STALE,
)
from fgtrack.estimation.smoothing.nodes import Nodes
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.terms import cost, overshot
from fgtrack.models.motion import MotionModel

#: A smaller step of a state, in m, rad, m/s or rad/s, is rounding.
STEP_TOLERANCE = 1e-7
#: Smallest share of a step that is tried, and relative rounding of a cost.
_LEAST_SHARE, _ROUNDING = 1e-6, 1e-9
#: A track with a robust loss: level of `NONLINEAR`, share of the thresholds, and largest number of steps. Its weights
#: follow its states.
_ROBUST, _ROBUST_SHARE, _ROBUST_STEPS = 2, 0.1, 3
Leaving = tuple[IntArray, list[int], FloatArray, FloatArray]
"""Tracks, stamps, means (m, n) and covariances (m, n, n) of nodes that leave a window, oldest first for each track."""


class NotFusedError(Exception):
    """Measurements could not be fused. All states are as before; the states of `lost` tracks are unknown."""

    def __init__(self, cause: Exception, lost: Collection[int] = ()) -> None:
        super().__init__(f"not fused ({cause})")
        self.cause, self.lost = cause, frozenset(lost)


class Solver(Stateful):
    """The windows of many tracks, by track number, solved in covariance form by compiled loops.

    Parameters
    ----------
    motion
        Motion model of all tracks.
    settings
        Settings of relinearisation and outputs.
    """

    STATE: ClassVar[tuple[str, ...]] = ("nodes",)

    is_damped: ClassVar[bool] = False
    """True if the solver accepts no step that increases the cost."""

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        self.motion = motion
        self.nodes = Nodes(motion)
        self._has_final = settings.final
        linear, nonlinear = (
            settings.thresholds(motion, nonlinear) for nonlinear in (False, True)
        )
        self._thresholds = np.array([linear, nonlinear, _ROBUST_SHARE * nonlinear])

    def begin(
        self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray
    ) -> None:
        """Start the window of a track with its first node."""
        self.nodes.begin_window(track, stamp_ns, mean, covariance)
        self.forget(track)

    # --- solution; subclasses with a factor graph override `forget` and `_solve_graphs`

    def forget(self, track: int) -> None:
        """Drop the results for a window whose prior, or whole content, has changed."""

    def _solve_graphs(
        self, tracks: IntArray, starts: IntArray, firsts: IntArray
    ) -> None:
        """Solve the factor graphs of windows that `_solve` has solved from `starts` on. The windows began at `firsts`
        before.

        Raises `numpy.linalg.LinAlgError` if a state is not finite.
        """

    def solve(self, tracks: IntArray, starts: IntArray, anchors: IntArray) -> None:
        """Solve windows that have changed from `starts` on, and let them begin at `anchors`.

        Raises `numpy.linalg.LinAlgError` if a state is not finite.
        """
        firsts = self.nodes.first[tracks]
        self._solve(tracks, starts, anchors)
        self._solve_graphs(tracks, starts, firsts)

    def _solve(
        self,
        tracks: IntArray,
        starts: IntArray,
        anchors: IntArray,
        is_partial: bool = False,
    ) -> None:
        """Solve windows, see `solution_kernels.solve_windows`.

        Raises `numpy.linalg.LinAlgError` if a state is not finite.
        """
        if not solution_kernels.solve_windows(
            tracks, starts, anchors, is_partial, self.nodes.arrays
        ):
            raise np.linalg.LinAlgError("a state is not finite")

    def smoothed(
        self, tracks: IntArray, indices: IntArray, after_s: FloatArray
    ) -> FloatArray:
        """Compute the covariances `P` of the nodes at `indices`, and return means (m, n).

        The mean is that of the node at the index. Where `after_s` > 0, it is the mean of the node before, given
        this node, and the covariances that an interpolation needs are computed, too.
        """
        means = np.empty((len(tracks), self.motion.dim))
        solution_kernels.smooth(tracks, indices, after_s, self.nodes.arrays, means)
        return means

    # --- states

    def states_at(
        self, tracks: IntArray, stamps_ns: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return means (m, n) and covariances (m, n, n) of `tracks` at `stamps_ns`, at or after the oldest node.

        The states are interpolated, or predicted after the last node.

        Raises `numpy.linalg.LinAlgError` if the process noise around a stamp is not positive definite.
        """
        nodes, indices = self.nodes, np.empty(len(tracks), dtype=np.int64)
        until_s, after_s = np.empty((2, len(tracks)))
        num_between = interpolation_kernels.locate(
            tracks, stamps_ns, nodes.arrays, indices, until_s, after_s
        )
        mean, F, Q = nodes.transition(self.smoothed(tracks, indices, after_s), until_s)
        ahead = nodes.transition(mean, after_s) if num_between else (mean, F, Q)
        if not interpolation_kernels.arrive(
            tracks, indices, after_s, nodes.arrays, mean, F, Q, *ahead
        ):
            raise np.linalg.LinAlgError("process noise is not positive definite")
        return mean, Q

    def estimates(self, track: int) -> FloatArray:
        """Return the means of all nodes in the window of a track, shape (m, n)."""
        numbers = self.nodes.window(track)
        return np.asarray(self.nodes.origin[numbers] + self.nodes.step[numbers])

    def _leaving(self, tracks: IntArray, anchors: IntArray) -> Leaving | None:
        """Return the states of the nodes before `anchors`; None if no node leaves."""
        nodes = self.nodes
        num = anchors - nodes.first[tracks]
        if not num.any():
            return None
        rows, columns = np.nonzero(np.arange(int(num.max())) < num[:, None])
        stamps_ns = nodes.stamps_ns[tracks[rows], nodes.first[tracks[rows]] + columns]
        return (
            tracks[rows],
            stamps_ns.tolist(),
            *self.states_at(tracks[rows], stamps_ns),
        )

    # --- updates

    def fuse(
        self,
        tracks: IntArray,
        stack: Measurement,
        y: FloatArray,
        H: FloatArray,
        guesses: FloatArray,
        R: FloatArray,
        anchors: IntArray,
    ) -> Leaving | None:
        """Fuse a stack of measurements, one of each of `tracks`, and let the windows begin at the indices
        `anchors`.

        `y` (m, k) are the innovations at `guesses`, the states (m, n) at the stamp of the stack. `H`, (1, k, n)
        or (m, k, n), are their Jacobians, and `R` (m, k, k) the covariances. A measurement that is older than
        its window changes the prior of the window. Returns the smoothed states of the nodes that left, if final
        states are reported. Raises `NotFusedError` if a step raises.
        """
        nodes, stamp_ns = self.nodes, stack.stamp_ns
        ahead_s, out = np.empty(len(tracks)), np.empty((8, len(tracks)), dtype=np.int64)
        try:
            guesses = (
                self._marked_nonlinear(tracks, stack, guesses)
                if stack.is_nonlinear
                else guesses
            )
            leaving = self._leaving(tracks, anchors) if self._has_final else None
            z = np.ascontiguousarray(stack.z, dtype=np.float64)
            while True:
                flags = insertion_kernels.place(
                    tracks,
                    stamp_ns,
                    (*nodes.noted_as(stack), z, R),
                    (y, H, guesses),
                    not stack.is_nonlinear,
                    self._thresholds,
                    anchors,
                    nodes.arrays,
                    nodes.seen,
                    out,
                    ahead_s,
                )
                if flags != NO_ROOM:
                    break
                nodes.widen(y.shape[1])
        except Exception as error:
            raise NotFusedError(error, self._not_restored(tracks)) from error
        numbers, indices, is_new, starts, anchors, is_behind, _, _ = out
        is_noted = False
        try:
            nodes.note(Measurements(stack), numbers, is_new, ahead_s)
            is_noted = True
            if flags & NOT_DEFINITE:
                raise np.linalg.LinAlgError("a covariance is not positive definite")
            nodes.linearise(tracks, starts)
            if flags & BEHIND:
                rows = is_behind.nonzero()[0]
                self._refilter(tracks[rows], starts[rows], anchors[rows])
                starts[rows] = anchors[rows]
            self.solve(tracks, starts, anchors)
        except Exception as error:
            nodes.first[tracks] = out[6]
            for track, index, new in zip(
                tracks.tolist(), indices.tolist(), is_new.tolist(), strict=True
            ):
                nodes.withdraw(track, index, is_new=bool(new), is_noted=is_noted)
            raise NotFusedError(
                error, self._not_restored(tracks, indices - is_new)
            ) from error
        return leaving

    def withdraw(self, track: int, measurement: Measurement) -> bool:
        """Solve the window of a track without a fused measurement. Return False if no node has the measurement."""
        nodes, index = self.nodes, self.nodes.index_of(track, measurement)
        if index is None:
            return False
        nodes.take_out(track, index, measurement)
        self.relinearise(track, start=min(index, int(nodes.count[track]) - 1))
        return True

    def _not_restored(
        self, tracks: IntArray, starts: IntArray | None = None
    ) -> list[int]:
        """Solve windows again after a measurement was withdrawn, see `relinearise`. Return the tracks for which
        this raises.

        A window that cannot be solved without the measurement keeps its last states.
        """
        lost = list[int]()
        for row, track in enumerate(tracks.tolist()):
            try:
                self.relinearise(
                    track, start=NEVER if starts is None else int(starts[row])
                )
            except np.linalg.LinAlgError:
                pass
            except Exception:
                lost.append(track)
        return lost

    def _refilter(self, tracks: IntArray, starts: IntArray, anchors: IntArray) -> None:
        """Filter nodes from `starts`, which lie behind the windows, up to `anchors`: the windows get new priors."""
        starts = np.minimum(starts, self.nodes.first[tracks])
        self.nodes.first[tracks] = 0
        self._solve(tracks, starts, anchors, is_partial=True)
        self.nodes.first[tracks] = anchors
        for track in tracks.tolist():
            self.forget(track)

    def _marked_nonlinear(
        self, tracks: IntArray, stack: Measurement, guesses: FloatArray
    ) -> FloatArray:
        """Relinearise tracks whose first nonlinear measurement, or first robust loss, comes now. Return the
        states (m, n) at its stamp. These tracks have other thresholds from now on.
        """
        level, stamp_ns = 1 if stack.loss is None else _ROBUST, stack.stamp_ns
        first = (self.nodes.tracks[tracks, NONLINEAR] < level).nonzero()[0]
        if first.size:
            self.nodes.tracks[tracks[first], NONLINEAR] = level
            for track in tracks[first].tolist():
                self.relinearise(track, self.estimates(track))
            guesses = guesses.copy()
            guesses[first] = self.states_at(
                tracks[first], np.full(len(first), stamp_ns)
            )[0]
        return guesses

    # --- relinearisation

    def iterate(self, tracks: IntArray, max_iterations: int) -> None:
        """Take Gauss-Newton steps while a state is farther than a threshold from its linearisation point."""
        nodes, far = self.nodes, np.empty(1, dtype=np.int64)
        begins = np.full(len(self.nodes.tracks), NEVER)  # of all tracks
        for _ in range(max_iterations if len(tracks) else 0):
            starts = np.empty(len(tracks), dtype=np.int64)
            num = relinearisation_kernels.move_far(
                tracks, self._thresholds, nodes.arrays, far, starts
            )
            if not num:
                break
            if num < len(tracks):
                has_moved = starts < NEVER
                tracks, starts = tracks[has_moved], starts[has_moved]
            begins[tracks] = np.minimum(begins[tracks], starts)
            nodes.linearise(tracks, starts)
            self._solve(tracks, starts, nodes.first[tracks])
        moved = (begins < NEVER).nonzero()[0]
        if len(moved):
            self._solve_graphs(moved, begins[moved], nodes.first[moved])

    def reweight(self, tracks: IntArray) -> None:
        """Take further steps for tracks with a robust loss, whose weights follow the states."""
        is_robust = self.nodes.tracks[tracks, NONLINEAR] == _ROBUST
        self.iterate(tracks[is_robust], _ROBUST_STEPS)

    def relinearise(
        self, track: int, means: FloatArray | None = None, start: int = NEVER
    ) -> None:
        """Linearise a window, and solve it. If `start` lies behind the window, begin at the node with this
        index.

        The linearisation points become `means`, shape (m, n); without `means` they stay.
        """
        tracks = np.array([track])
        self._linearise_at(track, means, start)
        first = self.nodes.first[tracks]
        self.solve(tracks, first, first)

    def _linearise_at(
        self, track: int, means: FloatArray | None, start: int = NEVER
    ) -> None:
        """Linearise a window as `relinearise` does, and do not solve it."""
        nodes, tracks = self.nodes, np.array([track])
        first = nodes.first[tracks]
        starts = np.minimum(first, start)
        numbers = nodes.numbers[track, starts[0] : nodes.count[track]].copy()
        nodes.labels[numbers, INFORMED] = 0
        if means is not None:
            nodes.predicted[numbers[0], :, -1] -= means[0] - nodes.origin[numbers[0]]
            nodes.origin[numbers] = means
        nodes.labels[numbers, STALE] = nodes.labels[numbers, ROWS_STALE] = 1
        nodes.linearise(tracks, starts)
        self._refilter(tracks, starts, first)

    def converge(self, track: int, max_iterations: int = 100) -> None:
        """Relinearise a window at its solution and solve it, until no state moves by more than rounding.

        A step is halved if it is not much shorter than the last step, or does not lower the cost. Process noise
        that depends on the state can make Gauss-Newton oscillate.
        """
        tracks = np.array([track])
        first = self.nodes.first[tracks]
        means, last = self.estimates(track), np.inf
        for _ in range(max_iterations):
            self._linearise_at(track, means)
            self._solve(tracks, first, first)
            steps = self.estimates(track) - means
            longest = float(np.abs(steps).max())
            if longest < STEP_TOLERANCE:
                break
            share, most = (
                1.0 if longest < 0.5 * last else 0.5,
                self._cost(track, means) * (1.0 + _ROUNDING) + _ROUNDING,
            )
            while (
                share > _LEAST_SHARE and self._cost(track, means + share * steps) > most
            ):
                share *= 0.5
            means, last = means + share * steps, longest
        self._solve_graphs(tracks, first, first)

    def _cost(self, track: int, means: FloatArray) -> float:
        """Return half of the sum of squares of a window at `means` (m, n), with the robust losses of the
        measurements.

        The process noise is that of the linearisation points.
        """
        nodes, n, compiled = self.nodes, self.motion.dim, self.nodes.compiled
        if compiled is not None and not nodes.has_plugins:
            cost_of_window: float = cost_kernels.window_cost(
                compiled.kind,
                compiled.noise,
                track,
                np.ascontiguousarray(means),
                nodes.arrays,
                nodes.seen,
            )
            if np.isnan(cost_of_window):
                raise np.linalg.LinAlgError("a covariance is not positive definite")
            return cost_of_window
        numbers = nodes.window(track)
        prior, Q = nodes.predicted[numbers[0]], nodes.Q[numbers[:-1]]
        dt_s = np.diff(nodes.window_stamps_ns(track)) / NS_PER_S
        total = mahalanobis_squared(
            means[0] - nodes.origin[numbers[0]] - prior[:, n], prior[:, :n]
        )
        gaps = means[1:] - self.motion.predict(means[:-1], dt_s)
        total += sum(
            ((noise_root(each) @ gap) ** 2).sum()
            for each, gap in zip(Q, gaps, strict=True)
        )
        return 0.5 * float(total) + sum(
            cost(factor, x, self.motion)
            for number, x in zip(numbers.tolist(), means, strict=True)
            for factor in nodes.factors(number)
        )

    def damp(self, tracks: IntArray) -> int:
        """Converge, with damped steps, the tracks whose last step left its linear range. Return the number of
        these tracks.
        """
        nodes = self.nodes
        nonlinear = tracks[nodes.tracks[tracks, NONLINEAR] > 0]
        if self.is_damped or not nonlinear.size:
            return 0
        overshot_tracks = nonlinear[self._overshot(nonlinear)].tolist()
        for track in overshot_tracks:
            means = nodes.origin[nodes.window(track)]
            try:
                self.converge(track)
            except np.linalg.LinAlgError:
                self.relinearise(track, means)
        return len(overshot_tracks)

    def _overshot(self, tracks: IntArray) -> BoolArray:
        """Mask (m,) of the tracks with a node whose step left the linear range of a measurement."""
        nodes, compiled = self.nodes, self.nodes.compiled
        far = np.empty(nodes.stamps_ns.shape[1], dtype=np.int64)
        found = np.zeros(len(tracks), dtype=bool)
        if compiled is not None and not nodes.has_plugins:
            relinearisation_kernels.overshot(
                compiled.kind,
                compiled.noise,
                tracks,
                self._thresholds,
                nodes.arrays,
                nodes.seen,
                far,
                found,
            )
            return found
        for row, track in enumerate(tracks.tolist()):
            num = relinearisation_kernels.find_far(
                track, self._thresholds, nodes.arrays, far
            )
            numbers = nodes.numbers[track, far[:num]].tolist()
            found[row] = any(
                overshot(
                    nodes.factors(number),
                    nodes.origin[number],
                    nodes.origin[number] + nodes.step[number],
                    self.motion,
                )
                for number in numbers
            )
        return found

    # --- initiation

    def fixes(self, track: int) -> list[Fix]:
        """Return the position of the prior and the measured positions of a window that no node has left yet."""
        nodes, numbers = self.nodes, self.nodes.window(track)
        prior, begin_ns = (
            nodes.predicted[numbers[0]],
            int(nodes.tracks[track, BEGIN_NS]),
        )
        factors = (
            factor for number in numbers.tolist() for factor, _ in nodes.factors(number)
        )
        later = ((seconds(factor.stamp_ns - begin_ns), factor) for factor in factors)
        return fixes_of(
            nodes.origin[numbers[0]] + prior[:, -1], prior[:, :-1].copy(), later
        )

    def restart(self, track: int, line: Line) -> None:
        """Solve a window again from states along `line`. The heading of the prior must be vague; it is turned
        to the line.
        """
        nodes, oldest = self.nodes, self.nodes.window(track)[0]
        times_s = (
            nodes.window_stamps_ns(track) - nodes.tracks[track, BEGIN_NS]
        ) / NS_PER_S
        means = np.array(
            [
                along(line, time_s, self.motion.state_names)
                for time_s in times_s.tolist()
            ]
        )
        if not self.motion.cartesian:
            nodes.predicted[oldest, YAW, -1] = means[0, YAW] - nodes.origin[oldest, YAW]
        self.relinearise(track, means)

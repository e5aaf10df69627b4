"""The windows of all tracks: insertion, relinearisation, marginalisation and states at any stamp."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.failures import Failure, Failures
from fgtrack.estimation.filters.initiation import Fix, Line, along, fixes_of
from fgtrack.estimation.kernels import kalman
from fgtrack.estimation.smoothing import kernels, node_kernels
from fgtrack.estimation.smoothing.damping import damped
from fgtrack.estimation.smoothing.ring import fuse_behind
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.estimation.smoothing.terms import Innovations, NearMeasurement, is_nonlinear, overshot

#: Nodes behind the window are forgotten when there are so many that nobody needs.
_MANY = 16
#: Later than any index.
_NEVER = np.iinfo(np.int64).max

_Leaving = tuple[IntArray, list[int], FloatArray, FloatArray]
"""Tracks, stamps, means (m, n) and covariances (m, n, n) of nodes that leave, oldest first for each track."""


class Windows:
    """Windows of many tracks, each by its number.

    Parameters
    ----------
    solver
        Solves them.
    final
        True if the states of nodes that leave are wanted.
    failures
        Counts how often steps are damped.
    """

    def __init__(self, solver: Solver, final: bool, failures: Failures) -> None:
        self._motion = solver.motion
        self._final = final
        self.solver = solver
        self.nodes = solver.nodes
        self.failures = failures

    # --- states

    def states_at(self, tracks: IntArray, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return means (m, n) and covariances (m, n, n) of `tracks` at `stamps_ns`, not older than the oldest node.

        They are interpolated, or predicted ahead.
        """
        nodes, n = self.nodes, self._motion.dim
        indices, numbers = np.empty((2, len(tracks)), dtype=np.int64)
        until_s, after_s = np.empty((2, len(tracks)))
        given = nodes.stamps_ns, nodes.count, nodes.numbers
        num_between = node_kernels.locate(tracks, stamps_ns, *given, indices, numbers, until_s, after_s)
        self.solver.look_up(tracks, indices, after_s > 0.0)
        means, covariances = self.solver.smoothed(tracks, indices)
        means += nodes.origin[numbers]
        if num_between < len(tracks):  # of no time, or between two nodes, are states ahead what they are
            ahead, F, Q = self._motion.transition(
                means, until_s if num_between == 0 else np.where(after_s > 0.0, 0.0, until_s)
            )
            covariances, means = kalman.predict(F, covariances, Q)[0], ahead
        if num_between:
            k = slice(None) if num_between == len(tracks) else after_s > 0.0
            left, P = nodes.numbers[tracks[k], indices[k] - 1], covariances[k]
            back, C = nodes.back[left], nodes.C[left]
            mean = nodes.origin[left] + np.matvec(back[:, :, :n], means[k] - nodes.origin[numbers[k]]) + back[:, :, n]
            first = self._motion.transition(mean, until_s[k])
            second = self._motion.transition(first.mean, after_s[k])
            if not kernels.interpolate(*first, *second, means[k], back, C, P):
                raise np.linalg.LinAlgError("process noise is not positive definite")
            means[k], covariances[k] = first.mean, P
        return means, covariances

    # --- updates

    def fuse(
        self,
        tracks: IntArray,
        stamp_ns: int,
        measurements: Sequence[Measurement],
        innovations: Innovations,
        guesses: FloatArray,
        start_ns: IntArray,
        reach_ns: IntArray,
    ) -> _Leaving | None:
        """Fuse one measurement of each of `tracks`, all at `stamp_ns`, and move the windows up to `start_ns`.

        `innovations` are those at `guesses`, shape (m, n), the states at `stamp_ns`. One node at or before `start_ns`
        stays in each window; behind it, what `reach_ns` needs is kept. Returns the smoothed states of the nodes
        that left, if wanted. Raises `numpy.linalg.LinAlgError` if it fails; all is as before then.
        """
        nodes, solver = self.nodes, self.solver
        guesses = self._relinearised(tracks, stamp_ns, measurements, guesses)
        anchors = np.maximum(nodes.first[tracks], nodes.last_before(tracks, start_ns))
        left = self._leaving(tracks, anchors)
        indices, stamps_ns = nodes.nearest(tracks, stamp_ns)
        at_nodes = [
            each if stamp_ns == node_ns else NearMeasurement.at(each, node_ns, self._motion)
            for each, node_ns in zip(measurements, stamps_ns.tolist(), strict=True)
        ]
        is_old = indices < anchors
        saved, added = nodes.saved(tracks, anchors, is_old), list[int]()
        try:
            of, at = solver.move_far(tracks, anchors, indices)
            starts = nodes.count[tracks]
            np.minimum.at(starts, of, at)
            of = tracks[of]
            if is_old.any():
                solver.linearise_motion(of, at)
                of = at = tracks[:0]
                solver.solve(tracks[is_old], starts[is_old], anchors[is_old])
                for row in is_old.nonzero()[0].tolist():
                    track = int(tracks[row])
                    factor = fuse_behind(nodes, self._motion, track, int(indices[row]), at_nodes[row])
                    starts[row] = anchors[row] = nodes.first[track]
                    added.append(int(nodes.numbers[track, starts[row]]))
                    nodes.terms[added[-1]].append(factor)
                    nodes.linearise_terms(added[-1])
            numbers = self._insert(tracks, stamp_ns, stamps_ns, indices, ~is_old, guesses, of, at, starts)
            is_linear = ~is_old
            for row in is_linear.nonzero()[0].tolist():
                added.append(int(numbers[row]))
                nodes.terms[added[-1]].append(at_nodes[row])
                if is_nonlinear(at_nodes[row]) or isinstance(at_nodes[row], NearMeasurement):
                    is_linear[row] = False
                    nodes.linearise_terms(added[-1])
            if is_linear.any():
                rows = is_linear.nonzero()[0]
                nodes.observe(numbers[rows], innovations.at(rows), guesses[rows] - nodes.origin[numbers[rows]])
            solver.solve(tracks, starts, anchors)
        except np.linalg.LinAlgError:
            for name, at, values in saved:
                getattr(nodes, name)[at] = values
            for number in added:
                nodes.terms[number].pop()
            solver.rebuild(tracks)
            raise
        self._forget_before(tracks, reach_ns)
        return left

    def damp(self, tracks: IntArray) -> None:
        """Solve again by Levenberg-Marquardt where the last step went beyond what its linearisation is good for."""
        solver, nodes = self.solver, self.nodes
        tracks = tracks[solver.is_nonlinear[tracks]]
        if not tracks.size or solver.is_damped:
            return
        rows, indices = solver.far(tracks, nodes.first[tracks], nodes.count[tracks])
        moved = nodes.numbers[tracks[rows], indices]
        far = zip(rows.tolist(), moved.tolist(), nodes.origin[moved], nodes.step[moved], strict=True)
        for row in sorted({row for row, number, x, step in far if overshot(nodes.terms[number], x, x + step)}):
            track = int(tracks[row])
            means = nodes.origin[nodes.window(track)]
            with suppress(np.linalg.LinAlgError):  # then the linearisation points remain
                means = damped(solver, track)
            solver.solve_at(track, means)
            self.failures.add(Failure.STEP_DAMPED)

    def _relinearised(
        self, tracks: IntArray, stamp_ns: int, measurements: Sequence[Measurement], guesses: FloatArray
    ) -> FloatArray:
        """States at `stamp_ns` after the relinearisation of tracks whose first nonlinear measurement comes now."""
        first = [k for k, each in enumerate(measurements) if is_nonlinear(each) > self.solver.is_nonlinear[tracks[k]]]
        if first:
            for track in tracks[first].tolist():
                self.solver.mark_nonlinear(track)
            guesses = guesses.copy()
            guesses[first] = self.states_at(tracks[first], np.full(len(first), stamp_ns))[0]
        return guesses

    def _leaving(self, tracks: IntArray, anchors: IntArray) -> _Leaving | None:
        nodes = self.nodes
        num = anchors - nodes.first[tracks]
        if not self._final or not num.any():
            return None
        self.solver.prepare_leaving(tracks[num > 0], anchors[num > 0])
        rows, columns = np.nonzero(np.arange(int(num.max())) < num[:, None])
        tracks, indices = tracks[rows], nodes.first[tracks[rows]] + columns
        steps, covariances = self.solver.smoothed(tracks, indices)
        means = nodes.origin[nodes.numbers[tracks, indices]] + steps
        return tracks, nodes.stamps_ns[tracks, indices].tolist(), means, covariances

    def _insert(
        self,
        tracks: IntArray,
        stamp_ns: int,
        stamps_ns: IntArray,
        indices: IntArray,
        is_live: BoolArray,
        guesses: FloatArray,
        of: IntArray,
        at: IntArray,
        starts: IntArray,
    ) -> IntArray:
        """Insert nodes at `stamps_ns` where there are none, after those at `indices`; return the numbers of the nodes.

        Linearises the motion from and to them, and from the nodes of the tracks `of` at the indices `at`, which have
        moved. `starts`, from which on the windows have changed, become smaller.
        """
        nodes = self.nodes
        is_new = is_live & (nodes.stamps_ns[tracks, indices] != stamps_ns)
        indices = indices + is_new
        if is_new.any():
            to, inner = tracks[is_new], indices[is_new]
            nodes.insert_at(to, inner, stamp_ns, guesses[is_new])
            if of.size:
                inserted = np.full(len(nodes.first), _NEVER)
                inserted[to] = inner
                at = at + (at >= inserted[of])
            of, at = np.concatenate([of, to, to]), np.concatenate([at, inner - 1, inner])
        self.solver.linearise_motion(of, at)
        np.minimum(starts, indices, out=starts, where=is_live)
        return nodes.numbers[tracks, indices]

    def _forget_before(self, tracks: IntArray, stamps_ns: IntArray) -> None:
        nodes = self.nodes
        most = nodes.first[tracks] - 1
        if not ((most >= _MANY) & (nodes.stamps_ns[tracks, _MANY - 1] <= stamps_ns)).any():
            return
        num = np.minimum(nodes.last_before(tracks, stamps_ns), most)
        many = num >= _MANY
        if many.any():
            nodes.drop(tracks[many], num[many])

    # --- one track

    def fixes(self, track: int) -> list[Fix]:
        """Positions measured at the nodes, after that of the prior, of a window that nothing has left yet."""
        nodes, numbers = self.nodes, self.nodes.window(track)
        stamps_ns = nodes.window_stamps_ns(track).tolist()
        prior = nodes.predicted[numbers[0]]
        later = (
            (seconds(stamp_ns - stamps_ns[0]), term)
            for number, stamp_ns in zip(numbers.tolist(), stamps_ns, strict=True)
            for term in nodes.terms[number]
            if isinstance(term, Measurement)
        )
        return fixes_of(nodes.origin[numbers[0]] + prior[:, -1], prior[:, :-1].copy(), later)

    def restart(self, track: int, line: Line) -> None:
        """Solve again from states along `line`, with the prior's heading, which must be vague, turned there."""
        nodes, oldest = self.nodes, self.nodes.window(track)[0]
        stamps_ns = nodes.window_stamps_ns(track)
        times_s = (stamps_ns - stamps_ns[0]) / NS_PER_S
        means = np.array([along(line, time_s, self._motion.state_names) for time_s in times_s.tolist()])
        if not self._motion.cartesian:
            nodes.predicted[oldest, YAW, -1] = means[0, YAW] - nodes.origin[oldest, YAW]
        self.solver.solve_at(track, means)

"""The windows of all tracks: measurements inserted, relinearised where a state moved, solved, and read at any stamp."""

from typing import ClassVar

import numpy as np

from fgtrack.core.linalg import mahalanobis_squared, noise_root
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import Measurement, Measurements
from fgtrack.estimation.filters.initiation import Fix, Line, along, fixes_of
from fgtrack.estimation.kernels import kalman
from fgtrack.estimation.smoothing import kernels, node_kernels
from fgtrack.estimation.smoothing.nodes import NEVER, Nodes
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.terms import cost, overshot
from fgtrack.models.motion import MotionModel

#: A step of a state, in m, rad, m/s or rad/s, that is rounding.
STEP_TOLERANCE = 1e-7
#: The least share of a step that is tried, and rounding of a cost.
_LEAST_SHARE, _ROUNDING = 1e-6, 1e-9
#: Nodes behind the window are forgotten when there are so many that nobody needs.
_MANY = 16
Leaving = tuple[IntArray, list[int], FloatArray, FloatArray]
"""Tracks, stamps, means (m, n) and covariances (m, n, n) of nodes that leave, oldest first for each track."""


class Solver:
    """Windows of many tracks, each by its number; solved in covariance form by compiled loops.

    Parameters
    ----------
    motion
        Motion model of all of them.
    settings
        Those of relinearisation and outputs.
    """

    is_damped: ClassVar[bool] = False
    """True if no step makes the fit worse."""

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        self.motion = motion
        self.nodes = Nodes(motion)
        self._has_final = settings.final
        self._thresholds = np.array([settings.thresholds(motion, nonlinear) for nonlinear in (False, True)])

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """Start the window of a track with its first node."""
        self.nodes.begin_window(track, stamp_ns, mean, covariance)
        self.forget(track)

    # --- solution; a factor graph has its own

    def forget(self, track: int) -> None:
        """Forget what was made of a window whose prior, or all, is different now."""

    def solve(self, tracks: IntArray, starts: IntArray, anchors: IntArray) -> None:
        """Solve windows that have changed from `starts` on and begin at `anchors` from now on.
        Raises `numpy.linalg.LinAlgError` if it fails.
        """
        self.eliminate(tracks, starts, self.nodes.count[tracks])
        self.nodes.first[tracks] = anchors
        kernels.back_substitute(tracks, *self.nodes.order, self.nodes.filtered, self.nodes.back, self.nodes.step)
        self.nodes.known[tracks] = self.nodes.count[tracks]

    def smoothed(
        self, tracks: IntArray, indices: IntArray, with_previous: BoolArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Steps (m, n) and covariances (m, n, n) of the nodes at `indices`; `back` and `C` of those before are known.
        The latter only where `with_previous`, if the windows are factor graphs.
        """
        nodes, n = self.nodes, self.motion.dim
        steps, covariances = np.empty((len(tracks), n)), np.empty((len(tracks), n, n))
        given = nodes.filtered, nodes.back, nodes.C, nodes.step, nodes.P
        kernels.smoothed(tracks, indices, nodes.known, *nodes.order, *given, steps, covariances)
        return steps, covariances

    def eliminate(self, tracks: IntArray, starts: IntArray, ends: IntArray) -> None:
        """Eliminate the nodes of `tracks` from `starts` up to before `ends`.
        Raises `numpy.linalg.LinAlgError` if it fails.
        """
        nodes = self.nodes
        given = nodes.origin, nodes.segment, nodes.rows, nodes.num_rows
        result = nodes.predicted, nodes.filtered, nodes.back, nodes.C
        if not kernels.eliminate(tracks, starts, ends, *nodes.order, *given, *result):
            raise np.linalg.LinAlgError("a state is not finite")

    # --- states

    def states_at(self, tracks: IntArray, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return means (m, n) and covariances (m, n, n) of `tracks` at `stamps_ns`, not older than the oldest node.
        They are interpolated, or predicted ahead.
        """
        nodes, n = self.nodes, self.motion.dim
        indices, numbers = np.empty((2, len(tracks)), dtype=np.int64)
        until_s, after_s = np.empty((2, len(tracks)))
        given = nodes.stamps_ns, nodes.count, nodes.numbers
        num_between = node_kernels.locate(tracks, stamps_ns, *given, indices, numbers, until_s, after_s)
        means, covariances = self.smoothed(tracks, indices, after_s > 0.0)
        means += nodes.origin[numbers]
        if num_between < len(tracks):  # of no time, or between two nodes, are states ahead what they are
            ahead, F, Q = self.motion.transition(
                means, until_s if num_between == 0 else np.where(after_s > 0.0, 0.0, until_s)
            )
            covariances, means = kalman.predict(F, covariances, Q)[0], ahead
        if num_between:
            k = slice(None) if num_between == len(tracks) else after_s > 0.0
            left, P = nodes.numbers[tracks[k], indices[k] - 1], covariances[k]
            back, C = nodes.back[left], nodes.C[left]
            mean = nodes.origin[left] + np.matvec(back[:, :, :n], means[k] - nodes.origin[numbers[k]]) + back[:, :, n]
            first = self.motion.transition(mean, until_s[k])
            second = self.motion.transition(first.mean, after_s[k])
            if not kernels.interpolate(*first, *second, means[k], back, C, P):
                raise np.linalg.LinAlgError("process noise is not positive definite")
            means[k], covariances[k] = first.mean, P
        return means, covariances

    def estimates(self, track: int) -> FloatArray:
        """Means of all nodes in the window, shape (m, n)."""
        numbers = self.nodes.window(track)
        return np.asarray(self.nodes.origin[numbers] + self.nodes.step[numbers])

    def _leaving(self, tracks: IntArray, anchors: IntArray) -> Leaving | None:
        """Return the states of the nodes before `anchors`, if wanted."""
        nodes = self.nodes
        num = anchors - nodes.first[tracks]
        if not self._has_final or not num.any():
            return None
        rows, columns = np.nonzero(np.arange(int(num.max())) < num[:, None])
        tracks, indices = tracks[rows], nodes.first[tracks[rows]] + columns
        steps, covariances = self.smoothed(tracks, indices)
        means = nodes.origin[nodes.numbers[tracks, indices]] + steps
        return tracks, nodes.stamps_ns[tracks, indices].tolist(), means, covariances

    # --- updates

    def fuse(
        self,
        tracks: IntArray,
        stack: Measurement,
        y: FloatArray,
        H: FloatArray,
        guesses: FloatArray,
        start_ns: IntArray,
        reach_ns: IntArray,
    ) -> Leaving | None:
        """Fuse a stack of measurements, one of each of `tracks`, and move the windows up to `start_ns`.

        Their innovations at `guesses`, the states (m, n) at their stamp, are `y` (m, k), with Jacobians `H` (m, k, n).
        One node at or before `start_ns` stays in each window; behind it, what `reach_ns` needs is kept. A measurement
        that is older changes the prior of its window. Returns the smoothed states of the nodes that left, if wanted.
        Raises `numpy.linalg.LinAlgError` if it fails; states are as before then.
        """
        nodes, stamp_ns = self.nodes, stack.stamp_ns
        guesses = self._marked_nonlinear(tracks, stamp_ns, guesses) if stack.is_nonlinear else guesses
        anchors = np.maximum(nodes.first[tracks], nodes.last_before(tracks, start_ns))
        leaving = self._leaving(tracks, anchors)
        before, stamps_ns = nodes.nearest(tracks, stamp_ns)
        saved, is_old = nodes.saved(tracks), before < anchors
        is_new = nodes.stamps_ns[tracks, before] != stamps_ns
        indices = before + is_new
        rows, moved = self._move_far(tracks, anchors, before)
        if is_new.any():
            nodes.insert_at(tracks[is_new], indices[is_new], stamp_ns, guesses[is_new])
        moved = moved + (moved >= np.where(is_new, indices, NEVER)[rows])
        starts = indices.copy()
        np.minimum.at(starts, rows, moved)
        anchors = anchors + (is_old & is_new)
        numbers = nodes.numbers[tracks, indices]
        ahead_s = (stamp_ns - stamps_ns) / NS_PER_S
        for number, term in zip(numbers.tolist(), zip(Measurements(stack), ahead_s.tolist(), strict=True), strict=True):
            nodes.terms[number].append(term)
        try:
            to, inner = tracks[is_new], indices[is_new]
            nodes.linearise_motion(np.concatenate([tracks[rows], to, to]), np.concatenate([moved, inner - 1, inner]))
            is_linear = np.full(len(tracks), False) if stack.is_nonlinear else ahead_s == 0.0
            for number in numbers[~is_linear].tolist():
                nodes.linearise_terms(number)
            if is_linear.any():
                linear = numbers[is_linear]
                given = y[is_linear], H[is_linear], stack.R[is_linear]
                nodes.observe(linear, *given, guesses[is_linear] - nodes.origin[linear])
            if is_old.any():
                self._refilter(tracks[is_old], starts[is_old], anchors[is_old])
                starts[is_old] = anchors[is_old]
            self.solve(tracks, starts, anchors)
        except np.linalg.LinAlgError:
            for name, values in zip(nodes.ORDER, saved, strict=True):
                getattr(nodes, name)[tracks] = values
            for number in numbers.tolist():
                nodes.terms[number].pop()
                nodes.linearise_terms(number)
            nodes.linearise_motion(tracks, before)
            self._refilter(tracks[is_old], before[is_old], nodes.first[tracks[is_old]])
            for track in tracks.tolist():
                self.relinearise(track)
            raise
        self._forget_before(tracks, reach_ns)
        return leaving

    def _refilter(self, tracks: IntArray, starts: IntArray, anchors: IntArray) -> None:
        """Filter from `starts`, which lie behind the windows, up to `anchors`, where these begin: with other priors."""
        starts = np.minimum(starts, self.nodes.first[tracks])
        self.nodes.first[tracks] = 0
        self.eliminate(tracks, starts, anchors + 1)
        self.nodes.first[tracks] = anchors
        for track in tracks.tolist():
            self.forget(track)

    def _marked_nonlinear(self, tracks: IntArray, stamp_ns: int, guesses: FloatArray) -> FloatArray:
        """States at `stamp_ns` after the relinearisation of tracks whose first nonlinear measurement comes now.
        From now on, these have other thresholds.
        """
        first = (~self.nodes.is_nonlinear[tracks]).nonzero()[0]
        if first.size:
            self.nodes.is_nonlinear[tracks] = True
            for track in tracks[first].tolist():
                self.relinearise(track, self.estimates(track))
            guesses = guesses.copy()
            guesses[first] = self.states_at(tracks[first], np.full(len(first), stamp_ns))[0]
        return guesses

    def _forget_before(self, tracks: IntArray, stamps_ns: IntArray) -> None:
        nodes = self.nodes
        most = nodes.first[tracks] - 1
        if ((most >= _MANY) & (nodes.stamps_ns[tracks, _MANY - 1] <= stamps_ns)).any():
            num = np.minimum(nodes.last_before(tracks, stamps_ns), most)
            many = num >= _MANY
            nodes.drop(tracks[many], num[many])

    # --- relinearisation

    def _far(self, tracks: IntArray, anchors: IntArray, starts: IntArray) -> tuple[IntArray, IntArray]:
        """Nodes that are too far from their linearisation points: rows of `tracks`, and indices.
        The tolerance is smaller for those before `anchors`, which are about to leave, and for those that are solved
        again anyway, from `starts` on.
        """
        nodes = self.nodes
        rows, indices = np.empty((2, int((nodes.count - nodes.first)[tracks].sum())), dtype=np.int64)
        thresholds = self._thresholds[nodes.is_nonlinear[tracks].astype(int)]
        num = kernels.find_far(tracks, anchors, starts, *nodes.order, thresholds, nodes.step, rows, indices)
        return rows[:num], indices[:num]

    def _move_far(self, tracks: IntArray, anchors: IntArray, starts: IntArray) -> tuple[IntArray, IntArray]:
        """Move the linearisation points of nodes that are `_far`, not yet the motion from there; return as it does."""
        rows, indices = self._far(tracks, anchors, starts)
        if rows.size:
            numbers = self.nodes.numbers[tracks[rows], indices]
            self.nodes.move(tracks[rows], numbers, self.nodes.step[numbers])
        return rows, indices

    def iterate(self, tracks: IntArray, max_iterations: int) -> None:
        """Take Gauss-Newton steps while a state is further than a threshold from its linearisation point."""
        for _ in range(max_iterations):
            rows, indices = self._move_far(tracks, self.nodes.first[tracks], self.nodes.count[tracks])
            if not rows.size:
                return
            self.nodes.linearise_motion(tracks[rows], indices)
            rows, first_of = np.unique(rows, return_index=True)  # indices rise within a track
            tracks = tracks[rows]
            self.solve(tracks, indices[first_of], self.nodes.first[tracks])

    def relinearise(self, track: int, means: FloatArray | None = None) -> None:
        """Linearise a window at `means`, shape (m, n), or where its linearisation points are, and solve it."""
        nodes, numbers, tracks = self.nodes, self.nodes.window(track), np.array([track])
        of, first = np.full(len(numbers), track), nodes.first[tracks]
        if means is not None:
            nodes.move(of, numbers, means - nodes.origin[numbers])
        nodes.linearise_motion(of, first + np.arange(len(numbers)))
        for number in numbers.tolist():
            nodes.linearise_terms(number)
        self.forget(track)
        self.solve(tracks, first, first)

    def converge(self, track: int, max_iterations: int = 100) -> None:
        """Solve with all states linearised where the last step led, until none moves by more than rounding.
        Half a step is taken where a whole one comes no closer, or does not lower the cost: process noise that follows
        its state can make Gauss-Newton oscillate.
        """
        means, last = self.estimates(track), np.inf
        for _ in range(max_iterations):
            self.relinearise(track, means)
            steps = self.estimates(track) - means
            longest = float(np.abs(steps).max())
            if longest < STEP_TOLERANCE:
                return
            share, most = 1.0 if longest < 0.5 * last else 0.5, self._cost(track, means) * (1.0 + _ROUNDING) + _ROUNDING
            while share > _LEAST_SHARE and self._cost(track, means + share * steps) > most:
                share *= 0.5
            means, last = means + share * steps, longest

    def _cost(self, track: int, means: FloatArray) -> float:
        """Half of the sum of squares of a window at `means` (m, n), and the robust losses of those that have one.
        The process noise is that of the linearisation points.
        """
        nodes, n, numbers = self.nodes, self.motion.dim, self.nodes.window(track)
        prior, Q = nodes.predicted[numbers[0]], nodes.segment[numbers[:-1], :, n : 2 * n]
        dt_s = np.diff(nodes.window_stamps_ns(track)) / NS_PER_S
        total = mahalanobis_squared(means[0] - nodes.origin[numbers[0]] - prior[:, n], prior[:, :n])
        gaps = means[1:] - self.motion.predict(means[:-1], dt_s)
        total += sum(((noise_root(each) @ gap) ** 2).sum() for each, gap in zip(Q, gaps, strict=True))
        terms = ((term, x) for number, x in zip(numbers.tolist(), means, strict=True) for term in nodes.terms[number])
        return 0.5 * float(total) + sum(cost(term, x, self.motion) for term, x in terms)

    def damp(self, tracks: IntArray) -> int:
        """Converge in damped steps where the last one left the range of its linearisation; return how many tracks."""
        nodes, tracks = self.nodes, tracks[self.nodes.is_nonlinear[tracks]]
        if not tracks.size or self.is_damped:
            return 0
        rows, indices = self._far(tracks, nodes.first[tracks], nodes.count[tracks])
        numbers = nodes.numbers[tracks[rows], indices]
        far = zip(rows.tolist(), numbers.tolist(), nodes.origin[numbers], nodes.step[numbers], strict=True)
        overshooting = {row for row, number, x, step in far if overshot(nodes.terms[number], x, x + step, self.motion)}
        for track in tracks[sorted(overshooting)].tolist():
            means = nodes.origin[nodes.window(track)]
            try:
                self.converge(track)
            except np.linalg.LinAlgError:
                self.relinearise(track, means)
        return len(overshooting)

    # --- initiation

    def fixes(self, track: int) -> list[Fix]:
        """Positions measured at the nodes, after that of the prior, of a window that nothing has left yet."""
        nodes, numbers = self.nodes, self.nodes.window(track)
        prior, begin_ns = nodes.predicted[numbers[0]], int(nodes.begin_ns[track])
        terms = (term for number in numbers.tolist() for term, _ in nodes.terms[number])
        later = ((seconds(term.stamp_ns - begin_ns), term) for term in terms)
        return fixes_of(nodes.origin[numbers[0]] + prior[:, -1], prior[:, :-1].copy(), later)

    def restart(self, track: int, line: Line) -> None:
        """Solve again from states along `line`, with the prior's heading, which must be vague, turned there."""
        nodes, oldest = self.nodes, self.nodes.window(track)[0]
        times_s = (nodes.window_stamps_ns(track) - nodes.begin_ns[track]) / NS_PER_S
        means = np.array([along(line, time_s, self.motion.state_names) for time_s in times_s.tolist()])
        if not self.motion.cartesian:
            nodes.predicted[oldest, YAW, -1] = means[0, YAW] - nodes.origin[oldest, YAW]
        self.relinearise(track, means)

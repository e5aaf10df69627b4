"""The windows of all tracks as systems of equations: linearised, relinearised where they moved, and solved."""

from typing import ClassVar

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.smoothing import kernels
from fgtrack.estimation.smoothing.nodes import Nodes, grown
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.models.motion import MotionModel

#: A step of a state, in m, rad, m/s or rad/s, that is rounding.
STEP_TOLERANCE = 1e-7


class Solver:
    """Linearised windows of many tracks, each by its number; solved in covariance form by compiled loops.

    Parameters
    ----------
    motion
        Motion model of all of them.
    settings
        Those of relinearisation.
    """

    is_damped: ClassVar[bool] = False
    """True if no step makes the fit worse."""

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        self.motion = motion
        self._settings = settings
        self.nodes = Nodes(motion.dim)
        self._thresholds = np.empty((0, motion.dim))
        self.is_nonlinear: BoolArray = np.zeros(0, dtype=bool)
        """True if a track has a measurement that is not linear."""

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """Start the window of a track with its first node."""
        self.nodes.begin_window(track, stamp_ns, mean, covariance)
        size = len(self.nodes.first)
        if size > len(self.is_nonlinear):
            self._thresholds, self.is_nonlinear = grown(self._thresholds, size), grown(self.is_nonlinear, size)
        self._thresholds[track] = self._settings.thresholds(self.motion, nonlinear=False)
        self.is_nonlinear[track] = False

    # --- solution; a factor graph has its own

    def prepare_leaving(self, tracks: IntArray, anchors: IntArray) -> None:
        """Make the states of the nodes before `anchors` known, which leave the windows next."""

    def look_up(self, tracks: IntArray, indices: IntArray, with_previous: BoolArray) -> None:
        """Make `smoothed` known at `indices`, and the nodes before them given those, if `with_previous`."""

    def solve(self, tracks: IntArray, starts: IntArray, anchors: IntArray) -> None:
        """Solve windows that have changed from `starts` on and begin at `anchors` from now on.

        Raises `numpy.linalg.LinAlgError` if it fails.
        """
        self.eliminate(tracks, starts)
        self.nodes.first[tracks] = anchors
        self.back_substitute(tracks)

    # --- in covariance form

    def eliminate(self, tracks: IntArray, starts: IntArray, ends: IntArray | None = None) -> None:
        """Eliminate the nodes of `tracks` from `starts` up to before `ends`, or all that follow.

        Raises `numpy.linalg.LinAlgError` if it fails.
        """
        nodes = self.nodes
        given = nodes.origin, nodes.segment, nodes.rows, nodes.num_rows
        result = nodes.predicted, nodes.filtered, nodes.back, nodes.C
        ends = nodes.count[tracks] if ends is None else ends
        if not kernels.eliminate(tracks, starts, ends, *self.nodes.order, *given, *result):
            raise np.linalg.LinAlgError("a state is not finite")

    def back_substitute(self, tracks: IntArray) -> None:
        """Find how far the states of `tracks` are from their linearisation points."""
        nodes = self.nodes
        kernels.back_substitute(tracks, *self.nodes.order, nodes.filtered, nodes.back, nodes.step)
        nodes.known[tracks] = nodes.count[tracks]

    def smoothed(self, tracks: IntArray, indices: IntArray) -> tuple[FloatArray, FloatArray]:
        """Steps (m, n) and covariances (m, n, n) of the nodes at `indices` of `tracks`."""
        nodes, n = self.nodes, self.motion.dim
        steps, covariances = np.empty((len(tracks), n)), np.empty((len(tracks), n, n))
        given = nodes.filtered, nodes.back, nodes.C, nodes.step, nodes.P
        kernels.smoothed(tracks, indices, nodes.known, *self.nodes.order, *given, steps, covariances)
        return steps, covariances

    # --- linearisation

    def far(self, tracks: IntArray, anchors: IntArray, starts: IntArray) -> tuple[IntArray, IntArray]:
        """Nodes that are too far from their linearisation points: rows of `tracks`, and indices.

        The tolerance is smaller for those before `anchors`, which are about to leave, and for those that are solved
        again anyway, from `starts` on.
        """
        nodes = self.nodes
        rows, indices = np.empty((2, int((nodes.count - nodes.first)[tracks].sum())), dtype=np.int64)
        num = kernels.find_far(tracks, anchors, starts, *nodes.order, self._thresholds, nodes.step, rows, indices)
        return rows[:num], indices[:num]

    def move_far(self, tracks: IntArray, anchors: IntArray, starts: IntArray) -> tuple[IntArray, IntArray]:
        """Move the linearisation points of nodes that are `far`, not yet the motion from there; return what it does."""
        nodes = self.nodes
        rows, indices = self.far(tracks, anchors, starts)
        if rows.size:
            numbers = nodes.numbers[tracks[rows], indices]
            nodes.move(tracks[rows], numbers, nodes.step[numbers])
        return rows, indices

    def linearise_motion(self, tracks: IntArray, indices: IntArray) -> None:
        """Linearise the motion from the nodes at `indices` to the next ones, where there are any."""
        nodes = self.nodes
        inner = indices < nodes.count[tracks] - 1
        if not inner.all():
            tracks, indices = tracks[inner], indices[inner]
        if tracks.size:
            dt_s = (nodes.stamps_ns[tracks, indices + 1] - nodes.stamps_ns[tracks, indices]) / NS_PER_S
            numbers = nodes.numbers[tracks, indices]
            ahead, F, Q = self.motion.transition(nodes.origin[numbers], dt_s)
            nodes.segment[numbers] = np.concatenate([F, Q, ahead[..., None]], axis=-1)
            nodes.changed[numbers] = True

    def iterate(self, tracks: IntArray, max_iterations: int) -> None:
        """Take Gauss-Newton steps while a state is further than a threshold from its linearisation point."""
        for _ in range(max_iterations):
            rows, indices = self.move_far(tracks, self.nodes.first[tracks], self.nodes.count[tracks])
            if not rows.size:
                return
            self.linearise_motion(tracks[rows], indices)
            rows, first_of = np.unique(rows, return_index=True)  # indices rise within a track
            tracks = tracks[rows]
            self.solve(tracks, indices[first_of], self.nodes.first[tracks])

    # --- one track

    def mark_nonlinear(self, track: int) -> None:
        """Relinearise a window before its first measurement that is not linear, with other thresholds from now on."""
        self.is_nonlinear[track] = True
        self._thresholds[track] = self._settings.thresholds(self.motion, nonlinear=True)
        self.solve_at(track, self.estimates(track))

    def estimates(self, track: int) -> FloatArray:
        """Means of all nodes in the window, shape (m, n)."""
        numbers = self.nodes.window(track)
        return np.asarray(self.nodes.origin[numbers] + self.nodes.step[numbers])

    def solve_at(self, track: int, means: FloatArray) -> None:
        """Linearise the whole window at `means`, shape (m, n), and solve it."""
        self.move_to(track, means)
        self.rebuild(np.array([track]))

    def move_to(self, track: int, means: FloatArray) -> None:
        """Move all linearisation points of the window."""
        numbers = self.nodes.window(track)
        self.nodes.move(np.full(len(numbers), track), numbers, means - self.nodes.origin[numbers])

    def linearise(self, track: int) -> None:
        """Linearise everything in the window where its linearisation points are."""
        numbers = self.nodes.window(track)
        self.linearise_motion(np.full(len(numbers), track), self.nodes.first[track] + np.arange(len(numbers)))
        for number in numbers.tolist():
            self.nodes.linearise_terms(number)

    def rebuild(self, tracks: IntArray) -> None:
        """Relinearise everything where the linearisation points are, and solve it."""
        for track in tracks.tolist():
            self.linearise(track)
        first = self.nodes.first[tracks]
        self.solve(tracks, first, first)

    def converge(self, track: int, max_iterations: int) -> None:
        """Solve with all states linearised where the last step led, until none moves by more than rounding.

        Half a step is taken where a whole one comes no closer: process noise that follows its state can make
        Gauss-Newton oscillate.
        """
        means, last = self.estimates(track), np.inf
        for _ in range(max_iterations):
            self.solve_at(track, means)
            steps = self.estimates(track) - means
            longest = float(np.abs(steps).max())
            if longest < STEP_TOLERANCE:
                return
            share = 1.0 if longest < 0.5 * last else 0.5
            means, last = means + share * steps, longest

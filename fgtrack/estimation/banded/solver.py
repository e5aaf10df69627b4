"""The windows of all tracks as systems of equations: linearised, relinearised where they moved, and solved."""

from typing import NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.banded import kernels
from fgtrack.estimation.banded.linearisation import linearise_segments, linearise_terms, move
from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.banded.undo import Undo
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.models.motion import MotionModel

#: A step of a state, in m, rad, m/s or rad/s, that is rounding.
_AT_REST = 1e-7


class Moved(NamedTuple):
    """Where the linearisation points of m tracks have moved."""

    starts: IntArray
    """First places, or `count` where none has; shape (m,)."""
    tracks: IntArray
    """Track of each node that has moved, shape (k,)."""
    places: IntArray
    """Their places, shape (k,)."""


class Solver:
    """Linearised windows of many tracks, each by its number.

    Parameters
    ----------
    motion
        Motion model of all of them.
    settings
        Those of relinearisation.
    """

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        self._motion = motion
        self._settings = settings
        self.nodes = Nodes(motion.dim)
        self._thresholds = np.empty((0, motion.dim))
        self.curved: BoolArray = np.zeros(0, dtype=bool)
        """Whether a track has a measurement that is not linear."""
        self.anchored: IntArray = np.zeros(0, dtype=np.int64)
        """1 where the oldest node of the window keeps its linearisation, because it has a marginalised past."""

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """Start the window of a track with its first node."""
        self.nodes.begin_window(track, stamp_ns, mean, covariance)
        more = len(self.nodes.first) - len(self.curved)
        if more:
            self._thresholds = np.concatenate([self._thresholds, np.zeros((more, self._motion.dim))])
            self.curved = np.concatenate([self.curved, np.zeros(more, dtype=bool)])
            self.anchored = np.concatenate([self.anchored, np.zeros(more, dtype=np.int64)])
        self._thresholds[track] = self._settings.thresholds(self._motion, curved=False)
        self.curved[track], self.anchored[track] = False, 0

    def eliminate(self, tracks: IntArray, places: IntArray) -> None:
        """Eliminate the nodes of `tracks` from `places` on. Raises `numpy.linalg.LinAlgError` where it fails."""
        nodes = self.nodes
        given = nodes.origin, nodes.segment, nodes.rows, nodes.num_rows
        result = nodes.predicted, nodes.filtered, nodes.back, nodes.C
        if not kernels.eliminate(tracks, places, *self._order, *given, *result):
            raise np.linalg.LinAlgError("a state is not finite")

    def solve_means(self, tracks: IntArray) -> None:
        """Find out how far the states of `tracks` are from their linearisation points."""
        nodes = self.nodes
        limits, given = (self._thresholds, self.anchored), (nodes.filtered, nodes.back)
        kernels.solve_means(tracks, *self._order, *limits, *given, nodes.step, nodes.far, nodes.any_far)
        nodes.known[tracks] = nodes.count[tracks]

    def smoothed(self, tracks: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Steps (m, n) and covariances (m, n, n) of the nodes at `places` of `tracks`."""
        nodes, n = self.nodes, self._motion.dim
        steps, covariances = np.empty((len(tracks), n)), np.empty((len(tracks), n, n))
        given = nodes.filtered, nodes.back, nodes.C, nodes.step, nodes.P
        kernels.smoothed(tracks, places, nodes.known, *self._order, *given, steps, covariances)
        return steps, covariances

    @property
    def _order(self) -> tuple[IntArray, IntArray, IntArray]:
        return self.nodes.first, self.nodes.count, self.nodes.numbers

    def iterate(self, tracks: IntArray, max_iterations: int) -> None:
        """Take Gauss-Newton steps while a state is further than a threshold from its linearisation point."""
        for _ in range(max_iterations):
            starts = self.relinearise(tracks)
            moved = starts < self.nodes.count[tracks]
            tracks, starts = tracks[moved], starts[moved]
            if not tracks.size:
                return
            self.eliminate(tracks, starts)
            self.solve_means(tracks)

    def relinearise(self, tracks: IntArray) -> IntArray:
        """Relinearise where states are too far from their linearisation points; the first places, or `count`."""
        moved = self.move_far(tracks)
        if moved.tracks.size:
            linearise_segments(self.nodes, self._motion, moved.tracks, moved.places)
        return moved.starts

    def move_far(self, tracks: IntArray, undo: Undo | None = None) -> Moved:
        """Move the linearisation points that are too far from their states, without the segments from there."""
        nodes = self.nodes
        starts = nodes.count[tracks]
        rows, places = self.far(tracks)
        of = tracks[rows]
        if rows.size:
            moved = nodes.at(of, places)
            if undo is not None:
                undo.keep_origins(of, moved)
            move(nodes, of, moved, nodes.step[moved])
            nodes.far[moved] = False
            np.minimum.at(starts, rows, places)
        return Moved(starts, of, places)

    def far(self, tracks: IntArray) -> tuple[IntArray, IntArray]:
        """Nodes that are too far from their linearisation points: positions of their tracks, and their places."""
        nodes = self.nodes
        rows, places = np.empty((2, int((nodes.count - nodes.first)[tracks].sum())), dtype=np.int64)
        num = kernels.find_far(tracks, *self._order, self.anchored, nodes.far, nodes.any_far, rows, places)
        return rows[:num], places[:num]

    # --- one track

    def window(self, track: int) -> IntArray:
        """Numbers of all nodes of the window."""
        return self.nodes.numbers[track, self.nodes.first[track] : self.nodes.count[track]].copy()

    def stamps_ns(self, track: int) -> list[int]:
        """Stamps of the nodes in the window."""
        stamps_ns: list[int] = self.nodes.stamps_ns[track, self.nodes.first[track] : self.nodes.count[track]].tolist()
        return stamps_ns

    def bend(self, track: int) -> None:
        """The first measurement comes that is not linear: linearise anew, with thresholds for that from now on."""
        self.curved[track] = True
        self._thresholds[track] = self._settings.thresholds(self._motion, curved=True)
        self.solve_anew(track, self.estimates(track))

    def estimates(self, track: int) -> FloatArray:
        """Means of all nodes in the window, shape (m, n)."""
        at = self.window(track)
        return np.asarray(self.nodes.origin[at] + self.nodes.step[at])

    def solve_at(self, track: int, means: FloatArray) -> None:
        """Linearise the whole window at `means`, shape (m, n), and solve it."""
        self.move_to(track, means)
        self.rebuild(np.array([track]))

    def solve_anew(self, track: int, means: FloatArray) -> None:
        """`solve_at`, and from now on the oldest node may be relinearised, too, until the next one leaves."""
        self.anchored[track] = 0
        self.solve_at(track, means)

    def move_to(self, track: int, means: FloatArray) -> None:
        """Move all linearisation points of the window."""
        at = self.window(track)
        move(self.nodes, np.full(len(at), track), at, means - self.nodes.origin[at])

    def linearise(self, track: int) -> None:
        """Linearise everything in the window where it stands."""
        nodes, at = self.nodes, self.window(track)
        linearise_segments(nodes, self._motion, np.full(len(at), track), nodes.first[track] + np.arange(len(at)))
        for number in at.tolist():
            linearise_terms(nodes, number)

    def rebuild(self, tracks: IntArray) -> None:
        """Linearise everything anew where it stands, and solve it."""
        for track in tracks.tolist():
            self.linearise(track)
        self.eliminate(tracks, self.nodes.first[tracks])
        self.solve_means(tracks)

    def converge(self, track: int, max_iterations: int) -> None:
        """Solve again, with all states linearised where the last step led, until none moves by more than rounding.

        Half a step is taken where a whole one comes no closer: process noise that follows its state can make
        Gauss-Newton oscillate.
        """
        means, last = self.estimates(track), np.inf
        for _ in range(max_iterations):
            self.solve_at(track, means)
            steps = self.estimates(track) - means
            longest = float(np.abs(steps).max())
            if longest < _AT_REST:
                return
            share = 1.0 if longest < 0.5 * last else 0.5
            means, last = means + share * steps, longest

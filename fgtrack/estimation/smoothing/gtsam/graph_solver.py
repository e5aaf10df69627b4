"""What the solvers on gtsam share: states and covariances that are read from the factor graph of each window."""

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.histories import grown
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.estimation.smoothing.terms import NEAR_NS
from fgtrack.models.motion import MotionModel


class GraphSolver(Solver):
    """Windows whose means and covariances come from a factor graph each; what leaves them is kept as in `Solver`.

    A track has no graph before something is fused: most tracks of clutter end as they began.
    """

    near_ns: ClassVar[int] = NEAR_NS

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        super().__init__(motion, settings)
        self._is_known: BoolArray = np.zeros((0, 2), dtype=bool)
        """True if the covariance of a node, and its distribution given the next node, have been read."""

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """See `Solver.begin`."""
        super().begin(track, stamp_ns, mean, covariance)
        self._forget(track)
        self._fit()
        self._is_known[self.nodes.numbers[track, 0], 0] = True

    def prepare_leaving(self, tracks: IntArray, anchors: IntArray) -> None:
        """See `Solver.prepare_leaving`: eliminated by themselves."""
        self.eliminate(tracks, self.nodes.first[tracks], anchors + 1)
        self.look_up(tracks, anchors, np.zeros(len(tracks), dtype=bool))
        self.nodes.known[tracks] = anchors

    def look_up(self, tracks: IntArray, indices: IntArray, with_previous: BoolArray) -> None:
        """See `Solver.look_up`."""
        nodes, n = self.nodes, self.motion.dim
        first = nodes.first[tracks]
        indices = np.maximum(indices, first)
        previous = nodes.at(tracks, np.maximum(indices - 1, 0))
        with_previous = with_previous & (indices > first)
        numbers = nodes.at(tracks, indices)
        missing = ~np.where(with_previous, self._is_known[previous, 1], self._is_known[numbers, 0])
        for row in missing.nonzero()[0].tolist():
            number = int(numbers[row])
            if not with_previous[row]:
                nodes.P[number] = self._covariance(int(tracks[row]), number)
            else:
                left = int(previous[row])
                joint = self._covariance(int(tracks[row]), left, number)
                cross, nodes.P[number], nodes.P[left] = joint[:n, n:], joint[n:, n:], joint[:n, :n]
                A = psd_solve(nodes.P[number], cross.T).T
                nodes.back[left, :, :n], nodes.back[left, :, n] = A, nodes.step[left] - A @ nodes.step[number]
                nodes.C[left] = symmetrise(nodes.P[left] - A @ cross.T)
                self._is_known[left] = True
            self._is_known[number, 0] = True

    def solve(self, tracks: IntArray, starts: IntArray, anchors: IntArray) -> None:
        """See `Solver.solve`."""
        nodes = self.nodes
        self._fit()
        first = nodes.first[tracks]
        is_leaving = first < anchors
        if is_leaving.any():
            self.eliminate(tracks[is_leaving], first[is_leaving], anchors[is_leaving] + 1)
        nodes.first[tracks] = anchors
        try:
            self._update(tracks, first)
        except (RuntimeError, ValueError, IndexError) as error:
            raise np.linalg.LinAlgError(f"the graph cannot be solved ({error})") from error
        for track in tracks.tolist():
            window = nodes.window(track)
            if not np.isfinite(nodes.step[window]).all():
                raise np.linalg.LinAlgError("a state is not finite")
            self._is_known[window] = False
        self._mark_far(tracks)
        nodes.known[tracks] = anchors

    def rebuild(self, tracks: IntArray) -> None:
        """See `Solver.rebuild`; in graphs of their own."""
        for track in tracks.tolist():
            self._forget(track)
        super().rebuild(tracks)

    @abstractmethod
    def _update(self, tracks: IntArray, starts: IntArray) -> None:
        """Solve the graphs of `tracks` without what has left the windows, which began at index `starts` before.

        Writes `step` of the nodes in the windows.

        Raises `RuntimeError`, `ValueError` or `IndexError` if it fails; then only a new graph helps.
        """

    @abstractmethod
    def _covariance(self, track: int, *numbers: int) -> FloatArray:
        """Joint covariance of one node, shape (n, n), or of two neighbours, (2 n, 2 n)."""

    @abstractmethod
    def _forget(self, track: int) -> None:
        """Forget the graph of a track."""

    def _fit(self) -> None:
        """Make room for the values of all numbers."""
        if self.nodes.size > len(self._is_known):
            self._is_known = grown(self._is_known, self.nodes.size)

"""Base of the solvers on gtsam: states and covariances that are read from the factor graph of each window."""

from abc import abstractmethod

import numpy as np

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.models.motion import MotionModel


class GraphSolver(Solver):
    """Windows whose means and covariances come from a factor graph each; what leaves them is kept as in `Solver`.

    A track has no graph before something is fused: most tracks of clutter end as they began.
    """

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        super().__init__(motion, settings)
        self._known: dict[int, dict[tuple[int | None, int], FloatArray]] = {}
        """Covariances by track and node, with the node before that it was read with, if any, since the last solution.

        So what is read for a stamp does not depend on what was read for others.
        """

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """See `Solver.begin`."""
        super().begin(track, stamp_ns, mean, covariance)
        self._forget(track)
        self._known[track] = {(None, int(self.nodes.numbers[track, 0])): covariance}

    def prepare_leaving(self, tracks: IntArray, anchors: IntArray) -> None:
        """See `Solver.prepare_leaving`: eliminated by themselves."""
        self.eliminate(tracks, self.nodes.first[tracks], anchors + 1)
        self.look_up(tracks, anchors, np.zeros(len(tracks), dtype=bool))
        self.nodes.known[tracks] = anchors

    def look_up(self, tracks: IntArray, indices: IntArray, with_previous: BoolArray) -> None:
        """See `Solver.look_up`."""
        nodes = self.nodes
        rows = zip(tracks.tolist(), indices.tolist(), nodes.first[tracks].tolist(), with_previous.tolist(), strict=True)
        for track, index, first, has_previous in rows:
            number, known = int(nodes.numbers[track, max(index, first)]), self._known[track]
            left = int(nodes.numbers[track, index - 1]) if has_previous and index > first else None
            if (left, number) not in known:
                known[left, number] = self._read(track, left, number)
            nodes.P[number] = known[left, number]

    def _read(self, track: int, left: int | None, number: int) -> FloatArray:
        """Read the covariance of a node, and the distribution of that on its left given it."""
        if left is None:
            return self._covariance(track, number)
        nodes, n = self.nodes, self.motion.dim
        joint = self._covariance(track, left, number)
        cross, P = joint[:n, n:], joint[n:, n:]
        A = psd_solve(P, cross.T).T
        nodes.back[left, :, :n], nodes.back[left, :, n] = A, nodes.step[left] - A.dot(nodes.step[number])
        nodes.C[left] = symmetrise(joint[:n, :n] - A.dot(cross.T))
        return P

    def solve(self, tracks: IntArray, starts: IntArray, anchors: IntArray) -> None:
        """See `Solver.solve`."""
        nodes = self.nodes
        first = nodes.first[tracks]
        is_leaving = first < anchors
        if is_leaving.any():
            self.eliminate(tracks[is_leaving], first[is_leaving], anchors[is_leaving] + 1)
        nodes.first[tracks] = anchors
        try:
            self._update(tracks, first)
        except (RuntimeError, ValueError, IndexError) as error:
            raise np.linalg.LinAlgError(f"the graph cannot be solved ({error})") from error
        self._known.update((track, {}) for track in tracks.tolist())
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

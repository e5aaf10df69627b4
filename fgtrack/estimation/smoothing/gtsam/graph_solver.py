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
        """True if `_covariances` of a node have been read."""
        self._covariances = np.zeros((0, 2, motion.dim, motion.dim))
        """By number: the covariance of the node, and that of the next one, from the joint covariance with it."""

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """See `Solver.begin`."""
        super().begin(track, stamp_ns, mean, covariance)
        self._forget(track)
        self._fit()
        number = self.nodes.numbers[track, 0]
        self._covariances[number, 0], self._is_known[number, 0] = covariance, True

    def prepare_leaving(self, tracks: IntArray, anchors: IntArray) -> None:
        """See `Solver.prepare_leaving`: eliminated by themselves."""
        self.eliminate(tracks, self.nodes.first[tracks], anchors + 1)
        self.look_up(tracks, anchors, np.zeros(len(tracks), dtype=bool))
        self.nodes.known[tracks] = anchors

    def look_up(self, tracks: IntArray, indices: IntArray, with_previous: BoolArray) -> None:
        """See `Solver.look_up`. What is read for a stamp never depends on what was read for others."""
        nodes, first = self.nodes, self.nodes.first[tracks]
        kinds = (with_previous & (indices > first)).astype(np.int64)
        numbers = nodes.at(tracks, np.maximum(indices, first))
        owners = np.where(kinds, nodes.at(tracks, np.maximum(indices - 1, 0)), numbers)
        for row in (~self._is_known[owners, kinds]).nonzero()[0].tolist():
            track, number, owner = int(tracks[row]), int(numbers[row]), int(owners[row])
            if kinds[row]:
                self._read_pair(track, owner, number)
            else:
                self._covariances[number, 0] = self._covariance(track, number)
            self._is_known[owner, kinds[row]] = True
        nodes.P[numbers] = self._covariances[owners, kinds]

    def _read_pair(self, track: int, left: int, right: int) -> None:
        """Read the covariance of a node, and the distribution of the one before it given that."""
        nodes, n = self.nodes, self.motion.dim
        joint = self._covariance(track, left, right)
        cross, P = joint[:n, n:], joint[n:, n:]
        A = psd_solve(P, cross.T).T
        nodes.back[left, :, :n], nodes.back[left, :, n] = A, nodes.step[left] - A @ nodes.step[right]
        nodes.C[left] = symmetrise(joint[:n, :n] - A @ cross.T)
        self._covariances[left, 1] = P

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
            self._covariances = grown(self._covariances, self.nodes.size)

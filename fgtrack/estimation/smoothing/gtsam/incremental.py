"""The default solver: gtsam's iSAM2 (Kaess et al., IJRR 31(2), 2012)."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import gtsam
import numpy as np

from fgtrack.core.linalg import inverse_root, psd_solve, symmetrise
from fgtrack.core.state import Snapshot
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing import factor_kernels
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.node_arrays import CHANGED, KNOWN
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.models.motion import MotionModel

_Changed = dict[int, gtsam.JacobianFactor]
"""Factors by the number of their node."""
_PRIOR = -1
"""Key of the prior of the oldest node with which the graph began; it replaces a node number."""
_unit = cache(gtsam.noiseModel.Unit.Create)


class _Graph:
    """The factor graph of a window. Its variables have the numbers of the nodes, and the values 0.

    iSAM2 uses QR, because Cholesky fails for stamps close together. It gets linear factors only, so it never calls
    back into Python; a factor that was linearised again is replaced. It eliminates in the order of the stamps. So a
    late measurement does not change older states, and nodes that leave the window are leaves of the Bayes tree.
    """

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.findUnusedFactorSlots = True
        params.enableRelinearization = False
        gauss_newton = gtsam.ISAM2GaussNewtonParams()
        gauss_newton.setWildfireThreshold(0.0)
        params.setOptimizationParams(gauss_newton)
        self.isam = gtsam.ISAM2(params)
        self.slots: dict[int, int | None] = {}
        """Slot in iSAM2 of the factor of each node (its measurements and its motion to the next node); None
        without a factor.
        """
        self._newest = -1

    def solve(
        self,
        numbers: Sequence[int],
        num_leaving: int,
        values: gtsam.Values,
        first: int,
        changed: _Changed,
    ) -> FloatArray:
        """Return the states of the nodes `numbers` as one vector, without the first `num_leaving` nodes, which
        leave the graph.

        The factors that have `changed` replace the factors of the same nodes, from index `first` on. `values`
        are the values of new nodes.
        """
        factors, order = gtsam.GaussianFactorGraph(), gtsam.KeyGroupMap()
        for factor in changed.values():
            factors.push_back(factor)
        if first and numbers[first] == self._newest:  # both nodes are in one clique
            first -= 1
        for group, number in enumerate(numbers[first:]):
            order.insert2(number, group)
        removed = [slot for slot in map(self.slots.get, changed) if slot is not None]
        graph = gtsam.LinearContainerFactor.ConvertLinearGraph(
            factors
        )  # faster than one by one
        added = self.isam.update(graph, values, removed, order).getNewFactorsIndices()
        self.slots.update(zip(changed, added, strict=False))
        self._newest = numbers[-1]
        if num_leaving:
            leaves = gtsam.KeyList()
            for number in numbers[:num_leaving]:
                leaves.push_back(number)
                del self.slots[number]
            self.isam.marginalizeLeaves(leaves)
        return self.isam.getDelta().vector(numbers[num_leaving:])


class IncrementalSolver(Solver):
    """Windows that iSAM2 solves. A compiled loop linearises the factors of all tracks.

    Each track has its own factor graph, which gives means and covariances. States that leave the graph are kept as
    in `Solver`. A track has no graph before its first fusion, because most tracks of clutter end before it.
    """

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        super().__init__(motion, settings)
        self._graphs: dict[int, Any] = {}  # Any: a subclass has its own type
        self._read = set[tuple[int, ...]]()
        """Nodes, and pairs of nodes, whose covariances were read since the last solution."""

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Graphs are not copied: the checkpoint only names the windows that have a
        graph.
        """
        return {**super().checkpoint(), "solved": tuple(self._graphs)}

    def restore(self, snapshot: Snapshot) -> None:
        """See `Stateful.restore`. iSAM2 cannot be copied, so each graph is made from its window.

        The new graph has equal factors and linearisation points, and eliminates all factors at once. Its states
        differ from those of the uninterrupted tracker by rounding: less than 1e-9 standard deviations.
        """
        super().restore(snapshot)
        self._graphs.clear()
        self._read.clear()
        tracks = np.array(snapshot["solved"], dtype=np.int64)
        if len(tracks):
            first = self.nodes.first[tracks]
            self.solve(tracks, first, first.copy())

    def forget(self, track: int) -> None:
        """See `Solver.forget`: the next solution makes a new graph."""
        self._graphs.pop(track, None)
        self._read.clear()

    def smoothed(
        self, tracks: IntArray, indices: IntArray, after_s: FloatArray
    ) -> FloatArray:
        """See `Solver.smoothed`. Inside the windows, means and covariances come from the graphs."""
        nodes, n = self.nodes, self.motion.dim
        rows = zip(
            tracks.tolist(),
            indices.tolist(),
            nodes.first[tracks].tolist(),
            after_s.tolist(),
            strict=True,
        )
        for track, index, first, time_s in rows:
            if track not in self._graphs:  # nothing was fused: the window has one node
                continue
            last = max(index, first)
            numbers = tuple(
                nodes.numbers[
                    track, last - (time_s > 0.0 and index > first) : last + 1
                ].tolist()
            )
            if numbers in self._read:
                continue
            P, (left, *right) = self._covariance(track, *numbers), numbers
            self._read.add(numbers)
            for number in right:
                A = psd_solve(
                    P[n:, n:], P[n:, :n]
                ).T  # the left state, given this state
                nodes.backs[left, :n, :n], nodes.backs[left, :n, n] = (
                    A,
                    nodes.step[left] - A.dot(nodes.step[number]),
                )
                nodes.C[left] = symmetrise(P[:n, :n] - A.dot(P[n:, :n]))
            nodes.P[right[0] if right else left] = P[-n:, -n:]
        return super().smoothed(tracks, indices, after_s)

    def solve(self, tracks: IntArray, starts: IntArray, anchors: IntArray) -> None:
        """See `Solver.solve`."""
        nodes = self.nodes
        self._read.clear()
        first = nodes.first[tracks]
        is_leaving = first < anchors
        if is_leaving.any():
            self._solve(
                tracks[is_leaving],
                first[is_leaving],
                anchors[is_leaving],
                is_partial=True,
            )
        nodes.first[tracks] = anchors
        try:
            self._update(tracks, first)
        except (RuntimeError, ValueError, IndexError) as error:
            nodes.tracks[tracks, KNOWN] = anchors  # the states that were read last
            for track in tracks.tolist():  # its graph may lack nodes
                self.forget(track)
            raise np.linalg.LinAlgError(
                f"the graph cannot be solved ({error})"
            ) from error
        nodes.tracks[tracks, KNOWN] = anchors

    def _covariance(self, track: int, *numbers: int) -> FloatArray:
        """Return the joint covariance of one node, shape (n, n), or of two neighbours, shape (2 n, 2 n)."""
        isam: gtsam.ISAM2 = self._graphs[track].isam
        if len(numbers) == 1:
            return isam.marginalCovariance(numbers[0])
        return isam.jointMarginalCovariance(list(numbers)).fullMatrix()

    def _update(self, tracks: IntArray, starts: IntArray) -> None:
        """Solve the graphs of `tracks` without the nodes that have left the windows, which began at index
        `starts` before.

        Writes `step` of the nodes in the windows. Raises `RuntimeError`, `ValueError` or `IndexError` if this
        fails; then only a new graph helps.
        """
        nodes, zero = self.nodes, np.zeros(self.motion.dim)
        leaving = (nodes.first[tracks] - starts).tolist()
        for track, start, num_leaving in zip(
            tracks.tolist(), starts.tolist(), leaving, strict=True
        ):
            window, values = (
                nodes.numbers[track, start : nodes.count[track]].copy(),
                gtsam.Values(),
            )
            graph, prior = self._graphs.get(track), _Changed()
            if graph is None:
                graph, oldest = _Graph(), nodes.predicted[window[0]]
                self._graphs[track], W = graph, inverse_root(oldest[:, :-1])
                prior[_PRIOR] = gtsam.JacobianFactor(
                    int(window[0]), W, W @ oldest[:, -1], _unit(len(W))
                )
                nodes.labels[window, CHANGED] = 1
            numbers = window.tolist()
            for number in set(numbers).difference(graph.slots):
                graph.slots[number] = None
                values.insert(number, zero)
                nodes.reference[number] = nodes.origin[number]
            changed = self._changed_factors(track, start)
            first = min(map(numbers.index, changed), default=0)
            delta = graph.solve(numbers, num_leaving, values, first, changed | prior)
            if not np.isfinite(delta).all():
                raise ValueError("a state is not finite")
            window = window[num_leaving:]
            nodes.step[window] = (
                nodes.reference[window]
                - nodes.origin[window]
                + delta.reshape(len(window), -1)
            )

    def _changed_factors(self, track: int, start: int) -> _Changed:
        """Return the factors of a track, from index `start` on, that have changed.

        Raises `ValueError` if process noise is not positive definite.
        """
        nodes, n = self.nodes, self.motion.dim
        most = nodes.count[track] - start
        owners = np.empty((most, 3), dtype=np.int64)
        factors = np.empty((most, n + nodes.rows.shape[1], 2 * n + 1))
        num = factor_kernels.changed_factors(
            track, start, nodes.arrays, owners, factors
        )
        if num < 0:
            raise ValueError("process noise is not positive definite")
        changed: _Changed = {}
        for (number, right, size), each in zip(
            owners[:num].tolist(), factors, strict=False
        ):
            A, b, unit = each[:size, :n], each[:size, -1], _unit(size)
            if right < 0:
                changed[number] = gtsam.JacobianFactor(number, A, b, unit)
            else:
                changed[number] = gtsam.JacobianFactor(
                    number, A, right, each[:size, n:-1], b, unit
                )
        return changed


class IncrementalBank(SmootherBank):
    """Fixed-lag smoother, a factor graph that iSAM2 solves incrementally."""

    make_solver = IncrementalSolver
    rounding = 1.0

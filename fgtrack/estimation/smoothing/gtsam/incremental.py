"""The default solver: gtsam's iSAM2 (Kaess et al., IJRR 31(2), 2012)."""

from collections.abc import Sequence
from functools import cache

import gtsam
import numpy as np

from fgtrack.core.linalg import inverse_root
from fgtrack.core.state import Snapshot
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing import factor_kernels
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.node_arrays import CHANGED
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
        new: Sequence[int],
        zero: FloatArray,
        changed: _Changed,
    ) -> FloatArray:
        """Return the states of the nodes `numbers` as one vector, without the first `num_leaving` nodes, which
        leave the graph.

        The factors that have `changed` replace the factors of the same nodes. The `new` nodes get the value `zero`.
        """
        factors, order, values = (
            gtsam.GaussianFactorGraph(),
            gtsam.KeyGroupMap(),
            gtsam.Values(),
        )
        for factor in changed.values():
            factors.push_back(factor)
        for number in new:
            values.insert(number, zero)
        first = min(map(numbers.index, changed.keys() - {_PRIOR}), default=0)
        if first and numbers[first] == self._newest:  # both nodes are in one clique
            first -= 1
        for group, number in enumerate(numbers[first:]):
            order.insert2(number, group)
        slots = self.slots
        removed = [slot for slot in map(slots.get, changed) if slot is not None]
        graph = gtsam.LinearContainerFactor.ConvertLinearGraph(
            factors
        )  # faster than one by one
        added = self.isam.update(graph, values, removed, order).getNewFactorsIndices()
        slots.update(dict.fromkeys(new))
        slots.update(zip(changed, added, strict=False))
        self._newest = numbers[-1]
        if num_leaving:
            leaves = gtsam.KeyList()
            for number in numbers[:num_leaving]:
                leaves.push_back(number)
                del slots[number]
            self.isam.marginalizeLeaves(leaves)
        return self.isam.getDelta().vector(numbers[num_leaving:])


class IncrementalSolver(Solver):
    """Windows that iSAM2 solves. A compiled loop linearises the factors of all tracks.

    Each track has its own factor graph, which gives the means of its window. The covariances come from the elimination
    of `Solver`, which takes the same linearised factors of all tracks at once. A track has no graph before its first
    fusion, because most tracks of clutter end before it.
    """

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        super().__init__(motion, settings)
        self._graphs: dict[int, _Graph] = {}

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Graphs are not copied: the checkpoint only names the windows that have a
        graph.

        iSAM2 cannot be copied, so the running solver also makes its graphs again. Then it goes on with the same bits as
        a restored solver. Its states change by rounding: less than 1e-9 standard deviations.
        """
        self._make_again(tuple(self._graphs))
        return {**super().checkpoint(), "solved": tuple(self._graphs)}

    def restore(self, snapshot: Snapshot) -> None:
        """See `Stateful.restore`. Each graph is made from its window, as in `checkpoint`."""
        super().restore(snapshot)
        self._make_again(snapshot["solved"])

    def _make_again(self, tracks: Sequence[int]) -> None:
        """Make new graphs of windows with the factors at their linearisation points, and solve them.

        A window that cannot be solved keeps its states. It gets a graph at its next solution.
        """
        self._graphs.clear()
        for track in tracks:
            of = np.array([track])
            try:
                self._update(of, self.nodes.first[of])
            except (RuntimeError, ValueError, IndexError):
                self.forget(track)

    def forget(self, track: int) -> None:
        """See `Solver.forget`: the next solution makes a new graph."""
        self._graphs.pop(track, None)

    def _solve_graphs(self, tracks: IntArray, firsts: IntArray) -> None:
        """See `Solver._solve_graphs`. Means then come from the graphs."""
        try:
            self._update(tracks, firsts)
        except (RuntimeError, ValueError, IndexError) as error:
            for track in tracks.tolist():  # its graph may lack nodes
                self.forget(track)
            raise np.linalg.LinAlgError(
                f"the graph cannot be solved ({error})"
            ) from error

    def covariance(self, track: int, *numbers: int) -> FloatArray:
        """Return gtsam's joint covariance of nodes, shape (k n, k n). It is a check of the compiled elimination.

        `numbers` are one node, or several nodes, of the window of a track.
        """
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
        counts, graphs = nodes.count[tracks].tolist(), list[_Graph]()
        windows, new, priors = list[list[int]](), list[list[int]](), list[_Changed]()
        for track, row, start, count in zip(
            tracks.tolist(), nodes.numbers[tracks], starts.tolist(), counts, strict=True
        ):
            numbers = row[start:count].tolist()
            graph = self._graphs.get(track)
            priors.append({})
            if graph is None:
                graph = self._graphs[track] = _Graph()
                priors[-1][_PRIOR] = self._prior(numbers[0])
                nodes.labels[numbers, CHANGED] = 1
            graphs.append(graph)
            windows.append(numbers)
            new.append([number for number in numbers if number not in graph.slots])
        made = [number for own in new for number in own]
        nodes.reference[made] = nodes.origin[made]
        changed = self._changed_factors(tracks, starts, priors)
        inside = [own[num:] for own, num in zip(windows, leaving, strict=True)]
        deltas = [
            graph.solve(numbers, num, own_new, zero, own)
            for graph, numbers, num, own_new, own in zip(
                graphs, windows, leaving, new, changed, strict=True
            )
        ]
        delta = np.concatenate(deltas).reshape(-1, self.motion.dim)
        if not np.isfinite(delta).all():
            raise ValueError("a state is not finite")
        window = np.array([number for own in inside for number in own])
        nodes.step[window] = nodes.reference[window] - nodes.origin[window] + delta

    def _prior(self, number: int) -> gtsam.JacobianFactor:
        """Return the factor of the prior of the oldest node of a window."""
        prior = self.nodes.predicted[number]
        W = inverse_root(prior[:, :-1])
        return gtsam.JacobianFactor(number, W, W @ prior[:, -1], _unit(len(W)))

    def _changed_factors(
        self, tracks: IntArray, starts: IntArray, priors: Sequence[_Changed]
    ) -> list[_Changed]:
        """Return the factors of each of `tracks`, from index `starts` on, that have changed, and then its prior.

        Raises `ValueError` if process noise is not positive definite.
        """
        nodes, n = self.nodes, self.motion.dim
        most = int((nodes.count[tracks] - starts).sum())
        owners = np.empty((most, 4), dtype=np.int64)
        factors = np.empty((most, n + nodes.rows.shape[1], 2 * n + 1))
        num = factor_kernels.changed_factors(
            tracks, starts, nodes.arrays, owners, factors
        )
        if num < 0:
            raise ValueError("process noise is not positive definite")
        changed: list[_Changed] = [{} for _ in priors]
        for (row, number, right, size), each in zip(
            owners[:num].tolist(), factors, strict=False
        ):
            A, b, unit = each[:size, :n], each[:size, -1], _unit(size)
            if right < 0:
                changed[row][number] = gtsam.JacobianFactor(number, A, b, unit)
            else:
                changed[row][number] = gtsam.JacobianFactor(
                    number, A, right, each[:size, n:-1], b, unit
                )
        for own, prior in zip(changed, priors, strict=True):
            own.update(prior)
        return changed


class IncrementalBank(SmootherBank):
    """Fixed-lag smoother, a factor graph that iSAM2 solves incrementally."""

    make_solver = IncrementalSolver
    rounding = 1.0

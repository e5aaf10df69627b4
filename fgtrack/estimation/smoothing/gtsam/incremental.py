"""The default solver: gtsam's incremental fixed-lag smoother on iSAM2."""

from collections.abc import Sequence
from functools import cache
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np

from fgtrack.core.linalg import inverse_roots
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing import node_kernels
from fgtrack.estimation.smoothing.gtsam.graph_solver import GraphSolver
from fgtrack.estimation.smoothing.nodes import grown
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.models.motion import MotionModel

_Key = SupportsInt | SupportsIndex
_Stamp = SupportsFloat | SupportsIndex

#: gtsam marginalises what is older than its lag: only nodes that leave are given such a stamp.
_INSIDE, _LEFT, _LAG = 1.0, 0.0, 0.5


class _Graph:
    """The factor graph of a window; its variables have the numbers of the nodes, and the values 0.

    iSAM2 with QR, because Cholesky fails for stamps close together. It is given linear factors only, so it never calls
    back into Python: what has to be linearised elsewhere is replaced.
    """

    def __init__(self, prior: gtsam.JacobianFactor) -> None:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.findUnusedFactorSlots = True
        params.enableRelinearization = False
        gauss_newton = gtsam.ISAM2GaussNewtonParams()
        gauss_newton.setWildfireThreshold(0.0)
        params.setOptimizationParams(gauss_newton)
        self.smoother = gtsam.IncrementalFixedLagSmoother(_LAG, params)
        self.slots: dict[int, list[int | None]] = {}
        """Slots of the motion factor to the next node and of the measurements, by node."""
        self._factors = gtsam.GaussianFactorGraph()
        self._owners: list[tuple[int, int]] = []
        self._removed: list[int] = []
        self._prior: gtsam.JacobianFactor | None = prior

    def replace(self, number: int, kind: int, factor: gtsam.JacobianFactor) -> None:
        """Add a factor instead of that of this `kind` of a node, 0 for motion and 1 for measurements."""
        self._factors.push_back(factor)
        self._owners.append((number, kind))
        slot = self.slots[number][kind]
        if slot is not None:
            self._removed.append(slot)

    def solve(self, new: Sequence[int], leaving: Sequence[int], size: int) -> None:
        """Solve with `new` nodes of n = `size` entries and the new factors, without those that are `leaving`."""
        values, stamps = gtsam.Values(), dict[_Key, _Stamp]()
        for number in new:
            values.insert(number, np.zeros(size))
            stamps[number] = _INSIDE
        for number in leaving:
            stamps[number] = _LEFT
        if self._prior is not None:
            self._factors.push_back(self._prior)
            self._prior = None
        graph = gtsam.LinearContainerFactor.ConvertLinearGraph(self._factors)  # in half the time of one by one
        self.smoother.update(graph, values, stamps, self._removed)
        slots = self.smoother.getISAM2Result().getNewFactorsIndices()
        for (number, kind), slot in zip(self._owners, slots, strict=False):
            self.slots[number][kind] = slot
        for number in leaving:
            del self.slots[number]
        self._factors, self._owners, self._removed = gtsam.GaussianFactorGraph(), [], []


class IncrementalSolver(GraphSolver):
    """Windows that iSAM2 solves, with factors that a compiled loop linearises, of all tracks at once."""

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        super().__init__(motion, settings)
        self._graphs: dict[int, _Graph] = {}
        self._reference = np.zeros((0, motion.dim))
        """States that the variables are relative to, by number: their first linearisation points."""

    def _forget(self, track: int) -> None:
        self._graphs.pop(track, None)

    def _covariance(self, track: int, *numbers: int) -> FloatArray:
        smoother = self._graphs[track].smoother
        if len(numbers) == 1:
            return smoother.marginalCovariance(numbers[0])
        return smoother.getISAM2().jointMarginalCovariance(list(numbers)).fullMatrix()

    def _update(self, tracks: IntArray, starts: IntArray) -> None:
        nodes, n = self.nodes, self.motion.dim
        if nodes.numbers.size > len(self._reference):
            self._reference = grown(self._reference, nodes.numbers.size)
        rows = list(zip(tracks.tolist(), starts.tolist(), strict=True))
        windows = [nodes.numbers[track, start : nodes.count[track]] for track, start in rows]
        graphs = [self._graph(track, window) for (track, _), window in zip(rows, windows, strict=True)]
        added = [
            [number for number in w.tolist() if number not in g.slots] for w, g in zip(windows, graphs, strict=True)
        ]
        for new, graph in zip(added, graphs, strict=True):
            self._reference[new] = nodes.origin[new]
            graph.slots.update((number, [None, None]) for number in new)
        self._add_factors(tracks, starts, graphs, 2 * sum(map(len, windows)))
        for (track, start), window, graph, new in zip(rows, windows, graphs, added, strict=True):
            num_leaving = int(nodes.first[track]) - start
            inside = window[num_leaving:]
            graph.solve(new, window[:num_leaving].tolist(), n)
            delta = graph.smoother.getDelta().vector(inside.tolist())
            if not node_kernels.write_steps(inside, delta, self._reference, nodes.origin, nodes.step):
                raise ValueError("a state is not finite")

    def _graph(self, track: int, window: IntArray) -> _Graph:
        """Return the graph of a track; a new one has the prior of the oldest node only."""
        graph = self._graphs.get(track)
        if graph is None:
            nodes, oldest = self.nodes, int(window[0])
            prior = nodes.predicted[oldest]
            W = inverse_roots(prior[:, :-1])
            graph = self._graphs[track] = _Graph(gtsam.JacobianFactor(oldest, W, W @ prior[:, -1], _unit(len(W))))
            nodes.changed[window] = True
        return graph

    def _add_factors(self, tracks: IntArray, starts: IntArray, graphs: Sequence[_Graph], most: int) -> None:
        """Add the factors that have changed, at most so many, of all tracks."""
        nodes, n = self.nodes, self.motion.dim
        owners, factors = np.empty((most, 3), dtype=np.int64), np.empty((most, 2 * n + 1, n))
        given = nodes.origin, self._reference, nodes.segment, nodes.num_rows, nodes.changed
        num = node_kernels.changed_factors(tracks, starts, nodes.count, nodes.numbers, *given, owners, factors)
        if num < 0:
            raise ValueError("process noise is not positive definite")
        for (row, number, right), motion in zip(owners[:num].tolist(), factors, strict=False):
            if right >= 0:
                factor = gtsam.JacobianFactor(number, motion[:n].T, right, motion[n:-1].T, motion[-1], _unit(n))
            else:
                rows = nodes.rows[number, : nodes.num_rows[number]]
                b = rows[:, -1] + rows[:, :-1].dot(nodes.origin[number] - self._reference[number])
                factor = gtsam.JacobianFactor(number, rows[:, :-1], b, _unit(len(rows)))
            graphs[row].replace(number, right < 0, factor)


@cache
def _unit(size: int) -> gtsam.noiseModel.Unit:
    return gtsam.noiseModel.Unit.Create(size)

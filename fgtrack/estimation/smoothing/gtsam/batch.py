"""A slow reference: Levenberg-Marquardt on the whole window at every update, with factors that call the models."""

from typing import ClassVar

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from fgtrack.core.state import Snapshot
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.gtsam.graph import window_graph
from fgtrack.estimation.smoothing.gtsam.incremental import IncrementalSolver
from fgtrack.estimation.smoothing.solver import Solver


class BatchSolver(IncrementalSolver):
    """Windows that Levenberg-Marquardt solves from their last estimates. A prior replaces the states that leave a
    window.

    Process noise stays that of the linearisation point. All other terms are relinearised at every step.
    """

    is_damped: ClassVar[bool] = True

    def optimise(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> gtsam.Values:
        """Return the values with the smallest error, starting from `values`."""
        params = gtsam.LevenbergMarquardtParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")
        params.setRelativeErrorTol(1e-12)
        params.setAbsoluteErrorTol(1e-12)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Graphs are not copied: the checkpoint has their last estimates."""
        estimates = {
            track: {
                number: values.atVector(number)
                for number in self.nodes.window(track).tolist()
                if values.exists(number)
            }
            for track, (_, values) in self._graphs.items()
        }
        return {**super().checkpoint(), "estimates": estimates}

    def restore(self, snapshot: Snapshot) -> None:
        """See `Stateful.restore`. The graphs are made from the last estimates, but not solved."""
        Solver.restore(self, snapshot)
        self._graphs.clear()
        self._read.clear()
        for track, estimates in snapshot["estimates"].items():
            values = gtsam.Values()
            for number, estimate in estimates.items():
                values.insert(number, estimate)
            self._graphs[track] = self._graph(track), values

    def _graph(self, track: int) -> gtsam.NonlinearFactorGraph:
        """Return the nonlinear factors of a window, with a prior that replaces the states that have left it."""
        nodes, n = self.nodes, self.motion.dim
        numbers = nodes.window(track).tolist()
        oldest = nodes.predicted[numbers[0]]
        return window_graph(
            self.motion,
            numbers,
            nodes.window_stamps_ns(track).tolist(),
            nodes.origin[numbers[0]] + oldest[:, n],
            oldest[:, :n],
            nodes.Q[numbers[:-1]],
            [(number, each) for number in numbers for each in nodes.factors(number)],
        )

    def _update(self, tracks: IntArray, starts: IntArray) -> None:
        nodes = self.nodes
        for track in tracks.tolist():
            numbers, graph = nodes.window(track).tolist(), self._graph(track)
            values = gtsam.Values()
            _, last = self._graphs.get(track, (None, values))
            for number in numbers:
                values.insert(
                    number,
                    last.atVector(number)
                    if last.exists(number)
                    else nodes.origin[number],
                )
            values = self.optimise(graph, values)
            self._graphs[track] = graph, values
            for number in numbers:
                nodes.step[number] = values.atVector(number) - nodes.origin[number]

    def _covariance(self, track: int, *numbers: int) -> FloatArray:
        """See `IncrementalSolver._covariance`; computed by one dense QR of the whole linearised window."""
        graph, values = self._graphs[track]
        ordering, n = gtsam.Ordering(), self.motion.dim
        for number in (*sorted(set(values.keys()).difference(numbers)), *numbers):
            ordering.push_back(number)
        A, _ = graph.linearize(values).jacobian(ordering)
        R, size = np.asarray(np.linalg.qr(A, mode="r")), n * len(numbers)
        root = dtrtri(R[-size:, -size:])[0]
        return np.asarray(root @ root.T)


class BatchBank(SmootherBank):
    """Fixed-lag smoother: a factor graph that Levenberg-Marquardt solves at every update. Slow, for checks."""

    make_solver = BatchSolver
    tolerance = 1e-6  # it compares errors at absolute positions: eps W of 50 m instead of the standard deviation, 0.5 m
    rounding = 100.0

"""A slow reference: Levenberg-Marquardt on the whole window at every update, with factors that call the models."""

from typing import ClassVar

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.state import Snapshot
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.gtsam.graph import window_graph
from fgtrack.estimation.smoothing.node_arrays import KNOWN
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.models.motion import MotionModel


class BatchSolver(Solver):
    """Windows that Levenberg-Marquardt solves from their last estimates. A prior replaces the states that leave a
    window.

    Process noise stays that of the linearisation point. All other terms are relinearised at every step.
    """

    is_damped: ClassVar[bool] = True

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        super().__init__(motion, settings)
        self._graphs: dict[int, tuple[gtsam.NonlinearFactorGraph, gtsam.Values]] = {}
        self._read = set[tuple[int, ...]]()
        """Nodes, and pairs of nodes, whose covariances were read since the last solution."""

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
        super().restore(snapshot)
        self._graphs.clear()
        self._read.clear()
        for track, estimates in snapshot["estimates"].items():
            values = gtsam.Values()
            for number, estimate in estimates.items():
                values.insert(number, estimate)
            self._graphs[track] = self._graph(track), values

    def forget(self, track: int) -> None:
        """See `Solver.forget`: the next solution starts from the linearisation points."""
        self._graphs.pop(track, None)
        self._read.clear()

    def _solve_graphs(
        self, tracks: IntArray, starts: IntArray, firsts: IntArray
    ) -> None:
        """See `Solver._solve_graphs`. Means and covariances then come from the graphs."""
        nodes = self.nodes
        self._read.clear()
        nodes.tracks[tracks, KNOWN] = nodes.first[tracks]
        try:
            for track in tracks.tolist():
                self._update(track)
        except (RuntimeError, ValueError, IndexError) as error:
            for track in tracks.tolist():
                self.forget(track)
            raise np.linalg.LinAlgError(
                f"the graph cannot be solved ({error})"
            ) from error

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

    def _update(self, track: int) -> None:
        """Solve the graph of a track, and write `step` of the nodes in its window.

        Raises `RuntimeError`, `ValueError` or `IndexError` if this fails.
        """
        nodes = self.nodes
        numbers, graph = nodes.window(track).tolist(), self._graph(track)
        values = gtsam.Values()
        _, last = self._graphs.get(track, (None, values))
        for number in numbers:
            values.insert(
                number,
                last.atVector(number) if last.exists(number) else nodes.origin[number],
            )
        values = self.optimise(graph, values)
        self._graphs[track] = graph, values
        for number in numbers:
            nodes.step[number] = values.atVector(number) - nodes.origin[number]

    def _covariance(self, track: int, *numbers: int) -> FloatArray:
        """Return the joint covariance of one node, shape (n, n), or of two neighbours, shape (2 n, 2 n).

        It is computed by one dense QR of the whole linearised window.
        """
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

"""The slow check: Levenberg-Marquardt on the whole window at every update."""

from collections.abc import Sequence
from typing import ClassVar

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from fgtrack.core.types import FloatArray
from fgtrack.estimation.factor_graph.backends.base import Change
from fgtrack.estimation.factor_graph.rows import Factor


class BatchBackend:
    """Solves the whole window from its last estimates. What leaves it is replaced by the prior it gives.

    Process noise stays that of where its factor is linearised; all else is linearised anew at every step.
    """

    damped: ClassVar[bool] = True

    def __init__(self) -> None:
        self._factors: dict[int, gtsam.NonlinearFactor] = {}
        self._values = gtsam.Values()
        self._next_slot = 0

    def update(self, change: Change) -> list[int]:
        """See `Backend.update`."""
        for slot in change.removed:
            del self._factors[slot]
        slots = [self._add(factor) for factor in change.factors]
        for key, mean in change.values.items():
            self._values.insert(key, mean)
        if change.marginalised is not None:
            gone = set(change.marginalised.keys)
            self._factors = {slot: factor for slot, factor in self._factors.items() if gone.isdisjoint(factor.keys())}
            for key in gone:
                self._values.erase(key)
            self._add(change.marginalised.prior)
        self._solve()
        return slots

    def means(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.means`."""
        return np.array([self._values.atVector(key) for key in keys])

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.covariance`; from one dense QR of the whole linearised window."""
        others = set(self._values.keys()).difference(keys)
        ordering = gtsam.Ordering()
        for key in (*sorted(others), *keys):
            ordering.push_back(key)
        A, _ = self._graph().linearize(self._values).jacobian(ordering)
        R: FloatArray = np.asarray(np.linalg.qr(A, mode="r"))
        size = sum(len(self._values.atVector(key)) for key in keys)
        root = dtrtri(R[-size:, -size:])[0]
        return np.asarray(root @ root.T)

    def _add(self, factor: Factor) -> int:
        slot = self._next_slot
        self._next_slot += 1
        self._factors[slot] = factor.nonlinear()
        return slot

    def _graph(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for factor in self._factors.values():
            graph.add(factor)
        return graph

    def _solve(self) -> None:
        params = gtsam.LevenbergMarquardtParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")
        params.setRelativeErrorTol(1e-12)
        params.setAbsoluteErrorTol(1e-12)
        self._values = gtsam.LevenbergMarquardtOptimizer(self._graph(), self._values, params).optimize()

"""The default backend: gtsam's incremental fixed-lag smoother on iSAM2."""

from collections.abc import Sequence
from functools import cache
from typing import ClassVar, SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.factor_graph.backends.base import Change
from fgtrack.estimation.factor_graph.rows import Rows

_Key = SupportsInt | SupportsIndex
_Stamp = SupportsFloat | SupportsIndex

#: Longer than any window: nothing leaves by itself.
_FOREVER_S = 1e10  # more than stamps in nanoseconds, 64 bit, can be apart


class IncrementalBackend:
    """iSAM2 with QR (Cholesky fails for stamps close together), and slots that are used again.

    It is given linear factors only, so it never calls back into Python. They are relative to the first estimates of
    their variables, which iSAM2 keeps: what has to be linearised elsewhere is replaced.
    """

    damped: ClassVar[bool] = False

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.findUnusedFactorSlots = True
        params.enableRelinearization = False
        gauss_newton = gtsam.ISAM2GaussNewtonParams()
        gauss_newton.setWildfireThreshold(0.0)
        params.setOptimizationParams(gauss_newton)
        self._smoother = gtsam.IncrementalFixedLagSmoother(_FOREVER_S, params)
        self._newest_s = 0.0
        self._first: dict[int, FloatArray] = {}
        """First estimates of the variables."""

    def update(self, change: Change) -> list[int]:
        """See `Backend.update`."""
        values = gtsam.Values()
        for key, mean in change.values.items():
            values.insert(key, mean)
        self._first.update(change.values)
        graph = self.graph(change)
        gone = change.marginalised
        if change.stamps_s:
            self._newest_s = max(self._newest_s, *change.stamps_s.values())
        self._smoother.setSmootherLag(_FOREVER_S if gone is None else self._newest_s - gone.cutoff_s)
        stamps_s: dict[_Key, _Stamp] = {}
        for key, stamp_s in change.stamps_s.items():
            stamps_s[key] = stamp_s
        self._smoother.update(graph, values, stamps_s, change.removed)
        for key in gone.keys if gone is not None else ():
            del self._first[key]
        return list(self._smoother.getISAM2Result().getNewFactorsIndices())[: len(change.factors)]

    def graph(self, change: Change) -> gtsam.NonlinearFactorGraph:
        """The new factors of `change`, relative to the first estimates of their variables."""
        graph = gtsam.GaussianFactorGraph()
        for factor in change.factors:
            graph.push_back(self._linear(factor.rows()))
        return gtsam.LinearContainerFactor.ConvertLinearGraph(graph)  # in half the time of one after the other

    def means(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.means`."""
        first = np.concatenate([self._first[key] for key in keys])
        return np.asarray(first + self._smoother.getDelta().vector(list(keys))).reshape(len(keys), -1)

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.covariance`."""
        if len(keys) == 1:
            return self._smoother.marginalCovariance(keys[0])
        return self._smoother.getISAM2().jointMarginalCovariance(list(keys)).fullMatrix()

    def _linear(self, rows: Rows) -> gtsam.JacobianFactor:
        keys, A, b, at = rows
        for key, by_key, origin in zip(keys, A, at, strict=True):
            first = self._first[key]
            if first is not origin:
                b = b - by_key.dot(first - origin)
        unit = _unit(len(b))
        if len(keys) == 1:
            return gtsam.JacobianFactor(keys[0], A[0], b, unit)
        return gtsam.JacobianFactor(keys[0], A[0], keys[1], A[1], b, unit)


@cache
def _unit(size: int) -> gtsam.noiseModel.Unit:
    return gtsam.noiseModel.Unit.Create(size)

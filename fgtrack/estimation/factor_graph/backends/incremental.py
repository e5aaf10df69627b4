"""The default backend: gtsam's incremental fixed-lag smoother on iSAM2."""

from collections.abc import Sequence
from typing import ClassVar, SupportsFloat, SupportsIndex, SupportsInt

import gtsam

from fgtrack.core.types import FloatArray
from fgtrack.estimation.factor_graph.backends.base import Change

_Key = SupportsInt | SupportsIndex
_Stamp = SupportsFloat | SupportsIndex

_KIND = "x"
#: Variables are numbered from here; the symbol's letter chooses their relinearisation thresholds.
FIRST_KEY: int = gtsam.symbol(_KIND, 0)
#: Longer than any window: nothing leaves by itself.
_FOREVER_S = 1e9


class IncrementalBackend:
    """iSAM2 with QR (Cholesky fails for stamps close together), thresholds per entry, and slots that are used again.

    Parameters
    ----------
    thresholds
        An entry of a state that moves further than this is relinearised, shape (n,); see `SmootherSettings`.
    """

    damped: ClassVar[bool] = False

    def __init__(self, thresholds: FloatArray) -> None:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.findUnusedFactorSlots = True
        params.relinearizeSkip = 1
        gauss_newton = gtsam.ISAM2GaussNewtonParams()
        gauss_newton.setWildfireThreshold(0.0)
        params.setOptimizationParams(gauss_newton)
        by_kind = gtsam.ISAM2ThresholdMap()
        by_kind.insert((_KIND, thresholds))
        params.setRelinearizeThreshold(by_kind)
        self._smoother = gtsam.IncrementalFixedLagSmoother(_FOREVER_S, params)
        self._newest_s = 0.0

    def update(self, change: Change) -> list[int]:
        """See `Backend.update`."""
        graph = gtsam.NonlinearFactorGraph()
        for factor in change.factors:
            graph.add(factor)
        values = gtsam.Values()
        for key, mean in change.values.items():
            values.insert(key, mean)
        gone = change.marginalised
        if change.stamps_s:
            self._newest_s = max(self._newest_s, *change.stamps_s.values())
        self._smoother.setSmootherLag(_FOREVER_S if gone is None else self._newest_s - gone.cutoff_s)
        stamps_s: dict[_Key, _Stamp] = {}
        for key, stamp_s in change.stamps_s.items():
            stamps_s[key] = stamp_s
        self._smoother.update(graph, values, stamps_s, change.removed)
        return list(self._smoother.getISAM2Result().getNewFactorsIndices())[: len(change.factors)]

    def mean(self, key: int) -> FloatArray:
        """See `Backend.mean`."""
        return self._smoother.calculateEstimateVector(key)

    def moves(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.moves`."""
        return self._smoother.getDelta().vector(list(keys)).reshape(len(keys), -1)

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.covariance`."""
        if len(keys) == 1:
            return self._smoother.marginalCovariance(keys[0])
        return self._smoother.getISAM2().jointMarginalCovariance(list(keys)).fullMatrix()

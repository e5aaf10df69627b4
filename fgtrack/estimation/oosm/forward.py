"""Predict the late measurement forward as an estimate of its own, and fuse it with the present one."""

import numpy as np
from scipy.optimize import minimize_scalar

from fgtrack.core.linalg import identity, psd_solve, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import Correction, OneCorrection, correct_one
from fgtrack.estimation.oosm.late import RewindForget

_Estimate = tuple[FloatArray, FloatArray]
"""Mean (n,) and covariance (n, n) at the present stamp."""


class Fpfd(RewindForget):
    """Forward prediction, fusion, and decorrelation: fuse both estimates and subtract their common information once.

    Rheaume and Benaskeur, Forward prediction-based approach to target-tracking with out-of-sequence measurements, IEEE
    Conference on Decision and Control, 2008:

        P^-1 = P_k^-1 + P_1^-1 - P_0^-1,   P^-1 x = P_k^-1 x_k + P_1^-1 x_1 - P_0^-1 x_0

    with the present x_k, P_k; step m predicted to tau, corrected there and predicted to now, x_1, P_1; and step m
    predicted to now, x_0, P_0. That is, both are taken as if they shared x_0 and nothing else; they share the process
    noise since tau. The steps are not repaired after a late measurement; x_k holds all that came since m.

    Exact for: one lag, the first late measurement since step m. Numerically the same as `Al1` in a linear model.
    """

    exact = "one lag, first late measurement"

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        stamp_ns, now = measurement.stamp_ns, self._steps[-1]
        mean, covariance = self._predicted(self._left(stamp_ns), stamp_ns)
        at_tau = correct_one(mean, covariance, measurement)
        late = self._moved(at_tau.mean, at_tau.covariance, stamp_ns, now.stamp_ns)
        common = self._moved(mean, covariance, stamp_ns, now.stamp_ns)
        x, P = self._fused((now.mean, now.covariance), late, common)
        np.linalg.cholesky(P)
        self._absorb(x, P)
        return Correction(x, P, at_tau.innovation, at_tau.nis, at_tau.weight, at_tau.S)

    def _fused(self, now: _Estimate, late: _Estimate, common: _Estimate) -> _Estimate:
        """One estimate from `now` and `late`, which share the information of `common`."""
        P_k, P_1, P_0 = (information(P) for _, P in (now, late, common))
        covariance = symmetrise(information(P_k + P_1 - P_0))
        pull = P_1 @ (late[0] - now[0]) - P_0 @ (common[0] - now[0])
        return now[0] + covariance @ pull, covariance


class CovarianceIntersection(Fpfd):
    """Fuse both estimates for any correlation between them.

    Julier and Uhlmann, Fusion of time delayed measurements with uncertain time delays, American Control Conference,
    2005:

        P^-1 = w P_k^-1 + (1 - w) P_1^-1,   P^-1 x = w P_k^-1 x_k + (1 - w) P_1^-1 x_1

    with the w in [0, 1] for which the trace of P is smallest, whose entries differ in their units.

    Exact for: nothing; never overconfident.
    """

    exact = ""

    def _fused(self, now: _Estimate, late: _Estimate, common: _Estimate) -> _Estimate:
        P_k, P_1 = information(now[1]), information(late[1])

        def covariance(w: float) -> FloatArray:
            return symmetrise(information(w * P_k + (1.0 - w) * P_1))

        def spread(w: float) -> float:
            return float(np.trace(covariance(w)))

        inner = float(minimize_scalar(spread, bounds=(0.0, 1.0), method="bounded").x)
        w = min((0.0, inner, 1.0), key=spread)
        P = covariance(w)
        return now[0] + (1.0 - w) * P @ (P_1 @ (late[0] - now[0])), P


def information(covariance: FloatArray) -> FloatArray:
    """The matrix whose product with `covariance`, shape (n, n), is the identity."""
    return symmetrise(psd_solve(covariance, identity(len(covariance))))

"""The update that most methods end in: the past corrects the present through their cross-covariance."""

from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import congruence, psd_solve, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import OneCorrection, linearised, propagated, robust_weight
from fgtrack.estimation.oosm.history import require_finite


class Past(NamedTuple):
    """A method's estimate of the state at the stamp tau of a late measurement."""

    mean: FloatArray
    """x_tau, shape (n,)."""
    covariance: FloatArray
    """P_tau, shape (n, n)."""
    cross: FloatArray
    """Cov(x, x_tau) of the state x to be corrected, shape (m, n)."""


def fuse_across(mean: FloatArray, covariance: FloatArray, past: Past, measurement: Measurement) -> OneCorrection:
    """The state x, `mean` (m,) and `covariance` (m, m), after a measurement of the state `past`.

    S = H P_tau H' + R, x+ = x + C H' S^-1 (z - h(x_tau)), P+ = P - C H' S^-1 H C' with C = Cov(x, x_tau) (Bar-Shalom
    2002, see `A1`), with the weight that a robust loss gives R (see `robust_weight`). Raises
    `numpy.linalg.LinAlgError` where S is not positive definite or the result is not finite.
    """
    y, H = linearised(measurement.z, past.mean, measurement.model, measurement.pose)
    S = propagated(H, past.covariance, measurement.R)
    np.linalg.cholesky(S)  # raises where S is not positive definite
    expected, nis = S, measurement.nis(y, S)
    w = robust_weight(measurement.loss, y, congruence(H, past.covariance), measurement.R)
    if w < 1.0:
        S = propagated(H, past.covariance, measurement.R / w)
    across = past.cross @ H.T
    gain = psd_solve(S, across.T).T
    result = OneCorrection(mean + gain @ y, symmetrise(covariance - gain @ across.T), y, nis, w, expected)
    require_finite(result)
    return result

"""Contaminated normal distribution: most errors have the nominal covariance, a few are several times larger."""

import math
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.types import FloatArray

#: Factor on the nominal standard deviations by class: nominal errors, outliers, detections of another object.
SCALES = np.array([1.0, 4.0, 40.0])
#: Largest share of outliers. With a larger share the fit could exchange the nominal class and the outliers.
MAX_SHARE = 0.15
#: Shares of the two outlier classes among all outliers.
PARTS = np.array([0.9, 0.1])


class Update(NamedTuple):
    """State update with a measurement whose error is contaminated normal."""

    step: FloatArray
    """Posterior minus prior mean, shape (..., n)."""
    covariance: FloatArray
    """Posterior covariance, shape (..., n, n)."""
    S: FloatArray
    """Covariance of the innovation for a nominal error, shape (..., k, k)."""
    log_likelihood: FloatArray
    """Log density of the innovation, shape (...)."""
    outlier: FloatArray
    """Probability that the error is not nominal, shape (...)."""


def update(
    P: FloatArray,
    H: FloatArray,
    y: FloatArray,
    R: FloatArray,
    other_errors: FloatArray,
    odds: FloatArray,
) -> Update:
    """Update states with the innovations y (..., k) of measurements with Jacobians H (..., k, n).

    The error has the covariance c^2 R + `other_errors`, shape (..., k, k). The factor c is
    1, or another of `SCALES` with the probability `outlier_share(odds)`. At odds 0 this
    is the Kalman filter.

    Class i has S_i = H P H' + c_i^2 R + other_errors, the step s_i = P H' S_i^-1 y, and the
    probability w_i given y. The posterior has the exact moments of the mixture. Its
    mean is x + s with s = sum w_i s_i. Its covariance is P - sum w_i P H' S_i^-1 H P +
    sum w_i (s_i - s) (s_i - s)'.

    Source: Alspach and Sorenson 1972, "Nonlinear Bayesian estimation using Gaussian sum
    approximations", IEEE Transactions on Automatic Control 17(4).
    """
    HP = H @ P
    scales = np.square(SCALES).reshape(-1, *[1] * R.ndim)
    S = (HP @ H.mT + other_errors) + scales * R
    columns = np.concatenate([HP, y[..., None]], axis=-1)
    solved = psd_solve(S, columns)
    share = outlier_share(odds)
    with np.errstate(divide="ignore"):
        log_shares = np.log(np.stack([1.0 - share, *(part * share for part in PARTS)]))
    log_density = log_shares - 0.5 * (
        np.vecdot(y, solved[..., -1]) + np.linalg.slogdet(S)[1]
    )
    highest = log_density.max(axis=0)
    weights = np.exp(log_density - highest)
    total = weights.sum(axis=0)
    weights /= total
    steps = (solved[..., None, :, -1] @ HP)[..., 0, :]
    step = (weights[..., None] * steps).sum(axis=0)
    deviations = np.sqrt(weights)[..., None] * (steps - step)
    spread = (deviations[..., :, None] * deviations[..., None, :]).sum(axis=0)
    reduction = HP.mT @ (weights[..., None, None] * solved[..., :-1]).sum(axis=0)
    return Update(
        step,
        symmetrise(P - reduction + spread),
        S[0],
        highest + np.log(total) - 0.5 * y.shape[-1] * math.log(math.tau),
        1.0 - weights[0],
    )


def outlier_share(odds: FloatArray) -> FloatArray:
    """Share of outliers for positive `odds`: approximately `odds` if small, always below `MAX_SHARE`."""
    return np.asarray(MAX_SHARE * odds / (MAX_SHARE + odds))

"""The contaminated normal distribution: most errors have the nominal covariance, a few are several times as large."""

import math
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.types import FloatArray

#: How many times as large as nominal the standard deviations of the classes of errors are: nominal, outliers, and what
#: belongs to another object.
SCALES = np.array([1.0, 4.0, 40.0])
#: Largest share of outliers: beyond it the names of the classes would be exchanged.
MAX_SHARE = 0.15
#: Of the outliers, the share of each class.
PARTS = np.array([0.9, 0.1])


class Update(NamedTuple):
    """A state after a measurement whose error is contaminated."""

    step: FloatArray
    """Posterior minus prior mean, shape (..., n)."""
    covariance: FloatArray
    """Posterior covariance, shape (..., n, n)."""
    S: FloatArray
    """Covariance of the innovation where the error is nominal, shape (..., k, k)."""
    log_likelihood: FloatArray
    """Log density of the innovation, shape (...)."""
    outlier: FloatArray
    """Probability that the error was not nominal, shape (...)."""


def update(
    P: FloatArray,
    H: FloatArray,
    y: FloatArray,
    R: FloatArray,
    foreign: FloatArray,
    odds: FloatArray,
) -> Update:
    """Fuse innovations y (..., k) of measurements with Jacobians H (..., k, n).

    The error has the covariance c^2 R + `foreign`, shape (..., k, k), with c = 1 or, with the probability
    `outlier_share(odds)`, another one of `SCALES`. With S_i = H P H' + c_i^2 R + foreign, w_i the probability of class
    i given y and s_i = P H' S_i^-1 y, the posterior has the mean x + s, s = sum w_i s_i, and the covariance
    P - sum w_i P H' S_i^-1 H P + sum w_i (s_i - s) (s_i - s)': the exact moments of the mixture (Alspach and Sorenson
    1972, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE Transactions on Automatic Control
    17(4)). At odds 0 this is the Kalman filter.
    """
    HP = H @ P
    scales = np.square(SCALES).reshape(-1, *[1] * R.ndim)
    S = (HP @ H.mT + foreign) + scales * R
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
    apart = np.sqrt(weights)[..., None] * (steps - step)
    reduced = HP.mT @ (weights[..., None, None] * solved[..., :-1]).sum(axis=0)
    return Update(
        step,
        symmetrise(
            P - reduced + (apart[..., :, None] * apart[..., None, :]).sum(axis=0)
        ),
        S[0],
        highest + np.log(total) - 0.5 * y.shape[-1] * math.log(math.tau),
        1.0 - weights[0],
    )


def outlier_share(odds: FloatArray) -> FloatArray:
    """Share of outliers, below `MAX_SHARE`, from a positive number that is about the share where it is small."""
    return np.asarray(MAX_SHARE * odds / (MAX_SHARE + odds))

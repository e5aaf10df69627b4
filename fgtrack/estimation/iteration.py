"""How an update iterates: what it lowers, how far it steps, and until when."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fgtrack.core.checks import not_negative
from fgtrack.core.linalg import psd_solve
from fgtrack.core.types import FloatArray
from fgtrack.estimation.ekf import Update, updated_one
from fgtrack.models.robust import penalty, weight
from fgtrack.models.sensors import RobustLoss

_MAX_HALVINGS = 8


@dataclass(frozen=True)
class Iteration:
    """End and safeguard of an iteration. Raises `ValueError` for a number of iterations or tolerance out of range."""

    max_iterations: int
    tolerance: float
    """In standard deviations."""

    def __post_init__(self) -> None:
        if not 1 <= self.max_iterations <= 100:
            raise ValueError(f"max_iterations: must lie between 1 and 100, is {self.max_iterations}")
        not_negative(tolerance=self.tolerance)

    def descended(
        self, cost: Callable[[FloatArray], float], limit: float, start: FloatArray, end: FloatArray
    ) -> FloatArray:
        """The farthest point from `start` (n,) to `end` (n,), halving the way, at which `cost` is at most `limit`.

        `start`, where it is that, if there is none.
        """
        if self.max_iterations == 1:
            return end
        step = end - start
        for _ in range(_MAX_HALVINGS):
            if cost(start + step) <= limit:
                return start + step
            step = 0.5 * step
        return start


def largest_move(step: FloatArray, covariance: FloatArray) -> float:
    """The largest entry of `step` (..., n) in standard deviations of `covariance` (..., n, n)."""
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    return float(np.divide(np.abs(step), sigma, out=np.zeros(step.shape), where=sigma > 0.0).max())


def negative_log_posterior(
    off: FloatArray, P: FloatArray, residual: FloatArray, R: FloatArray, loss: RobustLoss | None
) -> float:
    """What an update minimises, but for a constant: half of off' P^-1 off, and the loss of the whitened residual.

    `off` (n,) is the way from the prior, whose covariance is P (n, n); `residual` (k,) that of the measurement there,
    with R (k, k). Raises `numpy.linalg.LinAlgError` for a singular P or R.
    """
    return 0.5 * float(off.dot(psd_solve(P, off))) + penalty(loss, _length(residual, R))


def reweighted(
    mean: FloatArray,
    covariance: FloatArray,
    residual: FloatArray,
    H: FloatArray,
    R: FloatArray,
    loss: RobustLoss | None,
    off: FloatArray,
) -> Update:
    """`updated_one` with a measurement that is linearised `off` (n,) from the prior, where it leaves `residual` (k,).

    Its innovation for the prior is residual + H off. The weight under a robust loss is that of the residual, which
    makes the step one that lowers `negative_log_posterior`; at the prior itself it is that of the whole update.
    """
    y = residual + H.dot(off)
    if loss is None or not off.any():
        return updated_one(mean, covariance, y, H, R, loss)
    w = weight(loss, _length(residual, R))
    return updated_one(mean, covariance, y, H, R / w)._replace(weight=w)


def _length(residual: FloatArray, R: FloatArray) -> float:
    return math.sqrt(max(float(residual.dot(psd_solve(R, residual))), 0.0))

"""The iterated extended Kalman filter: Gauss-Newton on each update."""

import math
from collections.abc import Callable

import numpy as np

from fgtrack.core.linalg import psd_solve
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import OneCorrection, updated_one
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.models.robust import penalty, weight
from fgtrack.models.sensors import RobustLoss

_MAX_HALVINGS = 8


class IekfReplay(ReplayEkf):
    """Iterated EKF with replay: each update is linearised at its own result (Gauss-Newton).

    Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE Transactions on Automatic Control
    38(2), 1993. The update minimises half of |x - x_0|^2 in P^-1 plus half of |z - h(x)|^2 in R^-1. A robust loss
    replaces the second term. A step that does not lower this sum is halved. The iteration ends with a step below 1e-6
    standard deviations of the prediction. A linear measurement is fused as in `ReplayEkf`.
    """

    iterates = True
    _max_iterations, _tolerance = 10, 1e-6

    def correct(
        self, mean: FloatArray, covariance: FloatArray, measurement: Measurement
    ) -> OneCorrection:
        """See `ReplayEkf.correct`."""
        if measurement.model.linear:
            return super().correct(mean, covariance, measurement)

        def cost(x: FloatArray) -> float:
            y = measurement.model.residual(
                measurement.z, measurement.model.predict(x, measurement.pose)
            )
            return negative_log_posterior(
                x - mean, covariance, y, measurement.R, measurement.loss
            )

        x = mean
        for _ in range(self._max_iterations):
            last = x
            y, H = measurement.model.linearised(measurement.z, x, measurement.pose)
            update = reweighted(
                mean, covariance, y, H, measurement.R, measurement.loss, x - mean
            )
            limit = negative_log_posterior(
                x - mean, covariance, y, measurement.R, measurement.loss
            )
            x = descended(cost, limit, last, update.mean)
            if largest_move(x - last, covariance) < self._tolerance:
                break
        first = super().correct(mean, covariance, measurement)
        return first._replace(
            mean=x, covariance=update.covariance, weight=update.weight
        )


def descended(
    cost: Callable[[FloatArray], float],
    limit: float,
    start: FloatArray,
    end: FloatArray,
) -> FloatArray:
    """Return the first of `end` (n,) and the points halfway back to `start` (n,) whose `cost` is at most `limit`.

    The step from `start` is halved until the cost is low enough. Returns `start` if it stays too high.
    """
    step = end - start
    for _ in range(_MAX_HALVINGS):
        if cost(start + step) <= limit:
            return start + step
        step = 0.5 * step
    return start


def largest_move(step: FloatArray, covariance: FloatArray) -> float:
    """Largest entry of `step` (n,) in standard deviations of `covariance` (n, n)."""
    sigma = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    return float(
        np.divide(np.abs(step), sigma, out=np.zeros(len(step)), where=sigma > 0.0).max()
    )


def negative_log_posterior(
    off: FloatArray,
    P: FloatArray,
    residual: FloatArray,
    R: FloatArray,
    loss: RobustLoss | None,
) -> float:
    """Cost that an update minimises: half of off' P^-1 off, plus the loss of the residual (k,) in R (k, k).

    `off` (n,) is the step from the prior, whose covariance is P (n, n).
    """
    return 0.5 * float(off.dot(psd_solve(P, off))) + penalty(
        loss, _length(residual, R), len(R)
    )


def reweighted(
    mean: FloatArray,
    covariance: FloatArray,
    residual: FloatArray,
    H: FloatArray,
    R: FloatArray,
    loss: RobustLoss | None,
    off: FloatArray,
) -> OneCorrection:
    """Update of the prior by a measurement that is linearised at a step `off` (n,) from the prior.

    `residual` (k,) is the residual at the point of linearisation. The innovation at the prior is residual + H off. A
    robust loss weighs the measurement by this residual, so the step lowers `negative_log_posterior`. At the prior
    itself `updated_one` computes the weight.
    """
    y = residual + H.dot(off)
    if loss is None or not off.any():
        return updated_one(mean, covariance, y, H, R, loss)
    w = weight(loss, _length(residual, R), len(R))
    return updated_one(mean, covariance, y, H, R / w)._replace(weight=w)


def _length(residual: FloatArray, R: FloatArray) -> float:
    return math.sqrt(max(float(residual.dot(psd_solve(R, residual))), 0.0))

"""The unscented Kalman filter and the iterated posterior linearisation filter, by statistical linear regression.

The 2 n sigma points are those of the cubature rule of third degree (Arasaratnam and Haykin, Cubature Kalman filters,
IEEE Transactions on Automatic Control 54(6), 2009), at sqrt(n) standard deviations along the columns of the
covariance's root. They give no weight to the mean, so every covariance stays positive semidefinite.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from fgtrack.core.linalg import identity, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import OneCorrection, Prediction, updated_one
from fgtrack.estimation.filters.iekf import descended, largest_move, negative_log_posterior, reweighted
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.models.measurement import MeasurementModel

_JITTER = 1e-12
Regression = tuple[FloatArray, FloatArray, FloatArray]
"""z = E[g(x)] (..., k), A (..., k, n), and the covariance (..., k, k) of e, which is uncorrelated with x, in
g(x) = z + A (x - m) + e for x ~ N(m, P)."""


def regression(
    g: Callable[[FloatArray], FloatArray],
    mean: FloatArray,
    covariance: FloatArray,
    difference: Callable[[FloatArray, FloatArray], FloatArray] = np.subtract,
) -> Regression:
    """Statistical linear regression of `g`, (..., n) -> (..., k), over N(mean, covariance), (..., n) and (..., n, n).
    Garcia-Fernandez et al. 2015, eqs. 9 to 11. With the points m +- c L_i of the root P = L L', c^2 = n, and the
    differences d+ and d- of g there from g(m): A L_i = (d+ - d-) / 2c, and the noise comes from the bends (d+ + d-) /
    2, so that it is zero of a linear g. Raises `numpy.linalg.LinAlgError` for a covariance that is not semidefinite.
    """
    n, L = mean.shape[-1], _root(covariance)
    centre, offsets = mean[..., None, :], n**0.5 * L.mT
    values = g(np.concatenate([centre, centre + offsets, centre - offsets], axis=-2))
    d = difference(values[..., 1:, :], values[..., :1, :])
    ahead, behind = d[..., :n, :], d[..., n:, :]
    bends, slopes = 0.5 * (ahead + behind), (ahead - behind) / (2.0 * n**0.5)
    shift = bends.sum(axis=-2) / n
    noise = bends.mT @ bends / n - shift[..., :, None] * shift[..., None, :]
    return values[..., 0, :] + shift, np.linalg.solve(L.mT, slopes).mT, symmetrise(noise)


def _root(covariance: FloatArray) -> FloatArray:
    """L with L L' = covariance; of one that is only semidefinite after a tiny increase."""
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        n = covariance.shape[-1]
        scale = np.maximum(np.trace(covariance, axis1=-2, axis2=-1) / n, _JITTER)
        return np.asarray(np.linalg.cholesky(covariance + _JITTER * scale[..., None, None] * identity(n)))


def measurement_regression(measurement: Measurement, mean: FloatArray, covariance: FloatArray) -> Regression:
    """Regression of what `measurement` measures. Angles are averaged on the circle, but for entries of the state."""
    model, pose = measurement.model, measurement.pose
    return regression(lambda x: model.predict(x, pose), mean, covariance, _difference(model))


@cache
def _difference(model: MeasurementModel) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Difference of measurements, angles in their range, but for entries of the state."""
    direct = np.array([k for k, name in enumerate(model.components) if name in model.state_names], dtype=np.int64)

    def difference(z: FloatArray, centre: FloatArray) -> FloatArray:
        y = model.residual(z, centre)
        y[..., direct] = z[..., direct] - centre[..., direct]
        return y

    return difference


class UkfReplay(ReplayEkf):
    """Unscented Kalman filter with replay: means over the spread of the state instead of derivatives.
    Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proceedings of the IEEE 92(3), 2004, written as
    statistical linear regression (see `regression`). The process noise is that of the mean. What is linear it does as
    `ReplayEkf`.
    """

    spreads = True

    def predict(self, mean: FloatArray, covariance: FloatArray, dt_s: float) -> Prediction:
        """See `ReplayEkf.predict`."""
        if self._motion.linear:
            return super().predict(mean, covariance, dt_s)
        after, A, noise = regression(lambda x: self._motion.predict(x, dt_s), mean, covariance)
        AP, Q = A @ covariance, self._motion.process_noise(mean, dt_s)
        return Prediction(after, symmetrise(AP @ A.mT + noise + Q), AP)

    def correct(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """See `ReplayEkf.correct`."""
        if measurement.model.linear:
            return super().correct(mean, covariance, measurement)
        z, A, noise = measurement_regression(measurement, mean, covariance)
        y, R = measurement.model.residual(measurement.z, z), measurement.R + noise
        return updated_one(mean, covariance, y, A, R, measurement.loss, measurement.measured)


class IplfReplay(UkfReplay):
    """Iterated posterior linearisation filter with replay: averages over the spread of the posterior.

    Garcia-Fernandez, Svensson, Morelande and Sarkka, Posterior linearization filter: principles and implementation
    using sigma points, IEEE Transactions on Signal Processing 63(20), 2015. The regression is repeated over each
    posterior that the prior and the last regression give, until mean and standard deviations change by less than
    a hundredth. With the spread and noise of a regression held, a step of the mean that does not lower the cost is
    halved (Raitoharju et al., Damped posterior linearization filter, IEEE Signal Processing Letters 25(4), 2018). What
    is linear it does as `ReplayEkf`.
    """

    iterates = True
    _max_iterations, _tolerance = 10, 1e-2

    def correct(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """See `ReplayEkf.correct`."""
        first = super().correct(mean, covariance, measurement)
        if measurement.model.linear:
            return first
        x, P = mean, covariance
        for _ in range(self._max_iterations):
            last, spread = x, P
            z, A, noise = measurement_regression(measurement, x, P)
            y, R = measurement.model.residual(measurement.z, z), measurement.R + noise
            update = reweighted(mean, covariance, y, A, R, measurement.loss, x - mean)
            x, P = update.mean, update.covariance

            def cost(x: FloatArray, spread: FloatArray = spread, R: FloatArray = R) -> float:
                z, _, _ = measurement_regression(measurement, x, spread)
                residual = measurement.model.residual(measurement.z, z)
                return negative_log_posterior(x - mean, covariance, residual, R, measurement.loss)

            limit = negative_log_posterior(last - mean, covariance, y, R, measurement.loss)
            x = descended(cost, limit, last, x)
            narrowed = np.abs(1.0 - spread.diagonal() / P.diagonal()).max()
            if max(largest_move(x - last, P), narrowed) < self._tolerance:
                break
        return first._replace(mean=x, covariance=P, weight=update.weight)

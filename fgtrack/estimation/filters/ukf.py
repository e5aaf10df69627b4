"""The unscented Kalman filter and the iterated posterior linearisation filter, by statistical linear regression.

The filters use the 2 n sigma points of the third-degree cubature rule (Arasaratnam and Haykin, Cubature Kalman
filters, IEEE Transactions on Automatic Control 54(6), 2009). The points lie sqrt(n) standard deviations from the mean,
along the columns of the covariance's root. The mean itself has no weight, so every covariance stays positive
semidefinite.

The cubature rule fails where an angle is very uncertain. The points then lie around the circle, where functions of the
angle are no polynomials of low degree. The uncertain directions of the covariance's root get equidistant points, at
most a radian apart (see `DenseRule`). The directions in which the functions are nearly affine keep the cubature rule.
All weights stay positive.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import polar_gradient, wrap_angles
from fgtrack.core.linalg import identity, symmetrise
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import OneCorrection, Prediction, updated_one
from fgtrack.estimation.filters.iekf import (
    descended,
    largest_move,
    negative_log_posterior,
    reweighted,
)
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.models.measurement import MIN_RANGE_M, MeasurementModel
from fgtrack.models.motion import MIN_SPEED_MPS

_JITTER = 1e-12
#: A direction of a covariance's root is wide where an angle changes by more: cubature points reach twice as far.
WIDE_RAD = 0.25
#: A direction is also wide where the direction or the relative range of a line of sight changes by more.
WIDE_SIGHT_RAD = 0.1
_REACH = 5.0  # standard deviations up to which equidistant points lie
_SIGHT_RAD, _MOST_RAD = 2.0, 10.0  # largest spreads that make points denser
_ROUNDING = 1e-9  # smaller shares of the largest spread are rounding
_STEP_RAD, _MOST_STEPS = 1e-9, 50  # in the search for a mean on the circle
Regression = tuple[FloatArray, FloatArray, FloatArray]
"""Terms of g(x) = z + A (x - m) + e for x ~ N(m, P): z (..., k), A (..., k, n), and the covariance of e.

The error e, with a covariance (..., k, k), is uncorrelated with x."""


def regression(
    g: Callable[[FloatArray], FloatArray],
    mean: FloatArray,
    covariance: FloatArray,
    difference: Callable[[FloatArray, FloatArray], FloatArray] = np.subtract,
) -> Regression:
    """Statistical linear regression of `g`, (..., n) -> (..., k), over N(mean, covariance), (..., n) and (..., n, n).

    Garcia-Fernandez et al. 2015, eqs. 9 to 11. The points are m +- c L_i with P = L L' and c^2 = n. Their values differ
    from g(m) by d+ and d-. The slope is A L_i = (d+ - d-) / 2c. The noise comes from the bends (d+ + d-) / 2, which are
    zero for a linear g. Raises `numpy.linalg.LinAlgError` for a covariance that is not positive semidefinite.
    """
    n, L = mean.shape[-1], _root(covariance)
    centre, offsets = mean[..., None, :], n**0.5 * L.mT
    values = g(np.concatenate([centre, centre + offsets, centre - offsets], axis=-2))
    d = difference(values[..., 1:, :], values[..., :1, :])
    ahead, behind = d[..., :n, :], d[..., n:, :]
    bends, slopes = 0.5 * (ahead + behind), (ahead - behind) / (2.0 * n**0.5)
    shift = bends.sum(axis=-2) / n
    noise = bends.mT @ bends / n - shift[..., :, None] * shift[..., None, :]
    return (
        values[..., 0, :] + shift,
        np.linalg.solve(L.mT, slopes).mT,
        symmetrise(noise),
    )


class DenseRule(NamedTuple):
    """Weighted points of a Gaussian, dense in the directions in which angles are uncertain."""

    points: FloatArray
    """Shape (m, n)."""
    weights: FloatArray
    """Positive, shape (m,); their sum is 1."""
    xi: FloatArray
    """The points as (x - mean) = root xi, shape (m, n)."""
    root: FloatArray
    """Shape (n, n)."""

    @classmethod
    def of(
        cls,
        mean: FloatArray,
        covariance: FloatArray,
        turns: FloatArray,
        sights: FloatArray,
    ) -> "DenseRule | None":
        """Return the rule of N(mean, covariance), (n,) and (n, n); None where no direction is wide.

        The rows of `turns`, shape (a, n), are gradients of angles whose sines and cosines count. The rows of `sights`,
        shape (b, n), are gradients of the direction and of the logarithm of the range of a line of sight. Rows may be
        0. A direction of the covariance's root is wide where an angle changes by more than `WIDE_RAD`. It is also wide
        where a line of sight changes by more than `WIDE_SIGHT_RAD`. Wide directions get equidistant points.

        This trapezoidal rule converges exponentially for a Gaussian and a smooth periodic function (Trefethen and
        Weideman, The exponentially convergent trapezoidal rule, SIAM Review 56(3), 2014). Narrow directions get the
        cubature rule, which is exact for functions that are affine along these directions. Marginalised sigma points
        use the same split (Morelande and Moran, An unscented transformation for conditionally linear models, ICASSP
        2007).
        """
        n, root, gradients = len(mean), _root(covariance), np.vstack([sights, turns])
        # Directions on which the angles depend come first. The angles do not depend on the other directions. So few
        # directions are wide, and a turned world has turned points.
        root = (
            root
            @ np.linalg.qr(
                (gradients[gradients.any(axis=1)] @ root).T, mode="complete"
            )[0]
        )
        spreads_rad = np.abs(turns @ root).max(axis=0, initial=0.0)
        seen_rad = np.minimum(
            np.abs(sights @ root).max(axis=0, initial=0.0), _SIGHT_RAD
        )
        if (
            seen_rad.max() > WIDE_SIGHT_RAD
        ):  # a line of sight needs both of its directions
            is_seen = seen_rad > _ROUNDING * seen_rad.max()
            spreads_rad = np.where(
                is_seen, np.maximum(spreads_rad, np.maximum(seen_rad, 1.0)), spreads_rad
            )
        wide, narrow = (
            (spreads_rad > WIDE_RAD).nonzero()[0],
            (spreads_rad <= WIDE_RAD).nonzero()[0],
        )
        if not len(wide):
            return None
        xi, weights = np.zeros((1, n)), np.ones(1)
        for row in wide.tolist():
            at, share = _equidistant(min(float(spreads_rad[row]), _MOST_RAD))
            xi, weights = (
                np.repeat(xi, len(at), axis=0),
                np.outer(weights, share).ravel(),
            )
            xi[:, row] = np.tile(at, len(xi) // len(at))
        if len(narrow):
            unit = len(narrow) ** 0.5 * identity(n)[narrow]
            xi = (xi[:, None, :] + np.concatenate([unit, -unit])).reshape(-1, n)
            weights = np.repeat(weights, 2 * len(narrow)) / (2 * len(narrow))
        return cls(mean + xi @ root.T, weights, xi, root)

    def regression(
        self, values: FloatArray, centre: FloatArray, circular: Sequence[int] = ()
    ) -> Regression:
        """Return the regression of the `values` (m, k) of a function at the points; `centre` (k,) is near its
        mean.

        `circular` components are angles. Their mean is the angle at which the wrapped differences sum to zero.
        """
        mean, apart = centre, values - centre
        for _ in range(_MOST_STEPS):
            apart[:, circular] = wrap_angles(apart[:, circular])
            step = self.weights @ apart
            mean, apart = mean + step, apart - step
            if not len(circular) or np.abs(step[circular]).max() < _STEP_RAD:
                break
        slopes = (self.weights[:, None] * apart).T @ self.xi
        left = apart - self.xi @ slopes.T
        noise = symmetrise((self.weights[:, None] * left).T @ left)
        return mean, np.asarray(np.linalg.solve(self.root.T, slopes.T).T), noise


def _equidistant(spread_rad: float) -> tuple[FloatArray, FloatArray]:
    """Return equidistant points (m,) of the standard normal distribution, and their weights (m,).

    A standard deviation changes the angle by `spread_rad`. Neighbouring points are at most a radian of this angle
    apart. No point lies at the mean. Beyond the sensor, a point at the mean would see the sensor at half a turn, with
    either sign.
    """
    step, num = min(1.0, 1.0 / spread_rad), math.ceil(_REACH * max(1.0, spread_rad))
    at = step * (np.arange(-num, num) + 0.5)
    weights = np.exp(-0.5 * at**2)
    weights /= weights.sum()
    return at / np.sqrt(weights @ at**2), weights


def _root(covariance: FloatArray) -> FloatArray:
    """Root L with L L' = covariance; a semidefinite covariance is increased a little first."""
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        n = covariance.shape[-1]
        scale = np.maximum(np.trace(covariance, axis1=-2, axis2=-1) / n, _JITTER)
        return np.asarray(
            np.linalg.cholesky(
                covariance + _JITTER * scale[..., None, None] * identity(n)
            )
        )


def measurement_regression(
    measurement: Measurement, mean: FloatArray, covariance: FloatArray
) -> Regression:
    """Return the statistical linear regression of the measurement model about a state.

    `mean` (n,) and `covariance` (n, n) describe the state. Measured angles that the state does not contain are
    averaged on the circle.
    """
    model, pose = measurement.model, measurement.pose
    rule = _rule_of(measurement, mean, covariance)
    if rule is None:
        return regression(
            lambda x: model.predict(x, pose), mean, covariance, _difference(model)
        )
    circular = [
        k for k in model.angular if model.components[k] not in model.state_names
    ]
    return rule.regression(
        model.predict(rule.points, pose), model.predict(mean, pose), circular
    )


def _rule_of(
    measurement: Measurement, mean: FloatArray, covariance: FloatArray
) -> DenseRule | None:
    """Return the dense rule for a measurement if its line of sight or a heading in it is uncertain, else None."""
    model, n = measurement.model, len(mean)
    turns, sights = np.zeros((1, n)), np.zeros((4, n))
    is_cartesian = "yaw_rad" not in model.state_names
    if model.relative:
        offset = mean[:2] - np.array(measurement.pose[:2])
        sights[:2, :2] = polar_gradient(offset, MIN_RANGE_M)
        sights[1] /= max(float(np.hypot(*offset)), MIN_RANGE_M)
    if "range_rate_mps" in model.components and not is_cartesian:
        turns[0, YAW] = 1.0
    if "yaw_rad" in model.components and is_cartesian:
        sights[2:, 2:4] = polar_gradient(mean[2:4], MIN_SPEED_MPS)
        sights[3] /= max(float(np.hypot(*mean[2:4])), MIN_SPEED_MPS)
    return DenseRule.of(mean, covariance, turns, sights)


@cache
def _difference(
    model: MeasurementModel,
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return the function that subtracts two measurements. Angles that are not entries of the state are wrapped."""
    direct = np.array(
        [k for k, name in enumerate(model.components) if name in model.state_names],
        dtype=np.int64,
    )

    def difference(z: FloatArray, centre: FloatArray) -> FloatArray:
        y = model.residual(z, centre)
        y[..., direct] = z[..., direct] - centre[..., direct]
        return y

    return difference


class UkfReplay(ReplayEkf):
    """Unscented Kalman filter with replay: averages over the spread of the state instead of derivatives.

    Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proceedings of the IEEE 92(3), 2004, written as
    statistical linear regression (see `regression`). The process noise is evaluated at the mean. Where the yaw is
    uncertain, the process noise is averaged (see `DenseRule`). Linear models are treated as in `ReplayEkf`.
    """

    spreads = True

    def predict(
        self, mean: FloatArray, covariance: FloatArray, dt_s: float
    ) -> Prediction:
        """See `ReplayEkf.predict`."""
        if self._motion.linear:
            return super().predict(mean, covariance, dt_s)
        rule = self._turning_rule(mean, covariance, dt_s)
        if rule is None:
            after, A, noise = regression(
                lambda x: self._motion.predict(x, dt_s), mean, covariance
            )
            Q = self._motion.process_noise(mean, dt_s)
        else:
            centre = self._motion.predict(mean, dt_s)
            after, A, noise = rule.regression(
                self._motion.predict(rule.points, dt_s), centre
            )
            Q = np.tensordot(
                rule.weights, self._motion.process_noise(rule.points, dt_s), axes=1
            )
        AP = A @ covariance
        return Prediction(after, symmetrise(AP @ A.mT + noise + Q), AP)

    def _turning_rule(
        self, mean: FloatArray, covariance: FloatArray, dt_s: float
    ) -> DenseRule | None:
        """Return the dense rule for a prediction if the yaw before or after the prediction is uncertain, else
        None.
        """
        names = self._motion.state_names[: len(mean)]
        if "yaw_rad" not in names:
            return None
        turns = np.zeros((2, len(mean)))
        turns[:, names.index("yaw_rad")] = 1.0
        if "yaw_rate_radps" in names:
            turns[1, names.index("yaw_rate_radps")] = dt_s
        return DenseRule.of(mean, covariance, turns, np.zeros((0, len(mean))))

    def correct(
        self, mean: FloatArray, covariance: FloatArray, measurement: Measurement
    ) -> OneCorrection:
        """See `ReplayEkf.correct`."""
        if measurement.model.linear:
            return super().correct(mean, covariance, measurement)
        z, A, noise = measurement_regression(measurement, mean, covariance)
        y, R = measurement.model.residual(measurement.z, z), measurement.R + noise
        return updated_one(
            mean, covariance, y, A, R, measurement.loss, measurement.measured
        )


class IplfReplay(UkfReplay):
    """Iterated posterior linearisation filter with replay: averages over the spread of the posterior.

    Garcia-Fernandez, Svensson, Morelande and Sarkka, Posterior linearization filter: principles and implementation
    using sigma points, IEEE Transactions on Signal Processing 63(20), 2015. The prior and a regression give a
    posterior, and the next regression is made over this posterior. The iteration ends when mean and standard deviations
    change by less than a hundredth. A step of the mean that does not lower the cost is halved; the spread and the noise
    of the regression are held meanwhile (Raitoharju et al., Damped posterior linearization filter, IEEE Signal
    Processing Letters 25(4), 2018). Linear models are treated as in `ReplayEkf`.
    """

    iterates = True
    _max_iterations, _tolerance = 10, 1e-2

    def correct(
        self, mean: FloatArray, covariance: FloatArray, measurement: Measurement
    ) -> OneCorrection:
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

            def cost(
                x: FloatArray, spread: FloatArray = spread, R: FloatArray = R
            ) -> float:
                z, _, _ = measurement_regression(measurement, x, spread)
                residual = measurement.model.residual(measurement.z, z)
                return negative_log_posterior(
                    x - mean, covariance, residual, R, measurement.loss
                )

            limit = negative_log_posterior(
                last - mean, covariance, y, R, measurement.loss
            )
            x = descended(cost, limit, last, x)
            narrowed = np.abs(1.0 - spread.diagonal() / P.diagonal()).max()
            if max(largest_move(x - last, P), narrowed) < self._tolerance:
                break
        return first._replace(mean=x, covariance=P, weight=update.weight)

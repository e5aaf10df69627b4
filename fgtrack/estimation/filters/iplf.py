"""The iterated posterior linearisation filter."""

from functools import partial

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.ekf import OneCorrection
from fgtrack.estimation.filters.iekf import check_iteration, descended, largest_move, negative_log_posterior, reweighted
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.filters.replay import ReplayingFilter
from fgtrack.estimation.filters.ukf import UkfRecursion, measurement_regression
from fgtrack.models.motion import MotionModel


class IplfRecursion(UkfRecursion):
    """An unscented filter whose update takes the measurement as what it is over the spread of the posterior.

    Garcia-Fernandez, Svensson, Morelande and Sarkka, Posterior linearization filter: principles and implementation
    using sigma points, IEEE Transactions on Signal Processing 63(20), 2015. The regression is repeated over each
    posterior that the prior and the last regression give. With the spread and noise of a regression held, a step of
    the mean that does not lower prior plus loss is halved (Raitoharju et al., Damped posterior linearization filter,
    IEEE Signal Processing Letters 25(4), 2018).

    Parameters
    ----------
    motion
        See `UkfRecursion`.
    max_iterations, tolerance
        When it ends; the tolerance is in standard deviations. Raises `ValueError` for a value out of range.
    """

    def __init__(self, motion: MotionModel, max_iterations: int, tolerance: float) -> None:
        super().__init__(motion)
        check_iteration(max_iterations, tolerance)
        self._max_iterations, self._tolerance = max_iterations, tolerance

    def correct_one(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """See `EkfRecursion.correct_one`."""
        if measurement.model.linear:
            return super().correct_one(mean, covariance, measurement)
        x, P = mean, covariance
        for _ in range(self._max_iterations):
            last, spread = x, P
            z, A, noise = measurement_regression(measurement, x, P)
            y, R = measurement.model.residual(measurement.z, z), measurement.R + noise
            update = reweighted(mean, covariance, y, A, R, measurement.loss, x - mean)
            cost = partial(self._cost, (mean, covariance), measurement, spread, R)
            limit = negative_log_posterior(x - mean, covariance, y, R, measurement.loss)
            x, P = update.mean, update.covariance
            if self._max_iterations > 1:
                x = descended(cost, limit, last, x)
            narrowed = np.abs(1.0 - spread.diagonal() / P.diagonal()).max()
            if max(largest_move(x - last, P), narrowed) < self._tolerance:
                break
        first = super().correct_one(mean, covariance, measurement)
        return first._replace(mean=x, covariance=P, weight=update.weight)

    def _cost(
        self,
        prior: tuple[FloatArray, FloatArray],
        measurement: Measurement,
        spread: FloatArray,
        R: FloatArray,
        x: FloatArray,
    ) -> float:
        """What a step lowers: the negative logarithm of the posterior at a state `x` (n,) of `spread` (n, n)."""
        z = measurement_regression(measurement, x, spread).mean
        residual = measurement.model.residual(measurement.z, z)
        return negative_log_posterior(x - prior[0], prior[1], residual, R, measurement.loss)


class IplfReplay(ReplayingFilter):
    """Iterated posterior linearisation filter that rewinds and replays: averages over the spread of the posterior.

    Garcia-Fernandez et al. 2015, see `IplfRecursion`. What is linear it does as `ReplayEkf`.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    max_iterations
        Regressions per update; 1 is the unscented filter.
    tolerance
        Where mean and standard deviations change by less than this many standard deviations, the iteration ends.
    initiation
        See `ReplayingFilter`.
    """

    spreads = True

    def __init__(
        self,
        motion: MotionModel,
        prior: Start,
        lag_s: float,
        max_iterations: int = 10,
        tolerance: float = 1e-2,
        initiation: str = DEFAULT,
    ) -> None:
        recursion = IplfRecursion(motion, max_iterations, tolerance)
        super().__init__(motion, prior, lag_s, recursion, initiation)

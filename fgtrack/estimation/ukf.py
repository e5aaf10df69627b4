"""The unscented Kalman filter."""

from fgtrack.core.linalg import congruence, product, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.ekf import Innovation, OneCorrection, Prediction, updated_one
from fgtrack.estimation.initiation import DEFAULT
from fgtrack.estimation.recursion import EkfRecursion
from fgtrack.estimation.replay import ReplayingFilter
from fgtrack.estimation.sigma_points import measurement_regression, motion_regression
from fgtrack.models.motion import MotionModel


class UkfRecursion(EkfRecursion):
    """A filter that takes motion and measurement as what they are on average over the spread of the state.

    Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proceedings of the IEEE 92(3), 2004, written as
    the statistical linear regression that it is (see `regression`). The process noise, that of the mean, is added. What
    is linear it does as the extended Kalman filter.
    """

    def predict(self, mean: FloatArray, covariance: FloatArray, dt_s: float) -> Prediction:
        """See `EkfRecursion.predict`."""
        if self._motion.linear:
            return super().predict(mean, covariance, dt_s)
        after, A, noise = motion_regression(self._motion, mean, covariance, dt_s)
        AP = product(A, covariance)
        Q = self._motion.step(mean.tolist(), dt_s).Q
        return Prediction(after, symmetrise(product(AP, A.T) + noise + Q), AP)

    def correct(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """See `EkfRecursion.correct`."""
        if measurement.model.linear:
            return super().correct(mean, covariance, measurement)
        z, A, noise = measurement_regression(measurement, mean, covariance)
        y = measurement.model.residual(measurement.z, z)
        after, P, S, w = updated_one(mean, covariance, y, A, measurement.R + noise, measurement.loss)
        return OneCorrection(after, P, y, measurement.nis(y, S), w, S)

    def innovation(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> Innovation:
        """See `EkfRecursion.innovation`."""
        if measurement.model.linear:
            return super().innovation(mean, covariance, measurement)
        z, A, noise = measurement_regression(measurement, mean, covariance)
        y = measurement.model.residual(measurement.z, z)
        S = congruence(A, covariance) + noise + measurement.R
        return Innovation(y, measurement.nis(y, S), S)


class UkfReplay(ReplayingFilter):
    """Unscented Kalman filter that rewinds and replays: means over the spread of the state in place of derivatives.

    Julier and Uhlmann 2004, see `UkfRecursion`. What is linear it does as `ReplayEkf`.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    initiation
        See `ReplayingFilter`.
    """

    spreads = True

    def __init__(
        self,
        motion: MotionModel,
        prior: Start,
        lag_s: float,
        initiation: str = DEFAULT,
    ) -> None:
        super().__init__(motion, prior, lag_s, UkfRecursion(motion), initiation)

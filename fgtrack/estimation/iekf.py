"""The iterated extended Kalman filter: Gauss-Newton on each update."""

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.ekf import OneCorrection, linearised
from fgtrack.estimation.initiation import DEFAULT
from fgtrack.estimation.iteration import Iteration, largest_move, negative_log_posterior, reweighted
from fgtrack.estimation.recursion import EkfRecursion
from fgtrack.estimation.replay import ReplayingFilter
from fgtrack.models.motion import MotionModel


class IekfRecursion(EkfRecursion):
    """An EKF that linearises the measurement again at the state that it gave, until that stays where it is.

    Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE Transactions on Automatic Control
    38(2), 1993: the update minimises half of |x - x_0|^2 in P^-1 and |z - h(x)|^2 in R^-1, or a robust loss in place of
    the latter. A step that does not lower this sum is halved.

    Parameters
    ----------
    motion
        Motion model.
    iteration
        When it ends.
    """

    def __init__(self, motion: MotionModel, iteration: Iteration) -> None:
        super().__init__(motion)
        self._iteration = iteration

    def correct(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """See `EkfRecursion.correct`."""
        if measurement.model.linear:
            return super().correct(mean, covariance, measurement)

        def cost(x: FloatArray) -> float:
            y = measurement.model.residual(measurement.z, measurement.model.predict(x, measurement.pose))
            return negative_log_posterior(x - mean, covariance, y, measurement.R, measurement.loss)

        x = mean
        for _ in range(self._iteration.max_iterations):
            last = x
            y, H = linearised(measurement.z, x, measurement.model, measurement.pose)
            update = reweighted(mean, covariance, y, H, measurement.R, measurement.loss, x - mean)
            limit = negative_log_posterior(x - mean, covariance, y, measurement.R, measurement.loss)
            x = self._iteration.descended(cost, limit, last, update.mean)
            if largest_move(x - last, covariance) < self._iteration.tolerance:
                break
        found = self.innovation(mean, covariance, measurement)
        return OneCorrection(x, update.covariance, found.innovation, found.nis, update.weight, found.S)


class IekfReplay(ReplayingFilter):
    """Iterated EKF that rewinds and replays: each update is linearised at its own result (Gauss-Newton).

    Bell and Cathey 1993, see `IekfRecursion`. What is linear, like a measured position, it fuses as `ReplayEkf`.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    max_iterations
        Linearisations per update; 1 is the EKF.
    tolerance
        A step below this many standard deviations of the prediction ends the iteration.
    initiation
        See `ReplayingFilter`.
    """

    def __init__(
        self,
        motion: MotionModel,
        prior: Start,
        lag_s: float,
        max_iterations: int = 10,
        tolerance: float = 1e-6,
        initiation: str = DEFAULT,
    ) -> None:
        recursion = IekfRecursion(motion, Iteration(max_iterations, tolerance))
        super().__init__(motion, prior, lag_s, recursion, initiation)

"""What a recursive filter does with one state: predict it, and correct it by a measurement."""

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.ekf import Innovation, OneCorrection, Prediction, correct_one, innovation_one, predict_across
from fgtrack.models.motion import MotionModel


class EkfRecursion:
    """The extended Kalman filter: everything linearised once, where it is predicted.

    It remembers nothing, so that a filter may rewind and replay its steps. All raise `numpy.linalg.LinAlgError` for a
    state or measurement that they cannot take.

    Parameters
    ----------
    motion
        Motion model.
    """

    def __init__(self, motion: MotionModel) -> None:
        self._motion = motion

    def predict(self, mean: FloatArray, covariance: FloatArray, dt_s: float) -> Prediction:
        """The state `mean` (n,), `covariance` (n, n) after `dt_s` > 0."""
        return predict_across(mean, covariance, self._motion, dt_s)

    def correct(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """The state after `measurement`, made at the stamp of `mean` (n,) and `covariance` (n, n)."""
        return correct_one(mean, covariance, measurement)

    def innovation(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> Innovation:
        """Those of `correct`, shape (k,) and NIS, without the correction."""
        return innovation_one(mean, covariance, measurement)

"""What a recursive filter does with one state: predict it, and correct it by a measurement."""

from typing import Protocol

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.ekf import Innovation, OneCorrection, Prediction, correct_one, innovation_one, predict_across
from fgtrack.models.motion import MotionModel


class Recursion(Protocol):
    """The two steps of a filter; it remembers nothing, so that a filter may rewind and replay them.

    All raise `numpy.linalg.LinAlgError` for a state or measurement that they cannot take.
    """

    def predict(self, mean: FloatArray, covariance: FloatArray, dt_s: float) -> Prediction:
        """The state `mean` (n,), `covariance` (n, n) after `dt_s` > 0."""

    def correct(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """The state after `measurement`, made at the stamp of `mean` (n,) and `covariance` (n, n)."""

    def innovation(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> Innovation:
        """Those of `correct`, shape (k,) and NIS, without the correction."""


class EkfRecursion:
    """The extended Kalman filter: everything linearised once, where it is predicted.

    Parameters
    ----------
    motion
        Motion model.
    """

    def __init__(self, motion: MotionModel) -> None:
        self._motion = motion

    def predict(self, mean: FloatArray, covariance: FloatArray, dt_s: float) -> Prediction:
        """See `Recursion.predict`."""
        return predict_across(mean, covariance, self._motion, dt_s)

    def correct(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """See `Recursion.correct`."""
        return correct_one(mean, covariance, measurement)

    def innovation(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> Innovation:
        """See `Recursion.innovation`."""
        return innovation_one(mean, covariance, measurement)

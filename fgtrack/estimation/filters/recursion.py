"""Recursions of filters: the prediction of a state, and its correction by a measurement."""

from dataclasses import dataclass

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import seconds
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import OneCorrection, Prediction, correct_one, predict_across
from fgtrack.estimation.filters.initiation import Initiation
from fgtrack.estimation.filters.track_initiation import TrackInitiation
from fgtrack.models.motion import MotionModel


@dataclass(slots=True)
class Step:
    """A measurement of a replaying filter with the state after it."""

    stamp_ns: int
    measurement: Measurement | None
    """None of the oldest step, which is the prior."""
    mean: FloatArray
    covariance: FloatArray
    predicted: Prediction
    """The state before it, predicted from the step before."""
    search: TrackInitiation | None = None
    """Measurements up to here, where the direction of travel was sought."""

    @property
    def along(self) -> bool:
        """True if the state comes from all that had been measured, along a line, and not from the step before."""
        return self.search is not None and self.search.line is not None


class EkfRecursion:
    """The extended Kalman filter: everything linearised once, where it is predicted.

    It remembers nothing, so that a filter may rewind and replay its steps.

    Parameters
    ----------
    motion
        Motion model.
    """

    def __init__(self, motion: MotionModel) -> None:
        self.motion = motion

    def predict(self, mean: FloatArray, covariance: FloatArray, dt_s: float) -> Prediction:
        """State `mean` (n,), `covariance` (n, n) after `dt_s` >= 0."""
        return predict_across(mean, covariance, self.motion, dt_s)

    def correct_one(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """State after `measurement`, made at the stamp of `mean` (n,) and `covariance` (n, n).

        Innovation, NIS and S are those of the prediction. Raises `numpy.linalg.LinAlgError` for a measurement that
        cannot be fused.
        """
        return correct_one(mean, covariance, measurement)

    # --- steps of filters

    def first(self, prior: Start, initiation: Initiation) -> Step:
        """The step that everything is replayed from."""
        mean, covariance = initial_state(self.motion, prior)
        search, predicted = TrackInitiation.of(self.motion, prior, initiation), Prediction(mean, covariance, covariance)
        return Step(prior.stamp_ns, None, mean, covariance, predicted, search)

    def ahead(self, before: Step, stamp_ns: int) -> Prediction:
        """State at `stamp_ns`, predicted from a step."""
        if stamp_ns == before.stamp_ns:
            return Prediction(before.mean, before.covariance, before.covariance)
        return self.predict(before.mean, before.covariance, seconds(stamp_ns - before.stamp_ns))

    def fused(self, before: Step, measurement: Measurement) -> tuple[Step, OneCorrection]:
        """The step of `measurement` after the step before it. Raises as `correct_one`."""
        predicted = self.ahead(before, measurement.stamp_ns)
        corrected = self.correct_one(predicted.mean, predicted.covariance, measurement)
        return self._concluded(before, measurement, predicted, corrected)

    def _concluded(
        self, before: Step, measurement: Measurement, predicted: Prediction, corrected: OneCorrection
    ) -> tuple[Step, OneCorrection]:
        """The step of a corrected state; while the direction of travel is sought, that along the line instead."""
        mean, covariance = corrected.mean, corrected.covariance
        search = None if before.search is None else before.search.with_measurement(measurement)
        if search is not None and search.line is not None:
            mean, covariance = search.state()
        if not self.motion.cartesian:
            mean[YAW] = wrap_angle(mean[YAW])
        return Step(measurement.stamp_ns, measurement, mean, covariance, predicted, search), corrected

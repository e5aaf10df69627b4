"""What a recursive filter does with stacks of states: predict them, and correct each by a measurement."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.grouping import equal_ones
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import OneCorrection, Prediction, correct, correct_one, predict_across
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
    """What had been measured up to here, where the direction of travel was sought."""

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

    linearises_at_prediction = True
    """True if a nonlinear measurement is fused by its derivative at the prediction, else by `correct_one`."""

    def __init__(self, motion: MotionModel) -> None:
        self.motion = motion

    def predict(self, mean: FloatArray, covariance: FloatArray, dt_s: FloatArray) -> Prediction:
        """States `mean` (m, n), `covariance` (m, n, n) after `dt_s` (m,) >= 0."""
        return predict_across(mean, covariance, self.motion, dt_s)

    def correct_one(self, mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
        """State after `measurement`, made at the stamp of `mean` (n,) and `covariance` (n, n).

        Innovation, NIS and S are those of the prediction. Raises `numpy.linalg.LinAlgError` for a measurement that
        cannot be fused.
        """
        return correct_one(mean, covariance, measurement)

    def correct(
        self, mean: FloatArray, covariance: FloatArray, measurements: Sequence[Measurement]
    ) -> list[OneCorrection | None]:
        """`correct_one` of m states; None where a measurement cannot be fused."""
        found: list[OneCorrection | None] = [None] * len(measurements)
        kinds = [(id(one.model), 0 if one.model.linear else id(one.pose), one.assumed) for one in measurements]
        for rows in equal_ones(kinds):
            chosen = [measurements[row] for row in rows]
            one = chosen[0]
            if one.model.linear or self.linearises_at_prediction:
                z, R = np.array([each.z for each in chosen]), np.array([each.R for each in chosen])
                losses = [each.loss for each in chosen]
                args = mean[rows], covariance[rows], z, R, one.model, one.pose, None, one.measured, losses
                for row, each in zip(rows, correct(*args).rows(), strict=True):
                    found[row] = each
                continue
            for row in rows:
                with suppress(np.linalg.LinAlgError):
                    found[row] = self.correct_one(mean[row], covariance[row], measurements[row])
        return found

    # --- steps of filters

    def first(self, prior: Start, initiation: Initiation) -> Step:
        """The step that everything is replayed from."""
        mean, covariance = initial_state(self.motion, prior)
        search, predicted = TrackInitiation.of(self.motion, prior, initiation), Prediction(mean, covariance, covariance)
        return Step(prior.stamp_ns, None, mean, covariance, predicted, search)

    def ahead(self, before: Sequence[Step], stamps_ns: Sequence[int]) -> Prediction:
        """States at `stamps_ns`, each predicted from its step."""
        mean, covariance = np.array([step.mean for step in before]), np.array([step.covariance for step in before])
        late_ns = np.array([stamp_ns - step.stamp_ns for step, stamp_ns in zip(before, stamps_ns, strict=True)])
        return (
            self.predict(mean, covariance, late_ns / NS_PER_S)
            if late_ns.any()
            else Prediction(mean, covariance, covariance)
        )

    def fused(
        self, before: Sequence[Step], measurements: Sequence[Measurement]
    ) -> list[tuple[Step, OneCorrection] | None]:
        """The steps of `measurements`, each after the step before it; None where one cannot be fused."""
        predicted = self.ahead(before, [one.stamp_ns for one in measurements])
        corrected = self.correct(predicted.mean, predicted.covariance, measurements)
        parts = zip(before, measurements, map(Prediction, *predicted), corrected, strict=True)
        return [None if own is None else self._concluded(step, one, at, own) for step, one, at, own in parts]

    def _concluded(
        self, before: Step, measurement: Measurement, predicted: Prediction, corrected: OneCorrection
    ) -> tuple[Step, OneCorrection] | None:
        """The step of a corrected state; while the direction of travel is sought, that along the line instead."""
        mean, covariance = corrected.mean, corrected.covariance
        search = None if before.search is None else before.search.with_measurement(measurement)
        if search is not None and search.line is not None:
            try:
                mean, covariance = search.state()
            except np.linalg.LinAlgError:
                return None
        if not self.motion.cartesian:
            mean[YAW] = wrap_angle(mean[YAW])
        return Step(measurement.stamp_ns, measurement, mean, covariance, predicted, search), corrected

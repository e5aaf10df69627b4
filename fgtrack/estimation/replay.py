"""Filters that rewind to a late measurement, and apply again what came after it."""

import bisect
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import NOTHING, Measurement, Order, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.ekf import OneCorrection, Prediction
from fgtrack.estimation.initiation import DEFAULT, checked_initiation
from fgtrack.estimation.opening import Opening
from fgtrack.estimation.propagation import track_state
from fgtrack.estimation.recursion import EkfRecursion
from fgtrack.estimation.rts import rts_step
from fgtrack.estimation.windowed import WindowedFilter
from fgtrack.models.motion import MotionModel


@dataclass(slots=True)
class Step:
    """A measurement of a replaying filter with the state after it."""

    order: Order
    """Place among all measurements: by stamp, and at one stamp by content, so that arrival does not matter."""
    measurement: Measurement | None
    """None of the oldest step, which is the prior."""
    mean: FloatArray
    covariance: FloatArray
    predicted: Prediction
    """The state before it, predicted from the step before."""
    opening: Opening | None = None
    """What had been measured up to here, where the direction of travel was sought."""

    @property
    def along(self) -> bool:
        """Whether the state comes from all that had been measured, along a line, and not from the step before."""
        return self.opening is not None and self.opening.line is not None


class ReplayingFilter(WindowedFilter):
    """A filter that keeps the measurements of a window; its estimates do not depend on the order of arrival.

    Rewind and replay, as in robot_localization; see docs/baseline.md.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    recursion
        How one state is predicted and corrected.
    initiation
        How the direction of travel is found where `prior` gives none, see `Initiation`.
    """

    exact = "any lag, any number"
    retrodicts = True
    initiates = True

    def __init__(
        self, motion: MotionModel, prior: Start, lag_s: float, recursion: EkfRecursion, initiation: str = DEFAULT
    ) -> None:
        super().__init__(motion, prior, lag_s)
        self._recursion = recursion
        self._initiation = checked_initiation(initiation)
        self._steps = [self._first(prior)]

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps of the window and the one that it is replayed from, in order."""
        return tuple(self._steps)

    @property
    def settled(self) -> bool:
        """Whether no direction of travel is sought any more, nor was at a step that may be replayed."""
        return self._steps[0].opening is None

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: the filter's state, from the measurements up to that stamp."""
        before = max(bisect.bisect_right(self._steps, stamp_ns, key=_stamp) - 1, 0)
        predicted = self._predicted(self._steps[before], stamp_ns)
        return track_state(self._motion, stamp_ns, predicted.mean, predicted.covariance)

    def _first(self, prior: Start) -> Step:
        """The state that everything is replayed from."""
        mean, covariance = initial_state(self._motion, prior)
        opening, predicted = Opening.of(self._motion, prior, self._initiation), Prediction(mean, covariance, covariance)
        return Step((prior.stamp_ns, NOTHING), None, mean, covariance, predicted, opening)

    def _forget_before(self, stamp_ns: int) -> None:
        # what is measured at that very stamp may still come, and belongs behind the first step
        del self._steps[: max(bisect.bisect_left(self._steps, stamp_ns, key=_stamp) - 1, 0)]

    def _fuse(self, measurement: Measurement) -> OneCorrection:
        order = measurement.order
        place = bisect.bisect_right(self._steps, order, lo=1, key=_order)
        step, correction = self._fused(self._steps[place - 1], order, measurement)
        later = self._steps[place:]
        if later and self.retrodicts:
            found = self._recursion.innovation(*self._retrodicted(step, later), measurement)
            correction = correction._replace(**found._asdict())
        self._steps[place:] = [step, *self._replayed(step, later)]
        return correction

    def _retrodicted(self, step: Step, later: Sequence[Step]) -> tuple[FloatArray, FloatArray]:
        """The state that the measurement of `step` finds, given all that was fused, the `later` steps included.

        From the newest step back (see `rts_step`), each as it was when the measurement of `step` was unknown.
        """
        blank = replace(step, mean=step.predicted.mean, covariance=step.predicted.covariance)
        first = later[0]
        later = [replace(first, predicted=self._predicted(blank, first.order[0])), *later[1:]]
        mean, covariance = later[-1].mean, later[-1].covariance
        for before, after in zip([*later[-2::-1], blank], later[::-1], strict=True):
            if after.along and after.opening is not None:
                return after.opening.retrodicted(step.order[0], mean, covariance)
            if before.order[0] != after.order[0]:  # else it is the same state
                shift = self._wrapped(mean - after.predicted.mean)
                mean, covariance, _ = rts_step(before.mean, before.covariance, after.predicted, shift, covariance)
        return mean, covariance

    def _replayed(self, step: Step, later: Iterable[Step]) -> list[Step]:
        """The measurements of `later` steps, in their order, applied to `step`."""
        steps = []
        for old in later:
            if old.measurement is not None:
                step, _ = self._fused(step, old.order, old.measurement)
                steps.append(step)
        return steps

    def _fused(self, before: Step, order: Order, measurement: Measurement) -> tuple[Step, OneCorrection]:
        """The step after `before` with `measurement`; `numpy.linalg.LinAlgError` where it is not finite."""
        predicted = self._predicted(before, measurement.stamp_ns)
        corrected = self._recursion.correct(predicted.mean, predicted.covariance, measurement)
        return self._concluded(before, order, measurement, predicted, corrected)

    def _concluded(
        self, before: Step, order: Order, measurement: Measurement, predicted: Prediction, corrected: OneCorrection
    ) -> tuple[Step, OneCorrection]:
        """The step of a corrected state; while the direction of travel is sought, that along the line instead."""
        mean, covariance = corrected.mean, corrected.covariance
        opening = None if before.opening is None else before.opening.with_measurement(measurement)
        if opening is not None and opening.line is not None:
            mean, covariance = opening.state()
            corrected = corrected._replace(mean=mean, covariance=covariance)
        if not math.isfinite(mean.dot(mean) + np.vdot(covariance, covariance)):  # one number instead of a mask
            raise np.linalg.LinAlgError("posterior is not finite")
        return Step(order, measurement, self._wrapped(mean), covariance, predicted, opening), corrected

    def _predicted(self, before: Step, stamp_ns: int) -> Prediction:
        """The state at `stamp_ns`, from the step before it."""
        if stamp_ns == before.order[0]:
            return Prediction(before.mean, before.covariance, before.covariance)
        return self._recursion.predict(before.mean, before.covariance, seconds(stamp_ns - before.order[0]))


class ReplayEkf(ReplayingFilter):
    """An EKF that keeps the measurements of a window; its estimates do not depend on the order of arrival.

    Rewind and replay, as in robot_localization; see docs/baseline.md.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    initiation
        See `ReplayingFilter`.
    """

    def __init__(self, motion: MotionModel, prior: Start, lag_s: float, initiation: str = DEFAULT) -> None:
        super().__init__(motion, prior, lag_s, EkfRecursion(motion), initiation)


def _order(step: Step) -> Order:
    return step.order


def _stamp(step: Step) -> int:
    return step.order[0]

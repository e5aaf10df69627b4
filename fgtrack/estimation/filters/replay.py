"""Filters of one object that roll back to a late measurement and re-filter the later ones."""

import bisect
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import ClassVar, NamedTuple

from fgtrack.core.errors import CallError
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start, asked_stamp
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import (
    OneCorrection,
    Prediction,
    correct_one,
    predict_across,
)
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.filters.propagation import track_state, wrapped
from fgtrack.estimation.filters.track_initiation import TrackInitiation
from fgtrack.estimation.filters.windowed import WindowedFilter
from fgtrack.estimation.rts import Link, smoothed_back
from fgtrack.models.motion import MotionModel


class Mixture(NamedTuple):
    """Gaussians of one object by several motion models, with the probabilities of the models."""

    means: tuple[FloatArray, ...]
    covariances: tuple[FloatArray, ...]
    probabilities: FloatArray
    """Shape (m,)."""


@dataclass(slots=True)
class Step:
    """A measurement of a replaying filter, with the states before and after the measurement."""

    stamp_ns: int
    measurement: Measurement | None
    """None for the oldest step, which is the prior."""
    mean: FloatArray
    covariance: FloatArray
    predicted: Prediction
    """The state before the measurement, predicted from the previous step."""
    search: TrackInitiation | None = None
    """Initiation with all measurements up to this step; None if the direction of travel is not sought here."""
    mixture: Mixture | None = None
    """States by each model of `imm-replay`. `mean` and `covariance` are the moments of the mixture."""


#: Sort key of steps.
by_stamp = attrgetter("stamp_ns")


class ReplayEkf(WindowedFilter):
    """An EKF that keeps the measurements of a window. Its estimates do not depend on the order of arrival.

    It rolls back and re-filters later measurements, as robot_localization does. Filters with another prediction or
    correction override `predict` and `correct`. `initiation`: see `Initiation`.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *WindowedFilter.STATE,
        "steps",
    )

    exact = "any lag, any number"
    retrodicts = True
    initiates = True

    def __init__(
        self, motion: MotionModel, prior: Start, lag_s: float, initiation: str = DEFAULT
    ) -> None:
        super().__init__(motion, prior, lag_s)
        x, P = initial_state(motion, prior)
        search = TrackInitiation.of(motion, prior, initiation)
        self.steps = [Step(prior.stamp_ns, None, x, P, Prediction(x, P, P), search)]
        """The last step before the window and the steps of the window, ordered by stamp and content."""

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: the filtered state, given the measurements up to this stamp."""
        stamp_ns = asked_stamp(stamp_ns, self.steps[0].stamp_ns)
        before = self.steps[
            max(bisect.bisect_right(self.steps, stamp_ns, key=by_stamp) - 1, 0)
        ]
        mean, covariance, _ = self._ahead(before, stamp_ns)
        return track_state(self._motion, stamp_ns, mean, covariance)

    def _forget_before(self, stamp_ns: int) -> None:
        # a measurement at this very stamp may still come, and needs a step before it
        del self.steps[
            : max(bisect.bisect_left(self.steps, stamp_ns, key=by_stamp) - 1, 0)
        ]

    def has_fused(self, measurement: Measurement) -> bool:
        """True if the window has an identical measurement."""
        return self._index_of(measurement) is not None

    def withdraw(self, measurement: Measurement) -> None:
        """Filter without a measurement, as if it had never been fused.

        Raises `CallError` if the window does not have the measurement.
        """
        index = self._index_of(measurement)
        if not index:
            raise CallError(
                f"withdraw: the window has no such measurement at {measurement.stamp_ns} ns"
            )
        before, later = self.steps[index - 1], self.steps[index + 1 :]
        self.steps[index - 1 :] = self._filtered(before, later)

    def _index_of(self, measurement: Measurement) -> int | None:
        """Return the index of the step with an identical measurement; None without one."""
        stamp_ns = measurement.stamp_ns
        if stamp_ns < self._start_ns:
            return None
        first = bisect.bisect_left(self.steps, stamp_ns, key=by_stamp)
        last = bisect.bisect_right(self.steps, stamp_ns, key=by_stamp)
        for index in range(first, last):
            own = self.steps[index].measurement
            if own is not None and own.order == measurement.order:
                return index
        return None

    def _fuse(self, measurement: Measurement) -> OneCorrection:
        stamp_ns = (
            measurement.stamp_ns
        )  # it comes by stamp and, at one stamp, by content; never before the first
        index = max(bisect.bisect_right(self.steps, stamp_ns, key=by_stamp), 1)
        while index > 1 and self.steps[index - 1].stamp_ns == stamp_ns:
            last = self.steps[index - 1].measurement
            if last is None or last.content <= measurement.content:
                break
            index -= 1
        later, (step, correction) = (
            self.steps[index:],
            self._step(self.steps[index - 1], measurement),
        )
        if later and self.retrodicts:
            expected = self.correct(*self._retrodicted(step, later), measurement)
            correction = correction._replace(
                innovation=expected.innovation, nis=expected.nis, S=expected.S
            )
        self.steps[index:] = self._filtered(step, later)
        return correction

    def _filtered(self, first: Step, later: Sequence[Step]) -> list[Step]:
        """Return the step `first`, and the measurements of the steps `later` filtered after it."""
        chain = [first]
        for each in later:
            if each.measurement is not None:
                chain.append(self._step(chain[-1], each.measurement)[0])
        return chain

    def predict(
        self, mean: FloatArray, covariance: FloatArray, dt_s: float
    ) -> Prediction:
        """Return the prediction of a state, `mean` (n,) and `covariance` (n, n), after `dt_s` >= 0."""
        return predict_across(mean, covariance, self._motion, dt_s)

    def correct(
        self, mean: FloatArray, covariance: FloatArray, measurement: Measurement
    ) -> OneCorrection:
        """Return the correction of a state, `mean` (n,) and `covariance` (n, n), by a measurement at the same
        stamp.

        Raises `numpy.linalg.LinAlgError` if the measurement cannot be fused.
        """
        return correct_one(mean, covariance, measurement)

    def _ahead(self, before: Step, stamp_ns: int) -> Prediction:
        """Return the state at `stamp_ns`, predicted from the step `before`."""
        if stamp_ns == before.stamp_ns:
            return Prediction(before.mean, before.covariance, before.covariance)
        return self.predict(
            before.mean, before.covariance, seconds(stamp_ns - before.stamp_ns)
        )

    def _step(
        self, before: Step, measurement: Measurement
    ) -> tuple[Step, OneCorrection]:
        """Return the step of `measurement` after the step `before`, and its correction.

        Raises the exceptions of `correct`.
        """
        predicted = self._ahead(before, measurement.stamp_ns)
        corrected = self.correct(predicted.mean, predicted.covariance, measurement)
        return self._concluded(before, measurement, predicted, corrected), corrected

    def _concluded(
        self,
        before: Step,
        measurement: Measurement,
        predicted: Prediction,
        corrected: OneCorrection,
    ) -> Step:
        """Return the step of a corrected state. While the direction of travel is sought, the state comes from
        the line instead.
        """
        mean, covariance = corrected.mean, corrected.covariance
        search = (
            None
            if before.search is None
            else before.search.with_measurement(measurement)
        )
        if search is not None and search.line is not None:
            mean, covariance = search.state()
        return Step(
            measurement.stamp_ns,
            measurement,
            wrapped(self._motion, mean),
            covariance,
            predicted,
            search,
        )

    def _retrodicted(
        self, new: Step, later: Sequence[Step]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the state, (n,) and (n, n), at the `new` measurement, given all other measurements.

        `later` are the steps after the new measurement.
        """
        links: list[Link] = [
            (each.stamp_ns, each.mean, each.covariance, each.predicted)
            for each in later
        ]
        mean, covariance = later[-1].mean, later[-1].covariance
        for index in range(len(later) - 1, -1, -1):
            search = later[index].search
            if search is not None and search.line is not None:
                mean, covariance = smoothed_back(
                    self._motion, links[index:], mean, covariance
                )
                return search.retrodicted(new.stamp_ns, mean, covariance)
        without = Step(new.stamp_ns, None, *new.predicted[:2], new.predicted)
        stamp_ns, x, P, _ = links[0]
        links[0] = stamp_ns, x, P, self._ahead(without, stamp_ns)
        first = new.stamp_ns, without.mean, without.covariance, without.predicted
        return smoothed_back(self._motion, [first, *links], mean, covariance)

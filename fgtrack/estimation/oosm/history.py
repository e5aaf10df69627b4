"""History of the steps of a filter, so that a late measurement can be fused without replaying them."""

import bisect
from dataclasses import dataclass

import numpy as np

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import OneCorrection, correct_one, linearised, predict, propagated
from fgtrack.models.motion import MotionModel


@dataclass(frozen=True, slots=True)
class FilterStep:
    """A state before and after a measurement, and what the measurement said; yaws are not wrapped."""

    stamp_ns: int
    mean: FloatArray
    """x_{j|j}, shape (n,)."""
    covariance: FloatArray
    """P_{j|j}, shape (n, n)."""
    predicted_mean: FloatArray
    """x_{j|j-1}, shape (n,)."""
    predicted_covariance: FloatArray
    """P_{j|j-1}, shape (n, n)."""
    score: FloatArray
    """H' S^-1 y, shape (n,)."""
    weight: FloatArray
    """H' S^-1 H, shape (n, n); with it I - K H = I - P_{j|j-1} weight."""


class History:
    """Steps of a filter in order of their stamps, the first of them the prior."""

    def __init__(self, motion: MotionModel, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        self._motion = motion
        nothing = np.zeros_like(mean), np.zeros_like(covariance)
        self.steps = [FilterStep(stamp_ns, mean, covariance, mean, covariance, *nothing)]

    @property
    def newest(self) -> FilterStep:
        """The present."""
        return self.steps[-1]

    @property
    def first_at_newest(self) -> FilterStep:
        """The first of the steps that share the present stamp."""
        return self.steps[bisect.bisect_left(self.steps, self.newest.stamp_ns, key=_stamp)]

    def left(self, stamp_ns: int) -> int:
        """Place of the last step that is not after `stamp_ns` (of the first step, where all are)."""
        return max(bisect.bisect_right(self.steps, stamp_ns, key=_stamp) - 1, 0)

    def predicted(self, place: int, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Mean (n,) and covariance (n, n) at `stamp_ns` from the step at `place`."""
        step = self.steps[place]
        return self.moved(step.mean, step.covariance, step.stamp_ns, stamp_ns)

    def moved(
        self, mean: FloatArray, covariance: FloatArray, from_ns: int, to_ns: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean (n,) and covariance (n, n) at `to_ns` from those at `from_ns`."""
        if from_ns == to_ns:
            return mean, covariance
        return predict(mean, covariance, self._motion, seconds(to_ns - from_ns))

    def transition(self, mean: FloatArray, from_ns: int, to_ns: int) -> FloatArray:
        """F(to, from), shape (n, n), at the state `mean` (n,)."""
        return self._motion.jacobian(mean, seconds(to_ns - from_ns))

    def transition_to(self, place: int) -> FloatArray:
        """F_j, shape (n, n), from the step before `place` to the one there."""
        before = self.steps[place - 1]
        return self.transition(before.mean, before.stamp_ns, self.steps[place].stamp_ns)

    def stepped(self, place: int, measurement: Measurement) -> tuple[FilterStep, OneCorrection]:
        """The ordinary step from the one at `place` to `measurement`; the history stays as it is.

        Raises `numpy.linalg.LinAlgError` for a measurement that cannot be fused.
        """
        mean, covariance = self.predicted(place, measurement.stamp_ns)
        result = correct_one(mean, covariance, measurement)
        y, H = linearised(measurement.z, mean, measurement.model, measurement.pose)
        weighted = psd_solve(propagated(H, covariance, measurement.R / result.weight), np.column_stack((y, H)))
        score, weight = H.T @ weighted[:, 0], symmetrise(H.T @ weighted[:, 1:])
        return (
            FilterStep(measurement.stamp_ns, result.mean, result.covariance, mean, covariance, score, weight),
            result,
        )

    def append(self, step: FilterStep) -> None:
        """Let `step` be the present."""
        self.steps.append(step)

    def absorb(self, mean: FloatArray, covariance: FloatArray) -> None:
        """A late measurement turned the present state into `mean` (n,) and `covariance` (n, n).

        It becomes a step at the present stamp, with the one measurement of the present state that has the same
        effect: H' S^-1 y = P^-1 (x+ - x), H' S^-1 H = P^-1 (P - P+) P^-1 (the equivalent measurement of Bar-Shalom,
        Chen and Mallick 2004).
        """
        now = self.newest
        gained = psd_solve(now.covariance, now.covariance - covariance)
        score = psd_solve(now.covariance, mean - now.mean)
        weight = symmetrise(psd_solve(now.covariance, gained.T))
        self.append(FilterStep(now.stamp_ns, mean, covariance, now.mean, now.covariance, score, weight))

    def forget_after(self, place: int) -> None:
        """Drop the steps after `place`."""
        del self.steps[place + 1 :]

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the steps that are not needed for stamps from `stamp_ns` on."""
        del self.steps[: self.left(stamp_ns)]


def _stamp(step: FilterStep) -> int:
    return step.stamp_ns

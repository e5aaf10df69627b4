"""What the window has marginalised: the prior of its oldest node, and a ring of conditionals for detections that are
older than the window."""

import bisect
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fgtrack.core.linalg import mahalanobis_squared, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.ekf import joseph, kalman_gain, propagated
from fgtrack.estimation.interpolation import between
from fgtrack.estimation.terms import (
    NEAR_NS,
    EquivalentMeasurement,
    Linearised,
    MeasurementTerm,
    NearMeasurement,
    linearised,
)
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import weight


@dataclass(frozen=True, slots=True)
class Conditional:
    """A marginalised node given its right neighbour: x - mean = A (x_right - mean_right) + b + N(0, C)."""

    stamp_ns: int
    mean: FloatArray
    """Where the motion and later detections are linearised, shape (n,)."""
    A: FloatArray
    b: FloatArray
    C: FloatArray


@dataclass(frozen=True, slots=True)
class Prior:
    """All that is known of the oldest node from before its stamp."""

    mean: FloatArray
    covariance: FloatArray


class MarginalisedPast:
    """The past of a window.

    When the oldest node leaves, its filtered state splits into the prior of the next node and a conditional
    p(x | x_right, everything up to x), as in smoothing. Both are exact in a linear model; else they are linearised
    at the node's mean when it left.

    Parameters
    ----------
    motion, stamp_ns, prior
        Motion model, and the first node.
    """

    def __init__(self, motion: MotionModel, stamp_ns: int, prior: Prior) -> None:
        self._motion = motion
        self._ring: list[Conditional] = []
        self._stamp_ns = stamp_ns
        self._origin = prior.mean
        self.prior = prior

    @classmethod
    def resumed(
        cls, motion: MotionModel, ring: Iterable[Conditional], stamp_ns: int, origin: FloatArray, prior: Prior
    ) -> "MarginalisedPast":
        """The past of an oldest node at `stamp_ns` from what is known of it.

        `ring` holds the conditionals, oldest first, the last one relative to the oldest node at `origin` (n,).
        """
        past = cls(motion, stamp_ns, prior)
        past._ring, past._origin = list(ring), origin
        return past

    def copy(self) -> "MarginalisedPast":
        """An independent copy."""
        return self.resumed(self._motion, self._ring, self._stamp_ns, self._origin, self.prior)

    @property
    def ring(self) -> tuple[Conditional, ...]:
        """The conditionals, oldest first."""
        return tuple(self._ring)

    @property
    def start_ns(self) -> int:
        """Oldest stamp that `fuse` and `state_at` reach."""
        return self._ring[0].stamp_ns if self._ring else self._stamp_ns

    def pass_node(self, terms: list[MeasurementTerm], mean: FloatArray, next_ns: int, next_mean: FloatArray) -> None:
        """The oldest node leaves the window with its terms; the node at `next_ns` becomes the oldest.

        `mean` and `next_mean`, shape (n,), are the two nodes' present estimates. Raises `numpy.linalg.LinAlgError` for
        a term that cannot be fused.
        """
        dt_s = seconds(next_ns - self._stamp_ns)
        step = self._motion.transition(mean, dt_s)
        filtered, P = self.prior.mean, self.prior.covariance
        for y, H, R in [_weighed(term, mean) for term in terms]:
            K, _ = kalman_gain(P, H, R)
            filtered, P = filtered + K.dot(y - H.dot(filtered - mean)), joseph(P, K, H, R)
        predicted = step.mean + step.F.dot(filtered - mean)
        A, P_next = kalman_gain(P, step.F, step.Q)  # the next node measures F x + N(0, Q)
        C = joseph(P, A, step.F, step.Q)
        b = filtered - mean + A.dot(next_mean - predicted)
        if self._ring:
            last = self._ring[-1]
            own = last.b + last.A.dot(mean - self._origin)
            self._ring[-1] = Conditional(last.stamp_ns, last.mean, last.A, own, last.C)
        self._ring.append(Conditional(self._stamp_ns, mean, A, b, C))
        self._stamp_ns, self._origin = next_ns, next_mean
        self.prior = Prior(predicted, symmetrise(P_next))

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the conditionals that are not needed for stamps from `stamp_ns` on."""
        del self._ring[: max(self._place(stamp_ns), 0)]

    def state_at(self, stamp_ns: int, mean: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance at `stamp_ns`, from those of the oldest node, (n,) and (n, n), given everything."""
        path = self._path(stamp_ns)[1]
        offset = mean - self._origin
        for conditional in reversed(path):
            offset = conditional.A @ offset + conditional.b
            P = propagated(conditional.A, P, conditional.C)
        return path[0].mean + offset, P

    def fuse(self, measurement: Measurement) -> EquivalentMeasurement:
        """Take a detection older than the window into the ring; gives what it says about the oldest node.

        Raises `numpy.linalg.LinAlgError` for one that cannot be fused, and stays as it was.
        """
        stamps_ns = [*(at.stamp_ns for at in self._ring), self._stamp_ns]
        near_ns = min(stamps_ns, key=lambda stamp_ns: abs(stamp_ns - measurement.stamp_ns))
        if 0 < abs(near_ns - measurement.stamp_ns) <= NEAR_NS:
            measurement = NearMeasurement.at(measurement, near_ns, self._motion)
        else:
            near_ns = measurement.stamp_ns
        if near_ns == self._stamp_ns:
            y, H, R = _weighed(measurement, self._origin)
            return EquivalentMeasurement(self._origin, H, y, R)
        before, path = self._path(near_ns)
        y, H, R = _weighed(measurement, path[0].mean)
        updated = []
        for at in path:
            K, S = kalman_gain(at.C, H, R)
            rest, through = y - H @ at.b, H @ at.A
            C = joseph(at.C, K, H, R)
            updated.append(Conditional(at.stamp_ns, at.mean, at.A - K @ through, at.b + K @ rest, C))
            y, H, R = rest, through, symmetrise(S)
        self._ring = before + updated
        return EquivalentMeasurement(self._origin, H, y, R)

    def _place(self, stamp_ns: int) -> int:
        return bisect.bisect_right(self._ring, stamp_ns, key=lambda at: at.stamp_ns) - 1

    def _path(self, stamp_ns: int) -> tuple[list[Conditional], list[Conditional]]:
        """Conditionals before and from `stamp_ns`, the second list beginning with one at that very stamp."""
        place = self._place(stamp_ns)
        left = self._ring[place]
        if left.stamp_ns == stamp_ns:
            return self._ring[:place], self._ring[place:]
        last = place + 1 == len(self._ring)
        right_ns, right = (
            (self._stamp_ns, self._origin) if last else (self._ring[place + 1].stamp_ns, self._ring[place + 1].mean)
        )
        until_s, after_s = seconds(stamp_ns - left.stamp_ns), seconds(right_ns - stamp_ns)
        inner = between(self._motion, left.mean, right, until_s, after_s)
        A = inner.Lambda @ left.A + inner.Psi
        C = propagated(inner.Lambda, left.C, inner.Sigma)
        b = inner.Lambda @ left.b
        # Given the state between them the left one no longer depends on the right one: left.A = gain A. Stamps close
        # together leave hardly a digit of the same gain as C_left Lambda' C^-1.
        gain = np.asarray(np.linalg.solve(A.T, left.A.T)).T
        spread = joseph(left.C, gain, inner.Lambda, inner.Sigma)
        outer = Conditional(left.stamp_ns, left.mean, gain, left.b - gain @ b, spread)
        return [*self._ring[:place], outer], [Conditional(stamp_ns, inner.mean, A, b, C), *self._ring[place + 1 :]]


def _weighed(term: MeasurementTerm, x: FloatArray) -> Linearised:
    """`term` near the state `x` (n,), with the weight that a robust loss leaves it there."""
    y, H, R = linearised(term, x)
    if isinstance(term, EquivalentMeasurement) or term.loss is None:
        return Linearised(y, H, R)
    distance = math.sqrt(mahalanobis_squared(y, R))
    return Linearised(y, H, R / weight(term.loss, distance))

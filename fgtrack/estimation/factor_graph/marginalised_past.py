"""What the window has marginalised: the prior of its oldest node, and a ring of conditionals for detections that are
older than the window."""

import bisect
import math
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.factor_graph.factors import weight
from fgtrack.estimation.factor_graph.terms import EquivalentMeasurement, Linearised, MeasurementTerm, linearised
from fgtrack.estimation.interpolation import between
from fgtrack.models.motion import MotionModel

#: An outlier that a loss ignores altogether still has a finite covariance.
_LEAST_WEIGHT = 1e-12


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
    """

    def __init__(self, motion: MotionModel, stamp_ns: int, prior: Prior) -> None:
        self._motion = motion
        self._ring: list[Conditional] = []
        self._stamp_ns = stamp_ns
        self._origin = prior.mean
        self.prior = prior

    def copy(self) -> "MarginalisedPast":
        """An independent copy."""
        other = MarginalisedPast(self._motion, self._stamp_ns, self.prior)
        other._ring, other._origin = list(self._ring), self._origin
        return other

    @property
    def start_ns(self) -> int:
        """Oldest stamp that `fuse` and `state_at` reach."""
        return self._ring[0].stamp_ns if self._ring else self._stamp_ns

    def pass_node(self, terms: list[MeasurementTerm], mean: FloatArray, next_ns: int, next_mean: FloatArray) -> None:
        """The oldest node leaves the window with its terms; the node at `next_ns` becomes the oldest.

        `mean` and `next_mean`, shape (n,), are the two nodes' present estimates. Raises `numpy.linalg.LinAlgError` for
        a term that cannot be fused.
        """
        filtered, P = self.prior.mean, self.prior.covariance
        for term in terms:
            y, H, R = _weighed(term, mean)
            filtered, P = _corrected(filtered, P, y - H @ (filtered - mean), H, R)
        step = self._motion.step(mean.tolist(), seconds(next_ns - self._stamp_ns))
        predicted = np.asarray(step.mean) + step.F @ (filtered - mean)
        FP = step.F @ P
        P_next = symmetrise(FP @ step.F.T + step.Q)
        A = psd_solve(P_next, FP).T
        kept = np.eye(len(mean)) - A @ step.F
        C = symmetrise(kept @ P @ kept.T + A @ step.Q @ A.T)
        b = filtered - mean + A @ (next_mean - predicted)
        if self._ring:
            left = self._ring[-1]
            self._ring[-1] = replace(left, b=left.b + left.A @ (mean - self._origin))
        self._ring.append(Conditional(self._stamp_ns, mean, A, b, C))
        self._stamp_ns, self._origin = next_ns, next_mean
        self.prior = Prior(predicted, P_next)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the conditionals that are not needed for stamps from `stamp_ns` on."""
        del self._ring[: max(self._place(stamp_ns), 0)]

    def state_at(self, stamp_ns: int, mean: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance at `stamp_ns`, from those of the oldest node, (n,) and (n, n), given everything."""
        path = self._path(stamp_ns)[1]
        offset = mean - self._origin
        for conditional in reversed(path):
            offset = conditional.A @ offset + conditional.b
            P = conditional.A @ P @ conditional.A.T + conditional.C
        return path[0].mean + offset, symmetrise(P)

    def fuse(self, measurement: Measurement) -> EquivalentMeasurement:
        """Take a detection older than the window into the ring; gives what it says about the oldest node.

        Raises `numpy.linalg.LinAlgError` for one that cannot be fused, and stays as it was.
        """
        before, path = self._path(measurement.stamp_ns)
        y, H, R = _weighed(measurement, path[0].mean)
        updated = []
        for at in path:
            S = symmetrise(H @ at.C @ H.T + R)
            b, C = _corrected(at.b, at.C, y - H @ at.b, H, R)
            A = at.A - psd_solve(S, H @ at.C).T @ (H @ at.A)
            updated.append(Conditional(at.stamp_ns, at.mean, A, b, C))
            y, H, R = y - H @ at.b, H @ at.A, S
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
        inner = between(self._motion, left.mean.tolist(), right, until_s, after_s)
        A = inner.Lambda @ left.A + inner.Psi
        C = symmetrise(inner.Lambda @ left.C @ inner.Lambda.T + inner.Sigma)
        b = inner.Lambda @ left.b
        # Given the state between them the left one no longer depends on the right one: left.A = gain A. Stamps close
        # together leave hardly a digit of the same gain as C_left Lambda' C^-1.
        gain = np.asarray(np.linalg.solve(A.T, left.A.T)).T
        kept = np.eye(len(b)) - gain @ inner.Lambda
        spread = symmetrise(kept @ left.C @ kept.T + gain @ inner.Sigma @ gain.T)
        outer = Conditional(left.stamp_ns, left.mean, gain, left.b - gain @ b, spread)
        return [*self._ring[:place], outer], [Conditional(stamp_ns, inner.mean, A, b, C), *self._ring[place + 1 :]]


def _weighed(term: MeasurementTerm, x: FloatArray) -> Linearised:
    """`term` near the state `x` (n,), with the weight that a robust loss leaves it there."""
    y, H, R = linearised(term, x)
    if isinstance(term, EquivalentMeasurement) or term.loss is None:
        return Linearised(y, H, R)
    distance = math.sqrt(y @ psd_solve(R, y))
    return Linearised(y, H, R / max(weight(term.loss, distance), _LEAST_WEIGHT))


def _corrected(
    mean: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance after the innovation y (k,) of a linear measurement; the covariance in Joseph form."""
    S = symmetrise(H @ P @ H.T + R)
    K = psd_solve(S, H @ P).T
    kept = np.eye(len(mean)) - K @ H
    return mean + K @ y, symmetrise(kept @ P @ kept.T + K @ R @ K.T)

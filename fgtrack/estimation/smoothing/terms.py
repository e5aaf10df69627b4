"""Measurements of a node of the window, linearised: its own, and the equivalent ones of older detections."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np

from fgtrack.core.linalg import congruence, inverse_root, mahalanobis_squared
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Measurement
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import penalty, weight

#: Stamps at most so far apart share a node of a factor graph: the process noise between them is all but singular.
NEAR_NS = 1_000


@dataclass(frozen=True, slots=True)
class EquivalentMeasurement:
    """A detection older than the window, as a linear measurement y = H (x - origin) + N(0, R) of its oldest node."""

    origin: FloatArray
    """Shape (n,)."""
    H: FloatArray
    """Shape (k, n)."""
    y: FloatArray
    """Shape (k,)."""
    R: FloatArray
    """Shape (k, k)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NearMeasurement(Measurement):
    """A measurement at most `NEAR_NS` from a node, fused there: of the state predicted from that of the node."""

    motion: MotionModel
    ahead_s: float
    """From the node's stamp to its own; the process noise of this time is neglected."""

    @classmethod
    def at(cls, measurement: Measurement, node_ns: int, motion: MotionModel) -> Self:
        """Return `measurement` as one of the node at `node_ns`."""
        own = {each.name: getattr(measurement, each.name) for each in fields(Measurement)}
        return cls(**own, motion=motion, ahead_s=seconds(measurement.stamp_ns - node_ns))


MeasurementTerm = Measurement | EquivalentMeasurement


def is_nonlinear(term: MeasurementTerm) -> bool:
    """True if `term` has to be linearised, or weighted, at the state of its node."""
    return isinstance(term, Measurement) and (term.loss is not None or not term.model.linear)


def linearised(term: MeasurementTerm, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return y, H and R of y = H (x' - x) + N(0, R) near the state `x`, shape (n,)."""
    if isinstance(term, EquivalentMeasurement):
        return term.y - term.H @ (x - term.origin), term.H, term.R
    if isinstance(term, NearMeasurement):
        ahead, F = term.motion.predict(x, term.ahead_s), term.motion.jacobian(x, term.ahead_s)
        y, H = term.model.linearised(term.z, ahead, term.pose)
        return y, H @ F, term.R
    return *term.model.linearised(term.z, x, term.pose), term.R


def whitened(term: MeasurementTerm, x: FloatArray) -> FloatArray:
    """Linearise `term` at `x` (n,), weighted by its loss there: rows [G | y] of y = G (x - x0) + N(0, I), (k, n + 1).

    Raises `numpy.linalg.LinAlgError` for an R that is not positive definite.
    """
    y, H, R = linearised(term, x)
    rows = inverse_root(R) @ np.column_stack([H, y])
    if isinstance(term, Measurement) and term.loss is not None:
        rows *= math.sqrt(weight(term.loss, float(np.linalg.norm(rows[:, -1]))))
    return np.asarray(rows)


def cost(term: MeasurementTerm, x: FloatArray) -> float:
    """Half of the squared Mahalanobis distance of `term` from the state `x` (n,), or its robust loss there.

    Raises `numpy.linalg.LinAlgError` for a singular covariance.
    """
    y, _, R = linearised(term, x)
    distance = math.sqrt(mahalanobis_squared(y, R))
    return penalty(term.loss if isinstance(term, Measurement) else None, distance)


def overshot(terms: Iterable[MeasurementTerm], origin: FloatArray, mean: FloatArray) -> bool:
    """True if the step from the linearisation point `origin` to `mean`, both (n,), left the linear range of a term.

    There the linearisation predicts a measurement wrong by more than a standard deviation.
    """
    for term in terms:
        if isinstance(term, Measurement) and not term.model.linear:
            y, H, R = linearised(term, origin)
            error = term.model.residual(linearised(term, mean)[0], y - H @ (mean - origin))
            if mahalanobis_squared(error, R) > 1.0:
                return True
    return False


class Innovations(NamedTuple):
    """Innovations of m measurements at as many states."""

    y: FloatArray
    """Shape (m, k)."""
    H: FloatArray
    """Shape (m, k, n)."""
    R: FloatArray
    """Shape (m, k, k)."""
    S: FloatArray
    """Covariances, shape (m, k, k)."""
    nis: FloatArray
    """Shape (m,); NaN if it cannot be computed."""

    def at(self, rows: IntArray) -> "Innovations":
        """Return those of some of the measurements."""
        return Innovations(self.y[rows], self.H[rows], self.R[rows], self.S[rows], self.nis[rows])

    @classmethod
    def of(cls, stack: Measurement, means: FloatArray, covariances: FloatArray) -> "Innovations":
        """Return those of a stack of measurements at the states (m, n), (m, n, n)."""
        y, H = stack.model.linearised(stack.z, means, stack.pose)
        S = congruence(H, covariances) + stack.R
        H = np.broadcast_to(H, (*y.shape, means.shape[1])).copy()
        return cls(y, H, stack.R, S, _nis(y, S, stack.measured))


def _nis(y: FloatArray, S: FloatArray, entries: Sequence[int] | None) -> FloatArray:
    try:
        return mahalanobis_squared(y, S, entries)
    except np.linalg.LinAlgError:
        if len(y) == 1:
            return np.array([np.nan])
        return np.concatenate([_nis(y[k : k + 1], S[k : k + 1], entries) for k in range(len(y))])

"""Measurements of a node of the window, linearised: its own, and the equivalent ones of older detections."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np

from fgtrack.core.linalg import congruence, equal_ones, inverse_roots, mahalanobis_squared
from fgtrack.core.time import seconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import Measurement, UpdateResult, UpdateStatus
from fgtrack.estimation.filters import ekf
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


class Linearised(NamedTuple):
    """y = H (x - x0) + N(0, R) near the state x0."""

    y: FloatArray
    H: FloatArray
    R: FloatArray


def linearised(term: MeasurementTerm, x: FloatArray) -> Linearised:
    """Linearise `term` at the state `x`, shape (n,)."""
    if isinstance(term, EquivalentMeasurement):
        return Linearised(term.y - term.H @ (x - term.origin), term.H, term.R)
    if isinstance(term, NearMeasurement):
        ahead, F = term.motion.predict(x, term.ahead_s), term.motion.jacobian(x, term.ahead_s)
        y, H = ekf.linearised(term.z, ahead, term.model, term.pose)
        return Linearised(y, H @ F, term.R)
    return Linearised(*ekf.linearised(term.z, x, term.model, term.pose), term.R)


def whitened(term: MeasurementTerm, x: FloatArray) -> FloatArray:
    """Linearise `term` at `x` (n,), weighted by its loss there: rows [G | y] of y = G (x - x0) + N(0, I), (k, n + 1).

    Raises `numpy.linalg.LinAlgError` for an R that is not positive definite.
    """
    y, H, R = linearised(term, x)
    rows = inverse_roots(R) @ np.column_stack([H, y])
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
            error = term.model.residual(linearised(term, mean).y, y - H @ (mean - origin))
            if mahalanobis_squared(error, R) > 1.0:
                return True
    return False


class Innovations(NamedTuple):
    """Innovations of m measurements at as many states; k is the largest number of components."""

    size: IntArray
    """Number of components of each, shape (m,); the others are 0, with variance 1."""
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

    def at(self, rows: BoolArray) -> "Innovations":
        """Return those of some of the measurements."""
        if rows.all():
            return self
        size, *arrays = self
        return Innovations(size[rows], *(values[rows] for values in arrays))

    def result(self, row: int, status: UpdateStatus) -> UpdateResult:
        """Return the outcome of the measurement of `row`."""
        size = self.size[row]
        return UpdateResult(status, self.y[row, :size], float(self.nis[row]), self.S[row, :size, :size])

    @classmethod
    def of(cls, measurements: Sequence[Measurement], means: FloatArray, covariances: FloatArray) -> "Innovations":
        """Return those of `measurements` at the states (m, n), (m, n, n)."""
        alike = equal_ones([(id(each.model), id(each.pose), each.assumed, each.loss) for each in measurements])
        if len(alike) == 1:
            return cls._alike(measurements, means, covariances)
        m, n, k = *means.shape, max(len(each.z) for each in measurements)
        unit = np.broadcast_to(np.eye(k), (m, k, k))
        every = cls(np.empty(m, np.int64), np.zeros((m, k)), np.zeros((m, k, n)), unit.copy(), unit.copy(), np.empty(m))
        for positions in alike:
            part = cls._alike(
                [measurements[position] for position in positions], means[positions], covariances[positions]
            )
            used = part.y.shape[1]
            every.size[positions], every.nis[positions] = part.size, part.nis
            every.y[positions, :used], every.H[positions, :used] = part.y, part.H
            every.R[positions, :used, :used], every.S[positions, :used, :used] = part.R, part.S
        return every

    @classmethod
    def _alike(cls, measurements: Sequence[Measurement], means: FloatArray, covariances: FloatArray) -> "Innovations":
        """Return those of measurements with one model, sensor pose and loss."""
        first = measurements[0]
        z, R = np.array([each.z for each in measurements]), np.array([each.R for each in measurements])
        y, H = ekf.linearised(z, means, first.model, first.pose)
        S = congruence(H, covariances) + R
        H = np.broadcast_to(H, (*y.shape, means.shape[1])).copy()
        return cls(np.full(len(y), y.shape[1]), y, H, R, S, _nis(y, S, first.measured))


def _nis(y: FloatArray, S: FloatArray, entries: Sequence[int] | None) -> FloatArray:
    try:
        return mahalanobis_squared(y, S, entries)
    except np.linalg.LinAlgError:
        if len(y) == 1:
            return np.array([np.nan])
        return np.concatenate([_nis(y[k : k + 1], S[k : k + 1], entries) for k in range(len(y))])

"""Measurement terms of a node of the window: its own measurements, and the equivalent ones of older detections."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

from fgtrack.core.linalg import mahalanobis_squared
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation import ekf
from fgtrack.estimation.base import Measurement
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import penalty

#: Stamps at most so far apart share a node of the graph: the process noise between them would be all but singular.
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
    """A measurement so close to a node that it counts there: of the state that follows from that of the node."""

    motion: MotionModel
    ahead_s: float
    """From the node's stamp to its own; at most `NEAR_NS`, in which next to no process noise gathers."""

    @classmethod
    def at(cls, measurement: Measurement, node_ns: int, motion: MotionModel) -> Self:
        """`measurement` as one of the node at `node_ns`."""
        own = {each.name: getattr(measurement, each.name) for each in fields(Measurement)}
        return cls(**own, motion=motion, ahead_s=seconds(measurement.stamp_ns - node_ns))


MeasurementTerm = Measurement | EquivalentMeasurement


def curved(term: MeasurementTerm) -> bool:
    """Whether `term` has to be linearised, or weighted, at the state of its node."""
    return isinstance(term, Measurement) and (term.loss is not None or not term.model.linear)


class Linearised(NamedTuple):
    """y = H (x - x0) + N(0, R) near the state x0."""

    y: FloatArray
    H: FloatArray
    R: FloatArray


def linearised(term: MeasurementTerm, x: FloatArray) -> Linearised:
    """`term` near the state `x`, shape (n,)."""
    if isinstance(term, EquivalentMeasurement):
        return Linearised(term.y - term.H @ (x - term.origin), term.H, term.R)
    if isinstance(term, NearMeasurement):
        there, F = term.motion.predict(x, term.ahead_s), term.motion.jacobian(x, term.ahead_s)
        y, H = ekf.linearised(term.z, there, term.model, term.pose)
        return Linearised(y, H @ F, term.R)
    return Linearised(*ekf.linearised(term.z, x, term.model, term.pose), term.R)


def cost(term: MeasurementTerm, x: FloatArray) -> float:
    """Half of the squared Mahalanobis distance of `term` from the state `x` (n,), or its loss there.

    Raises `numpy.linalg.LinAlgError` for a singular covariance.
    """
    y, _, R = linearised(term, x)
    distance = math.sqrt(mahalanobis_squared(y, R))
    return penalty(term.loss if isinstance(term, Measurement) else None, distance)


def overshot(terms: Iterable[MeasurementTerm], origin: FloatArray, mean: FloatArray) -> bool:
    """Whether the step from the linearisation point `origin` to `mean`, both (n,), left the linear range of a term.

    It did where the linearisation mistakes a measurement by more than a standard deviation.
    """
    for term in terms:
        if isinstance(term, Measurement) and not term.model.linear:
            y, H, R = linearised(term, origin)
            missed = term.model.residual(linearised(term, mean).y, y - H @ (mean - origin))
            if mahalanobis_squared(missed, R) > 1.0:
                return True
    return False

"""Measurement terms of a node of the window: its own measurements, and the equivalent ones of older detections."""

from dataclasses import dataclass
from typing import NamedTuple

from fgtrack.core.types import FloatArray
from fgtrack.estimation import ekf
from fgtrack.estimation.base import Measurement


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
    return Linearised(*ekf.linearised(term.z, x, term.model, term.pose), term.R)

"""What a node of the window knows besides its neighbours: measurements, and what older detections say about it."""

from dataclasses import dataclass
from typing import NamedTuple

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement


@dataclass(frozen=True, slots=True)
class Equivalent:
    """A detection older than the window, as a linear measurement y = H (x - origin) + N(0, R) of its oldest node."""

    origin: FloatArray
    """Shape (n,)."""
    H: FloatArray
    """Shape (k, n)."""
    y: FloatArray
    """Shape (k,)."""
    R: FloatArray
    """Shape (k, k)."""


Evidence = Measurement | Equivalent


class Linearised(NamedTuple):
    """y = H (x - x0) + N(0, R) near the state x0."""

    y: FloatArray
    H: FloatArray
    R: FloatArray


def linearised(evidence: Evidence, x: FloatArray) -> Linearised:
    """`evidence` near the state `x`, shape (n,)."""
    if isinstance(evidence, Equivalent):
        return Linearised(evidence.y - evidence.H @ (x - evidence.origin), evidence.H, evidence.R)
    model = evidence.model
    y = model.residual(evidence.z, model.predict(x, evidence.pose))
    H = model.selection(len(x)) if model.linear else model.jacobian(x, evidence.pose)
    return Linearised(y, H, evidence.R)

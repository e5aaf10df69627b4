"""What was measured of one object, with the noise of each measurement in parts: what is sought, and what is not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start


@dataclass(frozen=True, slots=True)
class Observation:
    """One measurement of a sensor; the covariance of its error is T diag(std^2) T' + `own` + `foreign`.

    The first d components are measured. Those that follow are assumed, as a heading from a map: they move the state as
    in the tracker, but they are no measurements, have no part in the likelihood and keep their noise.
    """

    sensor: str
    measurement: Measurement
    measured: tuple[int, ...]
    """Places of the d components that were measured."""
    assumed: tuple[int, ...]
    """Places of the others."""
    axes: FloatArray
    """T, shape (d, d): the axes of the sensor's standard deviations, seen from those of the measurement."""
    own: FloatArray
    """Covariance that the detection came with, shape (d, d); 0 where the standard deviations hold."""
    foreign: FloatArray
    """Covariance of errors that are not the sensor's, as those of the ego pose, shape (d, d)."""

    @property
    def tuned(self) -> bool:
        """Whether the standard deviations of the sensor hold for it."""
        return not self.own.any()


@dataclass(frozen=True, slots=True)
class Series:
    """The observations of one track by rising stamp, and the first state."""

    start: Start
    observations: Sequence[Observation]
    from_ns: int | None = None
    """Innovations before this stamp have no part in the likelihood; None for no limit."""
    until_ns: int | None = None
    """Nor have those from this stamp on."""


def positive_part(matrix: FloatArray) -> FloatArray:
    """The nearest positive semidefinite matrix to a symmetric `matrix`, shape (k, k)."""
    values, vectors = np.linalg.eigh(symmetrise(matrix))
    return symmetrise(congruence(vectors, np.diag(np.maximum(values, 0.0))))

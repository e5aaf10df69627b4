"""Measurements as rows y = G (x - x0) + N(0, I) at the linearisation point x0 of their node."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.grouping import equal_ones
from fgtrack.core.linalg import congruence, inverse_roots, mahalanobis_squared, product
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation import ekf
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.terms import MeasurementTerm, linearised
from fgtrack.models.robust import weight


class Innovations(NamedTuple):
    """Measurements alike, relative to the states of their tracks."""

    positions: IntArray
    """Which of the measurements these are, shape (m,)."""
    y: FloatArray
    """Shape (m, k)."""
    H: FloatArray
    """Shape (m, k, n)."""
    R: FloatArray
    """Shape (m, k, k)."""
    nis: FloatArray
    """Shape (m,); NaN where it cannot be computed."""

    def at(self, chosen: BoolArray) -> "Innovations":
        """Those that are `chosen`, shape (m,)."""
        if chosen.all():
            return self
        return Innovations(self.positions[chosen], self.y[chosen], self.H[chosen], self.R[chosen], self.nis[chosen])

    def numbered(self, positions: IntArray) -> "Innovations":
        """With their places among `positions`, ascending, instead of their positions."""
        return self._replace(positions=np.searchsorted(positions, self.positions))


def innovations(
    measurements: Sequence[Measurement], means: FloatArray, covariances: FloatArray
) -> Iterator[Innovations]:
    """Innovations of m measurements at as many states (m, n), (m, n, n), in groups that are measured alike."""
    for positions in _alike(measurements):
        one = measurements[positions[0]]
        z = np.array([measurements[position].z for position in positions])
        R = np.array([measurements[position].R for position in positions])
        rows = np.array(positions)
        y, H = ekf.linearised(z, means[rows], one.model, one.pose)
        S = congruence(H, covariances[rows]) + R
        H = np.broadcast_to(H, (len(rows), *H.shape[-2:]))
        yield Innovations(rows, y, H, R, _nis(y, S, one.measured))


def _nis(y: FloatArray, S: FloatArray, entries: Sequence[int] | None) -> FloatArray:
    try:
        return mahalanobis_squared(y, S, entries)
    except np.linalg.LinAlgError:
        if len(y) == 1:
            return np.array([np.nan])
        return np.concatenate([_nis(y[k : k + 1], S[k : k + 1], entries) for k in range(len(y))])


def _alike(measurements: Sequence[Measurement]) -> list[list[int]]:
    """Positions of those that share a model, a sensor pose, what is assumed and a loss."""
    return equal_ones([(id(one.model), id(one.pose), one.assumed, one.loss) for one in measurements])


def whitened(y: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """R^(-1/2) [H | y], shape (..., k, n + 1).

    Raises `numpy.linalg.LinAlgError` for a covariance R that is not positive definite.
    """
    alike = R.ndim == 3 and len(R) > 0 and bool((R[:1] == R).all())
    return product(inverse_roots(R[0] if alike else R), np.concatenate([H, y[..., None]], axis=-1))


def whitened_term(term: MeasurementTerm, x: FloatArray) -> FloatArray:
    """`term` linearised at `x` (n,), weighted by its loss there: [G | y], shape (k, n + 1). Raises as `whitened`."""
    rows = whitened(*linearised(term, x))
    if isinstance(term, Measurement) and term.loss is not None:
        y = rows[:, -1]
        rows *= np.sqrt(weight(term.loss, float(np.sqrt(y @ y))))
    return rows

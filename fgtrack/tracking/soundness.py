"""Faults of states that no object can have, and of tracks that their measurements contradict."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.special import chdtri

from fgtrack.core.linalg import kernels
from fgtrack.core.types import BoolArray, FloatArray, TrackState
from fgtrack.estimation.base import Measurement, UpdateResult
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.present import PresentStates

__all__ = ["IN_A_ROW", "RARE", "Divergence", "are_finite", "check_real", "faults"]

_MOST = np.array([1e9, 1e9, 1e3, 1e5, 1e4, 1e6])
"""Largest x, y, yaw, speed, yaw rate and acceleration, in SI units: far beyond any vehicle on Earth."""
_ROUNDING = 1e-9
"""Tolerance of an eigenvalue of a correlation matrix below 0: rounding, where an entry is known for certain."""
_FAULTS = Failure.NOT_FINITE, Failure.OUT_OF_BOUNDS, Failure.NOT_DEFINITE
"""By the codes of the compiled loop."""

IN_A_ROW, RARE = 8, 1e-4
"""A track has diverged when so many measurements in a row have a NIS that is rarer than this."""


def check_real(*arrays: FloatArray) -> None:
    """Raise `TypeError` where one of them does not hold real numbers."""
    for array in arrays:
        if array.dtype.kind not in "fiu":
            raise TypeError(f"states must be real numbers, are of type {array.dtype}")


def are_finite(means: FloatArray, covariances: FloatArray) -> BoolArray:
    """True where a state is, of means (m, n) and covariances (m, n, n); shape (m,)."""
    return np.asarray(np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))


def faults(states: Sequence[TrackState]) -> dict[int, Failure]:
    """Return what is wrong with kinematic states, by their index; nothing where all can be published.

    A state is sound where it is finite, no entry is larger than any vehicle's (10^9 m, 10^5 m/s, 10^4 rad/s,
    10^6 m/s^2), and its covariance is symmetric and positive definite: up to rounding, as an entry that the motion
    model does not have is 0 with variance 0. Raises `TypeError` for what is not a real number, `ValueError` for
    wrong shapes.
    """
    if not states:
        return {}
    if isinstance(states, PresentStates):
        means, covariances = states.means, states.covariances
    else:
        means = np.array([state.mean for state in states])
        covariances = np.array([state.covariance for state in states])
    check_real(means, covariances)
    n = means.shape[1]
    if not 5 <= n <= len(_MOST) or covariances.shape[1:] != (n, n):
        raise ValueError(f"states have the shapes {means.shape} and {covariances.shape}")
    arrays = (np.array(array, dtype=np.float64, order="C") for array in (means, covariances))
    codes = kernels("fgtrack.tracking.kernels").faults(*arrays, _MOST, _ROUNDING).tolist()
    return {row: _FAULTS[code - 1] for row, code in enumerate(codes) if code} if any(codes) else {}


@cache
def _limit(dof: int) -> float:
    return float(chdtri(dof, RARE))


class Divergence:
    """Counts how often a track diverges: `IN_A_ROW` measurements have a NIS that only the share `RARE` should have.

    With a noise that fits, this happens by chance once in 10^32 measurements; where the errors of positions are three
    times as large as the noise says, once in some 5000. A NIS is judged by the chi-square distribution of what was
    measured; measurements count in the order of their arrival, whatever their sensors. A track diverges again only
    after a measurement that fits.
    """

    def __init__(self) -> None:
        self._surprises: dict[int, int] = {}  # by track: how many in a row

    def count(
        self, track_ids: Sequence[int], measurements: Sequence[Measurement], results: Sequence[UpdateResult]
    ) -> int:
        """Return the number of tracks that diverge with these updates."""
        least, surprises, diverged = _limit(1), self._surprises, 0
        for track_id, measurement, result in zip(track_ids, measurements, results, strict=True):
            nis = result.nis
            if nis is None:
                continue
            if nis <= least or nis <= _limit(len(measurement.z) - len(measurement.assumed)):
                if surprises:
                    surprises.pop(track_id, None)
                continue
            surprises[track_id] = surprises.get(track_id, 0) + 1
            diverged += surprises[track_id] == IN_A_ROW
        return diverged

    def forget(self, track_id: int) -> None:
        """Forget a track that has ended."""
        self._surprises.pop(track_id, None)

"""One object that starts somewhere and is seen, and what one linear sighting makes of a state."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg
from support.oracle.dynamics import Dynamics, FloatArray
from support.oracle.sightings import Sighting

NS_PER_S = 1e9


class Estimate(NamedTuple):
    """Mean (n,) and covariance (n, n) of a state."""

    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Problem:
    """An object that starts as `start` at `start_ns` and is seen at or after that."""

    dynamics: Dynamics
    start_ns: int
    start: Estimate
    sightings: tuple[Sighting, ...]

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the start and of the sightings, each once, in order."""
        return sorted({self.start_ns, *(one.stamp_ns for one in self.sightings)})

    @property
    def durations_s(self) -> FloatArray:
        """Between the stamps, shape (N - 1,)."""
        return np.asarray(np.diff(np.array(self.stamps_ns)) / NS_PER_S)


def conditioned(P: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gain K (n, k) of H x + N(0, R) on x of covariance P (n, n), and the covariance that it leaves."""
    K = linalg.solve(H @ P @ H.T + R, H @ P, assume_a="pos").T
    A = np.eye(len(P)) - K @ H
    return K, A @ P @ A.T + K @ R @ K.T


def whitening(covariance: FloatArray) -> FloatArray:
    """W with W' W the inverse of `covariance`."""
    return np.asarray(
        linalg.solve_triangular(linalg.cholesky(covariance, lower=True), np.eye(len(covariance)), lower=True)
    )

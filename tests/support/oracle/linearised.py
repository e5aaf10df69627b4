"""What is affine in place of what is not: tangents at a mean, or averages over a spread."""

from typing import NamedTuple, Protocol

import numpy as np
from support.oracle.dynamics import Dynamics, FloatArray, Flow
from support.oracle.sightings import Sighting


class Seen(NamedTuple):
    """A whitened residual y - H (x - mean) + N(0, I + noise) of the states x about a mean."""

    y: FloatArray
    """Shape (k,)."""
    H: FloatArray
    """Shape (k, n)."""
    noise: FloatArray
    """What the affine form does not say, shape (k, k)."""


class Linearisation(Protocol):
    """How motion and sightings become affine about Gaussians."""

    def carried(self, dynamics: Dynamics, means: FloatArray, covariances: FloatArray, t: FloatArray) -> Flow:
        """Motion of the states N(mean, covariance), (m, n) and (m, n, n), over `t` (m,)."""

    def seen(self, one: Sighting, names: tuple[str, ...], mean: FloatArray, covariance: FloatArray) -> Seen:
        """A sighting of the state N(mean, covariance), (n,) and (n, n)."""


class Tangents:
    """First derivatives at the mean."""

    def carried(self, dynamics: Dynamics, means: FloatArray, covariances: FloatArray, t: FloatArray) -> Flow:
        """See `Linearisation`."""
        return dynamics.flow(means, t)

    def seen(self, one: Sighting, names: tuple[str, ...], mean: FloatArray, covariance: FloatArray) -> Seen:
        """See `Linearisation`."""
        return Seen(one.residual(mean, names), one.slope(mean, names), np.zeros((len(one.z), len(one.z))))


class Averages:
    """Least mean squares over the points of the cubature rule of third degree, mean +- sqrt(n) columns of the root.

    Process noise is that at the mean.
    """

    def carried(self, dynamics: Dynamics, means: FloatArray, covariances: FloatArray, t: FloatArray) -> Flow:
        """See `Linearisation`."""
        points = np.array([_points(*one) for one in zip(means, covariances, strict=True)])
        many = points.shape[1]
        ends = dynamics.ends(points.reshape(-1, means.shape[1]), np.repeat(t, many)).reshape(points.shape)
        Q = dynamics.flow(means, t).Q
        parts = [_fitted(*one) for one in zip(points, ends, covariances, strict=True)]
        found, slopes, noise = (np.array(part) for part in zip(*parts, strict=True))
        return Flow(found, slopes, Q + noise)

    def seen(self, one: Sighting, names: tuple[str, ...], mean: FloatArray, covariance: FloatArray) -> Seen:
        """See `Linearisation`."""
        points = _points(mean, covariance)
        y, slope, noise = _fitted(points, np.array([one.residual(point, names) for point in points]), covariance)
        return Seen(y, -slope, noise)


TANGENTS, AVERAGES = Tangents(), Averages()


def _points(mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Shape (2 n, n)."""
    offsets = np.sqrt(len(mean)) * np.linalg.cholesky(covariance).T
    return np.concatenate([mean + offsets, mean - offsets])


def _fitted(points: FloatArray, values: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Average (k,) of `values` (2 n, k) at `points`, slope (k, n) of the best affine map, covariance (k, k) left."""
    mean = values.mean(axis=0)
    off, apart = values - mean, points - points.mean(axis=0)
    slope = np.linalg.solve(P, apart.T @ off / len(points)).T
    left = off - apart @ slope.T
    return mean, slope, left.T @ left / len(points)

"""Generalised least squares over the paths of objects: a Kalman filter eliminates every path.

An object moves at constant velocity with white acceleration. Its detections y = H x + e
are in the map for the assumed parameters. Other parameters add A d to y. Let v be the
innovations of y, and V those of the columns of A, with the same gains. Then the
parameters minimise sum (v + V d)' S^-1 (v + V d). No path is a parameter, so the paths
may be any (Anderson and Moore, Optimal Filtering, 1979, chapter 5).

The covariance of a detection has the axes of the predicted sight. With the measured
sight, the weights would depend on the errors, and ranges would be biased by their
variance over the range.

All objects are cut into stretches of time. A stretch is filtered by itself, from an
unknown state. So the stretches are independent, and all are filtered at once.
"""

from typing import NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray

__all__ = ["Fit", "Rows", "filtered"]

#: Density of the white acceleration of objects, [m^2/s^3].
_DENSITY = 1.0
_UNKNOWN_MPS = 1000.0
#: Innovations beyond this number of standard deviations count less (Huber).
_HUBER = 2.5
#: Detections with a larger NIS, 99.9 % of chi-square, hardly count: clutter, or another object.
_OUTLIER_NIS = 13.8
_OUTLIER_WEIGHT = 0.03
#: Standard deviations of the velocity of an object that stands still, and its density.
_STILL_MPS = 0.05
_STILL_DENSITY = 1e-4


class Rows(NamedTuple):
    """Detections of all objects, in the order of object, stretch and stamp."""

    runs: IntArray
    """Number of the run, shape (n,): the detections of one object in one stretch."""
    times_s: FloatArray
    """Stamps, shape (n,)."""
    y_m: FloatArray
    """Positions in the map, shape (n, 2)."""
    A: FloatArray
    """Derivatives of the positions by the parameters, shape (n, 2, k)."""
    origins_m: FloatArray
    """Positions of the sensors in the map, shape (n, 2)."""
    noise: FloatArray
    """a and b of the standard deviation sqrt(a^2 + (b range)^2), along and across the sight, shape (n, 2, 2)."""
    still: BoolArray
    """Mask of the detections of objects that stand still, shape (n,)."""


class Fit(NamedTuple):
    """Normal equations of each run, and the innovations."""

    H: FloatArray
    """Information matrices of the runs, shape (m, k, k)."""
    g: FloatArray
    """Gradients of the runs, shape (m, k): the solution d minimises g'd + d'H d / 2."""
    nis: FloatArray
    """Normalised innovation squared of each detection, shape (n,); NaN for the first of a run."""
    velocities_mps: FloatArray
    """Velocity at the end of each run, shape (m, 2)."""


def filtered(rows: Rows) -> Fit:
    """Filter all runs, and return their normal equations at the parameters of `rows`."""
    size = rows.A.shape[2]
    starts = np.flatnonzero(np.diff(rows.runs, prepend=-1))
    lengths = np.diff(starts, append=len(rows.runs))
    order = np.argsort(-lengths, kind="stable")  # active runs are a prefix
    starts = starts[order]
    lengths = lengths[order]
    count = len(starts)
    Y = np.concatenate([rows.y_m[:, :, None], rows.A], axis=2)
    X = np.zeros((count, 4, 1 + size))
    P = np.zeros((count, 4, 4))
    X[:, :2] = Y[starts]
    P[:, :2, :2] = _covariances(rows, starts, rows.y_m[starts])
    still = rows.still[starts]
    P[:, 2, 2] = P[:, 3, 3] = np.where(still, _STILL_MPS, _UNKNOWN_MPS) ** 2
    density = np.where(still, _STILL_DENSITY, _DENSITY)
    H = np.zeros((count, size, size))
    g = np.zeros((count, size))
    nis = np.full(len(rows.runs), np.nan)
    ascending = lengths[::-1]
    for step in range(1, int(lengths.max(initial=0))):
        active = count - int(np.searchsorted(ascending, step, side="right"))
        at = starts[:active] + step
        x = X[:active]
        p = P[:active]
        _predict(x, p, rows.times_s[at] - rows.times_s[at - 1], density[:active])
        V = Y[at] - x[:, :2]
        R = _covariances(rows, at, x[:, :2, 0])
        W = _inverse(p[:, :2, :2] + R)
        v = V[:, :, 0]
        nis[at] = np.einsum("ni,nij,nj->n", v, W, v)
        weights = np.minimum(1.0, _HUBER / np.sqrt(np.maximum(nis[at], 1e-12)))
        weights[nis[at] > _OUTLIER_NIS] = _OUTLIER_WEIGHT
        # The smaller weight of an outlier is a larger R, of which the filter learns less too.
        W = _inverse(p[:, :2, :2] + R / weights[:, None, None] ** 2)
        WV = W @ V
        H[:active] += V[:, :, 1:].mT @ WV[:, :, 1:]
        g[:active] += np.einsum("nik,ni->nk", V[:, :, 1:], WV[:, :, 0])
        K = p[:, :, :2] @ W
        x += K @ V
        p -= K @ p[:, :2]
    back = np.argsort(order, kind="stable")
    return Fit(H[back], g[back], nis, X[back, 2:, 0])


def _covariances(rows: Rows, at: IntArray, seen_m: FloatArray) -> FloatArray:
    """Return the covariances of the detections `at`, shape (m, 2, 2); `seen_m` (m, 2) are positions of objects."""
    sight_m = seen_m - rows.origins_m[at]
    square_m2 = np.square(sight_m).sum(axis=1)
    noise = np.square(rows.noise[at])
    along, across = (noise[:, :, 0] + noise[:, :, 1] * square_m2[:, None]).T
    outer = sight_m[:, :, None] * sight_m[:, None, :]
    scale = (along - across) / np.maximum(square_m2, 1e-12)
    return np.asarray(across[:, None, None] * np.eye(2) + scale[:, None, None] * outer)


def _predict(
    x: FloatArray, p: FloatArray, dt_s: FloatArray, density: FloatArray
) -> None:
    """Predict the states `x` (m, 4, k) and covariances `p` (m, 4, 4) in `dt_s` (m,), in the same arrays."""
    dt = dt_s[:, None, None]
    x[:, :2] += dt * x[:, 2:]
    p[:, :2] += dt * p[:, 2:]
    p[:, :, :2] += dt * p[:, :, 2:]
    q = (density * dt_s)[:, None, None] * np.eye(2)
    p[:, :2, :2] += q * dt**2 / 3.0
    p[:, :2, 2:] += q * dt / 2.0
    p[:, 2:, :2] += q * dt / 2.0
    p[:, 2:, 2:] += q


def _inverse(S: FloatArray) -> FloatArray:
    """Return the inverse of symmetric matrices, shape (m, 2, 2), in closed form."""
    a = S[:, 0, 0]
    b = S[:, 0, 1]
    d = S[:, 1, 1]
    result = np.empty_like(S)
    result[:, 0, 0] = d
    result[:, 1, 1] = a
    result[:, 0, 1] = result[:, 1, 0] = -b
    return np.asarray(result / (a * d - b * b)[:, None, None])

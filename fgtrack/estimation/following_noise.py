"""A segment's process noise as a function of the state that it starts from: -log p(right | left) in full.

-2 log p = e' Q(left)^-1 e + log det Q(left) + constant, e = right - f(left), is written as a sum of squares, so that a
solver of least squares finds its minimum: those of W e with W' W = Q^-1, and s^2 = c + log det Q.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from fgtrack.core.types import FloatArray
from fgtrack.models.motion import MotionModel

#: s at the linearisation point. Least squares take s^2 to have the curvature of g g' / (2 s^2), g the gradient of
#: log det Q, which is not its own; the larger s, the less.
_LEVEL = 30.0
_STEP = 1e-4


class SegmentRows(NamedTuple):
    """Whitened rows near the states left and right: value + by_left (left' - left) + by_right (right' - right)."""

    value: FloatArray
    """W e and s, shape (n + 1,)."""
    by_left: FloatArray
    """Shape (n + 1, n)."""
    by_right: FloatArray
    """Shape (n + 1, n)."""
    root: FloatArray
    """Lower Cholesky factor of Q, shape (n, n)."""


def log_determinant(motion: MotionModel, x: FloatArray, dt_s: float) -> float:
    """log det Q of a segment of `dt_s` from `x`, shape (n,)."""
    return 2.0 * float(np.log(np.diag(_root(motion.step(x.tolist(), dt_s).Q))).sum())


def segment_rows(motion: MotionModel, left: FloatArray, right: FloatArray, dt_s: float, level: float) -> SegmentRows:
    """The rows of a segment at `left` and `right`, shape (n,); s^2 = `_LEVEL`^2 + log det Q - `level`.

    With M = W dQ W' and Phi(M) its lower triangle with half of the diagonal, d(W e) = W de - Phi(M) W e and
    d(log det Q) = trace M (Murray 2016, Differentiation of the Cholesky decomposition, eq. 10). Motion does not depend
    on the position, nor does Q; its derivatives by the other entries are difference quotients. Raises
    `numpy.linalg.LinAlgError` where Q is not positive definite, or so much smaller that s^2 is negative.
    """
    n = motion.dim
    step = motion.step(left.tolist(), dt_s)
    L = _root(step.Q)
    W = np.asarray(dtrtri(L, lower=1)[0])
    value, by_left, by_right = np.empty(n + 1), np.zeros((n + 1, n)), np.zeros((n + 1, n))
    value[:n] = W @ (right - np.asarray(step.mean))
    square = _LEVEL * _LEVEL + 2.0 * float(np.log(np.diag(L)).sum()) - level
    if not square > 0.0:
        raise np.linalg.LinAlgError("the process noise has shrunk to nothing")
    value[n] = np.sqrt(square)
    by_left[:n], by_right[:n] = -W @ step.F, W
    for k in range(2, n):
        M = W @ _slope(motion, left, k, dt_s) @ W.T
        by_left[:n, k] -= np.tril(M, -1) @ value[:n] + 0.5 * np.diag(M) * value[:n]
        by_left[n, k] = 0.5 * np.trace(M) / value[n]
    return SegmentRows(value, by_left, by_right, L)


def _slope(motion: MotionModel, x: FloatArray, k: int, dt_s: float) -> FloatArray:
    """Derivative of Q by entry `k` of `x`."""
    before, after = x.tolist(), x.tolist()
    before[k] -= _STEP
    after[k] += _STEP
    return (motion.step(after, dt_s).Q - motion.step(before, dt_s).Q) / (2.0 * _STEP)


def _root(Q: FloatArray) -> FloatArray:
    root, info = dpotrf(Q, lower=1, clean=1)
    if info:
        raise np.linalg.LinAlgError("a process noise is not positive definite")
    return np.asarray(root)

"""The Kalman filter on stacks of independent states."""

import numpy as np

from fgtrack.core.compiled import add_congruence, copy, inlined, njit, product, solve
from fgtrack.core.types import BoolArray, FloatArray, IntArray

_VECTORS, _MATRICES = "float64[:, ::1]", "float64[:, :, ::1]"


@inlined
def innovate(
    P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, measured: IntArray, S: FloatArray, HP: FloatArray
) -> float:
    """Write S = H P H' + R and S^-1 H P, and return the NIS of the entries `measured`; NaN where S has no root."""
    k, nis = len(y), 0.0
    copy(R, S)
    add_congruence(H, P, HP, S)
    for whole in range(2):
        d, n = (k, len(P)) if whole else (len(measured), 1)
        factor, columns = np.empty((d, d)), np.empty((d, n))
        for a in range(d):
            row = a if whole else measured[a]
            for b in range(d):
                factor[a, b] = S[row, b if whole else measured[b]]
            for b in range(n):
                columns[a, b] = HP[a, b] if whole else y[row]
        if not solve(factor, columns):
            return np.nan
        for a in range(d):
            if not whole:
                nis += y[measured[a]] * columns[a, 0]
            else:
                for b in range(n):
                    HP[a, b] = columns[a, b]
    return nis


@inlined
def correct_one(mean: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, K: FloatArray) -> bool:
    """Overwrite mean and P by x + K y and (I - K H) P (I - K H)' + K R K', of K transposed; True if all is finite."""
    n, k = len(mean), len(y)
    A, AP, KR, found = np.empty((n, n)), np.empty((n, n)), np.empty((n, k)), np.zeros((n, n))
    gain = np.empty((n, k))
    total = 0.0
    for a in range(n):
        for b in range(k):
            gain[a, b] = K[b, a]
            mean[a] += K[b, a] * y[b]
        total += abs(mean[a])
    product(gain, H, A)
    for a in range(n):
        for b in range(n):
            A[a, b] = (1.0 if a == b else 0.0) - A[a, b]
    add_congruence(A, P, AP, found)
    add_congruence(gain, R, KR, found)
    copy(found, P)
    for a in range(n):
        for b in range(n):
            total += abs(P[a, b])
    return total < np.inf


@njit(f"({_MATRICES}, {_MATRICES}, {_MATRICES})")
def predict(F: FloatArray, P: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariances F P F' + Q and cross-covariances F P, shapes (m, n, n)."""
    cross, found = np.empty(P.shape), Q.copy()
    for i in range(len(P)):
        add_congruence(F[i], P[i], cross[i], found[i])
    return found, cross


@njit(f"({_VECTORS}, {_MATRICES}, {_VECTORS}, {_MATRICES}, {_MATRICES}, int64[::1])")
def correct(
    mean: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, measured: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """Means x + K y and covariances (I - K H) P (I - K H)' + K R K' with K = P H' S^-1 and S = H P H' + R.

    Then the NIS of the entries `measured` of y, S, and where S was positive definite and all is finite. Shapes (m, n),
    (m, n, n), (m, k), (1, k, n) or (m, k, n), (m, k, k).
    """
    m, k = y.shape
    after, covariance, nis, S = mean.copy(), P.copy(), np.empty(m), np.empty(R.shape)
    fused, K = np.zeros(m, np.bool_), np.empty((k, mean.shape[1]))
    for i in range(m):
        h = H[min(i, len(H) - 1)]
        nis[i] = innovate(P[i], y[i], h, R[i], measured, S[i], K)
        if not np.isnan(nis[i]):
            fused[i] = correct_one(after[i], covariance[i], y[i], h, R[i], K)
    return after, covariance, nis, S, fused

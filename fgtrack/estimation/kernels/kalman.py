"""The Kalman filter on stacks of independent states."""

import numpy as np

from fgtrack.core.compiled import inlined, njit
from fgtrack.core.types import BoolArray, FloatArray, IntArray

_VECTORS, _MATRICES = "float64[:, ::1]", "float64[:, :, ::1]"


@inlined
def product(A: FloatArray, B: FloatArray, found: FloatArray) -> None:
    """Write A B."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            value = 0.0
            for k in range(A.shape[1]):
                value += A[i, k] * B[k, j]
            found[i, j] = value


@inlined
def add_product_transposed(A: FloatArray, B: FloatArray, found: FloatArray) -> None:
    """Add A B', which is symmetric, to `found`: its lower triangle, and the mirror of that."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            value = found[i, j]
            for k in range(A.shape[1]):
                value += A[i, k] * B[j, k]
            found[i, j] = found[j, i] = value


@inlined
def solve(S: FloatArray, columns: FloatArray) -> bool:
    """Overwrite columns by S^-1 columns and S by its Cholesky factor; False unless S is positive definite."""
    n = S.shape[0]
    for i in range(n):
        for j in range(i + 1):
            value = S[i, j]
            for k in range(j):
                value -= S[i, k] * S[j, k]
            if j < i:
                S[i, j] = value / S[j, j]
            elif value > 0.0:
                S[i, i] = np.sqrt(value)
            else:
                return False
    for c in range(columns.shape[1]):
        for i in range(n):
            for k in range(i):
                columns[i, c] -= S[i, k] * columns[k, c]
            columns[i, c] /= S[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                columns[i, c] -= S[k, i] * columns[k, c]
            columns[i, c] /= S[i, i]
    return True


@njit(f"({_MATRICES}, {_MATRICES}, {_MATRICES})")
def predict(F: FloatArray, P: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariances F P F' + Q and cross-covariances F P, shapes (m, n, n)."""
    cross, found = np.empty(P.shape), Q.copy()
    for i in range(len(P)):
        product(F[i], P[i], cross[i])
        add_product_transposed(cross[i], F[i], found[i])
    return found, cross


@njit(f"({_VECTORS}, {_MATRICES}, {_VECTORS}, {_MATRICES}, {_MATRICES}, int64[::1])")
def correct(
    mean: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, measured: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """Means x + K y and covariances (I - K H) P (I - K H)' + K R K' with K = P H' S^-1 and S = H P H' + R.

    Then the NIS of the entries `measured` of y, S, and where S was positive definite and all is finite. Shapes (m, n),
    (m, n, n), (m, k), (1, k, n) or (m, k, n), (m, k, k).
    """
    (m, n), k, d = mean.shape, y.shape[1], len(measured)
    after, covariance, nis, Ss = mean.copy(), np.zeros((m, n, n)), np.zeros(m), R.copy()
    fused = np.zeros(m, np.bool_)
    HP, factor, part, own = np.empty((k, n)), np.empty((k, k)), np.empty((d, d)), np.empty((d, 1))
    A, AP, K, KR = np.empty((n, n)), np.empty((n, n)), np.empty((n, k)), np.empty((n, k))
    for i in range(m):
        h, S = H[min(i, len(H) - 1)], Ss[i]
        product(h, P[i], HP)
        add_product_transposed(HP, h, S)
        factor[:] = S
        for a in range(d):
            own[a, 0] = y[i, measured[a]]
            for b in range(d):
                part[a, b] = S[measured[a], measured[b]]
        if not (solve(factor, HP) and solve(part, own)):
            continue
        for a in range(d):
            nis[i] += y[i, measured[a]] * own[a, 0]
        total = 0.0
        for a in range(n):
            for b in range(k):
                K[a, b] = HP[b, a]
                after[i, a] += K[a, b] * y[i, b]
            total += abs(after[i, a])
        product(K, h, A)
        for a in range(n):
            for b in range(n):
                A[a, b] = (1.0 if a == b else 0.0) - A[a, b]
        product(A, P[i], AP)
        product(K, R[i], KR)
        add_product_transposed(AP, A, covariance[i])
        add_product_transposed(KR, K, covariance[i])
        fused[i] = np.isfinite(total + np.abs(covariance[i]).sum())
    return after, covariance, nis, Ss, fused

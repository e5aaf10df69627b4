"""The Kalman filter on stacks of independent states."""

import numpy as np

from fgtrack.core.compiled import add_congruence, add_product_transposed, copy, inlined, njit, product, solve
from fgtrack.core.types import BoolArray, FloatArray, IntArray

_VECTORS, _MATRICES = "float64[:, ::1]", "float64[:, :, ::1]"


@inlined
def innovate(
    P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, rows: IntArray, S: FloatArray, K: FloatArray
) -> float:
    """Write S = H P H' + R and K' = S^-1 H P, and return the NIS of the `rows` of y; NaN where S has no root."""
    k, d, nis = len(y), len(rows), 0.0
    copy(R, S)
    add_congruence(H, P, K, S)
    marginal, weighted, root = np.empty((d, d)), np.empty((d, 1)), np.empty((k, k))
    for a in range(d):
        weighted[a, 0] = y[rows[a]]
        for b in range(d):
            marginal[a, b] = S[rows[a], rows[b]]
    if not solve(marginal, weighted):
        return np.nan
    for a in range(d):
        nis += y[rows[a]] * weighted[a, 0]
    copy(S, root)
    return nis if solve(root, K) else np.nan


@inlined
def correct_one(mean: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, K: FloatArray) -> bool:
    """Overwrite mean and P by x + K y and (I - K H) P (I - K H)' + K R K', of K transposed; True if all is finite."""
    n, k, total = len(mean), len(y), 0.0
    A, AP, KR, gain = np.empty((n, n)), np.empty((n, n)), np.empty((n, k)), np.empty((n, k))
    for a in range(n):
        for b in range(k):
            gain[a, b] = K[b, a]
            mean[a] += K[b, a] * y[b]
    product(gain, H, A)
    for a in range(n):
        for b in range(n):
            A[a, b] = (1.0 if a == b else 0.0) - A[a, b]
    product(A, P, AP)
    for a in range(n):
        for b in range(n):
            P[a, b] = 0.0
    add_product_transposed(AP, A, P)
    add_congruence(gain, R, KR, P)
    for a in range(n):
        total += abs(mean[a])
        for b in range(n):
            total += abs(P[a, b])
    return total < np.inf


@njit(f"({_MATRICES}, {_MATRICES}, {_MATRICES})")
def predict(F: FloatArray, P: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return covariances F P F' + Q, written over Q, and cross-covariances F P, shapes (m, n, n)."""
    cross = np.empty(P.shape)
    for i in range(len(P)):
        add_congruence(F[i], P[i], cross[i], Q[i])
    return Q, cross


@njit(
    f"({_VECTORS}, {_MATRICES}, {_VECTORS}, {_MATRICES}, {_MATRICES}, int64[::1], {_MATRICES}, float64[::1], b1[::1])"
)
def correct(
    mean: FloatArray,
    P: FloatArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    rows: IntArray,
    S: FloatArray,
    nis: FloatArray,
    fused: BoolArray,
) -> None:
    """Overwrite means and covariances by x + K y and (I - K H) P (I - K H)' + K R K' with K = P H' S^-1.
    Writes S = H P H' + R, the NIS of the `rows` of y, and where S was positive definite and all is finite. Shapes
    (m, n), (m, n, n), (m, k), (1, k, n) or (m, k, n), (m, k, k).
    """
    K = np.empty((y.shape[1], mean.shape[1]))
    for i in range(len(y)):
        h = H[min(i, len(H) - 1)]
        nis[i] = innovate(P[i], y[i], h, R[i], rows, S[i], K)
        fused[i] = not np.isnan(nis[i]) and correct_one(mean[i], P[i], y[i], h, R[i], K)

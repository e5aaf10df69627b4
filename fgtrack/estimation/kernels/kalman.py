"""The Kalman filter on stacks of independent states."""

import math

import numpy as np

from fgtrack.core.compiled import (
    MATRIX,
    READ,
    add_congruence,
    add_product_transposed,
    add_weighted,
    check,
    check_rows,
    copy,
    njit,
    product,
    scratch,
    shared,
    solve,
    whiten,
)
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.transitions import check_noise, transition

_VECTORS, _MATRICES, _READ = (
    "float64[:, ::1]",
    "float64[:, :, ::1]",
    "Array(float64, 3, 'C', readonly=True)",
)


@shared(f"float64({MATRIX}, float64[::1], int64[::1], {MATRIX}, float64[::1])")
def marginal_nis(
    S: FloatArray, y: FloatArray, rows: IntArray, root: FloatArray, white: FloatArray
) -> float:
    """Return the NIS of the `rows` of y (k,) with covariance S; NaN where that of the rows has no root."""
    for a in range(len(rows)):
        white[a] = y[rows[a]]
        for b in range(a + 1):
            root[a, b] = S[rows[a], rows[b]]
    return whiten(root, white[: len(rows)])


@shared(
    f"b1(float64[::1], {f'{MATRIX}, ' * 3}{READ}, float64[::1], {MATRIX}, {MATRIX})"
)
def conclude(
    mean: FloatArray,
    P: FloatArray,
    A: FloatArray,
    K: FloatArray,
    R: FloatArray,
    y: FloatArray,
    AP: FloatArray,
    KR: FloatArray,
) -> bool:
    """Overwrite mean and P by x + K y and A P A' + K R K', A = I - K H, of K transposed; True if all is finite."""
    total, n = 0.0, len(mean)
    product(A, P, AP)
    for a in range(n):
        for c in range(len(y)):
            mean[a] += K[c, a] * y[c]
        for b in range(n):
            P[a, b] = 0.0
    add_product_transposed(AP, A, P)
    add_weighted(K, R, KR, P)
    for a in range(n):
        total += abs(mean[a])
        for b in range(n):
            total += abs(P[a, b])
    return total < np.inf


@njit(f"({_VECTORS}, {_READ}, {_READ}, int64[:], {_READ}, int64[::1])")
def innovations(
    y: FloatArray,
    H: FloatArray,
    P: FloatArray,
    tracks: IntArray,
    R: FloatArray,
    rows: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return S = H P H' + R (m, k, k) of innovations y (m, k), and of their `rows` the NIS and log det S, shapes (m,).
    NaN where S has no root. Jacobians H (m, k, n) or (1, k, n), covariances P (tracks, n, n), R (m, k, k).
    """
    m, k = y.shape
    check_rows(tracks, 0, len(P))
    check_rows(rows, 0, k)
    check(len(tracks) >= m and len(R) >= m and (len(H) == 1 or len(H) >= m))
    check(H.shape[1] == k and H.shape[2] == P.shape[1] and P.shape[2] == P.shape[1])
    check(R.shape[1] == k and R.shape[2] == k)
    S, nis, logdet = np.empty((m, k, k)), np.empty(m), np.zeros(m)
    root, HP, white = np.empty((k, k)), np.empty((k, P.shape[1])), np.empty(k)
    for i in range(m):
        copy(R[i], S[i])
        add_congruence(H[min(i, len(H) - 1)], P[tracks[i]], HP, S[i])
        nis[i] = marginal_nis(S[i], y[i], rows, root, white)
        for a in range(len(rows)):
            logdet[i] += 2.0 * math.log(root[a, a])
    return S, nis, logdet


@njit(f"({_MATRICES}, {_MATRICES}, {_MATRICES})")
def predict(
    F: FloatArray, P: FloatArray, Q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return covariances F P F' + Q, written over Q, and cross-covariances F P, shapes (m, n, n)."""
    check(F.shape == P.shape and Q.shape == P.shape)
    cross = np.empty(P.shape)
    for i in range(len(P)):
        add_congruence(F[i], P[i], cross[i], Q[i])
    return Q, cross


@njit(f"void(int64, float64[::1], {_VECTORS}, {_MATRICES}, int64[::1], float64)")
def propagate(
    motion: int,
    noise: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    steps: IntArray,
    dt_s: float,
) -> None:
    """Move states (m, n) and (m, n, n), each by its own number of `steps` (m,) of `dt_s`: f(x) and F P F' + Q."""
    n = mean.shape[1]
    check(
        len(P) >= len(mean)
        and len(steps) >= len(mean)
        and P.shape[1] == n
        and P.shape[2] == n
    )
    check_noise(motion, noise, n)
    F, FP, Q, x = scratch(n, n), scratch(n, n), scratch(n, n), scratch(n)
    for i in range(len(mean)):
        for a in range(n):
            x[a] = mean[i, a]
        transition(motion, x, steps[i] * dt_s, noise, mean[i], F, Q)
        add_congruence(F, P[i], FP, Q)
        copy(Q, P[i])


@njit(
    f"void({_VECTORS}, {_MATRICES}, {_VECTORS}, {_READ}, {_READ}, int64[::1], {_MATRICES}, float64[::1], b1[::1])"
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
    m, k, n = len(y), y.shape[1], mean.shape[1]
    check_rows(rows, 0, k)
    check(
        len(mean) >= m
        and len(P) >= m
        and len(R) >= m
        and len(S) >= m
        and len(nis) >= m
        and len(fused) >= m
    )
    check(len(H) == 1 or len(H) >= m)
    check(P.shape[1] == n and P.shape[2] == n and H.shape[1] == k and H.shape[2] == n)
    check(R.shape[1] == k and R.shape[2] == k and S.shape[1] == k and S.shape[2] == k)
    K, root, white, A, AP, KR = (
        scratch(k, n),
        scratch(k, k),
        scratch(k),
        scratch(n, n),
        scratch(n, n),
        scratch(n, k),
    )
    for i in range(m):
        h = H[min(i, len(H) - 1)]
        copy(R[i], S[i])
        add_congruence(h, P[i], K, S[i])
        nis[i] = marginal_nis(S[i], y[i], rows, root, white)
        copy(S[i], root)
        fused[i] = not math.isnan(nis[i]) and solve(root, K)
        if not fused[i]:
            nis[i] = np.nan
            continue
        for a in range(n):
            for b in range(n):
                A[a, b] = 1.0 if a == b else 0.0
                for c in range(k):
                    A[a, b] -= K[c, a] * h[c, b]
        fused[i] = conclude(mean[i], P[i], A, K, R[i], y[i], AP, KR)

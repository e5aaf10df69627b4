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
    merged,
    njit,
    product,
    scratch,
    shared,
    solve,
    whiten,
)
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.models.measurement_kernels import GAUSSIAN, penalty_and_weight
from fgtrack.models.transitions import check_noise, transition

#: Largest number of reweightings of one update, and the relative change of the weight at which they end.
_MAX_REWEIGHTINGS, _REWEIGHTING_TOLERANCE = 50, 1e-9
CORRECTION_SPACE = f"UniTuple({MATRIX}, 8)"
CorrectionSpace = tuple[
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
]
"""Scratch of `correct_state`: (n, n) twice, (k, n), (n, k), (k, k) three times and (k, 1), for the largest k."""


@merged
def correction_space(n: int, k: int) -> CorrectionSpace:
    """Return scratch for corrections of states of dimension n by measurements of at most k components."""
    return (
        scratch(n, n),
        scratch(n, n),
        scratch(k, n),
        scratch(n, k),
        scratch(k, k),
        scratch(k, k),
        scratch(k, k),
        scratch(k, 1),
    )


_VECTORS, _MATRICES, _READ = (
    "float64[:, ::1]",
    "float64[:, :, ::1]",
    "Array(float64, 3, 'C', readonly=True)",
)


@shared(f"float64({MATRIX}, float64[::1], int64[::1], {MATRIX}, float64[::1])")
def marginal_nis(
    S: FloatArray, y: FloatArray, rows: IntArray, root: FloatArray, white: FloatArray
) -> float:
    """Return the NIS of the components `rows` of y (k,) with covariance S (k, k).

    NaN if the covariance of these components is not positive definite. `root` and `white` are scratch.
    """
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
    """Overwrite mean and P by x + K y and A P A' + K R K' with A = I - K H. True if all values are finite.

    `K` is the transposed gain, shape (k, n). `AP` (n, n) and `KR` (k, n) are scratch.
    """
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


@shared(
    f"b1(float64[::1], {MATRIX}, {READ}, {MATRIX}, float64[::1], {READ}, {MATRIX}, {MATRIX})"
)
def smooth_state(
    mean: FloatArray,
    P: FloatArray,
    predicted: FloatArray,
    gain: FloatArray,
    shift: FloatArray,
    after: FloatArray,
    root: FloatArray,
    CD: FloatArray,
) -> bool:
    """Overwrite a state by x + C s and P + C (P_s - P_-) C', see `fgtrack.estimation.rts.rts_step`.

    The next state has the predicted covariance P_-. Smoothing has moved its mean by the shift s, and its covariance
    to P_s = `after`. On entry `gain` holds the transposed cross-covariance C P_-, afterwards C'. False if P_- is
    not positive definite.
    """
    n = len(mean)
    copy(predicted, root)
    if not solve(root, gain):
        return False
    for a in range(n):
        for b in range(n):
            root[a, b] = after[a, b] - predicted[a, b]
            mean[a] += gain[b, a] * shift[b]
    add_weighted(gain, root, CD, P)
    return True


@njit(f"b1({_VECTORS}, {_MATRICES}, {_READ}, {_MATRICES}, {_VECTORS}, {_READ})")
def smooth_states(
    means: FloatArray,
    P: FloatArray,
    predicted: FloatArray,
    gains: FloatArray,
    shifts: FloatArray,
    after: FloatArray,
) -> bool:
    """Apply `smooth_state` to states (m, n) and (m, n, n). False if a predicted covariance is not positive definite."""
    (m, n), is_regular = means.shape, True
    check(shifts.shape == (m, n) and P.shape == (m, n, n))
    check(predicted.shape == P.shape and gains.shape == P.shape)
    check(after.shape == P.shape)
    root, CD = scratch(n, n), scratch(n, n)
    for i in range(m):
        if not smooth_state(
            means[i], P[i], predicted[i], gains[i], shifts[i], after[i], root, CD
        ):
            is_regular = False
    return is_regular


@shared(f"float64({READ}, {READ}, float64[::1], int64, float64, {MATRIX}, {MATRIX})")
def robust_weight(
    spread: FloatArray,
    R: FloatArray,
    y: FloatArray,
    loss: int,
    width: float,
    root: FloatArray,
    column: FloatArray,
) -> float:
    """Return the weight w of an innovation y (k,) with covariance `spread` + R under a robust loss; NaN if that is
    singular.

    The correction with R / w minimises prior cost plus robust loss of the post-fit residual r = R / w S^-1 y, with
    S = `spread` + R / w. The weight w is the weight of the loss at sqrt(r' R^-1 r). Reweighting starts at w = 1 and
    never increases w, so it ends at the largest of these weights.
    """
    k, w = len(y), 1.0
    for _ in range(_MAX_REWEIGHTINGS):
        for a in range(k):
            column[a, 0] = y[a]
            for b in range(k):
                root[a, b] = spread[a, b] + R[a, b] / w
        if not solve(root, column):
            return np.nan
        square = 0.0
        for a in range(k):
            for b in range(k):
                square += column[a, 0] * R[a, b] * column[b, 0]
        d = math.sqrt(max(square, 0.0)) / w
        _, new = penalty_and_weight(loss, width, d)
        if not new < w * (1.0 - _REWEIGHTING_TOLERANCE):
            break
        w = new
    return w


@njit(f"float64({READ}, {READ}, float64[::1], int64, float64)")
def robust_weight_of(
    spread: FloatArray, R: FloatArray, y: FloatArray, loss: int, width: float
) -> float:
    """Return `robust_weight`, for callers outside compiled loops."""
    k = len(y)
    check(spread.shape == (k, k) and R.shape == (k, k))
    root, column = scratch(k, k), scratch(k, 1)
    return robust_weight(spread, R, y, loss, width, root, column)


@shared(
    f"float64(float64[::1], {MATRIX}, float64[::1], {READ}, {READ}, int64, float64, {CORRECTION_SPACE})"
)
def correct_state(
    mean: FloatArray,
    P: FloatArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    loss: int,
    width: float,
    space: CorrectionSpace,
) -> float:
    """Overwrite mean and P by x + K y and (I - K H) P (I - K H)' + K R K' with K = P H' S^-1, S = H P H' + R.

    The innovation is y (k,), with the Jacobian H (k, n). R has at least k rows and columns. It is divided by the
    weight under the loss. Returns the weight; NaN if S is not positive definite or the result is not finite.
    """
    k, n, w = len(y), len(mean), 1.0
    A, AP, K, KR, root, spread, noise, column = space
    K = K[:k]
    if loss != GAUSSIAN:
        for a in range(k):
            for b in range(k):
                spread[a, b] = 0.0
        add_congruence(H, P, K, spread)
        w = robust_weight(spread, R, y, loss, width, root, column[:k])
        if math.isnan(w):
            return np.nan
    for a in range(k):
        for b in range(k):
            noise[a, b] = root[a, b] = R[a, b] / w
    add_congruence(H, P, K, root)
    if not solve(root, K):
        return np.nan
    for a in range(n):
        for b in range(n):
            A[a, b] = 1.0 if a == b else 0.0
            for c in range(k):
                A[a, b] -= K[c, a] * H[c, b]
    return w if conclude(mean, P, A, K, noise, y, AP, KR) else np.nan


@njit(f"({_VECTORS}, {_READ}, {_READ}, int64[:], {_READ}, int64[::1])")
def innovations(
    y: FloatArray,
    H: FloatArray,
    P: FloatArray,
    tracks: IntArray,
    R: FloatArray,
    rows: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the covariances S = H P H' + R (m, k, k) of innovations y (m, k), their NIS (m,) and log det S (m,).

    Jacobians H are (m, k, n) or (1, k, n), covariances P (tracks, n, n) and R (m, k, k). `tracks` (m,) are indices in
    P. The NIS and log det S are those of the components `rows` of y. The NIS is NaN if S is not positive definite.
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
    """Return the covariances F P F' + Q, written over Q, and the cross-covariances F P, shapes (m, n, n)."""
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
    """Move states (m, n) and (m, n, n) to f(x) and F P F' + Q, in `steps` (m,) steps of `dt_s` for each state."""
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
    f"void({_VECTORS}, {_MATRICES}, {_VECTORS}, {_READ}, {_READ}, int64[::1], int64, float64, {_MATRICES}, "
    "float64[::1], float64[::1])"
)
def correct(
    mean: FloatArray,
    P: FloatArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    rows: IntArray,
    loss: int,
    width: float,
    S: FloatArray,
    nis: FloatArray,
    weights: FloatArray,
) -> None:
    """Fuse innovations y (m, k) into means (m, n) and covariances (m, n, n), see `correct_state`.

    Jacobians H are (1, k, n) or (m, k, n), covariances R (m, k, k). Writes S = H P H' + R, the NIS of the components
    `rows` of y, and the weight under the loss. NIS and weight are NaN if the innovation was not fused. `loss` and
    `width` are the kind and the width of the robust loss.
    """
    m, k, n = len(y), y.shape[1], mean.shape[1]
    check_rows(rows, 0, k)
    check(
        len(mean) >= m
        and len(P) >= m
        and len(R) >= m
        and len(S) >= m
        and len(nis) >= m
        and len(weights) >= m
    )
    check(len(H) == 1 or len(H) >= m)
    check(P.shape[1] == n and P.shape[2] == n and H.shape[1] == k and H.shape[2] == n)
    check(R.shape[1] == k and R.shape[2] == k and S.shape[1] == k and S.shape[2] == k)
    space, white = correction_space(n, k), scratch(k)
    K, root = space[2], space[4]
    for i in range(m):
        h = H[min(i, len(H) - 1)]
        copy(R[i], S[i])
        add_congruence(h, P[i], K, S[i])
        nis[i], weights[i] = marginal_nis(S[i], y[i], rows, root, white), np.nan
        if not math.isnan(nis[i]):
            weights[i] = correct_state(mean[i], P[i], y[i], h, R[i], loss, width, space)
        if math.isnan(weights[i]):
            nis[i] = np.nan

"""The extended Kalman filter with replay, of many tracks: arrays (tracks, slots, ...) hold the steps of their windows.

`order[track]` has the slots of a track's steps, oldest first, and then the free ones. A step is what was measured, the
state predicted for it (`before`, with the cross-covariance to the step before), and the state after it. Measurements
are entries of the state: component a of a slot is entry `columns[a]`.
"""

import math

import numpy as np

from fgtrack.core.compiled import add_congruence, add_product_transposed, copy, inlined, njit, product, solve
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.kernels.kalman import correct_one, innovate
from fgtrack.models.transitions import ARC, transition

_YAW = 2


@inlined
def _wrapped(angle_rad: float) -> float:
    """Return the angle in (-pi, pi], unchanged where it lies there."""
    if -math.pi < angle_rad <= math.pi:
        return angle_rad
    wrapped = math.pi - np.mod(math.pi - angle_rad, 2.0 * math.pi)
    return math.pi if wrapped <= -math.pi else wrapped


@inlined
def _ahead(
    motion: int,
    density: FloatArray,
    x: FloatArray,
    P: FloatArray,
    late_ns: int,
    mean: FloatArray,
    covariance: FloatArray,
    cross: FloatArray,
) -> None:
    """Write mean, covariance and cross-covariance after a time: f(x), F P F' + Q and F P."""
    F = np.empty(P.shape)
    transition(motion, x, late_ns / NS_PER_S, density, mean, F, covariance)
    add_congruence(F, P, cross, covariance)


@inlined
def _innovation(x: FloatArray, z: FloatArray, columns: IntArray, wraps: bool, y: FloatArray, H: FloatArray) -> None:
    """Write y = z - H x, and H, which selects `columns`."""
    for a in range(len(y)):
        y[a] = z[a] - x[columns[a]]
        if wraps and columns[a] == _YAW:
            y[a] = _wrapped(y[a])
        for b in range(len(x)):
            H[a, b] = 1.0 if b == columns[a] else 0.0


@inlined
def _retrodict(
    motion: int,
    density: FloatArray,
    slots: IntArray,
    new: int,
    stamps_ns: IntArray,
    mean: FloatArray,
    covariance: FloatArray,
    before: FloatArray,
    before_P: FloatArray,
    cross: FloatArray,
    x: FloatArray,
    P: FloatArray,
) -> bool:
    """Smooth x, P, the state after the last of the later steps in `slots`, back to the prediction of the step `new`.

    From step to step (Rauch, Tung and Striebel), x_j + C s and P_j + C (P - P_-) C' with the prediction x_-, P_- of the
    step after, the shift s = x - x_- and C = (P_-^-1 F P_j)'. False where some P_- has no root.
    """
    n, wraps = len(x), motion == ARC
    ahead, ahead_P, gain, root = np.empty((1, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    shift, C, CD = np.empty(n), np.empty((n, n)), np.empty((n, n))
    for j in range(len(slots) - 1, -1, -1):
        after, left = slots[j], slots[j - 1] if j else new
        late_ns = stamps_ns[after] - stamps_ns[left]
        if late_ns == 0:  # the same state
            continue
        if j:
            copy(before[after : after + 1], ahead)
            copy(before_P[after], ahead_P)
            copy(cross[after], gain)
        else:
            _ahead(motion, density, before[new], before_P[new], late_ns, ahead[0], ahead_P, gain)
        copy(ahead_P, root)
        if not solve(root, gain):
            return False
        for a in range(n):
            shift[a] = x[a] - ahead[0, a]
            for b in range(n):
                C[a, b] = gain[b, a]
                root[a, b] = P[a, b] - ahead_P[a, b]
        if wraps:
            shift[_YAW] = _wrapped(shift[_YAW])
        product(C, root, CD)
        copy(covariance[left] if j else before_P[new], P)
        add_product_transposed(CD, C, P)
        for a in range(n):
            x[a] = mean[left, a] if j else before[new, a]
            for b in range(n):
                x[a] += C[a, b] * shift[b]
    return True


@inlined
def _step(
    motion: int,
    density: FloatArray,
    left: int,
    slot: int,
    stamps_ns: IntArray,
    mean: FloatArray,
    covariance: FloatArray,
    before: FloatArray,
    before_P: FloatArray,
    cross: FloatArray,
    z: FloatArray,
    R: FloatArray,
    columns: IntArray,
) -> bool:
    """Predict from the step in `left`, and fuse the measurement of `slot`; False where it cannot be fused."""
    late_ns = stamps_ns[slot] - stamps_ns[left]
    _ahead(motion, density, mean[left], covariance[left], late_ns, before[slot], before_P[slot], cross[slot])
    k, n = len(z), mean.shape[1]
    for a in range(n):
        mean[slot, a] = before[slot, a]
    copy(before_P[slot], covariance[slot])
    y, H, S, own, K = np.empty(k), np.empty((k, n)), np.empty((k, k)), np.empty((k, k)), np.empty((k, n))
    copy(R, own)
    _innovation(before[slot], z, columns, motion == ARC, y, H)
    nis = innovate(before_P[slot], y, H, own, columns[:0], S, K)
    if np.isnan(nis) or not correct_one(mean[slot], covariance[slot], y, H, own, K):
        return False
    if motion == ARC:
        mean[slot, _YAW] = _wrapped(mean[slot, _YAW])
    return True


_STEPS = (
    "int64, float64[::1], int64[:, ::1], int64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1], float64[:, :, ::1], "
    "float64[:, :, :, ::1], float64[:, :, :, ::1]"
)


@njit(
    f"({_STEPS}, float64[:, :, ::1], float64[:, :, :, ::1], int64[:, :, ::1], int64[:, ::1], int64[:, ::1], int64, "
    "float64[:, ::1], float64[:, :, ::1], int64[::1], int64[::1])"
)
def fuse(
    motion: int,
    density: FloatArray,
    order: IntArray,
    stamps_ns: IntArray,
    mean: FloatArray,
    covariance: FloatArray,
    before: FloatArray,
    before_P: FloatArray,
    cross: FloatArray,
    z: FloatArray,
    R: FloatArray,
    columns: IntArray,
    sizes: IntArray,
    at: IntArray,
    stamp_ns: int,
    new_z: FloatArray,
    new_R: FloatArray,
    new_columns: IntArray,
    measured: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Put a measurement of `stamp_ns` into each chain of steps, and filter the later ones again.

    Rows of `at` (m, 3) are a track, the place of its measurement, and the number of its steps, fewer than its slots.
    Returns innovations y (m, k), the NIS of their entries `measured`, and S (m, k, k), given all that was fused; and
    False where a measurement cannot be fused: there all is as it was.
    """
    (m, k), n = new_z.shape, mean.shape[2]
    y, S, nis, fused = np.empty((m, k)), np.empty((m, k, k)), np.empty(m), np.zeros(m, np.bool_)
    x, P, H, K, own = np.empty(n), np.empty((n, n)), np.empty((k, n)), np.empty((k, n)), np.empty((k, k))
    for i in range(m):
        t, place, count = at[i, 0], at[i, 1], at[i, 2]
        slots = order[t]
        new = slots[count]
        stamps_ns[t, new], sizes[t, new] = stamp_ns, k
        for a in range(k):
            z[t, new, a], columns[t, new, a] = new_z[i, a], new_columns[a]
            for b in range(k):
                R[t, new, a, b] = new_R[i, a, b]
        for j in range(count, place, -1):
            slots[j] = slots[j - 1]
        slots[place] = new
        steps = stamps_ns[t], mean[t], covariance[t], before[t], before_P[t], cross[t]
        j, last, fused[i] = place, count, True
        while j <= last:
            s, d = slots[j], sizes[t, slots[j]]
            ok = _step(motion, density, slots[j - 1], s, *steps, z[t, s, :d], R[t, s], columns[t, s, :d])
            if ok and s == new:
                newest = slots[count]
                for a in range(n):
                    x[a] = before[t, new, a] if place == count else mean[t, newest, a]
                copy(before_P[t, new] if place == count else covariance[t, newest], P)
                ok = _retrodict(motion, density, slots[place + 1 : count + 1], new, *steps, x, P)
                copy(new_R[i], own)
                _innovation(x, new_z[i], new_columns, motion == ARC, y[i], H)
                nis[i] = innovate(P, y[i], H, own, measured, S[i], K)
                ok = ok and not np.isnan(nis[i])
            j += 1
            if not ok and fused[i]:  # take it out, and filter the later ones again without it
                for j in range(place, count):
                    slots[j] = slots[j + 1]
                slots[count] = new
                j, last, fused[i] = place, count - 1, False
    return y, nis, S, fused


@njit(f"({_STEPS}, int64[:, ::1])")
def ahead(
    motion: int,
    density: FloatArray,
    order: IntArray,
    stamps_ns: IntArray,
    mean: FloatArray,
    covariance: FloatArray,
    before: FloatArray,
    before_P: FloatArray,
    cross: FloatArray,
    at: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Means (m, n) and covariances (m, n, n), each predicted; rows of `at` are track, place of the step, and stamp."""
    m, n = len(at), mean.shape[2]
    found, P, FP = np.empty((m, n)), np.empty((m, n, n)), np.empty((n, n))
    for i in range(m):
        t, place, at_ns = at[i, 0], at[i, 1], at[i, 2]
        s = order[t, place]
        _ahead(motion, density, mean[t, s], covariance[t, s], at_ns - stamps_ns[t, s], found[i], P[i], FP)
        if motion == ARC:
            found[i, _YAW] = _wrapped(found[i, _YAW])
    return found, P

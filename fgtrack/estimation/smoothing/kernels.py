"""Compiled loops that solve windows: elimination forwards in time and back-substitution, track by track, node by node.

The windows are block-tridiagonal. Elimination is the Kalman filter; what it leaves of each node, given the next one, is
the gain and the covariance of the Rauch-Tung-Striebel smoother. No process noise is divided by, which vanishes between
stamps 1 us apart. Arguments are those arrays of `Nodes` that have their names.
"""

import numpy as np

from fgtrack.core.compiled import add_product_transposed, inlined, njit, product, solve
from fgtrack.core.types import BoolArray, FloatArray, IntArray

#: Where a measurement leaves less than this of a variance, the short form of its update keeps too few digits.
_LEAST_SHARE = 1e-6
TRACKS, ORDER, VECTORS, MATRICES = "int64[::1]", "int64[:, ::1]", "float64[:, ::1]", "float64[:, :, ::1]"
_WINDOWS = f"{TRACKS}, {TRACKS}, {ORDER}"  # first, count, numbers


@inlined
def cholesky(matrix: FloatArray, n: int, L: FloatArray) -> bool:
    """Write the lower Cholesky factor of the leading n rows and columns to `L`; False if there is none."""
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j]
            for m in range(j):
                value -= L[i, m] * L[j, m]
            if i > j:
                L[i, j] = value / L[j, j]
            elif value > 0.0:
                L[i, i] = np.sqrt(value)
            else:
                return False
    return True


@inlined
def regularise(Q: FloatArray) -> None:
    """Add to process noise that leaves out a direction, see `linalg.regular`."""
    for i in range(Q.shape[0]):
        Q[i, i] += 1e-12 * max(Q[i, i], 1e-6)


@inlined
def _predict(left: FloatArray, segment: FloatArray, origin: FloatArray, moved: FloatArray, ahead: FloatArray) -> None:
    """[F P F' + Q | F x + f - x0] to `ahead`, and F P to `moved`."""
    n = len(origin)
    for i in range(n):
        mean = segment[i, 2 * n] - origin[i]
        for j in range(n):
            mean += segment[i, j] * left[j, n]
        ahead[i, n] = mean
        for j in range(i + 1):
            ahead[i, j] = 0.5 * (segment[i, n + j] + segment[j, n + i])
    product(segment[:, :n], left[:, :n], moved)
    add_product_transposed(moved, segment[:, :n], ahead[:, :n])


@inlined
def _condition(
    left: FloatArray,
    segment: FloatArray,
    ahead: FloatArray,
    gain: FloatArray,
    E: FloatArray,
    work: FloatArray,
    back: FloatArray,
    C: FloatArray,
) -> bool:
    """A = P F' (F P F' + Q)^-1, b, C = E P E' + A Q A', E = I - A F; `gain` holds F P. False if there is no A."""
    n = gain.shape[0]
    E[:] = ahead[:, :n]
    if not solve(E, gain):
        return False
    for i in range(n):
        mean = left[i, n]
        for j in range(n):
            back[i, j] = gain[j, i]
            mean -= gain[j, i] * ahead[j, n]
            value = 1.0 if i == j else 0.0
            for k in range(n):
                value -= gain[k, i] * segment[k, j]
            E[i, j] = value
        back[i, n] = mean
    C[:] = 0.0
    product(E, left[:, :n], work)
    add_product_transposed(work, E, C)
    product(back[:, :n], segment[:, n : 2 * n], work)
    add_product_transposed(work, back[:, :n], C)
    return True


@inlined
def _correct(
    state: FloatArray, row: FloatArray, gain: FloatArray, E: FloatArray, P: FloatArray, work: FloatArray
) -> None:
    """Fuse y = G x + N(0, 1), `row` being [G | y], into `state` [P | x]; precise ones in Joseph's form."""
    n = len(gain)
    S, y = 1.0, row[n]
    for i in range(n):
        gain[i] = 0.0
        for j in range(n):
            gain[i] += state[i, j] * row[j]
        S += row[i] * gain[i]
        y -= row[i] * state[i, n]
    precise = S > 1.0 / _LEAST_SHARE
    if precise:
        P[:] = state[:, :n]
    for i in range(n):
        gain[i] /= S
        state[i, n] += gain[i] * y
        for j in range(i + 1):
            state[i, j] = state[j, i] = state[i, j] - gain[i] * S * gain[j]
    if precise:
        for i in range(n):
            for j in range(n):
                E[i, j] = (1.0 if i == j else 0.0) - gain[i] * row[j]
                state[i, j] = gain[i] * gain[j]
        product(E, P, work)
        add_product_transposed(work, E, state[:, :n])


@njit(
    f"b1(int64[:], int64[:], int64[:], {_WINDOWS}, {VECTORS}, {MATRICES}, {MATRICES}, {TRACKS},"
    f" {', '.join([MATRICES] * 4)})"
)
def eliminate(
    tracks: IntArray,
    starts: IntArray,
    ends: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    origin: FloatArray,
    segment: FloatArray,
    rows: FloatArray,
    num_rows: IntArray,
    predicted: FloatArray,
    filtered: FloatArray,
    back: FloatArray,
    C: FloatArray,
) -> bool:
    """Eliminate the nodes of `tracks` from `starts` up to before `ends`; True if all is finite."""
    n = origin.shape[1]
    A, E, P, work, gain = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty(n)
    for t in range(len(tracks)):
        track = tracks[t]
        for index in range(starts[t], min(ends[t], count[track])):
            at = numbers[track, index]
            if index > first[track]:  # else the prior of the oldest node in the window, which follows from nothing
                before = numbers[track, index - 1]
                _predict(filtered[before], segment[before], origin[at], A, predicted[at])
                if not _condition(
                    filtered[before], segment[before], predicted[at], A, E, work, back[before], C[before]
                ):
                    return False
            state = filtered[at]
            state[:] = predicted[at]
            for k in range(num_rows[at]):
                _correct(state, rows[at, k], gain, E, P, work)
            if not np.isfinite(state).all():
                return False
    return True


@njit(f"void(int64[:], {_WINDOWS}, {MATRICES}, {MATRICES}, {VECTORS})")
def back_substitute(
    tracks: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    filtered: FloatArray,
    back: FloatArray,
    step: FloatArray,
) -> None:
    """Write `step` of the nodes in the windows: A (step of the next node) + b."""
    n = step.shape[1]
    for track in tracks:
        later = -1
        for index in range(count[track] - 1, first[track] - 1, -1):
            at = numbers[track, index]
            for i in range(n):
                value = filtered[at, i, n] if later < 0 else back[at, i, n]
                if later >= 0:
                    for j in range(n):
                        value += back[at, i, j] * step[later, j]
                step[at, i] = value
            later = at


@njit(f"void(int64[:], {_WINDOWS}, {VECTORS}, {TRACKS}, {VECTORS}, b1[::1], b1[::1])")
def mark_far(
    tracks: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    thresholds: FloatArray,
    anchored: IntArray,
    step: FloatArray,
    far: BoolArray,
    any_far: BoolArray,
) -> None:
    """Mark with `far` the nodes in the windows with a `step` longer than `thresholds` (tracks, n).

    The first `anchored` nodes of each window are never marked.
    """
    for track in tracks:
        any_far[track] = False
        for index in range(first[track], count[track]):
            at = numbers[track, index]
            too_long = False
            for i in range(step.shape[1]):
                too_long |= abs(step[at, i]) > thresholds[track, i]
            far[at] = too_long and index >= first[track] + anchored[track]
            any_far[track] |= far[at]


@njit(f"int64(int64[:], {_WINDOWS}, {TRACKS}, b1[::1], b1[::1], {TRACKS}, {TRACKS})")
def find_far(
    tracks: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    anchored: IntArray,
    far: BoolArray,
    any_far: BoolArray,
    rows: IntArray,
    indices: IntArray,
) -> int:
    """Write the marked nodes as rows of `tracks` and `indices`; return their number."""
    num = 0
    for t in range(len(tracks)):
        track = tracks[t]
        if any_far[track]:
            for index in range(first[track] + anchored[track], count[track]):
                if far[numbers[track, index]]:
                    rows[num], indices[num] = t, index
                    num += 1
    return num


@njit(
    f"void(int64[:], int64[:], {TRACKS}, {_WINDOWS}, {MATRICES}, {MATRICES}, {MATRICES}, {VECTORS}, {MATRICES},"
    f" {VECTORS}, {MATRICES})"
)
def smoothed(
    tracks: IntArray,
    indices: IntArray,
    known: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    filtered: FloatArray,
    back: FloatArray,
    C: FloatArray,
    step: FloatArray,
    P: FloatArray,
    steps: FloatArray,
    covariances: FloatArray,
) -> None:
    """Write `steps` and `covariances` of the nodes at `indices`; those computed on the way stay in `step` and `P`.

    From index `known` on covariances are known.
    """
    n = step.shape[1]
    work = np.empty((n, n))
    for t in range(len(tracks)):
        track = tracks[t]
        for index in range(known[track] - 1, indices[t] - 1, -1):
            at = numbers[track, index]
            if index == count[track] - 1:
                P[at] = filtered[at, :, :n]
                continue
            later = numbers[track, index + 1]
            P[at] = C[at]
            product(back[at, :, :n], P[later], work)
            add_product_transposed(work, back[at, :, :n], P[at])
            if index < first[track]:  # behind the window
                for i in range(n):
                    value = back[at, i, n]
                    for j in range(n):
                        value += back[at, i, j] * step[later, j]
                    step[at, i] = value
        known[track] = min(known[track], indices[t])
        at = numbers[track, indices[t]]
        steps[t], covariances[t] = step[at], P[at]


@njit(f"b1({', '.join([VECTORS, MATRICES, MATRICES] * 2)}, {VECTORS}, {MATRICES}, {MATRICES}, {MATRICES})")
def interpolate(
    mean: FloatArray,
    F1: FloatArray,
    Q1: FloatArray,
    ahead: FloatArray,
    F2: FloatArray,
    Q2: FloatArray,
    right: FloatArray,
    A: FloatArray,
    C: FloatArray,
    P: FloatArray,
) -> bool:
    """Write means and covariances of states between two nodes over `mean` and `P`; False if noise is not definite.

    `mean` is predicted from the left node, `ahead` from there; the right one has mean `right` and covariance P, that
    on the left A and C given it. See `interpolation.between` for Psi, Lambda and Sigma, which is E Q1 E' + Psi Q2 Psi'.
    """
    n = mean.shape[1]
    S, gain, Psi, E, Lambda, by_right, work = np.empty((7, n, n))
    for t in range(len(mean)):
        for attempt in range(2):
            product(F2[t], Q1[t], gain)
            S[:] = Q2[t]
            add_product_transposed(gain, F2[t], S)
            if solve(S, gain):
                break
            if attempt == 1:
                return False
            regularise(Q1[t])
            regularise(Q2[t])
        Psi[:] = gain.T
        product(Psi, F2[t], E)
        for i in range(n):
            for j in range(n):
                E[i, j] = (1.0 if i == j else 0.0) - E[i, j]
                mean[t, i] += Psi[i, j] * (right[t, j] - ahead[t, j])
        product(E, F1[t], Lambda)
        product(Lambda, A[t][:, :n], by_right)
        by_right += Psi
        product(by_right, P[t], work)
        P[t] = 0.0
        add_product_transposed(work, by_right, P[t])
        for weights, noise in ((Lambda, C[t]), (E, Q1[t]), (Psi, Q2[t])):
            product(weights, noise, work)
            add_product_transposed(work, weights, P[t])
    return True

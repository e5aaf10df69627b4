"""Compiled loops that look up, insert, move and linearise nodes; arguments are arrays of `Nodes` by name."""

import numpy as np

from fgtrack.core.compiled import cholesky, njit
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.smoothing.kernels import MATRICES, ORDER, TRACKS, VECTORS, regularise


@njit(f"int64({TRACKS}, {TRACKS}, {ORDER}, {TRACKS}, {ORDER}, {TRACKS}, {TRACKS}, float64[::1], float64[::1])")
def locate(
    tracks: IntArray,
    stamps_ns: IntArray,
    all_ns: IntArray,
    count: IntArray,
    numbers: IntArray,
    indices: IntArray,
    at: IntArray,
    until_s: FloatArray,
    after_s: FloatArray,
) -> int:
    """Write index and number of the nodes after `stamps_ns`, or of the last ones, and the times around the stamps.
    Return how many are after them.
    """
    num_between = 0
    for t in range(len(tracks)):
        track, stamp_ns = tracks[t], stamps_ns[t]
        index, end = -1, count[track]  # bisect to the newest node at or before the stamp
        while end - index > 1:
            middle = (index + end) // 2
            if all_ns[track, middle] <= stamp_ns:
                index = middle
            else:
                end = middle
        until_s[t], after_s[t] = (stamp_ns - all_ns[track, index]) / NS_PER_S, 0.0
        if until_s[t] > 0.0 and index < count[track] - 1:
            index += 1
            after_s[t] = (all_ns[track, index] - stamp_ns) / NS_PER_S
            num_between += 1
        indices[t], at[t] = index, numbers[track, index]
    return num_between


@njit(f"void({TRACKS}, {TRACKS}, int64, {ORDER}, {ORDER}, {TRACKS}, {TRACKS})")
def insert(
    tracks: IntArray,
    indices: IntArray,
    stamp_ns: int,
    all_ns: IntArray,
    numbers: IntArray,
    count: IntArray,
    given: IntArray,
) -> None:
    """Insert nodes at `indices`, whose numbers are written to `given`; later nodes move up."""
    for t in range(len(tracks)):
        track = tracks[t]
        given[t] = numbers[track, count[track]]
        for index in range(count[track], indices[t], -1):
            all_ns[track, index], numbers[track, index] = all_ns[track, index - 1], numbers[track, index - 1]
        all_ns[track, indices[t]], numbers[track, indices[t]] = stamp_ns, given[t]
        count[track] += 1


@njit(f"void({TRACKS}, {TRACKS}, {VECTORS}, {TRACKS}, {ORDER}, {VECTORS}, {VECTORS}, {', '.join([MATRICES] * 3)})")
def shift(
    tracks: IntArray,
    shifted: IntArray,
    steps: FloatArray,
    first: IntArray,
    numbers: IntArray,
    origin: FloatArray,
    step: FloatArray,
    predicted: FloatArray,
    back: FloatArray,
    rows: FloatArray,
) -> None:
    """Move the linearisation points of the nodes `shifted` by `steps`, and all that is relative to them."""
    n = origin.shape[1]
    for t in range(len(tracks)):
        at, oldest = shifted[t], first[tracks[t]]
        for i in range(n):
            origin[at, i] += steps[t, i]
            step[at, i] -= steps[t, i]
            predicted[at, i, n] -= steps[t, i]
        for k in range(rows.shape[1]):
            for j in range(n):
                rows[at, k, n] -= rows[at, k, j] * steps[t, j]
        if oldest > 0 and numbers[tracks[t], oldest] == at:
            behind = numbers[tracks[t], oldest - 1]
            for i in range(n):
                for j in range(n):
                    back[behind, i, n] += back[behind, i, j] * steps[t, j]


@njit(f"b1({TRACKS}, {VECTORS}, {MATRICES}, {MATRICES}, {VECTORS}, {MATRICES}, {TRACKS})")
def observe(
    numbers: IntArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    offsets: FloatArray,
    rows: FloatArray,
    num_rows: IntArray,
) -> bool:
    """Append L^-1 [H | y + H offset], R = L L', to the rows of the nodes; False if an R is not positive definite."""
    k, n = H.shape[1:]
    L = np.empty((k, k))
    for t in range(len(numbers)):
        at = numbers[t]
        if not cholesky(R[t], k, L):
            return False
        used = num_rows[at]
        for i in range(k):
            measured = y[t, i]
            for j in range(n):
                measured += H[t, i, j] * offsets[t, j]
            for j in range(n + 1):
                value = measured if j == n else H[t, i, j]
                for m in range(i):
                    value -= L[i, m] * rows[at, used + m, j]
                rows[at, used + i, j] = value / L[i, i]
        num_rows[at] += k
    return True


@njit(
    f"int64({TRACKS}, {TRACKS}, {TRACKS}, {ORDER}, {VECTORS}, {VECTORS}, {MATRICES}, {MATRICES},"
    f" {TRACKS}, b1[::1], {ORDER}, {MATRICES})"
)
def changed_factors(
    tracks: IntArray,
    starts: IntArray,
    count: IntArray,
    numbers: IntArray,
    origin: FloatArray,
    reference: FloatArray,
    segment: FloatArray,
    rows: FloatArray,
    num_rows: IntArray,
    changed: BoolArray,
    owners: IntArray,
    factors: FloatArray,
) -> int:
    """Write the factors from `starts` on that have `changed`; return their number, or -1 if a Q is not definite.

    A factor is that of the measurements of a node, in its first rows, and of its motion to the next one, if there is
    one. Row of `tracks`, index, number and next number, or -1, and the number of rows are in `owners`. Motion is
    W (F d_left - d_right) = W e + N(0, I), d relative to `reference`, W' W = Q^-1 and e = r_right - f(x0) - F (r_left -
    x0): [(W F)'; -W'; (W e)'] in `factors`; measurements are [G'; 0; (y + G (x0 - r))'].
    """
    n = origin.shape[1]
    L, Q, rhs = np.empty((n, n)), np.empty((n, n)), np.empty((n, 2 * n + 1))
    num = 0
    for t in range(len(tracks)):
        for index in range(starts[t], count[tracks[t]]):
            left, has_next = numbers[tracks[t], index], index < count[tracks[t]] - 1
            used = num_rows[left]
            if not changed[left] or not (has_next or used):
                continue
            changed[left] = False
            for k in range(used):
                factors[num, 2 * n, k] = rows[left, k, n]
                for j in range(n):
                    factors[num, j, k], factors[num, n + j, k] = rows[left, k, j], 0.0
                    factors[num, 2 * n, k] += rows[left, k, j] * (origin[left, j] - reference[left, j])
            owners[num, 0], owners[num, 1], owners[num, 2] = t, index, left
            owners[num, 3], owners[num, 4] = -1, used
            if has_next:
                right = numbers[tracks[t], index + 1]
                owners[num, 3], owners[num, 4] = right, used + n
                for i in range(n):
                    for j in range(n):
                        Q[i, j] = segment[left, i, n + j]
                if not cholesky(Q, n, L):
                    regularise(Q)
                    if not cholesky(Q, n, L):
                        return -1
                for i in range(n):
                    rhs[i, 2 * n] = reference[right, i] - segment[left, i, 2 * n]
                    for j in range(n):
                        rhs[i, j], rhs[i, n + j] = segment[left, i, j], -1.0 if i == j else 0.0
                        rhs[i, 2 * n] -= segment[left, i, j] * (reference[left, j] - origin[left, j])
                for j in range(2 * n + 1):
                    for i in range(n):
                        value = rhs[i, j]
                        for m in range(i):
                            value -= L[i, m] * factors[num, j, used + m]
                        factors[num, j, used + i] = value / L[i, i]
            num += 1
    return num


@njit(f"b1({TRACKS}, float64[::1], {VECTORS}, {VECTORS}, {VECTORS})")
def write_steps(
    numbers: IntArray, delta: FloatArray, reference: FloatArray, origin: FloatArray, step: FloatArray
) -> bool:
    """Write `step` of nodes whose states are `reference` + `delta`, one after the other; True if all are finite."""
    n, total = origin.shape[1], 0.0
    for k in range(len(numbers)):
        for i in range(n):
            step[numbers[k], i] = reference[numbers[k], i] - origin[numbers[k], i] + delta[k * n + i]
            total += abs(delta[k * n + i])
    return bool(np.isfinite(total))

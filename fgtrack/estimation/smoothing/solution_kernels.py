"""Compiled loops that solve windows: elimination forwards in time, back-substitution, and covariances.

The windows are block-tridiagonal. Elimination is the Kalman filter. For each node it leaves the gain and the covariance
given the next node: those of the Rauch-Tung-Striebel smoother. No step divides by process noise, which vanishes between
stamps 1 us apart. `nodes` are those of `node_arrays`.

All arrays are contiguous, and blocks are copied entry by entry: numba compiles this in a fraction of the time.
"""

import math

from fgtrack.core.compiled import (
    MATRIX,
    READ,
    add_congruence,
    check,
    copy,
    inlined,
    merged,
    njit,
    product,
    scratch,
    shared,
    solve,
)
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.node_arrays import (
    BLOCKS,
    COUNT,
    FILTERED,
    FIRST,
    INDICES,
    KNOWN,
    NODES,
    NUM_ROWS,
    PREDICTED,
    TIMES,
    VECTORS,
    Arrays,
    C,
    F,
    P,
    Q,
    check_indices,
    check_nodes,
)

#: If a measurement leaves less than this share of a variance, the short form of its update keeps too few digits.
_LEAST_SHARE = 1e-6


@shared(f"void({READ}, {READ}, {MATRIX})")
def complement(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Write I - A B."""
    product(A, B, out)
    for i in range(len(out)):
        for j in range(len(out)):
            out[i, j] = (1.0 if i == j else 0.0) - out[i, j]


@merged
def _predict(
    points: FloatArray, blocks: FloatArray, before: int, at: int, moved: FloatArray
) -> None:
    """Write the prediction [F P F' + Q | F x + f - x0] of the node `at`, and F P to `moved`."""
    n = len(moved)
    left, motion, noise = (
        blocks[before, FILTERED],
        blocks[before, F],
        blocks[before, Q],
    )
    ahead = blocks[at, PREDICTED]
    copy(noise, ahead)
    add_congruence(motion, left, moved, ahead)
    for i in range(n):
        ahead[i, n] = motion[i, n] - points[at, i]
        for j in range(n):
            ahead[i, n] += motion[i, j] * left[j, n]


@shared(f"b1({BLOCKS}, {VECTORS}, int64, int64, {VECTORS}, {VECTORS}, {VECTORS})")
def _condition(
    blocks: FloatArray,
    back: FloatArray,
    before: int,
    at: int,
    gain: FloatArray,
    E: FloatArray,
    work: FloatArray,
) -> bool:
    """Write A, b and C of the node `before`, given the next node `at`. False if A cannot be computed.

    A = P F' (F P F' + Q)^-1, and C = E P E' + A Q A' with E = I - A F. On entry `gain` holds F P.
    """
    n = len(gain)
    left, motion, ahead = (
        blocks[before, FILTERED],
        blocks[before, F],
        blocks[at, PREDICTED],
    )
    rest = blocks[before, C]
    copy(ahead, E)
    if not solve(E, gain):
        return False
    for i in range(n):
        back[i, n] = left[i, n]
        for j in range(n):
            back[i, j], rest[i, j] = gain[j, i], 0.0
            back[i, n] -= gain[j, i] * ahead[j, n]
    complement(back, motion, E)
    add_congruence(E, left, work, rest)
    add_congruence(back, blocks[before, Q], work, rest)
    return True


@shared(f"void({VECTORS}, {VECTORS}, int64, {TIMES}, {VECTORS}, {VECTORS}, {VECTORS})")
def _correct(
    state: FloatArray,
    rows: FloatArray,
    k: int,
    gain: FloatArray,
    E: FloatArray,
    P: FloatArray,
    work: FloatArray,
) -> None:
    """Fuse the measurement y = G x + N(0, 1) in row k of `rows`, [G | y], into `state` [P | x].

    A precise measurement is fused in Joseph's form.
    """
    n = len(gain)
    S, y = 1.0, rows[k, n]
    for i in range(n):
        gain[i] = 0.0
        for j in range(n):
            gain[i] += state[i, j] * rows[k, j]
        S += rows[k, i] * gain[i]
        y -= rows[k, i] * state[i, n]
    precise = S > 1.0 / _LEAST_SHARE
    if precise:
        copy(state, P)
    for i in range(n):
        gain[i] /= S
        state[i, n] += gain[i] * y
        for j in range(i + 1):
            state[i, j] = state[j, i] = state[i, j] - gain[i] * S * gain[j]
    if precise:
        for i in range(n):
            for j in range(n):
                E[i, j] = (1.0 if i == j else 0.0) - gain[i] * rows[k, j]
                state[i, j] = gain[i] * gain[j]
        add_congruence(E, P, work, state)


@inlined
def mean_given(back: FloatArray, later: FloatArray, out: FloatArray) -> None:
    """Write the mean A x + b of a node, given the next node, whose x stands in the last row of `later`."""
    n = len(back) - 1
    for i in range(n):
        value = back[i, n]
        for j in range(n):
            value += back[i, j] * later[n, j]
        out[i] = value


@njit(f"b1({INDICES}, {INDICES}, {INDICES}, b1, {NODES})")
def solve_windows(
    tracks: IntArray,
    starts: IntArray,
    anchors: IntArray,
    is_partial: bool,
    nodes: Arrays,
) -> bool:
    """Eliminate from `starts` on, let the windows begin at `anchors`, and write the steps of all nodes.

    The step of a node is A (step of the next node) + b. If `is_partial`, only eliminate up to the nodes at `anchors`.
    Returns True if all states are finite.
    """
    info, _, numbers, labels, backs, points, blocks, rows = nodes
    n = points.shape[1]
    check_nodes(tracks, nodes, 0)
    check_indices(anchors, tracks, nodes)
    check(len(starts) >= len(tracks))
    for t in range(len(tracks)):
        check(starts[t] >= 0)
    A, E, D, work, gain = (
        scratch(n, n),
        scratch(n, n),
        scratch(n, n),
        scratch(n, n),
        scratch(n),
    )
    for t in range(len(tracks)):
        of, track, count = numbers[tracks[t]], tracks[t], info[tracks[t], COUNT]
        for index in range(starts[t], anchors[t] + 1 if is_partial else count):
            at, before, state = (of[index], of[index - 1], blocks[of[index], FILTERED])
            if index > info[track, FIRST]:  # the oldest node has a prior instead
                _predict(points, blocks, before, at, A)
                if not _condition(blocks, backs[before], before, at, A, E, work):
                    return False
            copy(blocks[at, PREDICTED], state)
            for k in range(labels[at, NUM_ROWS]):
                _correct(state, rows[at], k, gain, E, D, work)
            for i in range(n):
                if not math.isfinite(state[i, i] + state[i, n]):
                    return False
        if is_partial:
            continue
        info[track, FIRST], info[track, KNOWN] = anchors[t], count
        for i in range(n):
            backs[of[count - 1], n, i] = blocks[of[count - 1], FILTERED][i, n]
        for index in range(count - 2, anchors[t] - 1, -1):
            mean_given(backs[of[index]], backs[of[index + 1]], backs[of[index], n])
    return True


@njit(f"void({INDICES}, {INDICES}, {TIMES}, {NODES}, {VECTORS})")
def smooth(
    tracks: IntArray,
    indices: IntArray,
    after_s: FloatArray,
    nodes: Arrays,
    means: FloatArray,
) -> None:
    """Compute the covariances of the nodes at `indices`, and of all later nodes, unless they are known.

    Nodes behind the window get their steps, too. Write the means (m, n) that a prediction to the stamp starts from:
    the mean of the node, or, where `after_s` > 0, the mean of the node before, given the node.
    """
    info, _, numbers, _, backs, points, blocks, _ = nodes
    n = points.shape[1]
    check_nodes(tracks, nodes, 0)
    check_indices(indices, tracks, nodes)
    check(min(len(after_s), len(means)) >= len(tracks) and means.shape[1] == n)
    work = scratch(n, n)
    for t in range(len(tracks)):
        track = tracks[t]
        check(indices[t] > 0 or not after_s[t] > 0.0)
        for index in range(info[track, KNOWN] - 1, indices[t] - 1, -1):
            at = numbers[track, index]
            if index == info[track, COUNT] - 1:
                copy(blocks[at, FILTERED], blocks[at, P])
                continue
            later, known = numbers[track, index + 1], blocks[at, P]
            copy(blocks[at, C], known)
            add_congruence(backs[at, :n], blocks[later, P], work, known)
            if index < info[track, FIRST]:
                mean_given(backs[at], backs[later], backs[at, n])
        info[track, KNOWN] = min(info[track, KNOWN], indices[t])
        at = start = numbers[track, indices[t]]
        for i in range(n):
            means[t, i] = backs[at, n, i]
        if after_s[t] > 0.0:
            start = numbers[track, indices[t] - 1]
            mean_given(backs[start], backs[at], means[t])
        for i in range(n):
            means[t, i] += points[start, i]

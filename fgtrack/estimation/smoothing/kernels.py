"""Compiled loops that solve windows: elimination forwards in time and back-substitution, and states at any stamp.

The windows are block-tridiagonal. Elimination is the Kalman filter; what it leaves of each node, given the next one, is
the gain and the covariance of the Rauch-Tung-Striebel smoother. No process noise is divided by, which vanishes between
stamps 1 us apart. `nodes` are the `arrays` of `Nodes`, in that order.

All arrays are contiguous, and blocks are copied entry by entry: numba compiles that in a fraction of the time.
"""

import math

import numpy as np

from fgtrack.core.compiled import (
    MATRIX,
    READ,
    add_congruence,
    check,
    check_rows,
    copy,
    inlined,
    merged,
    njit,
    product,
    scratch,
    shared,
    solve,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray

#: Where a measurement leaves less than this of a variance, the short form of its update keeps too few digits.
_LEAST_SHARE = 1e-6
#: Later than any stamp and index.
NEVER = int(np.iinfo(np.int64).max)
#: Instead of the number of a node.
NONE = -1
#: Columns of `tracks`: see `Nodes`.
COUNT, FIRST, KNOWN, BEGIN_NS, NONLINEAR = range(5)
#: Columns of `labels`.
NUM_ROWS, CHANGED, STALE, ROWS_STALE, NUM_PLUGINS = range(5)
#: Rows of `points` of a node, and its `blocks`.
ORIGIN, REFERENCE = range(2)
C, FILTERED, PREDICTED, P, F, Q = range(6)
#: Types of arguments.
INDICES, TIMES, VECTORS, MATRICES = (
    "int64[::1]",
    "float64[::1]",
    "float64[:, ::1]",
    "float64[:, :, ::1]",
)
BLOCKS = "float64[:, :, :, ::1]"
NODES = f"Tuple(({'int64[:, ::1], ' * 4}{MATRICES}, {MATRICES}, {BLOCKS}, {MATRICES}))"
Arrays = tuple[
    IntArray,
    IntArray,
    IntArray,
    IntArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
]
"""See `Nodes.arrays`."""


@inlined
def check_track(track: int, nodes: Arrays, spare: int) -> None:
    """Raise `IndexError` for a track, or the number of a node, beyond the ends of the arrays.
    With `spare` 1 the track needs the number of another node.
    """
    info, all_ns, numbers, labels, backs, points, blocks, rows = nodes
    size, n = len(labels), points.shape[2]
    check(0 <= track < len(info))
    check(
        len(all_ns) == len(info)
        and len(numbers) == len(info)
        and all_ns.shape[1] == numbers.shape[1]
    )
    check(
        len(backs) == size
        and len(points) == size
        and len(blocks) == size
        and len(rows) == size
    )
    check(
        backs.shape[1] == n + 1
        and backs.shape[2] == n + 1
        and blocks.shape[2] == n
        and blocks.shape[3] == n + 1
    )
    check(rows.shape[2] == n + 1)
    own = info[track]
    check(
        0 <= own[FIRST] < own[COUNT] <= all_ns.shape[1] - spare
        and 0 <= own[KNOWN] <= own[COUNT]
    )
    check_rows(numbers[track, : own[COUNT] + spare], 0, size)


@inlined
def check_nodes(tracks: IntArray, nodes: Arrays, spare: int) -> None:
    """See `check_track`."""
    for t in range(len(tracks)):
        check_track(tracks[t], nodes, spare)


@inlined
def check_indices(indices: IntArray, tracks: IntArray, nodes: Arrays) -> None:
    """Raise `IndexError` if a track lacks the node of its index; `indices` has one index for each of `tracks`."""
    check(len(indices) >= len(tracks))
    for t in range(len(tracks)):
        check_rows(indices[t : t + 1], 0, nodes[0][tracks[t], COUNT])


@inlined
def regularise(Q: FloatArray) -> None:
    """Add to process noise that leaves out a direction, see `linalg.regular`."""
    for i in range(Q.shape[0]):
        Q[i, i] += 1e-12 * max(Q[i, i], 1e-6)


@shared(f"void({READ}, {READ}, {MATRIX})")
def _complement(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Write I - A B."""
    product(A, B, out)
    for i in range(len(out)):
        for j in range(len(out)):
            out[i, j] = (1.0 if i == j else 0.0) - out[i, j]


@merged
def _predict(
    points: FloatArray, blocks: FloatArray, before: int, at: int, moved: FloatArray
) -> None:
    """Write the prediction [F P F' + Q | F x + f - x0], and F P to `moved`."""
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
        ahead[i, n] = motion[i, n] - points[at, ORIGIN, i]
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
    """A = P F' (F P F' + Q)^-1, b, C = E P E' + A Q A', E = I - A F; `gain` holds F P. False if there is no A."""
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
    _complement(back, motion, E)
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
    """Fuse y = G x + N(0, 1), [G | y] being row k, into `state` [P | x]; precise ones in Joseph's form."""
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
def _given(back: FloatArray, later: FloatArray, out: FloatArray) -> None:
    """Write the mean A x + b of a node given the next one, x being in the last row of `later`."""
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
    """Eliminate from `starts` on, let the windows begin at `anchors`, and write steps: A (step of the next node) + b.
    If `is_partial`, only eliminate up to the nodes at `anchors`. True if all is finite.
    """
    info, _, numbers, labels, backs, points, blocks, rows = nodes
    n = points.shape[2]
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
            if (
                index > info[track, FIRST]
            ):  # else the prior of the oldest node in the window, which follows from nothing
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
            _given(backs[of[index]], backs[of[index + 1]], backs[of[index], n])
    return True


@inlined
def last_before(all_ns: IntArray, count: int, stamp_ns: int) -> int:
    """Return the index of the newest node at or before `stamp_ns`; -1 without such a node."""
    index = count - 1
    while index >= 0 and all_ns[index] > stamp_ns:
        index -= 1
    return index


@njit(f"int64({INDICES}, {INDICES}, {NODES}, {INDICES}, {TIMES}, {TIMES})")
def locate(
    tracks: IntArray,
    stamps_ns: IntArray,
    nodes: Arrays,
    indices: IntArray,
    until_s: FloatArray,
    after_s: FloatArray,
) -> int:
    """Write the indices of the nodes after `stamps_ns`, or of the last ones, and the times around the stamps.
    Return how many are after them.
    """
    info, all_ns, _, _, _, _, _, _ = nodes
    num_between = 0
    check_nodes(tracks, nodes, 0)
    check(min(len(stamps_ns), len(indices), len(until_s), len(after_s)) >= len(tracks))
    for t in range(len(tracks)):
        of, last = all_ns[tracks[t]], info[tracks[t], COUNT] - 1
        index = last_before(of, last + 1, stamps_ns[t])
        check(index >= 0)
        until_s[t], after_s[t] = (stamps_ns[t] - of[index]) / NS_PER_S, 0.0
        if until_s[t] > 0.0 and index < last:
            index += 1
            after_s[t] = (of[index] - stamps_ns[t]) / NS_PER_S
            num_between += 1
        indices[t] = index
    return num_between


@njit(f"void({INDICES}, {INDICES}, {TIMES}, {NODES}, {VECTORS})")
def smooth(
    tracks: IntArray,
    indices: IntArray,
    after_s: FloatArray,
    nodes: Arrays,
    means: FloatArray,
) -> None:
    """Make the covariances of the nodes at `indices` known, and behind the window the steps; those on the way stay.
    Write the states that motion starts from: of these nodes, or where `after_s` the conditional one of those before.
    """
    info, _, numbers, _, backs, points, blocks, _ = nodes
    n = points.shape[2]
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
                _given(backs[at], backs[later], backs[at, n])
        info[track, KNOWN] = min(info[track, KNOWN], indices[t])
        at = start = numbers[track, indices[t]]
        for i in range(n):
            means[t, i] = backs[at, n, i]
        if after_s[t] > 0.0:
            start = numbers[track, indices[t] - 1]
            _given(backs[start], backs[at], means[t])
        for i in range(n):
            means[t, i] += points[start, ORIGIN, i]


_STATE = f"{TIMES}, {VECTORS}, {VECTORS}"


@shared(
    f"b1({MATRICES}, {BLOCKS}, {MATRICES}, int64, int64, {_STATE}, {_STATE}, {MATRICES})"
)
def _interpolate(
    points: FloatArray,
    blocks: FloatArray,
    backs: FloatArray,
    before: int,
    at: int,
    mean: FloatArray,
    F1: FloatArray,
    Q1: FloatArray,
    ahead: FloatArray,
    F2: FloatArray,
    Q2: FloatArray,
    work: FloatArray,
) -> bool:
    """Write mean and covariance of a state between two nodes over `mean` and `Q1`.
    See `rts.between` for Psi, Lambda and Sigma, which is E Q1 E' + Psi Q2 Psi'.
    """
    n = len(mean)
    S, gain, Psi, E, Lambda, by_right, half = (
        work[0],
        work[1],
        work[2],
        work[3],
        work[4],
        work[5],
        work[6],
    )
    for attempt in range(2):
        copy(Q2, S)
        add_congruence(F2, Q1, gain, S)
        if solve(S, gain):
            break
        if attempt == 1:
            return False
        regularise(Q1)
        regularise(Q2)
    for i in range(n):
        for j in range(n):
            Psi[i, j] = gain[j, i]
    _complement(Psi, F2, E)
    for i in range(n):
        for j in range(n):
            mean[i] += Psi[i, j] * (points[at, ORIGIN, j] + backs[at, n, j] - ahead[j])
    product(E, F1, Lambda)
    product(Lambda, backs[before], by_right)
    for i in range(n):
        for j in range(n):
            by_right[i, j] += Psi[i, j]
    copy(Q1, S)
    for i in range(n):
        for j in range(n):
            Q1[i, j] = 0.0
    add_congruence(by_right, blocks[at, P], half, Q1)
    add_congruence(Lambda, blocks[before, C], half, Q1)
    add_congruence(E, S, half, Q1)
    add_congruence(Psi, Q2, half, Q1)
    return True


@njit(
    f"b1({INDICES}, {INDICES}, {TIMES}, {NODES}, {', '.join([VECTORS, MATRICES, MATRICES] * 2)})"
)
def arrive(
    tracks: IntArray,
    indices: IntArray,
    after_s: FloatArray,
    nodes: Arrays,
    mean: FloatArray,
    F1: FloatArray,
    Q1: FloatArray,
    ahead: FloatArray,
    F2: FloatArray,
    Q2: FloatArray,
) -> bool:
    """Write covariances over `Q1` of states at `mean`, which has moved from where `smooth` let it start.
    Where `after_s`, the state is between two nodes, and `ahead` is what motion makes of it until the right one. False
    if noise is not definite there.
    """
    _, _, numbers, _, backs, points, blocks, _ = nodes
    n = mean.shape[1]
    check_nodes(tracks, nodes, 0)
    check_indices(indices, tracks, nodes)
    check(
        len(mean)
        <= min(
            len(tracks), len(after_s), len(F1), len(Q1), len(ahead), len(F2), len(Q2)
        )
    )
    check(
        n == points.shape[2]
        and ahead.shape[1] == n
        and F1.shape[1:] == (n, n)
        and Q1.shape[1:] == (n, n)
    )
    check(F2.shape[1:] == (n, n) and Q2.shape[1:] == (n, n))
    work = scratch(7, n, n)
    for t in range(len(mean)):
        at = numbers[tracks[t], indices[t]]
        check(indices[t] > 0 or not after_s[t] > 0.0)
        if after_s[t] > 0.0:
            before = numbers[tracks[t], indices[t] - 1]
            if not _interpolate(
                points,
                blocks,
                backs,
                before,
                at,
                mean[t],
                F1[t],
                Q1[t],
                ahead[t],
                F2[t],
                Q2[t],
                work,
            ):
                return False
        else:
            add_congruence(F1[t], blocks[at, P], work[0], Q1[t])
    return True

"""Compiled loops around the elimination of factor graphs: they write factors as matrices, and read conditionals.

`nodes` are those of `node_arrays`. Variables are states relative to their linearisation points x0. A block is at most
`MOST_NODES` successive nodes that are eliminated together. Its matrix [A | B | b] has the columns of its nodes, of the
next node if there is one, and of the right-hand side. Its rows are those of the `INFORMATION` of its first node, and
then, node by node, of the measurements and of the motion to the next node. In this order QR fills no column of a node
that is not a neighbour.
"""

import math

from fgtrack.core.compiled import (
    check,
    cholesky,
    copy,
    forward,
    inlined,
    merged,
    njit,
    regularise,
    scratch,
)
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.node_arrays import (
    COUNT,
    FIRST,
    INDICES,
    INFORMATION,
    INFORMED,
    MATRICES,
    NODES,
    NUM_ROWS,
    PREDICTED,
    Arrays,
    F,
    Q,
    check_indices,
    check_nodes,
)
from fgtrack.estimation.smoothing.solution_kernels import mean_given

#: Most nodes of a block: more nodes of a dense matrix cost more than a second matrix.
MOST_NODES = 4


@inlined
def _block_size(num_nodes: int) -> int:
    """Return the number of nodes in the first of the blocks for `num_nodes` nodes; the last block is as large as it
    can be.
    """
    if num_nodes <= MOST_NODES:
        return num_nodes
    return min(MOST_NODES, num_nodes - MOST_NODES)


@merged
def _write_prior(blocks: FloatArray, at: int, L: FloatArray) -> bool:
    """Write the square-root information of the prior of a node. False if the prior is not positive definite."""
    prior, information = blocks[at, PREDICTED], blocks[at, INFORMATION]
    n = len(prior)
    if not cholesky(prior, n, L):
        return False
    for i in range(n):
        information[i, n] = prior[i, n]
        for j in range(n):
            information[i, j] = 1.0 if i == j else 0.0
    forward(L, information)
    return True


@merged
def _write_motion(
    points: FloatArray,
    blocks: FloatArray,
    left: int,
    right: int,
    column: int,
    noise: FloatArray,
    L: FloatArray,
    out: FloatArray,
) -> bool:
    """Write the rows [W F | -W | W e] of the motion from a node to the next node. False if Q is invalid.

    The columns of the node begin at `column`. The motion is W (F d_left - d_right) = W e + N(0, I), with W' W = Q^-1
    and e = x0_right - f(x0_left).
    """
    motion, n, last = blocks[left, F], len(L), out.shape[1] - 1
    copy(blocks[left, Q], noise)
    if not cholesky(noise, n, L):
        regularise(noise)
        if not cholesky(noise, n, L):
            return False
    for i in range(n):
        out[i, last] = points[right, i] - motion[i, n]
        for j in range(n):
            out[i, column + j] = motion[i, j]
            out[i, column + n + j] = -1.0 if i == j else 0.0
    forward(L, out)
    return True


@njit(f"int64({INDICES}, {INDICES}, {INDICES}, {NODES}, {INDICES})")
def find_begins(
    tracks: IntArray,
    starts: IntArray,
    firsts: IntArray,
    nodes: Arrays,
    begins: IntArray,
) -> int:
    """Write the indices from which `tracks` must be eliminated, and return the number of their blocks.

    Factors have changed from the node before `starts` on. Elimination begins at the newest node before them that has
    `INFORMATION`, or at the oldest node, `firsts`.
    """
    info, _, numbers, labels, _, _, _, _ = nodes
    num = 0
    check_nodes(tracks, nodes, 0)
    check_indices(firsts, tracks, nodes)
    check(min(len(starts), len(begins)) >= len(tracks))
    for t in range(len(tracks)):
        of, count = numbers[tracks[t]], info[tracks[t], COUNT]
        index = max(min(starts[t], count) - 1, firsts[t])
        while index > firsts[t] and not labels[of[index], INFORMED]:
            index -= 1
        begins[t] = index
        while index < count:
            index += _block_size(count - index)
            num += 1
    return num


@njit(f"b1({INDICES}, {INDICES}, {INDICES}, {NODES}, int64[:, ::1], {MATRICES})")
def write_factors(
    tracks: IntArray,
    begins: IntArray,
    firsts: IntArray,
    nodes: Arrays,
    sizes: IntArray,
    factors: FloatArray,
) -> bool:
    """Write the blocks from `begins` on, of all `tracks` in turn. False if a covariance is invalid.

    `sizes` (blocks, 3) are the numbers of rows and nodes of each block, and 1 if there is a next node. The right-hand
    side is the last column of `factors`. The oldest node of a window, at the index `firsts`, gets the `INFORMATION` of
    its prior. Only the first block of a track has the rows of its `INFORMATION`; in later blocks these rows are zero.
    """
    info, _, numbers, labels, _, points, blocks, rows = nodes
    n, num, last = points.shape[1], 0, factors.shape[2] - 1
    L, noise = scratch(n, n), scratch(n, n)
    check_nodes(tracks, nodes, 0)
    check_indices(begins, tracks, nodes)
    check(len(firsts) >= len(tracks) and len(sizes) == len(factors))
    check(factors.shape[1] >= n + MOST_NODES * (n + rows.shape[1]))
    check(sizes.shape[1] >= 3 and last >= (MOST_NODES + 1) * n)
    for t in range(len(tracks)):
        of, count, index = numbers[tracks[t]], info[tracks[t], COUNT], begins[t]
        if index == firsts[t] and not _write_prior(blocks, of[index], L):
            return False
        while index < count:
            check(num < len(sizes))
            row, num_nodes = n, _block_size(count - index)
            out, earlier = factors[num], blocks[of[index], INFORMATION]
            for i in range(len(out)):
                for j in range(last + 1):
                    out[i, j] = 0.0
            if index == begins[t]:
                for i in range(n):
                    out[i, last] = earlier[i, n]
                    for j in range(n):
                        out[i, j] = earlier[i, j]
            for k in range(num_nodes):
                at, column = of[index + k], k * n
                for m in range(labels[at, NUM_ROWS]):
                    out[row, last] = rows[at, m, n]
                    for j in range(n):
                        out[row, column + j] = rows[at, m, j]
                    row += 1
                if index + k < count - 1:
                    own = out[row : row + n]
                    if not _write_motion(
                        points, blocks, at, of[index + k + 1], column, noise, L, own
                    ):
                        return False
                    row += n
            index += num_nodes
            sizes[num, 0], sizes[num, 1] = row, num_nodes
            sizes[num, 2] = index < count
            num += 1
    return True


@inlined
def _solve_node(
    conditional: FloatArray, row: int, has_next: bool, last: int, out: FloatArray
) -> None:
    """Write R^-1 [-S | b] of a node, whose rows and columns of [R | S | b] begin at `row`. R is upper triangular.

    Without a next node there is no S, and only the last column of `out` is written. b is in column `last`.
    """
    n = out.shape[1] - 1
    for c in range(0 if has_next else n, n + 1):
        for i in range(n - 1, -1, -1):
            value = (
                conditional[row + i, last]
                if c == n
                else -conditional[row + i, row + n + c]
            )
            for k in range(i + 1, n):
                value -= conditional[row + i, row + k] * out[k, c]
            out[i, c] = value / conditional[row + i, row + i]


@njit(f"b1({INDICES}, {INDICES}, {NODES}, {MATRICES}, {MATRICES})")
def read_conditionals(
    tracks: IntArray,
    begins: IntArray,
    nodes: Arrays,
    conditionals: FloatArray,
    information: FloatArray,
) -> bool:
    """Read the result of an elimination from `begins` on, and write the steps of all nodes in the windows.

    A conditional R d = b - S d_next + N(0, I) gives d = A d_next + b', with A = -R^-1 S and b' = R^-1 b. `conditionals`
    are those of the blocks, [R | S | b], with b in their last columns. `information` (blocks, n, n + 1) is what each
    block leaves on the next node. Returns True if all states are finite.
    """
    info, _, numbers, labels, backs, points, blocks, _ = nodes
    n, num, is_finite = points.shape[1], 0, True
    last = conditionals.shape[2] - 1
    check_nodes(tracks, nodes, 0)
    check_indices(begins, tracks, nodes)
    check(len(information) == len(conditionals))
    check(conditionals.shape[1] >= MOST_NODES * n and last >= (MOST_NODES + 1) * n)
    check(information.shape[1] == n and information.shape[2] == n + 1)
    for t in range(len(tracks)):
        of, count, index = numbers[tracks[t]], info[tracks[t], COUNT], begins[t]
        while index < count:
            check(num < len(conditionals))
            num_nodes = _block_size(count - index)
            for k in range(num_nodes):
                at, has_next = of[index + k], index + k < count - 1
                if k > 0:
                    labels[at, INFORMED] = 0
                _solve_node(conditionals[num], k * n, has_next, last, backs[at])
            index += num_nodes
            if index < count:
                copy(information[num], blocks[of[index], INFORMATION])
                labels[of[index], INFORMED] = 1
            num += 1
        newest = backs[of[count - 1]]
        for i in range(n):
            newest[n, i] = newest[i, n]
        for index in range(count - 1, info[tracks[t], FIRST] - 1, -1):
            if index < count - 1:
                mean_given(backs[of[index]], backs[of[index + 1]], backs[of[index], n])
            for i in range(n):
                is_finite = is_finite and math.isfinite(backs[of[index], n, i])
    return is_finite

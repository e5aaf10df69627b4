"""Compiled loops around the elimination of factor graphs: they write factors as matrices, and read conditionals.

`nodes` are those of `node_arrays`. Variables are states relative to their linearisation points x0.
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
    noise: FloatArray,
    L: FloatArray,
    out: FloatArray,
) -> bool:
    """Write the rows [W F | -W | W e] of the motion from a node to the next node. False if Q is invalid."""
    motion, n = blocks[left, F], len(L)
    copy(blocks[left, Q], noise)
    if not cholesky(noise, n, L):
        regularise(noise)
        if not cholesky(noise, n, L):
            return False
    for i in range(n):
        out[i, 2 * n] = points[right, i] - motion[i, n]
        for j in range(n):
            out[i, j], out[i, n + j] = motion[i, j], -1.0 if i == j else 0.0
    forward(L, out)
    return True


@njit(f"b1({INDICES}, {INDICES}, {INDICES}, {NODES}, {INDICES}, {MATRICES})")
def write_factors(
    tracks: IntArray,
    begins: IntArray,
    firsts: IntArray,
    nodes: Arrays,
    sizes: IntArray,
    factors: FloatArray,
) -> bool:
    """Write the factors of the nodes from `begins` on, of all `tracks` in turn. False if a covariance is invalid.

    The factor of a node has the rows of its measurements first, [G | 0 | y], and then the rows of the motion to the
    next node, [W F | -W | W e]. It is W (F d_left - d_right) = W e + N(0, I), with W' W = Q^-1, e = x0_right - f(x0_left).
    `sizes` are the numbers of rows. A track that begins at its oldest node, `firsts`, gets the `INFORMATION` of
    its prior there.
    """
    info, _, numbers, labels, _, points, blocks, rows = nodes
    n, num = points.shape[1], 0
    L, noise = scratch(n, n), scratch(n, n)
    check_nodes(tracks, nodes, 0)
    check_indices(begins, tracks, nodes)
    check(len(firsts) >= len(tracks) and len(sizes) == len(factors))
    check(factors.shape[1] >= n + rows.shape[1] and factors.shape[2] >= 2 * n + 1)
    for t in range(len(tracks)):
        of, last = numbers[tracks[t]], info[tracks[t], COUNT] - 1
        if begins[t] == firsts[t] and not _write_prior(blocks, of[begins[t]], L):
            return False
        check(num + last + 1 - begins[t] <= len(factors))
        for index in range(begins[t], last + 1):
            at, used = of[index], labels[of[index], NUM_ROWS]
            for k in range(used):
                factors[num, k, 2 * n] = rows[at, k, n]
                for j in range(n):
                    factors[num, k, j], factors[num, k, n + j] = rows[at, k, j], 0.0
            sizes[num] = used
            if index < last:
                own = factors[num, used : used + n]
                if not _write_motion(points, blocks, at, of[index + 1], noise, L, own):
                    return False
                sizes[num] += n
            num += 1
    return True


@inlined
def _back_substitute(
    conditional: FloatArray, columns: int, out: FloatArray
) -> None:
    """Write R^-1 [-S | d] of a conditional [R | S | d] with `columns` of S. R (n, n) is upper triangular."""
    n = len(conditional)
    for c in range(columns + 1):
        source = n + c
        for i in range(n - 1, -1, -1):
            value = conditional[i, source] if c == columns else -conditional[i, source]
            for k in range(i + 1, n):
                value -= conditional[i, k] * out[k, c]
            out[i, c] = value / conditional[i, i]


@njit(f"b1({INDICES}, {INDICES}, {NODES}, {MATRICES}, {MATRICES}, {MATRICES})")
def read_conditionals(
    tracks: IntArray,
    begins: IntArray,
    nodes: Arrays,
    inner: FloatArray,
    newest: FloatArray,
    information: FloatArray,
) -> bool:
    """Read the result of an elimination from `begins` on, and write the steps of all nodes in the windows.

    A conditional R d = b - S d_next + N(0, I) gives d = A d_next + b', with A = -R^-1 S and b' = R^-1 b. `inner`
    (num, n, 2n + 1) are the conditionals [R | S | b] of all nodes but the newest ones. `newest` (tracks, n, n + 1) are
    those of the newest nodes, [R | b]. `information` (num, n, n + 1) is what each of the `inner` nodes leaves on the next
    node. Returns True if all states are finite.
    """
    info, _, numbers, _, backs, points, blocks, _ = nodes
    n, num, is_finite = points.shape[1], 0, True
    check_nodes(tracks, nodes, 0)
    check_indices(begins, tracks, nodes)
    check(len(newest) >= len(tracks) and len(information) == len(inner))
    check(inner.shape[1] == n and inner.shape[2] == 2 * n + 1)
    check(newest.shape[1] == n and newest.shape[2] == n + 1)
    check(information.shape[1] == n and information.shape[2] == n + 1)
    step = scratch(n, 1)
    for t in range(len(tracks)):
        of, last = numbers[tracks[t]], info[tracks[t], COUNT] - 1
        check(num + last - begins[t] <= len(inner))
        for index in range(begins[t], last):
            _back_substitute(inner[num], n, backs[of[index]])
            copy(information[num], blocks[of[index + 1], INFORMATION])
            num += 1
        _back_substitute(newest[t], 0, step)
        for i in range(n):
            backs[of[last], n, i] = step[i, 0]
            is_finite = is_finite and math.isfinite(step[i, 0])
        for index in range(last - 1, info[tracks[t], FIRST] - 1, -1):
            mean_given(backs[of[index]], backs[of[index + 1]], backs[of[index], n])
            for i in range(n):
                is_finite = is_finite and math.isfinite(backs[of[index], n, i])
    return is_finite

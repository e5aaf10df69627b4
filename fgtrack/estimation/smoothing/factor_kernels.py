"""A compiled loop that writes the factors of windows as matrices; `nodes` are those of `node_arrays`."""

from fgtrack.core.compiled import (
    check,
    cholesky,
    copy,
    forward,
    njit,
    regularise,
    scratch,
)
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.node_arrays import (
    CHANGED,
    COUNT,
    INDICES,
    MATRICES,
    NODES,
    NUM_ROWS,
    ORIGIN,
    REFERENCE,
    Arrays,
    F,
    Q,
    check_nodes,
)


@njit(f"int64({INDICES}, {INDICES}, {NODES}, int64[:, ::1], {MATRICES})")
def changed_factors(
    tracks: IntArray,
    starts: IntArray,
    nodes: Arrays,
    owners: IntArray,
    factors: FloatArray,
) -> int:
    """Write the factors of `tracks` that have changed, from `starts` on. Return their number; -1 for an invalid Q.

    The factor of a node has the rows of its measurements first, then the rows of the motion to the next node. `owners`
    has the row of the track, the number of the node, the number of the next node or -1, and the number of rows.
    Variables d are states relative to the reference r. A measurement is [G | 0 | y + G (x0 - r)]. The motion
    W (F d_left - d_right) = W e + N(0, I), with W' W = Q^-1 and e = r_right - f(x0) - F (r_left - x0), is
    [W F | -W | W e].
    """
    info, _, numbers, labels, _, points, blocks, rows = nodes
    n, num = points.shape[2], 0
    L, noise, moved = scratch(n, n), scratch(n, n), scratch(n)
    check_nodes(tracks, nodes, 0)
    check(len(starts) >= len(tracks))
    check(len(owners) == len(factors) and owners.shape[1] >= 4)
    check(factors.shape[1] >= n + rows.shape[1] and factors.shape[2] >= 2 * n + 1)
    for t in range(len(tracks)):
        of, last = numbers[tracks[t]], info[tracks[t], COUNT] - 1
        check(0 <= starts[t] <= last + 1)
        for index in range(starts[t], last + 1):
            left, is_last = of[index], index == last
            used = labels[left, NUM_ROWS]
            size = used + (0 if is_last else n)
            if not labels[left, CHANGED] or not size:
                continue
            check(num < len(owners))
            labels[left, CHANGED] = 0
            right = -1 if is_last else of[index + 1]
            owners[num, 0], owners[num, 1] = t, left
            owners[num, 2], owners[num, 3] = right, size
            for j in range(n):
                moved[j] = points[left, ORIGIN, j] - points[left, REFERENCE, j]
            for k in range(used):
                factors[num, k, 2 * n] = rows[left, k, n]
                for j in range(n):
                    factors[num, k, j], factors[num, k, n + j] = rows[left, k, j], 0.0
                    factors[num, k, 2 * n] += rows[left, k, j] * moved[j]
            if not is_last:
                motion, own = blocks[left, F], factors[num, used:size]
                copy(blocks[left, Q], noise)
                if not cholesky(noise, n, L):
                    regularise(noise)
                    if not cholesky(noise, n, L):
                        return -1
                for i in range(n):
                    own[i, 2 * n] = points[right, REFERENCE, i] - motion[i, n]
                    for j in range(n):
                        own[i, j], own[i, n + j] = motion[i, j], -1.0 if i == j else 0.0
                        own[i, 2 * n] += motion[i, j] * moved[j]
                forward(L, own)
            num += 1
    return num

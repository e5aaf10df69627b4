"""A compiled loop that writes the factors of a window as matrices; `nodes` are those of `node_arrays`."""

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
    MATRICES,
    NODES,
    NUM_ROWS,
    ORIGIN,
    REFERENCE,
    Arrays,
    F,
    Q,
    check_track,
)


@njit(f"int64(int64, int64, {NODES}, int64[:, ::1], {MATRICES})")
def changed_factors(
    track: int, start: int, nodes: Arrays, owners: IntArray, factors: FloatArray
) -> int:
    """Write the factors of a track that have changed, from index `start` on. Return their number; -1 for an invalid Q.

    The factor of a node has the rows of its measurements first, then the rows of the motion to the next node. `owners`
    has the number of the node, the number of the next node or -1, and the number of rows. Variables d are states
    relative to the reference r. A measurement is [G | 0 | y + G (x0 - r)]. The motion
    W (F d_left - d_right) = W e + N(0, I), with W' W = Q^-1 and e = r_right - f(x0) - F (r_left - x0), is
    [W F | -W | W e].
    """
    info, _, numbers, labels, _, points, blocks, rows = nodes
    n, num = points.shape[2], 0
    L, noise, moved = scratch(n, n), scratch(n, n), scratch(n)
    check_track(track, nodes, 0)
    check(0 <= start <= info[track, COUNT])
    last = info[track, COUNT] - 1
    check(min(len(owners), len(factors)) >= last + 1 - start and owners.shape[1] >= 3)
    check(factors.shape[1] >= n + rows.shape[1] and factors.shape[2] >= 2 * n + 1)
    for index in range(start, last + 1):
        left, right = (
            numbers[track, index],
            -1 if index == last else numbers[track, index + 1],
        )
        used, size = (
            labels[left, NUM_ROWS],
            labels[left, NUM_ROWS] + (0 if index == last else n),
        )
        if not labels[left, CHANGED] or not size:
            continue
        labels[left, CHANGED] = 0
        owners[num, 0], owners[num, 1], owners[num, 2] = left, right, size
        for j in range(n):
            moved[j] = points[left, ORIGIN, j] - points[left, REFERENCE, j]
        for k in range(used):
            factors[num, k, 2 * n] = rows[left, k, n]
            for j in range(n):
                factors[num, k, j], factors[num, k, n + j] = rows[left, k, j], 0.0
                factors[num, k, 2 * n] += rows[left, k, j] * moved[j]
        if index < last:
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

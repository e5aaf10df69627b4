"""Compiled loops that give states at any stamp: at a node, between two nodes, or after the last node.

`nodes` are those of `node_arrays`.
"""

from fgtrack.core.compiled import (
    add_congruence,
    check,
    copy,
    njit,
    product,
    regularise,
    scratch,
    shared,
    solve,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.node_arrays import (
    BLOCKS,
    COUNT,
    INDICES,
    MATRICES,
    NODES,
    TIMES,
    VECTORS,
    Arrays,
    C,
    P,
    check_indices,
    check_nodes,
    last_before,
)
from fgtrack.estimation.smoothing.solution_kernels import complement

_STATE = f"{TIMES}, {VECTORS}, {VECTORS}"


@njit(f"int64({INDICES}, {INDICES}, {NODES}, {INDICES}, {TIMES}, {TIMES})")
def locate(
    tracks: IntArray,
    stamps_ns: IntArray,
    nodes: Arrays,
    indices: IntArray,
    until_s: FloatArray,
    after_s: FloatArray,
) -> int:
    """Write the index of the node at or after each stamp, or of the last node, and the times around the stamp.

    `until_s` is the time from the node at or before the stamp. `after_s` is the time to the node after the stamp, or 0.
    Return the number of stamps between two nodes.
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


@shared(
    f"b1({VECTORS}, {BLOCKS}, {MATRICES}, int64, int64, {_STATE}, {_STATE}, {MATRICES})"
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
    """Overwrite `mean` and `Q1` by mean and covariance of a state between two nodes.

    Psi, Lambda and Sigma are those of `rts.between`; Sigma is E Q1 E' + Psi Q2 Psi' with E = I - Psi F2. False if the
    process noise is not positive definite.
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
    complement(Psi, F2, E)
    for i in range(n):
        for j in range(n):
            mean[i] += Psi[i, j] * (points[at, j] + backs[at, n, j] - ahead[j])
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
    """Overwrite `Q1` by the covariances of the states at the stamps, and `mean` by the means between two nodes.

    `mean`, `F1` and `Q1` are the predictions of the means that `smooth` writes. Where `after_s` > 0, the state lies
    between two nodes, and `ahead`, `F2` and `Q2` are its prediction to the node after the stamp. False if the process
    noise is not positive definite there.
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
        n == points.shape[1]
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

"""Compiled loops that linearise the measurements and the motion of nodes; arrays are those of `node_arrays`."""

import math

from fgtrack.core.compiled import (
    check,
    forward,
    inlined,
    merged,
    njit,
    scratch,
    shared,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.node_arrays import (
    AHEAD_S,
    CODE,
    COUNT,
    INDICES,
    LOSS,
    NODES,
    NONLINEAR,
    NUM_PLUGINS,
    NUM_ROWS,
    POSE,
    ROOT,
    ROWS_STALE,
    SEEN,
    SIZE,
    STALE,
    TIMES,
    VECTORS,
    WIDTH,
    Arrays,
    F,
    Q,
    Seen,
    Z,
    check_nodes,
    check_seen,
)
from fgtrack.models.measurement_kernels import (
    NUM_COMPONENTS,
    POSE_SIZE,
    observe,
    penalty_and_weight,
    subtract,
)
from fgtrack.models.short_bends import ARC
from fgtrack.models.transitions import check_noise, transition

OBSERVATION_SPACE = f"Tuple(({f'{VECTORS}, ' * 5}{TIMES}, {TIMES}, {TIMES}))"
ObservationSpace = tuple[
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
]
"""Scratch for a measurement: (c, n + 1), (c, n), (n, n) twice, (c, c), (c,), (n,), (5,); c is `NUM_COMPONENTS`."""


@merged
def observation_space(n: int) -> ObservationSpace:
    """Return scratch for linearising a measurement at a state of dimension n."""
    return (
        scratch(NUM_COMPONENTS, n + 1),
        scratch(NUM_COMPONENTS, n),
        scratch(n, n),
        scratch(n, n),
        scratch(NUM_COMPONENTS, NUM_COMPONENTS),
        scratch(NUM_COMPONENTS),
        scratch(n),
        scratch(POSE_SIZE),
    )


@shared(
    f"void(int64, {TIMES}, {TIMES}, int64[:, ::1], {VECTORS}, int64, {OBSERVATION_SPACE})"
)
def observe_at(
    kind: int,
    noise: FloatArray,
    x: FloatArray,
    marks: IntArray,
    values: FloatArray,
    row: int,
    space: ObservationSpace,
) -> None:
    """Write [H | y] of the measurement that begins in `row` of a node, at the state x (n,) of the node.

    y is the innovation and H its Jacobian. They stand in the first array of `space`.
    """
    n, k = len(x), marks[SIZE, row]
    out, H, F1, Q1, _, h, moved, pose = space
    codes, ahead_s, is_cartesian = (
        marks[CODE, row : row + k],
        values[AHEAD_S, row],
        kind != ARC,
    )
    for a in range(POSE_SIZE):
        pose[a] = values[POSE + a, row]
    if ahead_s == 0.0:
        observe(codes, is_cartesian, x, pose, h, H)
    else:
        transition(kind, x, ahead_s, noise, moved, F1, Q1)
        observe(codes, is_cartesian, moved, pose, h, H)
    subtract(codes, values[Z, row : row + k], h, h)
    for a in range(k):
        out[a, n] = h[a]
        for j in range(n):
            out[a, j] = H[a, j]
            if ahead_s != 0.0:
                out[a, j] = 0.0
                for b in range(n):
                    out[a, j] += H[a, b] * F1[b, j]


@inlined
def whiten_rows(
    marks: IntArray, values: FloatArray, row: int, out: FloatArray, L: FloatArray
) -> None:
    """Overwrite `out` (k, m) by L^-1 out. R = L L' is the covariance of the measurement that begins in `row`."""
    k = marks[SIZE, row]
    for a in range(k):
        for b in range(a + 1):
            L[a, b] = values[ROOT + b, row + a]
    forward(L, out[:k])


@inlined
def length(out: FloatArray, k: int) -> float:
    """Return the length of the last column, from the first k rows of `out`."""
    total, last = 0.0, out.shape[1] - 1
    for a in range(k):
        total += out[a, last] * out[a, last]
    return math.sqrt(total)


@shared(f"void(int64, {TIMES}, int64, {NODES}, {SEEN}, {OBSERVATION_SPACE})")
def _linearise_rows(
    kind: int,
    noise: FloatArray,
    at: int,
    nodes: Arrays,
    seen: Seen,
    space: ObservationSpace,
) -> None:
    """Linearise the measurements of a node: rows [G | y] of y = G (x - x0) + N(0, I), weighted by the robust losses."""
    _, _, _, labels, _, points, _, rows = nodes
    marks, values = seen[0][at], seen[1][at]
    out, L, row = space[0], space[4], 0
    while row < labels[at, NUM_ROWS]:
        k = marks[SIZE, row]
        observe_at(kind, noise, points[at], marks, values, row, space)
        whiten_rows(marks, values, row, out, L)
        _, weight = penalty_and_weight(
            marks[LOSS, row], values[WIDTH, row], length(out, k)
        )
        share = math.sqrt(weight)
        for a in range(k):
            for j in range(out.shape[1]):
                rows[at, row + a, j] = share * out[a, j]
        row += k


@njit(f"void(int64, {TIMES}, {INDICES}, {INDICES}, {NODES}, {SEEN})")
def linearise(
    kind: int,
    noise: FloatArray,
    tracks: IntArray,
    starts: IntArray,
    nodes: Arrays,
    seen: Seen,
) -> None:
    """Linearise measurements and motion of the stale nodes of `tracks`, from the node before `starts` on.

    Linear measurements have moved with the linearisation point already. Measurements that a plug-in has linearised stay
    as they are.
    """
    info, all_ns, numbers, labels, _, points, blocks, _ = nodes
    n = points.shape[1]
    check_nodes(tracks, nodes, 0)
    check_seen(nodes, seen)
    check(len(starts) >= len(tracks))
    check_noise(kind, noise, n)
    mean = scratch(n)
    space = observation_space(n)
    for t in range(len(tracks)):
        track = tracks[t]
        for index in range(max(starts[t] - 1, 0), info[track, COUNT]):
            at = numbers[track, index]
            if labels[at, ROWS_STALE] or (labels[at, STALE] and info[track, NONLINEAR]):
                if not labels[at, NUM_PLUGINS]:
                    _linearise_rows(kind, noise, at, nodes, seen, space)
                labels[at, ROWS_STALE] = 0
            if labels[at, STALE] and index < info[track, COUNT] - 1:
                dt_s = (all_ns[track, index + 1] - all_ns[track, index]) / NS_PER_S
                motion = blocks[at, F]
                transition(kind, points[at], dt_s, noise, mean, motion, blocks[at, Q])
                for i in range(n):
                    motion[i, n] = mean[i]
            labels[at, STALE] = 0

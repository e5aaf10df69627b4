"""A compiled loop that gives the cost of a window, which a line search compares; arrays are those of `node_arrays`."""

import math

from fgtrack.core.compiled import (
    READ,
    check,
    copy,
    merged,
    njit,
    regularise,
    scratch,
    shared,
    whiten,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.linearisation_kernels import (
    OBSERVATION_SPACE,
    ObservationSpace,
    length,
    observation_space,
    observe_at,
    whiten_rows,
)
from fgtrack.estimation.smoothing.node_arrays import (
    COUNT,
    FIRST,
    LOSS,
    NODES,
    NUM_ROWS,
    PREDICTED,
    SEEN,
    SIZE,
    TIMES,
    VECTORS,
    WIDTH,
    Arrays,
    Q,
    Seen,
    check_seen,
    check_track,
)
from fgtrack.models.measurement_kernels import penalty_and_weight
from fgtrack.models.transitions import check_noise, transition


@merged
def _whitened(Q: FloatArray, gap: FloatArray, S: FloatArray) -> float:
    """Return gap' Q^-1 gap, and overwrite `gap`. Singular noise is made regular; `S` is scratch (n, n)."""
    n, kept = len(gap), scratch(len(gap))
    for i in range(n):
        kept[i] = gap[i]
    copy(Q, S)
    total = whiten(S, gap)
    if math.isnan(total):
        copy(Q, S)
        regularise(S)
        for i in range(n):
            gap[i] = kept[i]
        total = whiten(S, gap)
    return total


@shared(
    f"float64(int64, {TIMES}, {TIMES}, int64[:, ::1], {VECTORS}, int64, {OBSERVATION_SPACE})"
)
def _losses(
    kind: int,
    noise: FloatArray,
    x: FloatArray,
    marks: IntArray,
    values: FloatArray,
    num_rows: int,
    space: ObservationSpace,
) -> float:
    """Return the sum of the losses of the measurements of a node, at the state x (n,) of the node."""
    out, L, row, total = space[0], space[4], 0, 0.0
    while row < num_rows:
        observe_at(kind, noise, x, marks, values, row, space)
        whiten_rows(marks, values, row, out, L)
        loss, _ = penalty_and_weight(
            marks[LOSS, row], values[WIDTH, row], length(out, marks[SIZE, row])
        )
        total += loss
        row += marks[SIZE, row]
    return total


@njit(f"float64(int64, {TIMES}, int64, {READ}, {NODES}, {SEEN})")
def window_cost(
    kind: int,
    noise: FloatArray,
    track: int,
    means: FloatArray,
    nodes: Arrays,
    seen: Seen,
) -> float:
    """Return half of the sum of squares of a window at the states `means` (m, n), with the robust losses.

    The process noise is that of the linearisation points. NaN if a covariance is not positive definite.
    """
    info, all_ns, numbers, labels, _, points, blocks, _ = nodes
    n = points.shape[1]
    check_track(track, nodes, 0)
    check_seen(nodes, seen)
    check_noise(kind, noise, n)
    first, end = info[track, FIRST], info[track, COUNT]
    check(len(means) >= end - first and means.shape[1] == n)
    space, gap, x = observation_space(n), scratch(n), scratch(n)
    S, F1, moved = scratch(n, n), scratch(n, n), scratch(n)
    oldest, total = numbers[track, first], 0.0
    for index in range(first, end):
        at = numbers[track, index]
        for i in range(n):
            x[i] = means[index - first, i]
        if index == first:
            for i in range(n):
                gap[i] = x[i] - points[oldest, i]
                gap[i] -= blocks[oldest, PREDICTED][i, n]
            copy(blocks[oldest, PREDICTED], S)
            total += 0.5 * whiten(S, gap)
        else:
            for i in range(n):
                gap[i] = x[i] - moved[i]
            total += 0.5 * _whitened(blocks[numbers[track, index - 1], Q], gap, S)
        total += _losses(
            kind, noise, x, seen[0][at], seen[1][at], labels[at, NUM_ROWS], space
        )
        if index < end - 1:
            dt_s = (all_ns[track, index + 1] - all_ns[track, index]) / NS_PER_S
            transition(kind, x, dt_s, noise, moved, F1, S)
    return total

"""Compiled loops that move linearisation points; `nodes` and `seen` are those of `node_arrays`."""

from fgtrack.core.compiled import check, merged, njit, scratch, shared, wrapped
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.smoothing.linearisation_kernels import (
    ObservationSpace,
    length,
    observation_space,
    observe_at,
    whiten_rows,
)
from fgtrack.estimation.smoothing.node_arrays import (
    CODE,
    COUNT,
    FIRST,
    INDICES,
    NEVER,
    NODES,
    NONLINEAR,
    NUM_LEVELS,
    NUM_ROWS,
    PREDICTED,
    SEEN,
    SIZE,
    STALE,
    TIMES,
    VECTORS,
    Arrays,
    Seen,
    check_nodes,
    check_seen,
    check_track,
)
from fgtrack.models.measurement_kernels import BEARING, NUM_COMPONENTS, SPEED, YAW
from fgtrack.models.short_bends import ARC
from fgtrack.models.transitions import check_noise

#: A node that is about to leave the window is relinearised after a step of this share of the thresholds.
LEAVING_SHARE = 0.5
#: A node that is re-solved, because an older node has changed, is relinearised after a step of this share.
SOLVED_SHARE = 0.25


@merged
def _shift(track: int, at: int, steps: FloatArray, nodes: Arrays) -> None:
    """Move the linearisation point of a node by `steps` (n,), and all values that are relative to this point."""
    info, _, numbers, labels, backs, points, blocks, rows = nodes
    n, oldest = len(steps), info[track, FIRST]
    predicted = blocks[at, PREDICTED]
    for i in range(n):
        points[at, i] += steps[i]
        backs[at, n, i] -= steps[i]
        predicted[i, n] -= steps[i]
    for k in range(labels[at, NUM_ROWS]):
        for j in range(n):
            rows[at, k, n] -= rows[at, k, j] * steps[j]
    if oldest > 0 and numbers[track, oldest] == at:
        back = backs[numbers[track, oldest - 1]]
        for i in range(n):
            for j in range(n):
                back[i, n] += back[i, j] * steps[j]
    labels[at, STALE] = 1


@shared(f"int64(int64, int64, int64, {VECTORS}, {NODES}, b1, {INDICES})")
def move_points(
    track: int,
    anchor: int,
    start: int,
    thresholds: FloatArray,
    nodes: Arrays,
    moves: bool,
    indices: IntArray,
) -> int:
    """Return the number of nodes of a window whose steps exceed the thresholds; if `moves`, move their points.

    Writes at most len(indices) of their indices. `thresholds` (levels, n) has a row for each level of `NONLINEAR`.
    Nodes before `anchor` have `LEAVING_SHARE` of the thresholds. Nodes from `start` on, and after the first node that
    is too far, have `SOLVED_SHARE`.
    """
    info, _, numbers, _, backs, _, _, _ = nodes
    limits, num, moved = (
        thresholds[info[track, NONLINEAR]],
        0,
        scratch(thresholds.shape[1]),
    )
    for index in range(info[track, FIRST], info[track, COUNT]):
        steps, too_long = backs[numbers[track, index], len(limits)], False
        share = (
            SOLVED_SHARE
            if num or index >= start
            else LEAVING_SHARE
            if index < anchor
            else 1.0
        )
        for i in range(len(limits)):
            moved[i] = steps[i]
            if abs(steps[i]) > share * limits[i]:
                too_long = True
        if too_long:
            if moves:
                _shift(track, numbers[track, index], moved, nodes)
            if num < len(indices):
                indices[num] = index
            num += 1
    return num


@njit(f"int64({INDICES}, {VECTORS}, {NODES}, {INDICES}, {INDICES})")
def move_far(
    tracks: IntArray,
    thresholds: FloatArray,
    nodes: Arrays,
    far: IntArray,
    starts: IntArray,
) -> int:
    """Move linearisation points of whole windows, see `move_points`. Return the number of tracks with a moved point.

    Writes to `starts` the index of the first moved node of each track, or `NEVER`. `far` is scratch.
    """
    info, _, _, _, _, points, _, _ = nodes
    num = 0
    check_nodes(tracks, nodes, 0)
    check(thresholds.shape[1] == points.shape[1] and len(thresholds) >= NUM_LEVELS)
    check(len(far) > 0)
    check(len(starts) >= len(tracks))
    for t in range(len(tracks)):
        check(0 <= info[tracks[t], NONLINEAR] < len(thresholds))
    for t in range(len(tracks)):
        starts[t] = NEVER
        if move_points(tracks[t], 0, NEVER, thresholds, nodes, True, far):
            starts[t] = far[0]
            num += 1
    return num


@njit(f"int64(int64, {VECTORS}, {NODES}, {INDICES})")
def find_far(track: int, thresholds: FloatArray, nodes: Arrays, far: IntArray) -> int:
    """Return the number of nodes of a window that are far from their linearisation points, and write their indices."""
    info, _, _, _, _, points, _, _ = nodes
    check_track(track, nodes, 0)
    check(thresholds.shape[1] == points.shape[1] and len(thresholds) >= NUM_LEVELS)
    check(0 <= info[track, NONLINEAR] < len(thresholds))
    return move_points(track, 0, NEVER, thresholds, nodes, False, far)


@merged
def _overshoots(
    kind: int,
    noise: FloatArray,
    at: int,
    mean: FloatArray,
    nodes: Arrays,
    seen: Seen,
    space: ObservationSpace,
    linear: FloatArray,
) -> bool:
    """True if the step of a node to `mean` (n,) left the linear range of a measurement.

    Outside this range the linearisation predicts a measurement wrong by more than a standard deviation. `linear` is
    scratch (c, 1).
    """
    _, _, _, labels, _, points, _, _ = nodes
    marks, values = seen[0][at], seen[1][at]
    out, L, n, row = space[0], space[4], len(mean), 0
    origin, is_far = points[at], False
    while row < labels[at, NUM_ROWS]:
        k = marks[SIZE, row]
        last = marks[CODE, row + k - 1]
        if last > SPEED or (last >= YAW and kind != ARC):
            observe_at(kind, noise, origin, marks, values, row, space)
            for a in range(k):
                linear[a, 0] = out[a, n]
                for j in range(n):
                    linear[a, 0] -= out[a, j] * (mean[j] - origin[j])
            observe_at(kind, noise, mean, marks, values, row, space)
            for a in range(k):
                linear[a, 0] = out[a, n] - linear[a, 0]
                if marks[CODE, row + a] == YAW or marks[CODE, row + a] == BEARING:
                    linear[a, 0] = wrapped(linear[a, 0])
            whiten_rows(marks, values, row, linear, L)
            is_far = is_far or length(linear, k) > 1.0
        row += k
    return is_far


@njit(
    f"int64(int64, {TIMES}, {INDICES}, {VECTORS}, {NODES}, {SEEN}, {INDICES}, b1[::1])"
)
def overshot(
    kind: int,
    noise: FloatArray,
    tracks: IntArray,
    thresholds: FloatArray,
    nodes: Arrays,
    seen: Seen,
    far: IntArray,
    out: BoolArray,
) -> int:
    """Write True for tracks with a node that `move_points` would move and that overshoots. Return their number.

    `far` is scratch with an entry for each node of a track.
    """
    info, all_ns, numbers, _, backs, points, _, _ = nodes
    n, num = points.shape[1], 0
    check_nodes(tracks, nodes, 0)
    check_seen(nodes, seen)
    check_noise(kind, noise, n)
    check(thresholds.shape[1] == n and len(thresholds) >= NUM_LEVELS)
    check(len(far) >= all_ns.shape[1])
    check(len(out) >= len(tracks))
    for t in range(len(tracks)):
        check(0 <= info[tracks[t], NONLINEAR] < len(thresholds))
    space = observation_space(n)
    linear, mean = scratch(NUM_COMPONENTS, 1), scratch(n)
    for t in range(len(tracks)):
        out[t] = False
        num_far = move_points(tracks[t], 0, NEVER, thresholds, nodes, False, far)
        for k in range(num_far):
            at = numbers[tracks[t], far[k]]
            for i in range(n):
                mean[i] = points[at, i] + backs[at, n, i]
            if _overshoots(kind, noise, at, mean, nodes, seen, space, linear):
                out[t] = True
        num += out[t]
    return num

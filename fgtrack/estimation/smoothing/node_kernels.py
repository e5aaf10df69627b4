"""Compiled loops that insert, move, linearise and forget nodes; `nodes` are the `arrays` of `Nodes`, in that order.

`seen` are its arrays `marks` (size, 3, rows) and `values` (size, 16, rows), which hold the measurements of the nodes. A
measurement of k components has k rows, of which the first one holds what the measurement has once. Rows of `marks` are
the code of a component, the number k and the kind of the robust loss. Rows of `values` are z, the sensor pose, the
width of the loss, the time from the node to the measurement, and the lower Cholesky root of R.
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
    scratch,
    shared,
    wrapped,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.smoothing.kernels import (
    BEGIN_NS,
    CHANGED,
    COUNT,
    FIRST,
    INDICES,
    KNOWN,
    MATRICES,
    NEVER,
    NODES,
    NONLINEAR,
    NUM_PLUGINS,
    NUM_ROWS,
    ORIGIN,
    PREDICTED,
    REFERENCE,
    ROWS_STALE,
    STALE,
    TIMES,
    VECTORS,
    Arrays,
    F,
    Q,
    check_indices,
    check_nodes,
    check_track,
    last_before,
    regularise,
)
from fgtrack.estimation.smoothing.terms import NEAR_NS
from fgtrack.models.measurement_kernels import (
    BEARING,
    NUM_COMPONENTS,
    POSE_SIZE,
    SPEED,
    YAW,
    check_components,
    observe,
    penalty_and_weight,
    subtract,
)
from fgtrack.models.transitions import ARC, check_noise, transition

#: Nodes that are about to leave the window are relinearised where they have moved by this share of the thresholds.
LEAVING_SHARE = 0.5
#: Levels of `NONLINEAR`: linear tracks, tracks with a nonlinear measurement, and with a robust loss.
NUM_LEVELS = 3
#: Nodes that are re-solved because an older one has changed, by this one.
SOLVED_SHARE = 0.25
#: Nodes behind the window are forgotten when there are so many that nobody needs.
_MANY = 16
#: Flags that `place` returns: measurements lie behind a window, an R has no root, rows are lacking and nothing is done.
BEHIND, NOT_DEFINITE, NO_ROOM = 1, 2, 4
#: Rows of `marks` and of `values`, and the number of the latter.
CODE, SIZE, LOSS = range(3)
Z, POSE, WIDTH, AHEAD_S, ROOT = 0, 1, 1 + POSE_SIZE, 2 + POSE_SIZE, 3 + POSE_SIZE
NUM_VALUES = ROOT + NUM_COMPONENTS
#: Instead of the kind of a loss: compiled loops do not contain the model of the measurement.
PLUGIN = -1
SEEN = f"Tuple((int64[:, :, ::1], {MATRICES}))"
Seen = tuple[IntArray, FloatArray]
_SPACE = f"Tuple(({f'{VECTORS}, ' * 5}{TIMES}, {TIMES}, {TIMES}))"
_Space = tuple[
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


@inlined
def check_seen(nodes: Arrays, seen: Seen) -> None:
    """Raise `IndexError` unless the arrays of measurements are as large as those of the nodes."""
    marks, values = seen
    _, _, _, labels, _, _, _, rows = nodes
    check(labels.shape[1] > NUM_PLUGINS)
    check(len(marks) == len(labels) and len(values) == len(labels))
    check(marks.shape[1] > LOSS and values.shape[1] >= NUM_VALUES)
    check(marks.shape[2] == rows.shape[1] and values.shape[2] == rows.shape[1])


@merged
def _forget(track: int, reach_ns: int, nodes: Arrays) -> None:
    """Forget nodes behind the window that are older than one at or before `reach_ns`, if they are many."""
    info, stamps_ns, numbers, _, _, _, _, _ = nodes
    count, all_ns, of = info[track, COUNT], stamps_ns[track], numbers[track]
    many = (
        0
        if all_ns[_MANY - 1] > reach_ns
        else min(last_before(all_ns, count, reach_ns), info[track, FIRST] - 1)
    )
    if many < _MANY:
        return
    for index in range(count):
        later = index + many
        all_ns[index] = all_ns[later] if later < count else NEVER
        if later < count:
            of[index], of[later] = of[later], of[index]
    for column in (COUNT, FIRST, KNOWN):
        info[track, column] -= many


@njit(f"int64({INDICES}, int64, int64, int64, {NODES}, int64[:, ::1])")
def windows(
    tracks: IntArray,
    clock_ns: int,
    lag_ns: int,
    behind_ns: int,
    nodes: Arrays,
    out: IntArray,
) -> int:
    """Write the newest stamps of `tracks`, the starts of their windows, the oldest stamps that are fused, and the
    indices of the nodes where the windows will begin; older nodes are kept as far as those stamps need them. Return the
    largest number of nodes.
    """
    info, all_ns, _, _, _, _, _, _ = nodes
    most = 0
    check_nodes(tracks, nodes, 0)
    check(len(out) >= 4 and out.shape[1] >= len(tracks) and all_ns.shape[1] >= _MANY)
    for t in range(len(tracks)):
        track = tracks[t]
        newest_ns, begin_ns = (
            all_ns[track, info[track, COUNT] - 1],
            info[track, BEGIN_NS],
        )
        start_ns = max(max(newest_ns, clock_ns) - lag_ns, begin_ns)
        out[0, t], out[1, t], out[2, t] = (
            newest_ns,
            start_ns,
            max(start_ns - behind_ns, begin_ns),
        )
        _forget(track, out[2, t], nodes)
        out[3, t] = max(
            info[track, FIRST], last_before(all_ns[track], info[track, COUNT], start_ns)
        )
        most = max(most, info[track, COUNT])
    return most


@merged
def _shift(track: int, at: int, steps: FloatArray, nodes: Arrays) -> None:
    """Move the linearisation point of a node by `steps`, and all that is relative to it."""
    info, _, numbers, labels, backs, points, blocks, rows = nodes
    n, oldest = len(steps), info[track, FIRST]
    predicted = blocks[at, PREDICTED]
    for i in range(n):
        points[at, ORIGIN, i] += steps[i]
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


_MOVE_FAR = f"int64(int64, int64, int64, {VECTORS}, {NODES}, b1, {INDICES})"


@shared(_MOVE_FAR)
def _move_far(
    track: int,
    anchor: int,
    start: int,
    thresholds: FloatArray,
    nodes: Arrays,
    moves: bool,
    indices: IntArray,
) -> int:
    """Move linearisation points, if it `moves`, where the step is longer than the thresholds; return their number.
    Of their `indices` so many are written as there is room for. `thresholds` are those of linear and nonlinear tracks,
    (2, n). A `LEAVING_SHARE` holds for nodes before `anchor`, a `SOLVED_SHARE` from `start` on and after the first node
    that is too far.
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
    """Move linearisation points of whole windows, see `_move_far`; return the number of tracks that have moved.

    Writes the index of the first node of each track that has moved, else `NEVER`; `far` is space.
    """
    info, _, _, _, _, points, _, _ = nodes
    num = 0
    check_nodes(tracks, nodes, 0)
    check(thresholds.shape[1] == points.shape[2] and len(thresholds) >= NUM_LEVELS)
    check(len(far) > 0)
    check(len(starts) >= len(tracks))
    for t in range(len(tracks)):
        check(0 <= info[tracks[t], NONLINEAR] < len(thresholds))
    for t in range(len(tracks)):
        starts[t] = NEVER
        if _move_far(tracks[t], 0, NEVER, thresholds, nodes, True, far):
            starts[t] = far[0]
            num += 1
    return num


@njit(f"int64(int64, {VECTORS}, {NODES}, {INDICES})")
def find_far(track: int, thresholds: FloatArray, nodes: Arrays, far: IntArray) -> int:
    """Write the indices of the nodes of a window that lie far from their linearisation points; return how many."""
    info, _, _, _, _, points, _, _ = nodes
    check_track(track, nodes, 0)
    check(thresholds.shape[1] == points.shape[2] and len(thresholds) >= NUM_LEVELS)
    check(0 <= info[track, NONLINEAR] < len(thresholds))
    return _move_far(track, 0, NEVER, thresholds, nodes, False, far)


@shared(f"void(int64, {TIMES}, {TIMES}, int64[:, ::1], {VECTORS}, int64, {_SPACE})")
def _observe(
    kind: int,
    noise: FloatArray,
    x: FloatArray,
    marks: IntArray,
    values: FloatArray,
    row: int,
    space: _Space,
) -> None:
    """Write [H | y] of the measurement from `row` of a node on, near the state x (n,) of the node, into the space."""
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
def _whiten(
    marks: IntArray, values: FloatArray, row: int, out: FloatArray, L: FloatArray
) -> None:
    """Overwrite rows of `out` (k, m) by L^-1 out, with the root of the covariance of the measurement from `row` on."""
    k = marks[SIZE, row]
    for a in range(k):
        for b in range(a + 1):
            L[a, b] = values[ROOT + b, row + a]
    forward(L, out[:k])


@inlined
def _length(out: FloatArray, k: int) -> float:
    """Return the length of the last column of the first k rows."""
    total, last = 0.0, out.shape[1] - 1
    for a in range(k):
        total += out[a, last] * out[a, last]
    return math.sqrt(total)


@shared(f"void(int64, {TIMES}, int64, {NODES}, {SEEN}, {_SPACE})")
def _linearise_rows(
    kind: int, noise: FloatArray, at: int, nodes: Arrays, seen: Seen, space: _Space
) -> None:
    """Linearise the measurements of a node, weighted by their losses: rows [G | y] of y = G (x - x0) + N(0, I)."""
    _, _, _, labels, _, points, _, rows = nodes
    marks, values = seen[0][at], seen[1][at]
    out, L, row = space[0], space[4], 0
    while row < labels[at, NUM_ROWS]:
        k = marks[SIZE, row]
        _observe(kind, noise, points[at, ORIGIN], marks, values, row, space)
        _whiten(marks, values, row, out, L)
        _, weight = penalty_and_weight(
            marks[LOSS, row], values[WIDTH, row], _length(out, k)
        )
        share = math.sqrt(weight)
        for a in range(k):
            for j in range(out.shape[1]):
                rows[at, row + a, j] = share * out[a, j]
        row += k
    labels[at, CHANGED] = 1


@njit(f"float64(int64, {TIMES}, int64, {VECTORS}, {NODES}, {SEEN})")
def measurement_cost(
    kind: int,
    noise: FloatArray,
    track: int,
    means: FloatArray,
    nodes: Arrays,
    seen: Seen,
) -> float:
    """Return the sum of the losses of all measurements of a window whose nodes have the states `means` (m, n)."""
    info, _, numbers, labels, _, points, _, _ = nodes
    n, total = points.shape[2], 0.0
    check_track(track, nodes, 0)
    check_seen(nodes, seen)
    check_noise(kind, noise, n)
    first, end = info[track, FIRST], info[track, COUNT]
    check(len(means) >= end - first and means.shape[1] == n)
    out, H, F1, Q1, L = (
        scratch(NUM_COMPONENTS, n + 1),
        scratch(NUM_COMPONENTS, n),
        scratch(n, n),
        scratch(n, n),
        scratch(NUM_COMPONENTS, NUM_COMPONENTS),
    )
    space = (
        out,
        H,
        F1,
        Q1,
        L,
        scratch(NUM_COMPONENTS),
        scratch(n),
        scratch(POSE_SIZE),
    )
    for index in range(first, end):
        at, row = numbers[track, index], 0
        marks, values = seen[0][at], seen[1][at]
        while row < labels[at, NUM_ROWS]:
            _observe(kind, noise, means[index - first], marks, values, row, space)
            _whiten(marks, values, row, out, L)
            loss, _ = penalty_and_weight(
                marks[LOSS, row],
                values[WIDTH, row],
                _length(out, marks[SIZE, row]),
            )
            total += loss
            row += marks[SIZE, row]
    return total


@merged
def _overshoots(
    kind: int,
    noise: FloatArray,
    at: int,
    mean: FloatArray,
    nodes: Arrays,
    seen: Seen,
    space: _Space,
    linear: FloatArray,
) -> bool:
    """True if the step of a node to `mean` left the linear range of a measurement.

    There the linearisation predicts a measurement wrong by more than a standard deviation. `linear` is space (c, 1).
    """
    _, _, _, labels, _, points, _, _ = nodes
    marks, values = seen[0][at], seen[1][at]
    out, L, n, row = space[0], space[4], len(mean), 0
    origin, is_far = points[at, ORIGIN], False
    while row < labels[at, NUM_ROWS]:
        k = marks[SIZE, row]
        last = marks[CODE, row + k - 1]
        if last > SPEED or (last >= YAW and kind != ARC):
            _observe(kind, noise, origin, marks, values, row, space)
            for a in range(k):
                linear[a, 0] = out[a, n]
                for j in range(n):
                    linear[a, 0] -= out[a, j] * (mean[j] - origin[j])
            _observe(kind, noise, mean, marks, values, row, space)
            for a in range(k):
                linear[a, 0] = out[a, n] - linear[a, 0]
                if marks[CODE, row + a] == YAW or marks[CODE, row + a] == BEARING:
                    linear[a, 0] = wrapped(linear[a, 0])
            _whiten(marks, values, row, linear, L)
            is_far = is_far or _length(linear, k) > 1.0
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
    """Write True for tracks with a node that `_move_far` would move and that `_overshoots`; return their number.

    `far` is space, as long as a track has nodes.
    """
    info, all_ns, numbers, _, backs, points, _, _ = nodes
    n, num = points.shape[2], 0
    check_nodes(tracks, nodes, 0)
    check_seen(nodes, seen)
    check_noise(kind, noise, n)
    check(thresholds.shape[1] == n and len(thresholds) >= NUM_LEVELS)
    check(len(far) >= all_ns.shape[1])
    check(len(out) >= len(tracks))
    for t in range(len(tracks)):
        check(0 <= info[tracks[t], NONLINEAR] < len(thresholds))
    space = (
        scratch(NUM_COMPONENTS, n + 1),
        scratch(NUM_COMPONENTS, n),
        scratch(n, n),
        scratch(n, n),
        scratch(NUM_COMPONENTS, NUM_COMPONENTS),
        scratch(NUM_COMPONENTS),
        scratch(n),
        scratch(POSE_SIZE),
    )
    linear, mean = scratch(NUM_COMPONENTS, 1), scratch(n)
    for t in range(len(tracks)):
        out[t] = False
        num_far = _move_far(tracks[t], 0, NEVER, thresholds, nodes, False, far)
        for k in range(num_far):
            at = numbers[tracks[t], far[k]]
            for i in range(n):
                mean[i] = points[at, ORIGIN, i] + backs[at, n, i]
            if _overshoots(kind, noise, at, mean, nodes, seen, space, linear):
                out[t] = True
        num += out[t]
    return num


@merged
def _insert(
    track: int, index: int, stamp_ns: int, mean: FloatArray, nodes: Arrays
) -> None:
    """Insert a node at `index`, linearised at `mean`; later nodes move up."""
    info, all_ns, numbers, labels, _, points, _, _ = nodes
    count = info[track, COUNT]
    at = numbers[track, count]
    for k in range(count, index, -1):
        all_ns[track, k], numbers[track, k] = (
            all_ns[track, k - 1],
            numbers[track, k - 1],
        )
    all_ns[track, index], numbers[track, index] = stamp_ns, at
    info[track, COUNT] = count + 1
    labels[at, NUM_ROWS], labels[at, NUM_PLUGINS], labels[at, ROWS_STALE] = 0, 0, 0
    labels[numbers[track, index - 1], STALE] = 1
    for i in range(len(mean)):
        points[at, ORIGIN, i] = mean[i]


@merged
def _note(
    at: int,
    z: FloatArray,
    R: FloatArray,
    components: IntArray,
    view: FloatArray,
    loss: int,
    ahead_s: float,
    nodes: Arrays,
    seen: Seen,
    L: FloatArray,
) -> bool:
    """Note a measurement in the next rows of a node, with R = L L'; False if R is not positive definite."""
    _, _, _, labels, _, _, _, _ = nodes
    marks, values, row, k = seen[0][at], seen[1][at], labels[at, NUM_ROWS], len(z)
    for a in range(k):
        marks[CODE, row + a], marks[SIZE, row + a] = components[a], k
        marks[LOSS, row + a], values[Z, row + a] = loss, z[a]
        for b in range(POSE_SIZE + 1):
            values[POSE + b, row + a] = view[b]
        values[AHEAD_S, row + a] = ahead_s
    labels[at, NUM_ROWS] = row + k
    labels[at, NUM_PLUGINS] += loss == PLUGIN
    if not cholesky(R, k, L):
        return False
    for a in range(k):
        for b in range(a + 1):
            values[ROOT + b, row + a] = L[a, b]
    return True


@merged
def _write_rows(
    at: int,
    y: FloatArray,
    H: FloatArray,
    mean: FloatArray,
    nodes: Arrays,
    L: FloatArray,
) -> None:
    """Write L^-1 [H | y + H (mean - x0)] of the last measurement into the rows of a node."""
    _, _, _, labels, _, points, _, rows = nodes
    k, n = H.shape
    own = rows[at, labels[at, NUM_ROWS] - k : labels[at, NUM_ROWS]]
    for i in range(k):
        own[i, n] = y[i]
        for j in range(n):
            own[i, j] = H[i, j]
            own[i, n] += H[i, j] * (mean[j] - points[at, ORIGIN, j])
    labels[at, CHANGED] = 1
    forward(L, own)


@njit(
    f"int64({INDICES}, int64, {VECTORS}, {MATRICES}, {MATRICES}, {VECTORS}, b1, {VECTORS}, {INDICES}, {VECTORS},"
    f" {INDICES}, {TIMES}, int64, {NODES}, {SEEN}, int64[:, ::1], {TIMES})"
)
def place(
    tracks: IntArray,
    stamp_ns: int,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    means: FloatArray,
    is_linear: bool,
    thresholds: FloatArray,
    anchors: IntArray,
    z: FloatArray,
    components: IntArray,
    view: FloatArray,
    loss: int,
    nodes: Arrays,
    seen: Seen,
    out: IntArray,
    ahead_s: FloatArray,
) -> int:
    """Move linearisation points that are far, and insert nodes and measurements: innovations y (m, k) at `means`.

    The measurements z (m, k) of `components` have the pose and the width of the loss in `view` (6,). Nodes at most
    `NEAR_NS` away are shared. Writes number and index of the nodes, 1 of those that are new, where elimination must
    start and, with nodes inserted behind them, where windows begin, 1 if the measurement is older, and where the window
    has begun, and space; and the time from the node to the measurement. Returns flags.
    """
    info, all_ns, numbers, labels, _, points, _, rows = nodes
    m, n, k, flags = len(tracks), points.shape[2], y.shape[1], 0
    check_nodes(tracks, nodes, 1)
    check_seen(nodes, seen)
    check_indices(anchors, tracks, nodes)
    check_components(components, n)
    check(
        min(len(y), len(z), len(R), len(means), len(ahead_s)) >= m
        and (len(H) == 1 or len(H) >= m)
    )
    check(
        H.shape[1] == k
        and H.shape[2] == n
        and R.shape[1] == k
        and R.shape[2] == k
        and z.shape[1] == k
        and len(components) == k
        and len(view) > POSE_SIZE
        and means.shape[1] == n
    )
    check(len(out) >= 8 and out.shape[1] >= m and thresholds.shape[1] == n)
    L = scratch(k, k)
    for t in range(m):
        check(0 <= info[tracks[t], NONLINEAR] < len(thresholds))
        before = last_before(
            all_ns[tracks[t]], info[tracks[t], COUNT], stamp_ns + NEAR_NS
        )
        used, is_new = 0, all_ns[tracks[t], before] < stamp_ns - NEAR_NS
        if not is_new:
            used = labels[numbers[tracks[t], before], NUM_ROWS]
        if used + k > rows.shape[1]:
            return NO_ROOM
    for t in range(len(tracks)):
        track = tracks[t]
        before = last_before(all_ns[track], info[track, COUNT], stamp_ns + NEAR_NS)
        is_new = all_ns[track, before] < stamp_ns - NEAR_NS
        index, is_behind = before + is_new, before < anchors[t]
        far = out[7, t:]  # of which the next track writes over all but the first
        num = _move_far(track, anchors[t], before, thresholds, nodes, True, far)
        if is_new:
            _insert(track, index, stamp_ns, means[t], nodes)
        at = numbers[track, index]
        ahead_s[t] = (stamp_ns - all_ns[track, index]) / NS_PER_S
        if not _note(
            at, z[t], R[t], components, view, loss, ahead_s[t], nodes, seen, L
        ):
            flags |= NOT_DEFINITE
        elif is_linear and ahead_s[t] == 0.0:
            _write_rows(at, y[t], H[min(t, len(H) - 1)], means[t], nodes, L)
        else:
            labels[at, ROWS_STALE] = 1
        flags |= BEHIND if is_behind else 0
        labels[at, STALE] = 1
        start = far[0] + (is_new and far[0] >= index) if num else index
        out[0, t], out[1, t], out[2, t], out[3, t] = (
            at,
            index,
            is_new,
            min(index, start),
        )
        out[4, t], out[5, t], out[6, t] = (
            anchors[t] + (is_behind and is_new),
            is_behind,
            info[track, FIRST],
        )
    return flags


@njit(f"void(int64, {TIMES}, {INDICES}, {INDICES}, {NODES}, {SEEN})")
def linearise(
    kind: int,
    noise: FloatArray,
    tracks: IntArray,
    starts: IntArray,
    nodes: Arrays,
    seen: Seen,
) -> None:
    """Linearise the stale nodes of `tracks`, the node before `starts` and later ones: measurements, and motion.

    Linear measurements have moved with the linearisation point already. Measurements that a plug-in has linearised stay
    as they are.
    """
    info, all_ns, numbers, labels, _, points, blocks, _ = nodes
    n = points.shape[2]
    check_nodes(tracks, nodes, 0)
    check_seen(nodes, seen)
    check(len(starts) >= len(tracks))
    check_noise(kind, noise, n)
    mean = scratch(n)
    space = (
        scratch(NUM_COMPONENTS, n + 1),
        scratch(NUM_COMPONENTS, n),
        scratch(n, n),
        scratch(n, n),
        scratch(NUM_COMPONENTS, NUM_COMPONENTS),
        scratch(NUM_COMPONENTS),
        scratch(n),
        scratch(POSE_SIZE),
    )
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
                transition(
                    kind, points[at, ORIGIN], dt_s, noise, mean, motion, blocks[at, Q]
                )
                for i in range(n):
                    motion[i, n] = mean[i]
                labels[at, CHANGED] = 1
            labels[at, STALE] = 0


@njit(f"int64(int64, int64, {NODES}, int64[:, ::1], {MATRICES})")
def changed_factors(
    track: int, start: int, nodes: Arrays, owners: IntArray, factors: FloatArray
) -> int:
    """Write the factors of a track from index `start` on that have changed. Return their number; -1 for an invalid Q.

    A factor is that of the measurements of a node, in its first rows, and of its motion to the next one, if there is
    one. Number and next number, or -1, and the number of rows are in `owners`. Motion is
    W (F d_left - d_right) = W e + N(0, I), d relative to the reference, W' W = Q^-1 and e = r_right - f(x0) - F (r_left
    - x0): [W F | -W | W e] in `factors`; measurements are [G | 0 | y + G (x0 - r)].
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

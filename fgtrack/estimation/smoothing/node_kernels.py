"""Compiled loops that insert, move, linearise and forget nodes; `nodes` are the `arrays` of `Nodes`, in that order."""

from fgtrack.core.compiled import (
    check,
    cholesky,
    copy,
    forward,
    merged,
    njit,
    scratch,
    shared,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
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
    NUM_ROWS,
    ORIGIN,
    PREDICTED,
    REFERENCE,
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
from fgtrack.models.transitions import check_noise, transition

#: Nodes that are about to leave the window are relinearised where they have moved by this share of the thresholds.
LEAVING_SHARE = 0.5
#: Nodes that are re-solved because an older one has changed, by this one.
SOLVED_SHARE = 0.25
#: Nodes behind the window are forgotten when there are so many that nobody needs.
_MANY = 16
#: Flags that `place` returns: of measurements behind a window, of some to linearise, of an R without a root.
BEHIND, NOT_PLAIN, NOT_DEFINITE = 1, 2, 4


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


@njit(_MOVE_FAR)
def move_far(
    track: int,
    anchor: int,
    start: int,
    thresholds: FloatArray,
    nodes: Arrays,
    moves: bool,
    indices: IntArray,
) -> int:
    """See `_move_far`."""
    info, _, _, _, _, points, _, _ = nodes
    check_track(track, nodes, 0)
    check(
        thresholds.shape[1] == points.shape[2]
        and 0 <= info[track, NONLINEAR] < len(thresholds)
    )
    return _move_far(track, anchor, start, thresholds, nodes, moves, indices)


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
    labels[at, NUM_ROWS], labels[numbers[track, index - 1], STALE] = 0, 1
    for i in range(len(mean)):
        points[at, ORIGIN, i] = mean[i]


@merged
def _observe(
    at: int,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    mean: FloatArray,
    nodes: Arrays,
    L: FloatArray,
) -> bool:
    """Append L^-1 [H | y + H (mean - x0)], R = L L', to the rows of a node; False if R is not positive definite."""
    _, _, _, labels, _, points, _, rows = nodes
    k, n = H.shape
    own = rows[at, labels[at, NUM_ROWS] : labels[at, NUM_ROWS] + k]
    for i in range(k):
        own[i, n] = y[i]
        for j in range(n):
            own[i, j] = H[i, j]
            own[i, n] += H[i, j] * (mean[j] - points[at, ORIGIN, j])
    labels[at, NUM_ROWS], labels[at, CHANGED] = labels[at, NUM_ROWS] + k, 1
    if not cholesky(R, k, L):
        return False
    forward(L, own)
    return True


@njit(
    f"int64({INDICES}, int64, {VECTORS}, {MATRICES}, {MATRICES}, {VECTORS}, b1, {VECTORS}, {INDICES}, {NODES},"
    f" int64[:, ::1], {TIMES})"
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
    nodes: Arrays,
    out: IntArray,
    ahead_s: FloatArray,
) -> int:
    """Move linearisation points that are far, and insert nodes and measurements: innovations y (m, k) at `means`.
    Nodes at most `NEAR_NS` away are shared. Writes number and index of the nodes, 1 of those that are new, where
    elimination must start and, with nodes inserted behind them, where windows begin, 1 if the measurement is older, and
    where the window has begun, and space; and the time from the node to the measurement. Returns flags.
    """
    info, all_ns, numbers, labels, _, points, _, rows = nodes
    m, n, k, flags = len(tracks), points.shape[2], y.shape[1], 0
    check_nodes(tracks, nodes, 1)
    check_indices(anchors, tracks, nodes)
    check(
        min(len(y), len(R), len(means), len(ahead_s)) >= m
        and (len(H) == 1 or len(H) >= m)
    )
    check(
        H.shape[1] == k
        and H.shape[2] == n
        and R.shape[1] == k
        and R.shape[2] == k
        and means.shape[1] == n
    )
    check(len(out) >= 8 and out.shape[1] >= m and thresholds.shape[1] == n)
    for t in range(m):
        check(0 <= info[tracks[t], NONLINEAR] < len(thresholds))
    L = scratch(k, k)
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
        is_plain = (
            is_linear
            and ahead_s[t] == 0.0
            and labels[at, NUM_ROWS] + k <= rows.shape[1]
        )
        if is_plain and not _observe(
            at, y[t], H[min(t, len(H) - 1)], R[t], means[t], nodes, L
        ):
            flags |= NOT_DEFINITE
        flags |= (BEHIND if is_behind else 0) | (0 if is_plain else NOT_PLAIN)
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


@njit(f"void(int64, {TIMES}, {INDICES}, {INDICES}, {NODES})")
def linearise_motion(
    kind: int, noise: FloatArray, tracks: IntArray, starts: IntArray, nodes: Arrays
) -> None:
    """Linearise the motion from nodes that are stale, the one before `starts` and later ones, to the next ones."""
    info, all_ns, numbers, labels, _, points, blocks, _ = nodes
    n = points.shape[2]
    check_nodes(tracks, nodes, 0)
    check(len(starts) >= len(tracks))
    check_noise(kind, noise, n)
    mean = scratch(n)
    for t in range(len(tracks)):
        track = tracks[t]
        for index in range(max(starts[t] - 1, 0), info[track, COUNT]):
            at = numbers[track, index]
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

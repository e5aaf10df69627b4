"""Compiled loops that insert measurements and their nodes, and forget nodes; arrays are those of `node_arrays`."""

from fgtrack.core.compiled import check, cholesky, forward, merged, njit, scratch
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.node_arrays import (
    AHEAD_S,
    BEGIN_NS,
    CODE,
    COUNT,
    FIRST,
    INDICES,
    KNOWN,
    LOSS,
    MATRICES,
    NEVER,
    NODES,
    NONLINEAR,
    NUM_PLUGINS,
    NUM_ROWS,
    PLUGIN,
    POSE,
    ROOT,
    ROWS_STALE,
    SEEN,
    SIZE,
    STALE,
    TIMES,
    VECTORS,
    Arrays,
    Seen,
    Z,
    check_indices,
    check_nodes,
    check_seen,
    last_before,
)
from fgtrack.estimation.smoothing.relinearisation_kernels import move_points
from fgtrack.estimation.smoothing.terms import NEAR_NS
from fgtrack.models.measurement_kernels import POSE_SIZE, STACK, Stack, check_stack

#: Nodes behind the window are forgotten once at least this number of them is no longer needed.
_MANY = 16
#: Flags that `place` returns: a measurement lies behind a window, an R is not positive definite, and a node has too few
#: rows (nothing is done then).
BEHIND, NOT_DEFINITE, NO_ROOM = 1, 2, 4
LINEARISED = f"Tuple(({VECTORS}, {MATRICES}, {VECTORS}))"
Linearised = tuple[FloatArray, FloatArray, FloatArray]
"""Innovations y (m, k), their Jacobians H, (1, k, n) or (m, k, n), and the states (m, n) at which they are."""


@merged
def _forget(track: int, reach_ns: int, nodes: Arrays) -> None:
    """Forget nodes behind the window, if they are many, but keep the newest node at or before `reach_ns`."""
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
    """Write the windows of `tracks` to `out`, shape (4, m), and return the largest number of nodes of a track.

    The rows are the newest stamps, the starts of the windows, the oldest stamps that can be fused, and the indices of
    the nodes where the windows will begin. A window has the length `lag_ns` before the newest stamp, or before
    `clock_ns`. Stamps within `behind_ns` before a window can still be fused. Nodes that no such stamp needs are
    forgotten.
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
def _insert(
    track: int, index: int, stamp_ns: int, mean: FloatArray, nodes: Arrays
) -> None:
    """Insert a node at `index` of a track, linearised at `mean` (n,). Later nodes move up."""
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
        points[at, i] = mean[i]


@merged
def _note(
    at: int,
    stack: Stack,
    own: int,
    ahead_s: float,
    nodes: Arrays,
    seen: Seen,
    L: FloatArray,
) -> bool:
    """Write the measurement in the row `own` of `stack` into the next rows of a node, with R = L L'.

    False if R is not positive definite.
    """
    _, _, _, labels, _, _, _, _ = nodes
    components, view, loss, z, R = stack
    marks, values, row, k = seen[0][at], seen[1][at], labels[at, NUM_ROWS], z.shape[1]
    for a in range(k):
        marks[CODE, row + a], marks[SIZE, row + a] = components[a], k
        marks[LOSS, row + a], values[Z, row + a] = loss, z[own, a]
        for b in range(POSE_SIZE + 1):
            values[POSE + b, row + a] = view[b]
        values[AHEAD_S, row + a] = ahead_s
    labels[at, NUM_ROWS] = row + k
    labels[at, NUM_PLUGINS] += loss == PLUGIN
    if not cholesky(R[own], k, L):
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
    """Write L^-1 [H | y + H (mean - x0)] into the rows of the last measurement of a node."""
    _, _, _, labels, _, points, _, rows = nodes
    k, n = H.shape
    own = rows[at, labels[at, NUM_ROWS] - k : labels[at, NUM_ROWS]]
    for i in range(k):
        own[i, n] = y[i]
        for j in range(n):
            own[i, j] = H[i, j]
            own[i, n] += H[i, j] * (mean[j] - points[at, j])
    forward(L, own)


@njit(
    f"int64({INDICES}, int64, {STACK}, {LINEARISED}, b1, {VECTORS}, {INDICES}, {NODES}, {SEEN}, int64[:, ::1], {TIMES})"
)
def place(
    tracks: IntArray,
    stamp_ns: int,
    stack: Stack,
    linearised: Linearised,
    is_linear: bool,
    thresholds: FloatArray,
    anchors: IntArray,
    nodes: Arrays,
    seen: Seen,
    out: IntArray,
    ahead_s: FloatArray,
) -> int:
    """Insert nodes and a stack of measurements, one of each of `tracks`; move linearisation points that are far.

    `linearised` has the innovations y (m, k), their Jacobians H, (1, k, n) or (m, k, n), and the states `means` (m, n)
    at which they are. A node at most `NEAR_NS` away is shared. Writes to the rows of `out`, shape (8, m):

    - number and index of the node, and 1 if it is new;
    - the index at which elimination must start;
    - the index at which the window begins, shifted by nodes that were inserted before it;
    - 1 if the measurement is older than the window, the index at which the window has begun, and scratch.

    Writes to `ahead_s` (m,) the time from the node to the measurement. Returns flags.
    """
    info, all_ns, numbers, labels, _, points, _, rows = nodes
    y, H, means = linearised
    m, n, k, flags = len(tracks), points.shape[1], y.shape[1], 0
    check_nodes(tracks, nodes, 1)
    check_seen(nodes, seen)
    check_indices(anchors, tracks, nodes)
    check_stack(stack, m, k, n)
    check(min(len(y), len(means), len(ahead_s)) >= m and means.shape[1] == n)
    check((len(H) == 1 or len(H) >= m) and H.shape[1] == k and H.shape[2] == n)
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
        far = out[7, t:]  # scratch: the next track overwrites all but the first entry
        num = move_points(track, anchors[t], before, thresholds, nodes, True, far)
        if is_new:
            _insert(track, index, stamp_ns, means[t], nodes)
        at = numbers[track, index]
        ahead_s[t] = (stamp_ns - all_ns[track, index]) / NS_PER_S
        if not _note(at, stack, t, ahead_s[t], nodes, seen, L):
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

"""Compiled loops that insert, move, linearise and forget nodes; `nodes` are the `arrays` of `Nodes`, in that order."""

import numpy as np

from fgtrack.core.compiled import cholesky, copy, inlined, njit
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.kernels.kalman import innovate
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
    block,
    last_before,
    regularise,
)
from fgtrack.estimation.smoothing.terms import NEAR_NS
from fgtrack.models.transitions import transition

#: Nodes that are about to leave the window are relinearised where they have moved by this share of the thresholds.
LEAVING_SHARE = 0.5
#: Nodes that are solved again, because an older one has changed, by this one.
SOLVED_SHARE = 0.25
#: Nodes behind the window are forgotten when there are so many that nobody needs.
_MANY = 16
#: Flags that `place` returns: a measurement behind a window, at another stamp than its node, with an R without a root.
NO_ROOM, BEHIND, SHARED, NOT_DEFINITE = -1, 1, 2, 4


@inlined
def _forget(track: int, reach_ns: int, nodes: Arrays) -> None:
    """Forget nodes behind the window that are older than one at or before `reach_ns`, if they are many."""
    info, stamps_ns, numbers, _, _, _, _ = nodes
    count, all_ns, of = info[track, COUNT], stamps_ns[track], numbers[track]
    most = info[track, FIRST] - 1
    if most < _MANY or all_ns[_MANY - 1] > reach_ns:
        return
    many = min(last_before(all_ns, count, reach_ns), most)
    if many < _MANY:
        return
    forgotten = of[:many].copy()
    for index in range(count - many):
        all_ns[index], of[index] = all_ns[index + many], of[index + many]
    for index in range(many):
        all_ns[count - many + index], of[count - many + index] = NEVER, forgotten[index]
    for column in (COUNT, FIRST, KNOWN):
        info[track, column] -= many


@njit(f"void({INDICES}, int64, int64, int64, {NODES}, int64[:, ::1])")
def windows(tracks: IntArray, clock_ns: int, lag_ns: int, behind_ns: int, nodes: Arrays, out: IntArray) -> None:
    """Write the newest stamps of `tracks`, the starts of their windows, the oldest stamps that are fused, and the
    indices of the nodes where the windows will begin; older nodes are kept as far as those stamps need them.
    """
    info, all_ns, _, _, _, _, _ = nodes
    for t in range(len(tracks)):
        track = tracks[t]
        newest_ns, begin_ns = all_ns[track, info[track, COUNT] - 1], info[track, BEGIN_NS]
        start_ns = max(max(newest_ns, clock_ns) - lag_ns, begin_ns)
        out[0, t], out[1, t], out[2, t] = newest_ns, start_ns, max(start_ns - behind_ns, begin_ns)
        _forget(track, out[2, t], nodes)
        out[3, t] = max(info[track, FIRST], last_before(all_ns[track], info[track, COUNT], start_ns))


@njit(f"void({MATRICES}, {INDICES}, {VECTORS}, {MATRICES}, {MATRICES}, {INDICES}, {MATRICES}, {TIMES})")
def innovations(
    P: FloatArray,
    of: IntArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    measured: IntArray,
    S: FloatArray,
    nis: FloatArray,
) -> None:
    """Write S = H P H' + R (m, k, k) of innovations y (m, k), P being that of row `of`, and the NIS of the `measured`
    ones; NaN where S has no root. H is (1, k, n) or (m, k, n).
    """
    K = np.empty((y.shape[1], P.shape[1]))
    for i in range(len(y)):
        nis[i] = innovate(P[of[i]], y[i], H[min(i, len(H) - 1)], R[i], measured, S[i], K)


@inlined
def _shift(track: int, at: int, steps: FloatArray, nodes: Arrays) -> None:
    """Move the linearisation point of a node by `steps`, and all that is relative to it."""
    info, _, numbers, labels, backs, values, rows = nodes
    n, oldest = len(steps), info[track, FIRST]
    predicted = block(values, at, PREDICTED)
    for i in range(n):
        values[at, ORIGIN, i] += steps[i]
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


@njit(f"void({INDICES}, {INDICES}, {VECTORS}, {NODES})")
def shift(tracks: IntArray, shifted: IntArray, steps: FloatArray, nodes: Arrays) -> None:
    """Move the linearisation points of the nodes `shifted` of `tracks`, one each, by `steps`."""
    for t in range(len(tracks)):
        _shift(tracks[t], shifted[t], steps[t], nodes)


@njit(f"int64(int64, int64, int64, {VECTORS}, {NODES}, b1, {INDICES})")
def move_far(
    track: int, anchor: int, start: int, thresholds: FloatArray, nodes: Arrays, moves: bool, indices: IntArray
) -> int:
    """Move linearisation points, if it `moves`, where the step is longer than the thresholds; return their number.
    Their indices are written. `thresholds` are those of linear and nonlinear tracks, (2, n). A `LEAVING_SHARE` holds
    for nodes before `anchor`, a `SOLVED_SHARE` from `start` on and after the first node that is too far.
    """
    info, _, numbers, _, backs, _, _ = nodes
    limits, num = thresholds[info[track, NONLINEAR]], 0
    for index in range(info[track, FIRST], info[track, COUNT]):
        steps, too_long = backs[numbers[track, index], len(limits)], False
        share = LEAVING_SHARE if index < anchor else 1.0
        if num or index >= start:
            share = SOLVED_SHARE
        for i in range(len(limits)):
            if abs(steps[i]) > share * limits[i]:
                too_long = True
        if too_long:
            if moves:
                _shift(track, numbers[track, index], steps[: len(limits)].copy(), nodes)
            indices[num] = index
            num += 1
    return num


@inlined
def _insert(track: int, index: int, stamp_ns: int, mean: FloatArray, nodes: Arrays) -> None:
    """Insert a node at `index`, linearised at `mean`; later nodes move up."""
    info, all_ns, numbers, labels, _, values, _ = nodes
    count = info[track, COUNT]
    at = numbers[track, count]
    for k in range(count, index, -1):
        all_ns[track, k], numbers[track, k] = all_ns[track, k - 1], numbers[track, k - 1]
    all_ns[track, index], numbers[track, index] = stamp_ns, at
    info[track, COUNT] = count + 1
    labels[at, NUM_ROWS], labels[numbers[track, index - 1], STALE] = 0, 1
    for i in range(len(mean)):
        values[at, ORIGIN, i] = mean[i]


@inlined
def _observe(
    at: int, y: FloatArray, H: FloatArray, R: FloatArray, mean: FloatArray, nodes: Arrays, L: FloatArray
) -> bool:
    """Append L^-1 [H | y + H (mean - x0)], R = L L', to the rows of a node; False if R is not positive definite."""
    _, _, _, labels, _, values, rows = nodes
    k, n = H.shape
    if not cholesky(R, k, L):
        return False
    used = labels[at, NUM_ROWS]
    for i in range(k):
        measured = y[i]
        for j in range(n):
            measured += H[i, j] * (mean[j] - values[at, ORIGIN, j])
        for j in range(n + 1):
            value = measured if j == n else H[i, j]
            for m in range(i):
                value -= L[i, m] * rows[at, used + m, j]
            rows[at, used + i, j] = value / L[i, i]
    labels[at, NUM_ROWS] += k
    labels[at, CHANGED] = 1
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
    where the window has begun; and the time from the node to the measurement. Returns flags; without room, nothing is
    changed.
    """
    info, all_ns, numbers, labels, _, _, rows = nodes
    k, flags = y.shape[1], 0
    far, L = np.empty(all_ns.shape[1], dtype=np.int64), np.empty((k, k))
    for t in range(len(tracks)):
        track = tracks[t]
        index = last_before(all_ns[track], info[track, COUNT], stamp_ns + NEAR_NS)
        is_new = all_ns[track, index] < stamp_ns - NEAR_NS
        out[1, t], out[2, t] = index, is_new
        used = 0 if is_new else labels[numbers[track, index], NUM_ROWS]
        if info[track, COUNT] == all_ns.shape[1] or used + k > rows.shape[1]:
            return NO_ROOM
    for t in range(len(tracks)):
        track, before, is_new = tracks[t], out[1, t], out[2, t]
        index, is_behind = before + is_new, before < anchors[t]
        num = move_far(track, anchors[t], before, thresholds, nodes, True, far)
        if is_new:
            _insert(track, index, stamp_ns, means[t], nodes)
        at = numbers[track, index]
        ahead_s[t] = (stamp_ns - all_ns[track, index]) / NS_PER_S
        if is_linear and ahead_s[t] == 0.0:
            flags |= 0 if _observe(at, y[t], H[min(t, len(H) - 1)], R[t], means[t], nodes, L) else NOT_DEFINITE
        flags |= (BEHIND if is_behind else 0) | (SHARED if ahead_s[t] != 0.0 else 0)
        labels[at, STALE] = 1
        start = far[0] + (is_new and far[0] >= index) if num else index
        out[0, t], out[1, t], out[3, t] = at, index, min(index, start)
        out[4, t], out[5, t], out[6, t] = anchors[t] + (is_behind and is_new), is_behind, info[track, FIRST]
    return flags


@njit(f"void(int64, {TIMES}, {INDICES}, {INDICES}, {NODES})")
def linearise_motion(kind: int, density: FloatArray, tracks: IntArray, starts: IntArray, nodes: Arrays) -> None:
    """Linearise the motion from nodes that are stale, the one before `starts` and later ones, to the next ones."""
    info, all_ns, numbers, labels, _, values, _ = nodes
    n = values.shape[2] - 1
    mean = np.empty(n)
    for t in range(len(tracks)):
        track = tracks[t]
        for index in range(max(starts[t] - 1, 0), info[track, COUNT]):
            at = numbers[track, index]
            if labels[at, STALE] and index < info[track, COUNT] - 1:
                dt_s = (all_ns[track, index + 1] - all_ns[track, index]) / NS_PER_S
                motion = block(values, at, F)
                transition(kind, values[at, ORIGIN, :n], dt_s, density, mean, motion, block(values, at, Q))
                for i in range(n):
                    motion[i, n] = mean[i]
                labels[at, CHANGED] = 1
            labels[at, STALE] = 0


@njit(f"int64({INDICES}, {INDICES}, {NODES}, int64[:, ::1], {MATRICES})")
def changed_factors(tracks: IntArray, starts: IntArray, nodes: Arrays, owners: IntArray, factors: FloatArray) -> int:
    """Write the factors from `starts` on that have changed; return their number, or -1 if a Q is not definite.

    A factor is that of the measurements of a node, in its first rows, and of its motion to the next one, if there is
    one. Row of `tracks`, index, number and next number, or -1, and the number of rows are in `owners`. Motion is
    W (F d_left - d_right) = W e + N(0, I), d relative to the reference, W' W = Q^-1 and e = r_right - f(x0) - F (r_left
    - x0): [(W F)'; -W'; (W e)'] in `factors`; measurements are [G'; 0; (y + G (x0 - r))'].
    """
    info, _, numbers, labels, _, values, rows = nodes
    n = values.shape[2] - 1
    L, noise, rhs = np.empty((n, n)), np.empty((n, n)), np.empty((n, 2 * n + 1))
    num = 0
    for t in range(len(tracks)):
        for index in range(starts[t], info[tracks[t], COUNT]):
            left, has_next = numbers[tracks[t], index], index < info[tracks[t], COUNT] - 1
            used = labels[left, NUM_ROWS]
            if not labels[left, CHANGED] or not (has_next or used):
                continue
            labels[left, CHANGED] = 0
            for k in range(used):
                factors[num, 2 * n, k] = rows[left, k, n]
                for j in range(n):
                    factors[num, j, k], factors[num, n + j, k] = rows[left, k, j], 0.0
                    factors[num, 2 * n, k] += rows[left, k, j] * (values[left, ORIGIN, j] - values[left, REFERENCE, j])
            owners[num, 0], owners[num, 1], owners[num, 2] = t, index, left
            owners[num, 3], owners[num, 4] = -1, used
            if has_next:
                right, motion = numbers[tracks[t], index + 1], block(values, left, F)
                owners[num, 3], owners[num, 4] = right, used + n
                copy(block(values, left, Q), noise)
                if not cholesky(noise, n, L):
                    regularise(noise)
                    if not cholesky(noise, n, L):
                        return -1
                for i in range(n):
                    rhs[i, 2 * n] = values[right, REFERENCE, i] - motion[i, n]
                    for j in range(n):
                        rhs[i, j], rhs[i, n + j] = motion[i, j], -1.0 if i == j else 0.0
                        rhs[i, 2 * n] -= motion[i, j] * (values[left, REFERENCE, j] - values[left, ORIGIN, j])
                for j in range(2 * n + 1):
                    for i in range(n):
                        value = rhs[i, j]
                        for m in range(i):
                            value -= L[i, m] * factors[num, j, used + m]
                        factors[num, j, used + i] = value / L[i, i]
            num += 1
    return num


@njit(f"b1({INDICES}, {TIMES}, {NODES})")
def write_steps(numbers: IntArray, delta: FloatArray, nodes: Arrays) -> bool:
    """Write the steps of nodes whose states are their reference + `delta`, one by one; True if all are finite."""
    _, _, _, _, backs, values, _ = nodes
    n, total = values.shape[2] - 1, 0.0
    for k in range(len(numbers)):
        at = numbers[k]
        for i in range(n):
            backs[at, n, i] = values[at, REFERENCE, i] - values[at, ORIGIN, i] + delta[k * n + i]
            total += abs(delta[k * n + i])
    return bool(np.isfinite(total))

"""Solving the linearised windows of many tracks together: elimination forwards, back-substitution backwards.

The windows are block-tridiagonal. Eliminating the nodes from the oldest on is the Kalman filter in Joseph's form; what
it leaves of each node, given the next one, is the gain and the covariance of the Rauch-Tung-Striebel smoother. They are
sums of positive semi-definite matrices throughout, and no process noise is divided by, which vanishes between stamps
1 us apart.

Tracks have windows of different lengths. All end at the same step, so those that take part are the first ones once they
are sorted by the length of what has to be done, longest first.
"""

from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import identity, inverse_roots, symmetrise
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes


class _Sorted(NamedTuple):
    tracks: IntArray
    """Longest first."""
    lengths: IntArray
    active: list[int]
    """How many tracks take part, by step from the one after which one step is left."""


def _sorted(tracks: IntArray, lengths: IntArray) -> _Sorted:
    if len(lengths) == 1 or (lengths == lengths[0]).all():
        return _Sorted(tracks, lengths, [len(tracks)] * int(lengths[0]))
    order = np.argsort(-lengths, kind="stable")
    order = order[lengths[order] > 0]
    lengths = lengths[order]
    active = np.searchsorted(-lengths, -np.arange(1, lengths[0] + 1), side="right")
    return _Sorted(tracks[order], lengths, active.tolist())


def eliminate(nodes: Nodes, tracks: IntArray, places: IntArray) -> None:
    """Eliminate the nodes of `tracks` from `places` on, which lie in the windows, one each.

    Raises `numpy.linalg.LinAlgError` where it fails.
    """
    tracks, lengths, active = _sorted(tracks, nodes.count[tracks] - places)
    longest, n = len(active), nodes.dim
    if not longest:
        return
    ends, first = nodes.count[tracks], nodes.first[tracks]
    at_places = ends - longest + np.arange(longest)[:, None]
    slots = nodes.slots[tracks, np.maximum(at_places, 0)]
    befores = nodes.slots[tracks, np.maximum(at_places - 1, 0)]
    F, Q = nodes.F[tracks, befores], nodes.Q[tracks, befores]
    misses = nodes.ahead[tracks, befores] - nodes.origin[tracks, slots]
    k = int(nodes.num_rows[tracks, slots].max())
    G, y = nodes.G[tracks, slots, :k], nodes.y[tracks, slots, :k]
    F_t, G_t, unit = _transposed(F), _transposed(G), identity(k)

    begins = longest - lengths
    before = tracks, befores[begins, np.arange(len(tracks))]
    x, P = nodes.filtered[before], nodes.P_filtered[before]
    oldest = ends - lengths == first
    has_oldest = bool(oldest.any())
    shape = longest, len(tracks), n
    predicted, filtered = np.zeros(shape), np.zeros(shape)
    P_predicted, P_filtered = np.zeros((*shape, n)), np.zeros((*shape, n))
    left, P_left = np.zeros(shape), np.zeros((*shape, n))
    for t in range(longest):
        m = active[longest - 1 - t]
        left[t, :m], P_left[t, :m] = x[:m], P[:m]
        x_next = np.vecdot(F[t, :m], x[:m, None]) + misses[t, :m]
        P_next = symmetrise(F[t, :m] @ P[:m] @ F_t[t, :m] + Q[t, :m])
        if has_oldest:
            starts = oldest[:m] & (begins[:m] == t)
            here = tracks[:m][starts], slots[t, :m][starts]
            x_next[starts], P_next[starts] = nodes.predicted[here], nodes.P_predicted[here]
        predicted[t, :m], P_predicted[t, :m] = x_next, P_next
        if k:
            GP = G[t, :m] @ P_next
            W = inverse_roots(GP @ G_t[t, :m] + unit)
            K = _transposed(W.mT @ (W @ GP))
            x_next = x_next + np.vecdot(K, (y[t, :m] - np.vecdot(G[t, :m], x_next[:, None]))[:, None])
            P_next = _joseph(P_next, K, G[t, :m])
        x[:m], P[:m] = x_next, P_next
        filtered[t, :m], P_filtered[t, :m] = x_next, P_next

    if not (np.isfinite(x).all() and np.isfinite(P).all()):
        raise np.linalg.LinAlgError("a state is not finite")
    done = at_places >= ends - lengths
    at = np.broadcast_to(tracks, done.shape)[done], slots[done]
    nodes.predicted[at], nodes.P_predicted[at] = predicted[done], P_predicted[done]
    nodes.filtered[at], nodes.P_filtered[at] = filtered[done], P_filtered[done]
    done &= at_places > first
    if done.any():
        at = np.broadcast_to(tracks, done.shape)[done], befores[done]
        f, left, P = F[done], left[done], P_left[done]
        W = inverse_roots(P_predicted[done])
        A = _transposed(W.mT @ (W @ (f @ P)))
        nodes.A[at], nodes.C[at] = A, _joseph(P, A, f, Q[done])
        nodes.b[at] = left - np.vecdot(A, predicted[done][:, None])


def _transposed(matrices: FloatArray) -> FloatArray:
    """A copy: products of many small matrices are faster than with a transposed view."""
    return np.ascontiguousarray(matrices.mT)


def _joseph(P: FloatArray, K: FloatArray, H: FloatArray, R: FloatArray | None = None) -> FloatArray:
    """`ekf.joseph` of stacks, without R for R = I, in half of the time."""
    E = identity(P.shape[-1]) - K @ H
    KR = K if R is None else K @ R
    return symmetrise(E @ P @ _transposed(E) + KR @ _transposed(K))


def substitute_means(nodes: Nodes, tracks: IntArray, thresholds: FloatArray, anchored: IntArray) -> IntArray:
    """Find the steps of the means of all nodes in the windows of `tracks`, from the newest back.

    Gives the tracks of which a node, after the first `anchored` ones of the window, is further than its `thresholds`
    from its linearisation point; shapes (tracks,) and (tracks, n) of all tracks.
    """
    tracks, _, active = _sorted(tracks, nodes.count[tracks] - nodes.first[tracks])
    longest = len(active)
    places = nodes.count[tracks] - longest + np.arange(longest)[:, None]
    slots = nodes.slots[tracks, np.maximum(places, 0)]
    A, b = nodes.A[tracks, slots], nodes.b[tracks, slots]
    steps = np.zeros((longest, len(tracks), nodes.dim))
    step = steps[-1] = nodes.filtered[tracks, slots[-1]]
    for t in range(longest - 2, -1, -1):
        m = active[longest - 1 - t]
        step = steps[t, :m] = np.vecdot(A[t, :m], step[:m, None]) + b[t, :m]
    done = places >= nodes.first[tracks]
    nodes.step[np.broadcast_to(tracks, done.shape)[done], slots[done]] = steps[done]
    far = (np.abs(steps) > thresholds[tracks]).any(axis=-1) & (places >= nodes.first[tracks] + anchored[tracks])
    return np.asarray(tracks[far.any(axis=0)])


def substitute(nodes: Nodes, tracks: IntArray, known: IntArray, places: IntArray) -> None:
    """Find the covariances of the nodes of `tracks` from `known` - 1 back to `places`, one each.

    Those from `known` on are found already; it is the number of nodes where none is. Behind the windows, find the means
    as well.
    """
    tracks_all = tracks
    newest = known == nodes.count[tracks]
    if newest.any():
        end = nodes.at(tracks[newest], known[newest] - 1)
        nodes.P[end] = nodes.P_filtered[end]
        known = known - newest
    lengths = known - places
    if not (lengths > 0).any():
        return
    order = np.argsort(-lengths, kind="stable")
    tracks, lengths, known = tracks_all[order], lengths[order], known[order]
    longest = int(lengths[0])
    at_right = nodes.at(tracks, known)
    places = known - 1 - np.arange(longest)[:, None]
    slots = nodes.slots[tracks, np.maximum(places, 0)]
    A, b, C = nodes.A[tracks, slots], nodes.b[tracks, slots], nodes.C[tracks, slots]
    A_t = _transposed(A)
    steps, covariances = np.empty(b.shape), np.empty(C.shape)
    behind = bool((places[lengths - 1, np.arange(len(tracks))] < nodes.first[tracks]).any())
    step, P = nodes.step[at_right], nodes.P[at_right]
    for t in range(longest):
        m = int(np.searchsorted(-lengths, -t, side="left"))
        if behind:
            step = steps[t, :m] = np.vecdot(A[t, :m], step[:m, None]) + b[t, :m]
        P = covariances[t, :m] = A[t, :m] @ P[:m] @ A_t[t, :m] + C[t, :m]
    done = np.arange(longest)[:, None] < lengths
    at = np.broadcast_to(tracks, done.shape)[done], slots[done]
    nodes.P[at] = symmetrise(covariances[done])
    if behind:
        nodes.step[at] = steps[done]

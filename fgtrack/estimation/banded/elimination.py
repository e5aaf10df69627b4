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

from fgtrack.core.linalg import congruence, identity, symmetrise
from fgtrack.core.types import IntArray
from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.ekf import joseph, kalman_gain, propagated


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
    unit = identity(k)

    begins = longest - lengths
    x = nodes.filtered[tracks, befores[begins, np.arange(len(tracks))]]
    P = nodes.P_filtered[tracks, befores[begins, np.arange(len(tracks))]]
    oldest = ends - lengths == first
    has_oldest = bool(oldest.any())
    shape = longest, len(tracks), n
    predicted, filtered, b = (np.zeros(shape) for _ in range(3))
    P_predicted, P_filtered, A, C = (np.zeros((*shape, n)) for _ in range(4))
    for t in range(longest):
        m = active[longest - 1 - t]
        f, q, xm, Pm = F[t, :m], Q[t, :m], x[:m], P[:m]
        x_next, P_next = np.vecdot(f, xm[:, None]) + misses[t, :m], propagated(f, Pm, q)
        if has_oldest:
            starts = oldest[:m] & (begins[:m] == t)
            P_next[starts] = nodes.P_predicted[tracks[:m][starts], slots[t, :m][starts]]
            x_next[starts] = nodes.predicted[tracks[:m][starts], slots[t, :m][starts]]
            f = np.where(starts[:, None, None], 0.0, f)  # nothing before the first node
            gain = np.linalg.solve(np.where(starts[:, None, None], identity(n), P_next), f @ Pm).mT
        else:
            gain = np.linalg.solve(P_next, f @ Pm).mT
        A[t, :m], C[t, :m] = gain, joseph(Pm, gain, f, q)
        b[t, :m] = xm - np.vecdot(gain, x_next[:, None])
        predicted[t, :m], P_predicted[t, :m] = x_next, P_next
        if k:
            g = G[t, :m]
            K, _ = kalman_gain(P_next, g, unit)
            x_next = x_next + np.vecdot(K, (y[t, :m] - np.vecdot(g, x_next[:, None]))[:, None])
            P_next = joseph(P_next, K, g, unit)
        x[:m], P[:m] = x_next, P_next
        filtered[t, :m], P_filtered[t, :m] = x_next, P_next

    if not (np.isfinite(x).all() and np.isfinite(P).all()):
        raise np.linalg.LinAlgError("a state is not finite")
    done = at_places >= ends - lengths
    at = np.broadcast_to(tracks, done.shape)[done], slots[done]
    nodes.predicted[at], nodes.P_predicted[at] = predicted[done], P_predicted[done]
    nodes.filtered[at], nodes.P_filtered[at] = filtered[done], P_filtered[done]
    done &= at_places > first
    at = np.broadcast_to(tracks, done.shape)[done], befores[done]
    nodes.A[at], nodes.b[at], nodes.C[at] = A[done], b[done], C[done]


def substitute_means(nodes: Nodes, tracks: IntArray) -> None:
    """Find the steps of the means of all nodes in the windows of `tracks`, from the newest back."""
    tracks, _, active = _sorted(tracks, nodes.count[tracks] - nodes.first[tracks])
    longest = len(active)
    places = nodes.count[tracks] - longest + np.arange(longest)[:, None]
    slots = nodes.slots[tracks, np.maximum(places, 0)]
    A, b = nodes.A[tracks, slots], nodes.b[tracks, slots]
    steps = np.empty((longest, len(tracks), nodes.dim))
    step = steps[-1] = nodes.filtered[tracks, slots[-1]]
    for t in range(longest - 2, -1, -1):
        m = active[longest - 1 - t]
        step = steps[t, :m] = np.vecdot(A[t, :m], step[:m, None]) + b[t, :m]
    done = places >= nodes.first[tracks]
    nodes.step[np.broadcast_to(tracks, done.shape)[done], slots[done]] = steps[done]


def substitute(nodes: Nodes, tracks: IntArray, known: IntArray, places: IntArray) -> None:
    """Find means and covariances of the nodes of `tracks` from `known` - 1 back to `places`, one each.

    Those from `known` on are found already; it is the number of nodes where none is.
    """
    tracks_all = tracks
    newest = known == nodes.count[tracks]
    if newest.any():
        at = nodes.at(tracks[newest], known[newest] - 1)
        nodes.step[at], nodes.P[at] = nodes.filtered[at], nodes.P_filtered[at]
        known = known - newest
    lengths = known - places
    if not (lengths > 0).any():
        return
    order = np.argsort(-lengths, kind="stable")
    tracks, lengths, known = tracks_all[order], lengths[order], known[order]
    right = nodes.at(tracks, known)
    step, P = nodes.step[right], nodes.P[right]
    for t in range(int(lengths[0])):
        m = int(np.searchsorted(-lengths, -t, side="left"))
        at = nodes.at(tracks[:m], known[:m] - 1 - t)
        A = nodes.A[at]
        step = np.vecdot(A, step[:m, None]) + nodes.b[at]
        P = symmetrise(congruence(A, P[:m]) + nodes.C[at])
        nodes.step[at], nodes.P[at] = step, P

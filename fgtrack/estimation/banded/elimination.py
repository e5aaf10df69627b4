"""Eliminating the nodes of the linearised windows of many tracks together, from the oldest on.

The windows are block-tridiagonal. Elimination is the Kalman filter; what it leaves of each node, given the next one, is
the gain and the covariance of the Rauch-Tung-Striebel smoother. No process noise is divided by, which vanishes between
stamps 1 us apart.
"""

import numpy as np

from fgtrack.core.linalg import congruence, identity, inverse_roots, symmetrise
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.banded.steps import Steps, forwards
from fgtrack.estimation.ekf import joseph, kalman_gain

#: Where a measurement leaves less than this of a variance, the short form of its update keeps too few digits.
LEAST_SHARE = 1e-6


def eliminate(nodes: Nodes, tracks: IntArray, places: IntArray) -> None:
    """Eliminate the nodes of `tracks` from `places` on, which lie in the windows, one each.

    Raises `numpy.linalg.LinAlgError` where it fails.
    """
    steps = forwards(tracks, places, nodes.count[tracks])
    if not steps.ends:
        return
    n = nodes.dim
    numbers = nodes.at(steps.tracks, steps.places)
    befores = nodes.at(steps.tracks, np.maximum(steps.places - 1, 0))
    inner = steps.places > nodes.first[steps.tracks]
    segment = nodes.segment.take(befores, axis=0)
    F, driven = segment[..., :n], segment[..., n:]  # the noise and the mean that F does not make
    driven[..., n] -= nodes.origin.take(numbers, axis=0)
    all_inner = bool(inner.all())
    if not all_inner:  # the prior of the oldest node in the window, which follows from nothing
        oldest = ~inner
        F[oldest], driven[oldest] = 0.0, nodes.predicted[numbers[oldest]]
    num_rows = nodes.num_rows.take(numbers)
    rows = nodes.rows.take(numbers, axis=0)[:, : int(num_rows.max())]
    begins = nodes.at(tracks[steps.order], np.maximum(places[steps.order] - 1, 0))
    with np.errstate(all="ignore"):  # what is not finite is found below
        left, filtered = _filtered(steps, nodes.filtered.take(begins, axis=0), F, driven, rows, num_rows)
        moved = F @ left
        predicted = driven + moved @ _beside_one(F).mT
    if (_variances(filtered) < LEAST_SHARE * _variances(predicted)).any():
        left, predicted, filtered = _filtered_joseph(steps, nodes.filtered.take(begins, axis=0), F, driven, rows)
        moved = F @ left
    if not np.isfinite(filtered).all():
        raise np.linalg.LinAlgError("a state is not finite")
    _symmetrise(predicted)
    _symmetrise(filtered)
    nodes.predicted[numbers], nodes.filtered[numbers] = predicted, filtered
    if not all_inner:
        befores, F, left, moved = befores[inner], F[inner], left[inner], moved[inner]
        predicted, segment = predicted[inner], segment[inner]
    if len(befores):
        nodes.back[befores], nodes.C[befores] = _conditionals(left, F, segment[..., n : 2 * n], moved, predicted)


def _variances(states: FloatArray) -> FloatArray:
    return np.diagonal(states, axis1=-2, axis2=-1)


def _symmetrise(states: FloatArray) -> None:
    states[..., :-1] = symmetrise(states[..., :-1])


def _beside_one(F: FloatArray) -> FloatArray:
    """[[F, 0], [0, 1]]."""
    n = F.shape[-1]
    larger = np.zeros((len(F), n + 1, n + 1))
    larger[:, :n, :n], larger[:, n, n] = F, 1.0
    return larger


def _filtered(
    steps: Steps, start: FloatArray, F: FloatArray, driven: FloatArray, rows: FloatArray, num_rows: IntArray
) -> tuple[FloatArray, FloatArray]:
    """States [P | x] before each step and after it.

    What is measured, G x - y, stands above the state in one vector with one joint covariance, [[S, G P], [P G', P]].
    Gaussian elimination of its first entries leaves P - P G' S^-1 G P, and the mean.
    """
    n, k = F.shape[-1], rows.shape[-2]
    both = np.empty((len(F), k + n, n))
    both[:, :k], both[:, k:] = rows[..., :n], identity(n)
    joint = np.empty((len(F), k + n, k + n + 1))
    np.matmul(both @ driven[..., :n], both.mT, out=joint[..., :-1])
    joint[:, range(k), range(k)] += 1.0
    joint[..., -1] = np.matvec(both, driven[..., n])
    joint[:, :k, -1] -= rows[..., n]
    along = both @ F
    across = along.mT
    state, left = start, np.empty(driven.shape)
    slices = steps.slices()
    most = np.maximum.reduceat(num_rows, [begin for begin, _ in slices]).tolist()
    for (begin, end), measured in zip(slices, most, strict=True):
        at, m = slice(begin, end), end - begin
        before = left[at] = state[:m]
        moved, table = along[at] @ before, joint[at]
        table[..., :-1] += moved[..., :n] @ across[at]
        table[..., -1] += moved[..., n]
        for pivot in range(measured):
            rest = table[:, pivot + 1 :, pivot + 1 :]
            row = table[:, None, pivot, pivot + 1 :]
            rest -= table[:, pivot + 1 :, pivot, None] * (row / table[:, pivot, pivot, None, None])
        state[:m] = table[:, k:, k:]
    return left, joint[:, k:, k:]


def _filtered_joseph(
    steps: Steps, start: FloatArray, F: FloatArray, driven: FloatArray, rows: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`_filtered` in Joseph's form, which keeps all digits of what precise measurements leave of a vague state.

    Gives the predicted states as well.
    """
    n = F.shape[-1]
    left, predicted, filtered = (np.empty(driven.shape) for _ in range(3))
    state = start
    for begin, end in steps.slices():
        at, m = slice(begin, end), end - begin
        F_at, G, y = F[at], rows[at, :, :n], rows[at, :, n]
        before = left[at] = state[:m]
        P = symmetrise(congruence(F_at, before[..., :n]) + driven[at, :, :n])
        x = np.matvec(F_at, before[..., n]) + driven[at, :, n]
        predicted[at, :, :n], predicted[at, :, n] = P, x
        K, _ = kalman_gain(P, G, identity(G.shape[-2]))
        state[:m, :, :n] = joseph(P, K, G, identity(G.shape[-2]))
        state[:m, :, n] = x + np.matvec(K, y - np.matvec(G, x))
        filtered[at] = state[:m]
    return left, predicted, filtered


def _conditionals(
    left: FloatArray, F: FloatArray, Q: FloatArray, moved: FloatArray, predicted: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """[A | b] and C of nodes filtered to `left` = [P | x], given the next ones: A = P F' (F P F' + Q)^-1."""
    n = F.shape[-1]
    if len(F) < 8:
        A = np.linalg.solve(predicted[..., :n], moved[..., :n]).mT
    else:
        W = inverse_roots(predicted[..., :n])
        A = (W.mT @ (W @ moved[..., :n])).mT
    P = left[..., :n]
    E = identity(n) - A @ F
    back = np.empty(left.shape)
    back[..., :n] = A
    back[..., n] = left[..., n] - np.matvec(A, predicted[..., n])
    return back, symmetrise(E @ P @ E.mT + A @ Q @ A.mT)

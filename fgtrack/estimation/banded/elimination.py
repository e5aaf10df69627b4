"""Eliminating the nodes of the linearised windows of many tracks together, from the oldest on.

The windows are block-tridiagonal. Elimination is the Kalman filter; what it leaves of each node, given the next one, is
the gain and the covariance of the Rauch-Tung-Striebel smoother. No process noise is divided by, which vanishes between
stamps 1 us apart.
"""

from collections.abc import Callable

import numpy as np

from fgtrack.core.linalg import eliminated, identity, inverse_roots, symmetrise
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.banded.steps import Steps, forwards

#: Where a measurement leaves less than this of a variance, the short form of its update keeps too few digits.
_LEAST_SHARE = 1e-6


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
    if not inner.all():  # the prior of the oldest node in the window, which follows from nothing
        oldest = ~inner
        F[oldest], driven[oldest] = 0.0, nodes.predicted[numbers[oldest]]
    rows = nodes.rows.take(numbers, axis=0)[:, : int(nodes.num_rows.take(numbers).max())]
    chosen = steps.order
    start = nodes.filtered[nodes.at(tracks[chosen], np.maximum(places[chosen] - 1, 0))]

    left, moved, predicted, filtered = _filtered(steps, start, F, driven.copy(), rows, _corrected)
    shares = _variances(filtered) < _LEAST_SHARE * _variances(predicted)
    if shares.any():
        left, moved, predicted, filtered = _filtered(steps, start, F, driven.copy(), rows, _corrected_joseph)
    if not np.isfinite(filtered).all():
        raise np.linalg.LinAlgError("a state is not finite")
    for values in (predicted, filtered):
        values[..., :n] = symmetrise(values[..., :n])
    nodes.predicted[numbers], nodes.filtered[numbers] = predicted, filtered
    if not inner.all():
        befores, F, left, moved = befores[inner], F[inner], left[inner], moved[inner]
        predicted, segment = predicted[inner], segment[inner]
    if len(befores):
        nodes.back[befores], nodes.C[befores] = _conditionals(left, F, segment[..., n : 2 * n], moved, predicted)


def _variances(states: FloatArray) -> FloatArray:
    return np.diagonal(states, axis1=-2, axis2=-1)


def _filtered(
    steps: Steps,
    start: FloatArray,
    F: FloatArray,
    driven: FloatArray,
    rows: FloatArray,
    correct: Callable[[FloatArray, FloatArray], FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """States [P | x] before each step, F times them, predicted (in the place of `driven`), and corrected."""
    n = F.shape[-1]
    left, moved, filtered = (np.empty(driven.shape) for _ in range(3))
    state = start.copy()
    measured = rows.shape[1] > 0
    for begin, end in steps.slices():
        at, m = slice(begin, end), end - begin
        before = left[at] = state[:m]
        F_at, predicted = F[at], driven[at]
        along = np.matmul(F_at, before, out=moved[at])
        predicted[..., :n] += along[..., :n] @ F_at.mT
        predicted[..., n] += along[..., n]
        state[:m] = filtered[at] = correct(predicted, rows[at]) if measured else predicted
    return left, moved, driven, filtered


def _corrected(state: FloatArray, rows: FloatArray) -> FloatArray:
    """States [P | x] after measurements [G | y] with noise I: P - P G' S^-1 G P with S = G P G' + I, and the mean."""
    n = state.shape[-2]
    G = rows[..., :n]
    seen = G @ state
    seen[..., n] -= rows[..., n]
    S = seen[..., :n] @ G.mT
    S += identity(S.shape[-1])
    return np.asarray(state - seen[..., :n].mT @ eliminated(S, seen))


def _corrected_joseph(state: FloatArray, rows: FloatArray) -> FloatArray:
    """`_corrected` in Joseph's form, which keeps all digits of what a precise measurement leaves of a vague state."""
    n = state.shape[-2]
    G = rows[..., :n]
    seen = G @ state[..., :n]
    K = eliminated(symmetrise(seen @ G.mT) + identity(G.shape[-2]), seen).mT
    E = identity(n) - K @ G
    after = np.empty(state.shape)
    after[..., :n] = E @ state[..., :n] @ E.mT + K @ K.mT
    after[..., n] = state[..., n] + np.matvec(K, rows[..., n] - np.matvec(G, state[..., n]))
    return after


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

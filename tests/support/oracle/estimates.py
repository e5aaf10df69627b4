"""Least squares over the states at all stamps."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from support.oracle.dynamics import FloatArray, Flow
from support.oracle.filters import filtered, moved
from support.oracle.problem import NS_PER_S, Estimate, Problem, conditioned, whitening

_MAX_STEPS = 500
#: A step of a state, in m, rad, m/s or rad/s, that is rounding.
_AT_REST = 1e-9


@dataclass(frozen=True)
class Solution:
    """States at all stamps, given everything."""

    problem: Problem
    means: FloatArray
    """Shape (N, n)."""
    covariance: FloatArray
    """Joint covariance, shape (N n, N n)."""

    def state_at(self, stamp_ns: int) -> Estimate:
        """At any stamp from the start on: at a node, predicted, or between two nodes, by tangents."""
        stamps = self.problem.stamps_ns
        place = int(np.searchsorted(stamps, stamp_ns, side="right")) - 1
        n = self.means.shape[1]
        here = slice(place * n, (place + 1) * n)
        mean, P = self.means[place], self.covariance[here, here]
        if place + 1 == len(stamps) or stamps[place] == stamp_ns:
            return moved(self.problem, Estimate(mean, P), stamp_ns - stamps[place])
        until = self.problem.dynamics.move(mean, (stamp_ns - stamps[place]) / NS_PER_S)
        after = self.problem.dynamics.move(until.mean, (stamps[place + 1] - stamp_ns) / NS_PER_S)
        return self._between(slice(place * n, (place + 2) * n), until, after, self.means[place + 1])

    def _between(self, both: slice, until: Flow, after: Flow, right: FloatArray) -> Estimate:
        """Condition N(until.mean, until.Q), given the left state, on the right one."""
        by_right, C = conditioned(until.Q, after.F, after.Q)
        by_left = until.F - by_right @ after.F @ until.F
        T = np.hstack([by_left, by_right])
        return Estimate(until.mean + by_right @ (right - after.mean), C + T @ self.covariance[both, both] @ T.T)


def smoothed(problem: Problem) -> Solution:
    """Least squares over all states; where noise and robust weights follow the state, reweighted until nothing moves.

    Gauss-Newton on the normal equations' orthogonal factor, from the filter's states; a step that comes no closer is
    halved.
    """
    means = np.array([estimate.mean for estimate in filtered(problem).estimates.values()])
    last, share = np.inf, 1.0
    for _ in range(_MAX_STEPS):
        A, b = _rows(problem, means)
        Q, R = np.linalg.qr(A)
        step = np.asarray(linalg.solve_triangular(R, Q.T @ b)).reshape(means.shape)
        longest = float(np.abs(step).max())
        share = 1.0 if longest < 0.95 * last else 0.5
        means, last = means + share * step, longest
        if longest < _AT_REST:
            break
    else:
        raise ArithmeticError(f"the oracle's least squares do not converge: the last step is {last:g}")
    A, _ = _rows(problem, means)
    return Solution(problem, means, _covariance(np.asarray(np.linalg.qr(A, mode="r"))))


def _covariance(R: FloatArray) -> FloatArray:
    """The inverse of R'R."""
    root = linalg.solve_triangular(R, np.eye(len(R)))
    return np.asarray(root @ root.T)


def _rows(problem: Problem, means: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whitened equations A step = b at `means`: of the start, of the segments, of the sightings."""
    count, n = means.shape
    dynamics, place = problem.dynamics, {stamp_ns: k for k, stamp_ns in enumerate(problem.stamps_ns)}
    rows, rhs = [], []

    def add(blocks: Iterable[tuple[int, FloatArray]], b: FloatArray) -> None:
        A = np.zeros((len(b), count * n))
        for k, block in blocks:
            A[:, k * n : (k + 1) * n] = block
        rows.append(A)
        rhs.append(b)

    W = whitening(problem.start.covariance)
    add([(0, W)], W @ (problem.start.mean - means[0]))
    flow = dynamics.flow(means[:-1], problem.durations_s)
    for k in range(count - 1):
        W = whitening(flow.Q[k])
        add([(k, -W @ flow.F[k]), (k + 1, W)], W @ (flow.mean[k] - means[k + 1]))
    for one in problem.sightings:
        k = place[one.stamp_ns]
        y, H = one.residual(means[k], dynamics.names), one.slope(means[k], dynamics.names)
        root = np.sqrt(one.weight(y))
        add([(k, root * H)], root * y)
    return np.vstack(rows), np.concatenate(rhs)

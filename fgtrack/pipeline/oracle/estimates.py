"""Estimates of one object: least squares over the states at all stamps, and the extended Kalman filter."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg

from fgtrack.pipeline.oracle.dynamics import Dynamics, FloatArray, Flow
from fgtrack.pipeline.oracle.sightings import Sighting

_NS_PER_S = 1e9
_MAX_STEPS = 500
#: A step of a state, in m, rad, m/s or rad/s, that is rounding.
_AT_REST = 1e-9


class Estimate(NamedTuple):
    """Mean (n,) and covariance (n, n) of a state."""

    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Problem:
    """An object that starts as `start` at `start_ns` and is seen at or after that."""

    dynamics: Dynamics
    start_ns: int
    start: Estimate
    sightings: tuple[Sighting, ...]

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the start and of the sightings, each once, in order."""
        return sorted({self.start_ns, *(one.stamp_ns for one in self.sightings)})

    @property
    def durations_s(self) -> FloatArray:
        """Between the stamps, shape (N - 1,)."""
        return np.asarray(np.diff(np.array(self.stamps_ns)) / _NS_PER_S)


def filtered(problem: Problem) -> dict[int, Estimate]:
    """The extended Kalman filter in the order of the stamps: the state at each stamp after all up to it.

    Sightings of one stamp count one after the other, as they stand in the problem.
    """
    dynamics, names = problem.dynamics, problem.dynamics.names
    (mean, P), now_ns = problem.start, problem.start_ns
    estimates = {}
    for stamp_ns in problem.stamps_ns:
        if stamp_ns > now_ns:
            moved = dynamics.move(mean, (stamp_ns - now_ns) / _NS_PER_S)
            mean, P, now_ns = moved.mean, moved.F @ P @ moved.F.T + moved.Q, stamp_ns
        for one in problem.sightings:
            if one.stamp_ns == stamp_ns:
                y = one.residual(mean, names)
                K, P = _conditioned(P, one.slope(mean, names), np.eye(len(y)))
                mean = mean + K @ y
        estimates[stamp_ns] = Estimate(mean, P)
    return estimates


@dataclass(frozen=True)
class Solution:
    """States at all stamps, given everything."""

    problem: Problem
    means: FloatArray
    """Shape (N, n)."""
    covariance: FloatArray
    """Joint covariance, shape (N n, N n)."""

    def state_at(self, stamp_ns: int) -> Estimate:
        """At any stamp from the start on: at a node, between two of them, or predicted."""
        stamps = self.problem.stamps_ns
        place = int(np.searchsorted(stamps, stamp_ns, side="right")) - 1
        n = self.means.shape[1]
        here = slice(place * n, (place + 1) * n)
        mean, P = self.means[place], self.covariance[here, here]
        if stamps[place] == stamp_ns:
            return Estimate(mean, P)
        until = self.problem.dynamics.move(mean, (stamp_ns - stamps[place]) / _NS_PER_S)
        if place + 1 == len(stamps):
            return Estimate(until.mean, until.F @ P @ until.F.T + until.Q)
        after = self.problem.dynamics.move(until.mean, (stamps[place + 1] - stamp_ns) / _NS_PER_S)
        return self._between(slice(place * n, (place + 2) * n), until, after, self.means[place + 1])

    def _between(self, both: slice, until: Flow, after: Flow, right: FloatArray) -> Estimate:
        """Condition N(until.mean, until.Q), given the left state, on the right one."""
        by_right, C = _conditioned(until.Q, after.F, after.Q)
        by_left = until.F - by_right @ after.F @ until.F
        T = np.hstack([by_left, by_right])
        return Estimate(until.mean + by_right @ (right - after.mean), C + T @ self.covariance[both, both] @ T.T)


def smoothed(problem: Problem, first: FloatArray | None = None) -> Solution:
    """Least squares over all states; where noise and robust weights follow the state, reweighted until nothing moves.

    Gauss-Newton on the normal equations' orthogonal factor, from `first` (N, n) or the filter's states; a step that
    comes no closer is halved.
    """
    means = np.array([estimate.mean for estimate in filtered(problem).values()]) if first is None else first
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
    root = linalg.solve_triangular(np.linalg.qr(A, mode="r"), np.eye(A.shape[1]))
    return Solution(problem, means, root @ root.T)


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

    W = _whitening(problem.start.covariance)
    add([(0, W)], W @ (problem.start.mean - means[0]))
    moved = dynamics.flow(means[:-1], problem.durations_s)
    for k in range(count - 1):
        W = _whitening(moved.Q[k])
        add([(k, -W @ moved.F[k]), (k + 1, W)], W @ (moved.mean[k] - means[k + 1]))
    for one in problem.sightings:
        k = place[one.stamp_ns]
        y, H = one.residual(means[k], dynamics.names), one.slope(means[k], dynamics.names)
        root = np.sqrt(one.weight(y))
        add([(k, root * H)], root * y)
    return np.vstack(rows), np.concatenate(rhs)


def _conditioned(P: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gain K (n, k) of H x + N(0, R) on x of covariance P (n, n), and the covariance that it leaves."""
    K = linalg.solve(H @ P @ H.T + R, H @ P, assume_a="pos").T
    A = np.eye(len(P)) - K @ H
    return K, A @ P @ A.T + K @ R @ K.T


def _whitening(covariance: FloatArray) -> FloatArray:
    """W with W' W the inverse of `covariance`."""
    return np.asarray(
        linalg.solve_triangular(linalg.cholesky(covariance, lower=True), np.eye(len(covariance)), lower=True)
    )

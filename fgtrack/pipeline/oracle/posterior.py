"""The most probable states of all stamps, where process noise follows the state."""

import numpy as np
from scipy import linalg, optimize

from fgtrack.pipeline.oracle.dynamics import FloatArray
from fgtrack.pipeline.oracle.estimates import smoothed
from fgtrack.pipeline.oracle.problem import Problem

_STEP = 1e-4
_ACCURACY = 1e-7


def most_probable(problem: Problem) -> FloatArray:
    """Means (N, n) that minimise -log p(states, sightings), without robust losses.

    That is half of the squares of start and sightings, and of e' Q^-1 e + log det Q with Q at the left state of each
    segment. BFGS, from the reweighted solution, in the coordinates in which its curvature is the identity.
    """
    first = smoothed(problem)
    root = linalg.cholesky(first.covariance, lower=True)
    shape = first.means.shape

    def cost(u: FloatArray) -> tuple[float, FloatArray]:
        value, gradient = _cost(problem, first.means + (root @ u).reshape(shape))
        return value, root.T @ gradient.ravel()

    found = optimize.minimize(cost, np.zeros(root.shape[0]), jac=True, method="BFGS", options={"gtol": _ACCURACY})
    if not np.abs(found.jac).max() <= 1e3 * _ACCURACY:  # nor where it is not a number
        raise ArithmeticError(f"the oracle's minimum is not found: {found.message}")
    return first.means + np.asarray(root @ found.x).reshape(shape)


def _cost(problem: Problem, means: FloatArray) -> tuple[float, FloatArray]:
    """-log p but for a constant, and its gradient, shape (N, n)."""
    dynamics, t, n = problem.dynamics, problem.durations_s, means.shape[1]
    gradient, off = np.zeros_like(means), means[0] - problem.start.mean
    gradient[0] = linalg.solve(problem.start.covariance, off, assume_a="pos")
    value = 0.5 * off @ gradient[0]
    moved = dynamics.flow(means[:-1], t)
    e = means[1:] - moved.mean
    weighed = np.linalg.solve(moved.Q, e[..., None])[..., 0]
    value += 0.5 * np.sum(e * weighed) + 0.5 * np.linalg.slogdet(moved.Q)[1].sum()
    gradient[1:] += weighed
    gradient[:-1] -= np.einsum("kij,ki->kj", moved.F, weighed)
    for k in range(2, n):  # Q does not depend on the position
        step = np.zeros(n)
        step[k] = _STEP
        dQ = (dynamics.flow(means[:-1] + step, t).Q - dynamics.flow(means[:-1] - step, t).Q) / (2.0 * _STEP)
        trace = np.trace(np.linalg.solve(moved.Q, dQ), axis1=1, axis2=2)
        gradient[:-1, k] += 0.5 * trace - 0.5 * np.einsum("ki,kij,kj->k", weighed, dQ, weighed)
    place = {stamp_ns: k for k, stamp_ns in enumerate(problem.stamps_ns)}
    for one in problem.sightings:
        k = place[one.stamp_ns]
        y, H = one.residual(means[k], dynamics.names), one.slope(means[k], dynamics.names)
        value += 0.5 * y @ y
        gradient[k] -= H.T @ y
    return float(value), gradient

"""The extended Kalman filter of one object, in the order of the stamps."""

from dataclasses import dataclass

import numpy as np
from support.oracle.problem import NS_PER_S, Estimate, Problem, conditioned
from support.oracle.sightings import Sighting

_MAX_STEPS = 500
#: Of a sighting that a loss ignores.
_LEAST_WEIGHT = 1e-12
_WEIGHT_AT_REST = 1e-12


@dataclass(frozen=True)
class Filtered:
    """The states at the stamps, each after all sightings up to it."""

    problem: Problem
    estimates: dict[int, Estimate]

    def state_at(self, stamp_ns: int) -> Estimate:
        """At any stamp from the start on, predicted where nothing was seen."""
        last_ns = max(at for at in self.estimates if at <= stamp_ns)
        return moved(self.problem, self.estimates[last_ns], stamp_ns - last_ns)


def filtered(problem: Problem) -> Filtered:
    """The filter; sightings of one stamp count one after the other."""
    names, now_ns, estimate = problem.dynamics.names, problem.start_ns, problem.start
    estimates = {}
    for stamp_ns in problem.stamps_ns:
        estimate = moved(problem, estimate, stamp_ns - now_ns)
        for one in problem.sightings:
            if one.stamp_ns == stamp_ns:
                estimate = _with(estimate, one, names)
        estimates[stamp_ns], now_ns = estimate, stamp_ns
    return Filtered(problem, estimates)


def moved(problem: Problem, state: Estimate, ahead_ns: int) -> Estimate:
    """`state` after `ahead_ns`."""
    if not ahead_ns:
        return state
    flow = problem.dynamics.move(state.mean, ahead_ns / NS_PER_S)
    return Estimate(flow.mean, flow.F @ state.covariance @ flow.F.T + flow.Q)


def _with(prior: Estimate, one: Sighting, names: tuple[str, ...]) -> Estimate:
    """The state after a sighting, by tangents at `prior`, weighed by the loss of the residual that is left."""
    y, H, weight = one.residual(prior.mean, names), one.slope(prior.mean, names), 1.0
    for _ in range(_MAX_STEPS):
        K, P = conditioned(prior.covariance, H, np.eye(len(y)) / max(weight, _LEAST_WEIGHT))
        step = K @ y
        last, weight = weight, one.weight(y - H @ step)
        if abs(weight - last) < _WEIGHT_AT_REST:
            return Estimate(prior.mean + step, P)
    raise ArithmeticError("the oracle's weight of a sighting does not converge")

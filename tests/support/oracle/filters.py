"""Filters of one object, in the order of the stamps: extended, iterated, unscented, posterior linearisation."""

from dataclasses import dataclass

import numpy as np
from support.oracle.dynamics import FloatArray
from support.oracle.linearised import TANGENTS, Linearisation, Seen
from support.oracle.problem import NS_PER_S, Estimate, Problem, conditioned, whitening
from support.oracle.sightings import Sighting

_MAX_STEPS = 500
#: Of a sighting that a loss ignores.
_LEAST_WEIGHT = 1e-12
#: Changes that are rounding: of a state, in standard deviations, after difference quotients; and of a weight.
_AT_REST, _WEIGHT_AT_REST = 1e-9, 1e-12


@dataclass(frozen=True)
class Filtered:
    """The states at the stamps, each after all sightings up to it."""

    problem: Problem
    linearisation: Linearisation
    estimates: dict[int, Estimate]

    def state_at(self, stamp_ns: int) -> Estimate:
        """At any stamp from the start on, predicted where nothing was seen."""
        last_ns = max(at for at in self.estimates if at <= stamp_ns)
        return moved(self.problem, self.linearisation, self.estimates[last_ns], stamp_ns - last_ns)


def filtered(problem: Problem, linearisation: Linearisation = TANGENTS, iterated: bool = False) -> Filtered:
    """The filter whose motion and sightings are affine as `linearisation` says, and `iterated` or not.

    With tangents it is the extended Kalman filter or the iterated one; with averages the unscented one, or the one of
    posterior linearisation. Sightings of one stamp count one after the other.
    """
    names, now_ns, estimate = problem.dynamics.names, problem.start_ns, problem.start
    estimates = {}
    for stamp_ns in problem.stamps_ns:
        estimate = moved(problem, linearisation, estimate, stamp_ns - now_ns)
        for one in problem.sightings:
            if one.stamp_ns == stamp_ns:
                estimate = corrected(estimate, one, names, linearisation, iterated)
        estimates[stamp_ns], now_ns = estimate, stamp_ns
    return Filtered(problem, linearisation, estimates)


def moved(problem: Problem, linearisation: Linearisation, state: Estimate, ahead_ns: int) -> Estimate:
    """`state` after `ahead_ns`."""
    if not ahead_ns:
        return state
    flow = linearisation.carried(
        problem.dynamics, state.mean[None], state.covariance[None], np.array([ahead_ns / NS_PER_S])
    )
    return Estimate(flow.mean[0], flow.F[0] @ state.covariance @ flow.F[0].T + flow.Q[0])


def corrected(
    prior: Estimate,
    one: Sighting,
    names: tuple[str, ...],
    linearisation: Linearisation = TANGENTS,
    iterated: bool = False,
) -> Estimate:
    """The state after a sighting; where `iterated`, affine about the result itself.

    That is found by iteration; where it comes no closer, by half steps.
    """
    found, longest, share = prior, np.inf, 1.0
    for _ in range(_MAX_STEPS):
        y, H, noise = linearisation.seen(one, names, *found)
        new = _with(prior, one, Seen(y + H @ (found.mean - prior.mean), H, noise))
        if not iterated:
            return new
        sigma = np.sqrt(np.diag(new.covariance))
        narrowed = np.abs(new.covariance - found.covariance) / np.outer(sigma, sigma)
        last, longest = longest, float(np.max([np.abs(new.mean - found.mean) / sigma, narrowed.max(axis=0)]))
        if longest < _AT_REST:
            return new
        share = share if longest < 0.95 * last else 0.5
        found = Estimate(*(old + share * (to - old) for old, to in zip(found, new, strict=True)))
    raise ArithmeticError("the oracle's iterated update does not converge")


def _with(prior: Estimate, one: Sighting, seen: Seen) -> Estimate:
    """The state after what is `seen` about `prior`, weighed by the loss of the residual that is left."""
    R, weight = np.eye(len(seen.y)) + seen.noise, 1.0
    W = whitening(R)
    for _ in range(_MAX_STEPS):
        K, P = conditioned(prior.covariance, seen.H, R / max(weight, _LEAST_WEIGHT))
        step = K @ seen.y
        last, weight = weight, one.weight(W @ (seen.y - seen.H @ step))
        if abs(weight - last) < _WEIGHT_AT_REST:
            return Estimate(prior.mean + step, P)
    raise ArithmeticError("the oracle's weight of a sighting does not converge")


def innovation_of(prior: Estimate, one: Sighting, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Whitened innovation (k,) and its covariance (k, k)."""
    y, H, noise = TANGENTS.seen(one, names, *prior)
    return y, H @ prior.covariance @ H.T + np.eye(len(y)) + noise

"""The interacting multiple model filter of Blom and Bar-Shalom, with a Markov chain in continuous time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import integrate, linalg
from support.oracle.dynamics import FloatArray
from support.oracle.filters import corrected, innovation_of, moved
from support.oracle.linearised import TANGENTS
from support.oracle.problem import NS_PER_S, Estimate, Problem
from support.oracle.sightings import Sighting


@dataclass(frozen=True)
class Mixed:
    """The mixtures at the stamps: a state of each model, and how probable the models are."""

    problems: tuple[Problem, ...]
    G: FloatArray
    """Rates of the chain, shape (m, m)."""
    unknown: float
    mixtures: dict[int, tuple[list[Estimate], FloatArray]]

    def state_at(self, stamp_ns: int) -> Estimate:
        """At any stamp from the start on, in the form of the first model."""
        last_ns = max(at for at in self.mixtures if at <= stamp_ns)
        return self._moments(*self._moved(last_ns, stamp_ns), 0)

    def _moved(self, last_ns: int, stamp_ns: int) -> tuple[list[Estimate], FloatArray]:
        """Each model starts from the mixture of what may have been before, given that it is the one now."""
        states, share = self.mixtures[last_ns]
        if stamp_ns == last_ns:
            return states, share
        joint = share[:, None] * linalg.expm(self.G * (stamp_ns - last_ns) / NS_PER_S)
        starts = [self._moments(states, before / before.sum(), k) for k, before in enumerate(joint.T)]
        ahead_ns = stamp_ns - last_ns
        pairs = zip(self.problems, starts, strict=True)
        return [moved(problem, TANGENTS, start, ahead_ns) for problem, start in pairs], joint.sum(axis=0)

    def _moments(self, states: Sequence[Estimate], share: FloatArray, wanted: int) -> Estimate:
        """Mean and covariance of the mixture, in the form of the model `wanted`; an entry that a model lacks is 0."""
        names = self.problems[wanted].dynamics.names
        means, covariances = np.zeros((len(states), len(names))), np.zeros((len(states), len(names), len(names)))
        for k, (state, problem) in enumerate(zip(states, self.problems, strict=True)):
            S = np.array([[float(name == own) for own in problem.dynamics.names] for name in names])
            means[k] = S @ state.mean
            covariances[k] = S @ state.covariance @ S.T + self.unknown * np.diag(1.0 - S.sum(axis=1))
        mean = share @ means
        off = means - mean
        return Estimate(mean, np.einsum("k,kij->ij", share, covariances + off[:, :, None] * off[:, None, :]))


def mixed(problems: tuple[Problem, ...], stay_s: Sequence[float], unknown: float) -> Mixed:
    """The filter of the models of `problems`, which have the same sightings, in the form of the first one.

    `stay_s` is the mean time that an object stays with each of the two, `unknown` the variance of an entry that another
    model lacks.
    """
    stay = np.array(stay_s)
    G = (np.ones((2, 2)) - 2.0 * np.eye(2)) / stay[:, None]
    first = problems[0]
    mixtures = {first.start_ns: ([problem.start for problem in problems], stay / stay.sum())}
    found, last_ns = Mixed(problems, G, unknown, mixtures), first.start_ns
    for stamp_ns in first.stamps_ns:
        states, share = found._moved(last_ns, stamp_ns)
        for one in first.sightings:
            if one.stamp_ns == stamp_ns:
                pairs = list(zip(states, problems, strict=True))
                logs = np.array([_log_likelihood(state, one, problem.dynamics.names) for state, problem in pairs])
                states = [corrected(state, one, problem.dynamics.names) for state, problem in pairs]
                share = share * np.exp(logs - logs.max())
                share = share / share.sum()
        mixtures[stamp_ns], last_ns = (states, share), stamp_ns
    return found


def _log_likelihood(state: Estimate, one: Sighting, names: tuple[str, ...]) -> float:
    """Of the innovation, under the loss of the sighting, but for what all models share.

    The loss rho of a length d is the integral of s w(s) over s up to d, with the weight w.
    """
    y, S = innovation_of(state, one, names)
    length = float(np.sqrt(y @ np.linalg.solve(S, y)))
    bend = None if one.loss is None else [min(one.loss[1], length)]
    rho, _ = integrate.quad(lambda s: s * one.weight(np.array([s])), 0.0, length, points=bend, epsabs=1e-12)
    return float(-rho - 0.5 * np.linalg.slogdet(S)[1])

"""The standard deviations that make the innovations of recorded tracks most likely, and their standard errors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.noise.likelihood.innovations import Evaluation, Innovations
from fgtrack.noise.likelihood.series import NoiseSpace, Series

_PRIOR_LOG_STDS = (
    3.0,
    1.5,
)  # weak, but keep what the data do not determine from running away; of shares of outliers
_MOST_LOG = 9.2  # beyond a factor of 10^4 there is no maximum: errors of exactly 0 are likelier the smaller std is
_BLOCK_S = (
    2.0  # scores are taken as independent between blocks of this length of a track
)
_DIFFERENCE, _CURVATURE_DIFFERENCE = (
    1e-4,
    0.05,
)  # of logarithms, for first and second derivatives
_MAX_LINEARISATIONS = 6
_FLAT = 0.01  # gain of the log-likelihood in the next step below which the maximum is reached
_TOLERANCE = 0.1  # share of its standard error that no parameter changes by after the last linearisation
_FLOOR = 1e-3  # curvature of a flat direction: its standard error is above 30 in the logarithm
_ROWS = 24  # parameter vectors that are evaluated at once
# Any: scipy's options have different types.
_TRUST_REGION: Any = {
    "gtol": 1e-6,
    "maxiter": 40,
    "initial_trust_radius": 1.0,
    "max_trust_radius": 4.0,
}


class Cost(NamedTuple):
    """Minus the log-likelihood, and the weak prior, at one point, with derivatives."""

    objective: float
    gradient: FloatArray
    """Shape (f,)."""
    information: FloatArray
    """Information that is expected of the innovations, and that of the prior, shape (f, f): positive definite.

    Of normal innovations, sum of tr(S^-1 dS S^-1 dS) / 2 + dy' S^-1 dy; of the shares of outliers, which change
    neither y nor S, the squared scores.
    """
    scores: FloatArray
    """Derivatives of the log-likelihoods of the N innovations, shape (f, N)."""


class Likelihood:
    """The log-likelihood of the series of a problem about the trajectory at `values` (p,), and its scores.
    A function of the logarithms of the parameters `free`, shape (p,); others are those of `values`.
    """

    def __init__(self, problem: "Problem", values: FloatArray, free: BoolArray) -> None:
        self._innovations = Innovations(problem.space, values, problem.series)
        self._start, self._free = values, free
        named = np.array([bool(name) for _, name in problem.space.names])[free]
        self._prior_log, self._prior_log_std = (
            np.log(problem.prior)[free],
            np.where(named, *_PRIOR_LOG_STDS),
        )
        self._shares = np.flatnonzero(~named)
        self._cost = cache(
            lambda data: self._cost_at(np.frombuffer(data))
        )  # the search asks twice

    def values(self, logs: FloatArray) -> FloatArray:
        """Return rows of parameters (..., p) of the free logarithms (..., f)."""
        values = np.broadcast_to(
            self._start, (*logs.shape[:-1], len(self._start))
        ).copy()
        values[..., self._free] = np.exp(logs)
        return values

    def totals(self, values: FloatArray) -> FloatArray:
        """Return the log-likelihood of everything that counts, shape (b,), at rows of all parameters (b, p)."""
        return np.asarray(
            self._innovations.evaluate(values).log_likelihoods.sum(axis=1)
        )

    def cost(self, logs: FloatArray) -> Cost:
        """Return the cost at the free logarithms, shape (f,)."""
        return self._cost(logs.tobytes())

    def stop_where_flat(self, logs: FloatArray) -> None:
        """Raise `StopIteration` where the next step would gain next to nothing."""
        cost = self.cost(logs)
        if (
            float(cost.gradient @ psd_solve(cost.information, cost.gradient))
            < 2.0 * _FLAT
        ):
            raise StopIteration

    def spread(self, logs: FloatArray) -> FloatArray:
        """Return standard deviations of the free logarithms where the model is right, and the prior, shape (f,)."""
        return np.sqrt(
            np.diag(psd_solve(self.cost(logs).information, np.eye(len(logs))))
        )

    def _cost_at(self, logs: FloatArray) -> Cost:
        rows = np.concatenate([logs[None], logs + _DIFFERENCE * np.eye(len(logs))])
        evaluation = self._innovations.evaluate(self.values(rows))
        middle, scores = (
            evaluation.log_likelihoods[0],
            _difference(evaluation.log_likelihoods),
        )
        if not np.isfinite(middle).all():
            return Cost(math.inf, np.zeros_like(logs), np.eye(len(logs)), scores)
        moved = logs - self._prior_log
        off = moved / self._prior_log_std
        beyond = np.sign(moved) * np.maximum(np.abs(moved) - _MOST_LOG, 0.0)
        wall = float(middle.size)  # as steep as the data can be
        objective = 0.5 * float(off @ off + wall * beyond @ beyond) - float(
            middle.sum()
        )
        gradient = off / self._prior_log_std + wall * beyond - scores.sum(axis=1)
        information = _expected(evaluation) + np.diag(
            self._prior_log_std**-2 + wall * (beyond != 0.0)
        )
        information[self._shares, self._shares] += np.square(scores[self._shares]).sum(
            axis=1
        )
        return Cost(objective, gradient, information, scores)

    def log_std(self, logs: FloatArray) -> FloatArray:
        """Return standard errors of the free logarithms, shape (f,); infinite where there is no information.
        The larger one of that of the curvature and the sandwich of curvature and scores summed over blocks of time,
        which holds for correlated innovations too (White 1982, "Maximum likelihood estimation of misspecified models",
        Econometrica 50(1)).
        """
        counted = self._innovations.counted
        blocks = (self._innovations.since_start_s / _BLOCK_S).astype(np.int64)
        series = np.broadcast_to(np.arange(blocks.shape[1]), blocks.shape)
        keys = np.stack([blocks[counted], series[counted]], axis=-1)
        groups = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
        clusters = np.zeros((groups.max() + 1, len(logs)))
        np.add.at(clusters, groups, self.cost(logs).scores.T)
        meat = clusters.T @ clusters * len(clusters) / max(len(clusters) - 1, 1)
        values, vectors = np.linalg.eigh(self._curvature(logs))
        inverse = vectors @ np.diag(1.0 / np.maximum(values, _FLOOR)) @ vectors.T
        return np.sqrt(np.maximum(np.diag(inverse), np.diag(inverse @ meat @ inverse)))

    def _curvature(self, logs: FloatArray) -> FloatArray:
        """Return minus the second derivatives of the log-likelihood, shape (f, f)."""
        f, h = len(logs), _CURVATURE_DIFFERENCE
        item = h * np.eye(f)
        first, second = np.triu_indices(f)
        rows = np.concatenate([logs[None], logs + item, logs - item])
        rows = np.concatenate(
            [rows, logs + item[first] + item[second], logs - item[first] - item[second]]
        )
        parts = np.array_split(rows, -(-len(rows) // _ROWS))
        total = np.concatenate([self.totals(self.values(part)) for part in parts])
        middle, up, down = total[0], total[1 : f + 1], total[f + 1 : 2 * f + 1]
        both_up, both_down = np.split(total[2 * f + 1 :], 2)
        mixed = (
            both_up
            - up[first]
            - up[second]
            + 2.0 * middle
            - down[first]
            - down[second]
            + both_down
        )
        H = np.zeros((f, f))
        H[first, second] = H[second, first] = -mixed / (2.0 * h * h)
        return symmetrise(H)


def _difference(values: FloatArray) -> FloatArray:
    """Return derivatives (f, ...) of values (f + 1, ...) at a point and a little further in every direction."""
    return np.asarray((values[1:] - values[0]) / _DIFFERENCE)


def _expected(evaluation: Evaluation) -> FloatArray:
    """Return the information expected of normal innovations, shape (f, f)."""
    dy, dS = _difference(evaluation.y), _difference(evaluation.S)
    solved = psd_solve(evaluation.S[:1], np.concatenate([dS, dy[..., None]], axis=-1))
    A, weighted = solved[..., :-1], solved[..., -1]
    f = len(dy)
    of_covariances = A.reshape(f, -1) @ A.mT.reshape(f, -1).T
    return symmetrise(
        0.5 * of_covariances + weighted.reshape(f, -1) @ dy.reshape(f, -1).T
    )


@dataclass(frozen=True)
class Problem:
    """Series and the parameters sought."""

    series: Sequence[Series]
    space: NoiseSpace
    prior: FloatArray
    """Centre of the weak prior, shape (p,)."""

    def counts(self) -> IntArray:
        """Return the number of measured components that count, by parameter, shape (p,); all for the motion."""
        columns = {name: column for column, name in enumerate(self.space.names)}
        counts = np.zeros(len(columns), dtype=np.int64)
        for item in self.series:
            for observation in compress(item.observations, item.counted):
                counts[: self.space.num_motion] += 1
                counts[
                    [
                        columns[name]
                        for name in [(observation.sensor, ""), *observation.parameters]
                    ]
                ] += 1
        return counts

    def endless(self, values: FloatArray) -> BoolArray:
        """Return True, shape (p,), for parameters that have no maximum, as they have run off at `values` (p,)."""
        return np.asarray(np.abs(np.log(values / self.prior)) >= _MOST_LOG)

    def maximum(
        self, start: FloatArray, free: BoolArray
    ) -> tuple[FloatArray, Likelihood]:
        """Return parameters, shape (p,), at the maximum next to `start`, and the likelihood about the trajectory there.
        What is not `free` stays as in `start`.
        """
        values = start.copy()
        likelihood = Likelihood(self, values, free)
        for _ in range(_MAX_LINEARISATIONS):
            logs, current = np.log(values[free]), likelihood
            best = minimize(  # type: ignore[call-overload]  # scipy-stubs lack the callback of two results
                lambda at, of=current: of.cost(at)[:2],
                logs,
                jac=True,
                hess=lambda at, of=current: of.cost(at).information,
                method="trust-exact",
                callback=current.stop_where_flat,
                options=_TRUST_REGION,
            )
            moved = np.abs(best.x - logs)
            if not moved.any():
                break
            values = likelihood.values(best.x)
            settled = (moved <= _TOLERANCE * likelihood.spread(best.x)).all()
            likelihood = Likelihood(self, values, free)
            if settled:
                break
        return values, likelihood

"""Maximum-likelihood fit of noise parameters to recorded tracks, with standard errors."""

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

# Weak prior of the logarithms of the standard deviations, and of the shares of outliers.
# It keeps parameters finite that the data do not determine.
_PRIOR_LOG_STD = 3.0
_PRIOR_LOG_STD_OF_SHARES = 1.5
# Beyond a factor of 10^4 there is no maximum: for errors of exactly 0 the likelihood grows as std falls.
_MAX_LOG_CHANGE = 9.2
# The scores of two blocks of this length on one track are assumed to be independent.
_BLOCK_S = 2.0
# Differences of the logarithms for first and second derivatives.
_DIFFERENCE = 1e-4
_CURVATURE_DIFFERENCE = 0.05
_MAX_LINEARISATIONS = 6
# The search ends if the next step would raise the log-likelihood by less than this.
_LEAST_GAIN = 0.01
# The linearisation is repeated until no parameter moves by more than this share of its standard error.
_TOLERANCE = 0.1
# Least curvature of a direction. Its standard error in the logarithm is then above 30.
_LEAST_CURVATURE = 1e-3
# Number of parameter vectors that are evaluated together.
_BATCH_ROWS = 24
# Any: scipy's options have different types.
_TRUST_REGION: Any = {
    "gtol": 1e-6,
    "maxiter": 40,
    "initial_trust_radius": 1.0,
    "max_trust_radius": 4.0,
}


class Cost(NamedTuple):
    """Negative log-likelihood plus the cost of the weak prior, with derivatives."""

    objective: float
    gradient: FloatArray
    """Shape (f,)."""
    information: FloatArray
    """Expected information of the innovations and the prior, shape (f, f); positive definite.

    For normal innovations it is sum of tr(S^-1 dS S^-1 dS) / 2 + dy' S^-1 dy. The
    shares of outliers change neither y nor S; their information is the sum of squared
    scores.
    """
    scores: FloatArray
    """Derivatives of the log-likelihoods of the N innovations, shape (f, N)."""


class Likelihood:
    """Log-likelihood of the series of a problem as a function of the logarithms of its free parameters.

    The filter is linearised about the trajectory at `values`, shape (p,). `free`, shape
    (p,), marks the free parameters. The other parameters keep their `values`.
    """

    def __init__(self, problem: "Problem", values: FloatArray, free: BoolArray) -> None:
        self._innovations = Innovations(problem.space, values, problem.series)
        self._start = values
        self._free = free
        named = np.array([bool(name) for _, name in problem.space.names])[free]
        self._prior_log = np.log(problem.prior)[free]
        self._prior_log_std = np.where(named, _PRIOR_LOG_STD, _PRIOR_LOG_STD_OF_SHARES)
        self._shares = np.flatnonzero(~named)
        # The search evaluates each point twice.
        self._cost = cache(lambda data: self._cost_at(np.frombuffer(data)))

    def values(self, logs: FloatArray) -> FloatArray:
        """Return parameter vectors (..., p) for the logarithms of the free parameters (..., f)."""
        values = np.broadcast_to(
            self._start, (*logs.shape[:-1], len(self._start))
        ).copy()
        values[..., self._free] = np.exp(logs)
        return values

    def totals(self, values: FloatArray) -> FloatArray:
        """Return the log-likelihood of all counted innovations together, shape (b,), for parameter vectors (b, p)."""
        return np.asarray(
            self._innovations.evaluate(values).log_likelihoods.sum(axis=1)
        )

    def cost(self, logs: FloatArray) -> Cost:
        """Return the cost at the logarithms of the free parameters, shape (f,)."""
        return self._cost(logs.tobytes())

    def stop_where_flat(self, logs: FloatArray) -> None:
        """Raise `StopIteration` if the next step would raise the log-likelihood by less than `_LEAST_GAIN`."""
        cost = self.cost(logs)
        if (
            float(cost.gradient @ psd_solve(cost.information, cost.gradient))
            < 2.0 * _LEAST_GAIN
        ):
            raise StopIteration

    def spread(self, logs: FloatArray) -> FloatArray:
        """Return model-based standard deviations of the free logarithms, with the prior, shape (f,)."""
        return np.sqrt(
            np.diag(psd_solve(self.cost(logs).information, np.eye(len(logs))))
        )

    def _cost_at(self, logs: FloatArray) -> Cost:
        rows = np.concatenate([logs[None], logs + _DIFFERENCE * np.eye(len(logs))])
        evaluation = self._innovations.evaluate(self.values(rows))
        middle = evaluation.log_likelihoods[0]
        scores = _difference(evaluation.log_likelihoods)
        if not np.isfinite(middle).all():
            return Cost(math.inf, np.zeros_like(logs), np.eye(len(logs)), scores)
        change = logs - self._prior_log
        off = change / self._prior_log_std
        beyond = np.sign(change) * np.maximum(np.abs(change) - _MAX_LOG_CHANGE, 0.0)
        # A quadratic wall beyond the largest change, as steep as the likelihood can be.
        wall = float(middle.size)
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
        """Return standard errors of the free logarithms, shape (f,); above 30 without information.

        Each is the larger of two errors. The first follows from the curvature of the
        log-likelihood. The second is the sandwich of the curvature and of the scores,
        summed over blocks of time. The sandwich holds for correlated innovations too.

        Source: White 1982, "Maximum likelihood estimation of misspecified models",
        Econometrica 50(1).
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
        bounded = np.maximum(values, _LEAST_CURVATURE)
        inverse = vectors @ np.diag(1.0 / bounded) @ vectors.T
        return np.sqrt(np.maximum(np.diag(inverse), np.diag(inverse @ meat @ inverse)))

    def _curvature(self, logs: FloatArray) -> FloatArray:
        """Return the negative second derivatives of the log-likelihood by the logarithms of the parameters, shape
        (f, f).
        """
        f, h = len(logs), _CURVATURE_DIFFERENCE
        item = h * np.eye(f)
        first, second = np.triu_indices(f)
        rows = np.concatenate([logs[None], logs + item, logs - item])
        rows = np.concatenate(
            [rows, logs + item[first] + item[second], logs - item[first] - item[second]]
        )
        parts = np.array_split(rows, -(-len(rows) // _BATCH_ROWS))
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
    """Return derivatives (f, ...) by f variables.

    `values` (f + 1, ...) are those at a point, and at the f points that are shifted by `_DIFFERENCE` in a variable.
    """
    return np.asarray((values[1:] - values[0]) / _DIFFERENCE)


def _expected(evaluation: Evaluation) -> FloatArray:
    """Return the expected information on the free logarithms, shape (f, f), if the innovations are normal."""
    dy, dS = _difference(evaluation.y), _difference(evaluation.S)
    solved = psd_solve(evaluation.S[:1], np.concatenate([dS, dy[..., None]], axis=-1))
    A = solved[..., :-1]
    weighted = solved[..., -1]
    f = len(dy)
    of_covariances = A.reshape(f, -1) @ A.mT.reshape(f, -1).T
    return symmetrise(
        0.5 * of_covariances + weighted.reshape(f, -1) @ dy.reshape(f, -1).T
    )


@dataclass(frozen=True)
class Problem:
    """A fit of noise parameters: the series of observations and the parameters."""

    series: Sequence[Series]
    space: NoiseSpace
    prior: FloatArray
    """Centre of the weak prior, shape (p,)."""

    def counts(self) -> IntArray:
        """Return the number of counted measured components per parameter, shape (p,).

        A motion parameter counts all measurements.
        """
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

    def without_maximum(self, values: FloatArray) -> BoolArray:
        """Mask of the parameters without a maximum, shape (p,): the fit moved them beyond the largest change."""
        return np.asarray(np.abs(np.log(values / self.prior)) >= _MAX_LOG_CHANGE)

    def maximum(
        self, start: FloatArray, free: BoolArray
    ) -> tuple[FloatArray, Likelihood]:
        """Return the parameters (p,) at the maximum near `start`, and the likelihood linearised there.

        Parameters that are not `free` keep their values in `start`.
        """
        values = start.copy()
        likelihood = Likelihood(self, values, free)
        for _ in range(_MAX_LINEARISATIONS):
            logs = np.log(values[free])
            current = likelihood
            best = minimize(  # type: ignore[call-overload]  # scipy-stubs lack the callback of two results
                lambda at, of=current: of.cost(at)[:2],
                logs,
                jac=True,
                hess=lambda at, of=current: of.cost(at).information,
                method="trust-exact",
                callback=current.stop_where_flat,
                options=_TRUST_REGION,
            )
            change = np.abs(best.x - logs)
            if not change.any():
                break
            values = likelihood.values(best.x)
            converged = (change <= _TOLERANCE * likelihood.spread(best.x)).all()
            likelihood = Likelihood(self, values, free)
            if converged:
                break
        return values, likelihood

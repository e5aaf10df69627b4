"""The standard deviations that make the innovations of recorded tracks most likely, and how well they are known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.likelihood.innovations import Evaluation, Innovations
from fgtrack.estimation.likelihood.noise import NoiseSpace
from fgtrack.estimation.likelihood.reference import filtered
from fgtrack.estimation.likelihood.series import Series


@dataclass(frozen=True)
class FitSettings:
    """Settings of the maximisation of the likelihood."""

    prior_log_std: float = 3.0
    """A parameter is a factor exp(3) from where it starts with one standard deviation: weak, but it keeps what the data
    do not know from running away."""
    share_log_std: float = 1.5
    """The same for the share of outliers."""
    most_log: float = 9.2
    """A parameter that the data drive farther than this from where it starts, a factor of 10^4, has no maximum: errors
    that are exactly 0 are the likelier the smaller their standard deviation is."""
    settle_s: float = 1.0
    """Innovations in the first seconds of a track do not count: they are those of its first state. These seconds begin
    where its direction of travel is known."""
    settle_steps: int = 5
    """Nor do as many of the first innovations."""
    block_s: float = 2.0
    """Scores are taken as independent between blocks of this length of a track."""
    difference: float = 1e-4
    """Step of the differences for scores, in the logarithm."""
    curvature_difference: float = 0.05
    """The same for second derivatives."""
    max_linearisations: int = 6
    flat: float = 0.01
    """The maximum is found where the next step promises to gain less than this in the log-likelihood."""
    tolerance: float = 0.1
    """Linearised again until no parameter changes by more than this share of its standard error."""

    def counts(self, series: Series, place: int) -> bool:
        """True if the observation at `place` has a part in the likelihood.

        It does where it is late enough in its track, within the limits of its series, and of one object.
        """
        stamp_ns = series.observations[place].measurement.stamp_ns
        settled = place >= series.num_initial + self.settle_steps and place not in series.mixed
        settled &= stamp_ns - series.initiated_ns >= NS_PER_S * self.settle_s
        after, before = series.from_ns, series.until_ns
        return settled and (after is None or stamp_ns >= after) and (before is None or stamp_ns < before)


class _Evaluated(NamedTuple):
    """Value and derivatives of the cost at one point."""

    logs: FloatArray
    objective: float
    gradient: FloatArray
    information: FloatArray


class Likelihood:
    """The log-likelihood of all series as a function of the free logarithms, and its scores."""

    def __init__(
        self,
        innovations: Innovations,
        names: Sequence[tuple[str, str]],
        start: FloatArray,
        free: BoolArray,
        prior_log: FloatArray,
        prior_log_std: FloatArray,
        settings: FitSettings,
    ) -> None:
        self._innovations = innovations
        self._start = start
        self._free = free
        self._prior_log, self._prior_log_std = prior_log[free], prior_log_std[free]
        self._h, self._curvature_h = settings.difference, settings.curvature_difference
        self._shares = np.flatnonzero([not name for (_, name), one in zip(names, free, strict=True) if one])
        self._flat, self._most_log = settings.flat, settings.most_log
        self._groups = _groups(innovations, settings.block_s)
        self._memory: list[_Evaluated] = []  # the last two: after a step that was none the one before is asked again

    def values(self, logs: FloatArray) -> FloatArray:
        """Rows of parameters (..., p) of the free logarithms (..., f)."""
        found = np.broadcast_to(self._start, (*logs.shape[:-1], len(self._start))).copy()
        found[..., self._free] = np.exp(logs)
        return found

    def totals(self, values: FloatArray) -> FloatArray:
        """Log-likelihood of everything that counts, shape (b,), at rows of all parameters (b, p)."""
        return np.asarray(self._innovations.evaluate(values).log_likelihoods.sum(axis=1))

    def objective(self, logs: FloatArray) -> float:
        """Cost: minus the log-likelihood, and the weak prior."""
        return self._evaluated(logs).objective

    def gradient(self, logs: FloatArray) -> FloatArray:
        """Its gradient, shape (f,)."""
        return self._evaluated(logs).gradient

    def information(self, logs: FloatArray) -> FloatArray:
        """Information that is expected of the innovations, and that of the prior, shape (f, f): positive definite.

        Of normal innovations, sum of tr(S^-1 dS S^-1 dS) / 2 + dy' S^-1 dy; of the shares of outliers, which change
        neither y nor S, the squared scores.
        """
        return self._evaluated(logs).information

    def stop_where_flat(self, logs: FloatArray) -> None:
        """Raise `StopIteration` where the next step would gain next to nothing."""
        g = self.gradient(logs)
        if float(g @ psd_solve(self.information(logs), g)) < 2.0 * self._flat:
            raise StopIteration

    def spread(self, logs: FloatArray) -> FloatArray:
        """Standard deviations of the free logarithms where the model is right, and the prior, shape (f,)."""
        return np.sqrt(np.diag(psd_solve(self.information(logs), np.eye(len(logs)))))

    def _evaluated(self, logs: FloatArray) -> _Evaluated:
        found = next((one for one in self._memory if np.array_equal(one.logs, logs)), None)
        if found is None:
            found = self._evaluate(logs)
        self._memory = [found, *(one for one in self._memory[:2] if one is not found)][:2]
        return found

    def _evaluate(self, logs: FloatArray) -> _Evaluated:
        found, scores = self._differentiated(logs)
        middle = found.log_likelihoods[0]
        if not np.isfinite(middle).all():
            return _Evaluated(logs.copy(), math.inf, np.zeros_like(logs), np.eye(len(logs)))
        moved = logs - self._prior_log
        off = moved / self._prior_log_std
        beyond = np.sign(moved) * np.maximum(np.abs(moved) - self._most_log, 0.0)
        wall = float(middle.size)  # as steep as the data can be
        objective = 0.5 * float(off @ off + wall * beyond @ beyond) - float(middle.sum())
        gradient = off / self._prior_log_std + wall * beyond - scores.sum(axis=1)
        information = self._expected(found) + np.diag(self._prior_log_std**-2 + wall * (beyond != 0.0))
        information[self._shares, self._shares] += np.square(scores[self._shares]).sum(axis=1)
        return _Evaluated(logs.copy(), objective, gradient, information)

    def _differentiated(self, logs: FloatArray) -> tuple[Evaluation, FloatArray]:
        """The innovations at `logs`, then a little further in every direction; the scores (f, N) by differences."""
        rows = np.concatenate([logs[None], logs + self._h * np.eye(len(logs))])
        found = self._innovations.evaluate(self.values(rows))
        return found, self._difference(found.log_likelihoods)

    def _difference(self, values: FloatArray) -> FloatArray:
        """Derivatives (f, ...) of the values (f + 1, ...) of `_differentiated`."""
        return np.asarray((values[1:] - values[0]) / self._h)

    def _expected(self, found: Evaluation) -> FloatArray:
        """Information expected of normal innovations, shape (f, f)."""
        dy, dS = self._difference(found.y), self._difference(found.S)
        solved = psd_solve(found.S[:1], np.concatenate([dS, dy[..., None]], axis=-1))
        A, weighted = solved[..., :-1], solved[..., -1]
        f = len(dy)
        curved = A.reshape(f, -1) @ A.mT.reshape(f, -1).T
        return symmetrise(0.5 * curved + weighted.reshape(f, -1) @ dy.reshape(f, -1).T)

    def log_std(self, logs: FloatArray) -> FloatArray:
        """Standard errors of the free logarithms, shape (f,); infinite where there is no information.

        The larger one of two: that of the curvature, right where the model is, and the sandwich of curvature and
        scores, these summed over blocks of time, which holds for correlated innovations too (White 1982, "Maximum
        likelihood estimation of misspecified models", Econometrica 50(1)).
        """
        _, scores = self._differentiated(logs)
        curvature = self._curvature(logs)
        clusters = np.zeros((self._groups.max() + 1, len(logs)))
        np.add.at(clusters, self._groups, scores.T)
        meat = clusters.T @ clusters * len(clusters) / max(len(clusters) - 1, 1)
        values, vectors = np.linalg.eigh(curvature)
        floor = 1e-3  # below it a direction is flat: a standard error above 30 in the logarithm
        inverse = vectors @ np.diag(1.0 / np.maximum(values, floor)) @ vectors.T
        variance = np.maximum(np.diag(inverse), np.diag(inverse @ meat @ inverse))
        return np.sqrt(variance)

    def _curvature(self, logs: FloatArray) -> FloatArray:
        """Minus the second derivatives of the log-likelihood, shape (f, f)."""
        f, h = len(logs), self._curvature_h
        one = h * np.eye(f)
        first, second = np.triu_indices(f)
        rows = np.concatenate([logs[None], logs + one, logs - one])
        rows = np.concatenate([rows, logs + one[first] + one[second], logs - one[first] - one[second]])
        total = np.concatenate([self.totals(self.values(part)) for part in np.array_split(rows, -(-len(rows) // 24))])
        middle, up, down = total[0], total[1 : f + 1], total[f + 1 : 2 * f + 1]
        both_up, both_down = np.split(total[2 * f + 1 :], 2)
        mixed = both_up - up[first] - up[second] + 2.0 * middle - down[first] - down[second] + both_down
        H = np.zeros((f, f))
        H[first, second] = H[second, first] = -mixed / (2.0 * h * h)
        return symmetrise(H)


def _groups(innovations: Innovations, block_s: float) -> IntArray:
    """The block of time and series that each innovation that counts belongs to, shape (N,)."""
    blocks = (innovations.since_start_s / block_s).astype(np.int64)
    series = np.broadcast_to(np.arange(blocks.shape[1]), blocks.shape)
    keys = np.stack([blocks[innovations.counted], series[innovations.counted]], axis=-1)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


# Any: scipy's options have different types.
_TRUST_REGION: Any = {"gtol": 1e-6, "maxiter": 40, "initial_trust_radius": 1.0, "max_trust_radius": 4.0}


@dataclass(frozen=True)
class Problem:
    """Series and the parameters sought."""

    series: Sequence[Series]
    space: NoiseSpace
    prior: FloatArray
    """Centre of the weak prior, shape (p,)."""
    settings: FitSettings = field(default_factory=FitSettings)

    def counts(self) -> IntArray:
        """Number of measured components that count, by parameter, shape (p,); all of them for noise of the motion."""
        names = {name: place for place, name in enumerate(self.space.names)}
        found = np.zeros(len(names), dtype=np.int64)
        for one in self.series:
            for place, observation in enumerate(one.observations):
                if self.settings.counts(one, place):
                    found[: self.space.num_motion] += 1
                    found[names[observation.sensor, ""]] += 1
                    if observation.tuned:
                        components = observation.measurement.model.components
                        found[[names[observation.sensor, components[i]] for i in observation.measured]] += 1
                        if observation.sensor in self.space.lasting:
                            found[names[observation.sensor, "share"]] += 1
        return found

    def endless(self, values: FloatArray) -> BoolArray:
        """Which parameters have no maximum, shape (p,), as they have run off at `values` (p,)."""
        return np.asarray(np.abs(np.log(values / self.prior)) >= self.settings.most_log)

    def likelihood(self, values: FloatArray, free: BoolArray) -> Likelihood:
        """The likelihood of the parameters `free`, shape (p,), about the trajectory at `values`, shape (p,).

        Raises `ValueError` where no innovation counts.
        """
        steps = [filtered(one, self.space, values) for one in self.series]
        innovations = Innovations(self.space, values, self.series, steps, self.settings.counts)
        if not innovations.counted.any():
            raise ValueError("no innovation counts")
        widths = self.settings.prior_log_std, self.settings.share_log_std
        prior_log_std = np.array([widths[0] if name else widths[1] for _, name in self.space.names])
        return Likelihood(innovations, self.space.names, values, free, np.log(self.prior), prior_log_std, self.settings)

    def maximum(self, start: FloatArray, free: BoolArray) -> tuple[FloatArray, Likelihood]:
        """Parameters, shape (p,), at the maximum next to `start`, and the likelihood about the trajectory there.

        What is not `free` stays as in `start`. Raises as `likelihood`.
        """
        values = start.copy()
        likelihood = self.likelihood(values, free)
        for _ in range(self.settings.max_linearisations):
            logs = np.log(values[free])
            found = minimize(  # type: ignore[call-overload]  # scipy-stubs know no callback of two results
                likelihood.objective,
                logs,
                jac=likelihood.gradient,
                hess=likelihood.information,
                method="trust-exact",
                callback=likelihood.stop_where_flat,
                options=_TRUST_REGION,
            )
            moved = np.abs(found.x - logs)
            if not moved.any():
                break
            values = likelihood.values(found.x)
            settled = (moved <= self.settings.tolerance * likelihood.spread(found.x)).all()
            likelihood = self.likelihood(values, free)
            if settled:
                break
        return values, likelihood

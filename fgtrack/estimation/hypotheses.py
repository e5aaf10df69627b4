"""Several hypotheses of one object at its start, until one is left."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.linalg import congruence, mahalanobis_squared, symmetrise
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation import starts
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateResult
from fgtrack.estimation.filters.ekf import linearised
from fgtrack.estimation.filters.propagation import track_state, wrapped
from fgtrack.models.motion import MotionModel

#: A hypothesis is dropped once it is so much less likely than the best.
LEAST_WEIGHT = 1e-4
#: Two are one and the same once their means differ by less than a standard deviation (squared).
SAME = 1.0


@dataclass(slots=True)
class _Hypothesis:
    estimator: Estimator
    log_weight: float


class Hypotheses:
    """An `Estimator` that runs one for each of several starts, weighs them by the likelihood of their innovations, and
    drops those that have become unlikely, until one is left.

    After measurements z_1, z_2, ... in the order of their arrival, log w = sum of log N(y_k; 0, S_k), with the
    innovation y_k of z_k against everything fused before it: the chain rule of their joint density, whatever the order,
    so for linear models the weights are exact (Bar-Shalom, Li and Kirubarajan 2001, section 11.6.2, the static multiple
    model estimator). The state is that of the likeliest hypothesis; `mixture_at` gives mean and covariance of all.

    Parameters
    ----------
    motion
        Motion model.
    estimators
        One for each hypothesis, all equally likely. Raises `CallError` for none.
    """

    def __init__(self, motion: MotionModel, estimators: Sequence[Estimator]) -> None:
        if not estimators:
            raise CallError("hypotheses: give at least one start")
        self._motion = motion
        self._alive = [_Hypothesis(each, 0.0) for each in estimators]

    @property
    def window_ns(self) -> tuple[int, int]:
        """See `Estimator.window_ns`."""
        return self.best.window_ns

    @property
    def best(self) -> Estimator:
        """That of the likeliest hypothesis; the first one of several."""
        return max(self._alive, key=lambda each: each.log_weight).estimator

    @property
    def estimators(self) -> list[Estimator]:
        """Estimators of the remaining hypotheses."""
        return [each.estimator for each in self._alive]

    @property
    def weights(self) -> FloatArray:
        """Probabilities of the hypotheses that are left, shape (m,), which add up to 1."""
        logs = np.array([each.log_weight for each in self._alive])
        weights = np.exp(logs - logs.max())
        return np.asarray(weights / weights.sum())

    def advance(self, now_ns: int) -> None:
        """See `Estimator.advance`."""
        for each in self._alive:
            each.estimator.advance(now_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        """See `Estimator.update`; the innovation is that of the hypothesis that was the likeliest before."""
        if len(self._alive) == 1:
            return self.best.update(measurement)
        best, fused, found = self.best, list[_Hypothesis](), dict[int, UpdateResult]()
        for each in self._alive:
            expected = self._expected(each.estimator, measurement)
            result = found[id(each.estimator)] = each.estimator.update(measurement)
            if result.innovation is not None:
                S = result.innovation_covariance
                y, S = expected if S is None else (result.innovation, S)
                fused.append(_Hypothesis(each.estimator, each.log_weight + _log_density(y, S)))
        if fused:
            self._alive = fused
            self._prune()
        said = found[id(best)]
        return said if said.innovation is not None or not fused else found[id(self.best)]

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: that of the likeliest hypothesis."""
        return self.best.state_at(stamp_ns)

    def mixture_at(self, stamp_ns: int) -> TrackState:
        """Mean and covariance of all hypotheses at `stamp_ns`; the mean may lie where none of them is."""
        states = [each.estimator.state_at(stamp_ns) for each in self._alive]
        middle = self.best.state_at(stamp_ns).mean
        off = np.array([wrapped(self._motion, state.mean - middle) for state in states])
        mean = self.weights @ off
        spread = sum(
            (w * (state.covariance + np.outer(each - mean, each - mean)))
            for w, state, each in zip(self.weights, states, off, strict=True)
        )
        return track_state(self._motion, stamp_ns, middle + mean, symmetrise(np.asarray(spread)))

    def _expected(self, estimator: Estimator, measurement: Measurement) -> tuple[FloatArray, FloatArray]:
        """Innovation (k,) and its covariance (k, k) by the state before, for estimators that do not give the latter."""
        if measurement.stamp_ns < estimator.window_ns[0]:
            return measurement.z * np.nan, measurement.R
        state, seen = estimator.state_at(measurement.stamp_ns), measurement.seen_by(self._motion)
        y, H = linearised(seen.z, state.mean, seen.model, seen.pose)
        return y, congruence(H, state.covariance) + seen.R

    def _prune(self) -> None:
        """Drop what has become unlikely, and the less likely of two that have become the same."""
        best = max(each.log_weight for each in self._alive)
        left: list[_Hypothesis] = []
        at_ns = self._alive[0].estimator.window_ns[1]
        for each in sorted(self._alive, key=lambda each: -each.log_weight):
            if each.log_weight < best + math.log(LEAST_WEIGHT):
                break
            state = each.estimator.state_at(at_ns)
            for other in left:
                kept = other.estimator.state_at(at_ns)
                if mahalanobis_squared(wrapped(self._motion, state.mean - kept.mean), kept.covariance) < SAME:
                    other.log_weight = float(np.logaddexp(other.log_weight, each.log_weight))
                    break
            else:
                left.append(each)
        self._alive = left


def hypotheses(
    motion: MotionModel, start: Start, wanted: int | Sequence[Start], make: Callable[[Start], Estimator]
) -> Estimator:
    """Return what `make` gives for `start`, or `Hypotheses`: one for each of the `wanted` starts, or of so many
    headings where the start has none and `motion` needs one.

    Raises `CallError` for starts of different stamps, and for a number below 1.
    """
    if isinstance(wanted, int):
        if wanted < 1:
            raise CallError(f"hypotheses: must be at least 1, is {wanted}")
        if wanted == 1 or motion.linear or start.yaw_rad is not None:
            return make(start)
        wanted = starts.headings(start, wanted)
    if any(each.stamp_ns != start.stamp_ns for each in wanted):
        raise CallError("hypotheses: give starts of one and the same stamp, that of the start itself")
    return Hypotheses(motion, [make(each) for each in wanted])


def _log_density(y: FloatArray, S: FloatArray) -> float:
    """log N(y; 0, S) of y (k,), S (k, k), but for what is the same of all hypotheses."""
    return -0.5 * float(mahalanobis_squared(y, S) + np.linalg.slogdet(S)[1])

"""Standard deviation of the stamps of a sensor by maximum likelihood, given all other noise."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from fgtrack.core.types import FloatArray
from fgtrack.noise.likelihood.fit import Likelihood, Problem
from fgtrack.noise.likelihood.reference import Step, filtered
from fgtrack.noise.likelihood.series import Observation, positive_part
from fgtrack.tracking.preprocess import StampError

_RANGE_S = 1e-3, 30.0
_TRACKS, _OBSERVATIONS = (
    5,
    1000,
)  # the longest ones, and of each the first ones: what is fitted is one number
_STEP = 0.2  # of the logarithm, for the curvature
_REJECTED = 1.92  # loss of log-likelihood at the border of a 95 % interval
_TOLERANCE = 0.03


Rates = Sequence[Sequence[FloatArray]]


class StampFit(NamedTuple):
    """Fit of the standard deviation of the stamps of a sensor."""

    std_s: float
    std_error: float
    """Standard error of its logarithm; infinite where the likelihood is flat."""


def fitted_stamps(
    problem: Problem, rates: Rates, values: FloatArray, sensor: str, std_s: float
) -> StampFit:
    """Return the fit of `sensor.stamp_std_s` to the series of `problem`, associated with `std_s`, at `values` (p,).
    The covariance of a detection has the part std_s^2 v v', with v of `rates`, see `stamp_rates`.
    """
    longest = sorted(range(len(rates)), key=lambda k: -len(rates[k]))[:_TRACKS]
    series = [problem.series[k] for k in longest]
    some = [
        replace(
            item,
            observations=item.observations[:_OBSERVATIONS],
            mixed=item.mixed.intersection(range(_OBSERVATIONS)),
        )
        for item in series
    ]
    part, free = replace(problem, series=some), np.ones(len(values), dtype=np.bool_)
    own = [rates[k][:_OBSERVATIONS] for k in longest]

    def loss(log_std: float) -> float:
        changed = with_stamps(part, own, sensor, std_s, math.exp(log_std))
        return -float(Likelihood(changed, values, free).totals(values[None])[0])

    low, high = map(math.log, _RANGE_S)
    best = minimize_scalar(
        loss, bounds=(low, high), method="bounded", options={"xatol": _TOLERANCE}
    )
    at, middle = float(best.x), float(best.fun)
    curvature = (loss(at - _STEP) + loss(at + _STEP) - 2.0 * middle) / _STEP**2
    is_needed = loss(low) - middle > _REJECTED
    return StampFit(
        math.exp(at),
        1.0 / math.sqrt(curvature) if is_needed and curvature > 0.0 else math.inf,
    )


def stamp_rates(problem: Problem, values: FloatArray) -> Rates:
    """Return v = H dx/dt at the updated state of each observation at `values` (p,), shapes (d,), by series."""
    error = StampError(problem.space.motion_model(values), 1.0)

    def rate(step: Step) -> FloatArray:
        own = step.observation.measurement
        return error.rate(own.model, own.pose, step.after)[
            list(step.observation.measured)
        ]

    return [
        list(map(rate, filtered(series, problem.space, values)))
        for series in problem.series
    ]


def with_stamps(
    problem: Problem, rates: Rates, sensor: str, was_s: float, std_s: float
) -> Problem:
    """Return `problem` with stamps of `sensor` that err by `std_s` instead of `was_s`; see `stamp_rates`."""

    def changed(item: Observation, v: FloatArray) -> Observation:
        if item.sensor != sensor:
            return item
        square = np.outer(v, v)
        return replace(
            item,
            foreign=positive_part(item.foreign - was_s**2 * square) + std_s**2 * square,
        )

    pairs = zip(problem.series, rates, strict=True)
    return replace(
        problem,
        series=[
            replace(s, observations=list(map(changed, s.observations, v)))
            for s, v in pairs
        ],
    )

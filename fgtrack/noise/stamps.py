"""Maximum-likelihood fit of the standard deviation of a sensor's stamps, given all other noise."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from fgtrack.core.types import FloatArray
from fgtrack.noise.likelihood.fit import Likelihood, Problem
from fgtrack.noise.likelihood.reference import FilteredObservation, filtered
from fgtrack.noise.likelihood.series import Observation, positive_part
from fgtrack.tracking.preprocess import StampError

_RANGE_S = 1e-3, 30.0
# The fit of this single number uses the longest tracks, and the first observations of each.
_MAX_TRACKS = 5
_MAX_OBSERVATIONS = 1000
# Difference of the logarithm for the curvature.
_DIFFERENCE = 0.2
# Drop of the log-likelihood at the border of a 95 % interval.
_REJECTED = 1.92
_TOLERANCE = 0.03


#: Rate of change of each measurement with its stamp, shape (d,), by series and observation.
Rates = Sequence[Sequence[FloatArray]]


class StampFit(NamedTuple):
    """Fitted standard deviation of the stamps of a sensor."""

    std_s: float
    std_error: float
    """Standard error of the logarithm of the standard deviation; infinite if the likelihood is flat."""


def fitted_stamps(
    problem: Problem, rates: Rates, values: FloatArray, sensor: str, std_s: float
) -> StampFit:
    """Fit the standard deviation of `sensor`'s stamps to the longest series of `problem`.

    The covariance of a detection contains the part std_s^2 v v', with v from `rates`
    (see `stamp_rates`). The series were associated with `std_s`. `values` are the other
    noise parameters, shape (p,).
    """
    longest = sorted(range(len(rates)), key=lambda k: -len(rates[k]))[:_MAX_TRACKS]
    shortened = [
        replace(
            item,
            observations=item.observations[:_MAX_OBSERVATIONS],
            mixed=item.mixed.intersection(range(_MAX_OBSERVATIONS)),
        )
        for item in (problem.series[k] for k in longest)
    ]
    part = replace(problem, series=shortened)
    own = [rates[k][:_MAX_OBSERVATIONS] for k in longest]
    free = np.ones(len(values), dtype=np.bool_)

    def loss(log_std: float) -> float:
        changed = with_stamps(part, own, sensor, std_s, math.exp(log_std))
        return -float(Likelihood(changed, values, free).totals(values[None])[0])

    low, high = map(math.log, _RANGE_S)
    best = minimize_scalar(
        loss, bounds=(low, high), method="bounded", options={"xatol": _TOLERANCE}
    )
    at = float(best.x)
    middle = float(best.fun)
    difference = loss(at - _DIFFERENCE) + loss(at + _DIFFERENCE) - 2.0 * middle
    curvature = difference / _DIFFERENCE**2
    is_needed = loss(low) - middle > _REJECTED
    return StampFit(
        math.exp(at),
        1.0 / math.sqrt(curvature) if is_needed and curvature > 0.0 else math.inf,
    )


def stamp_rates(problem: Problem, values: FloatArray) -> Rates:
    """Return the rate v = H dx/dt of each observation at its updated state, shape (d,), by series.

    `values` are the noise parameters of the filter, shape (p,).
    """
    error = StampError(problem.space.motion_model(values), 1.0)

    def rate(step: FilteredObservation) -> FloatArray:
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
    """Return `problem` with the stamp standard deviation `std_s` of `sensor` instead of `was_s`."""

    def changed(item: Observation, v: FloatArray) -> Observation:
        if item.sensor != sensor:
            return item
        square = np.outer(v, v)
        return replace(
            item,
            other_errors=positive_part(item.other_errors - was_s**2 * square)
            + std_s**2 * square,
        )

    pairs = zip(problem.series, rates, strict=True)
    return replace(
        problem,
        series=[
            replace(item, observations=list(map(changed, item.observations, own)))
            for item, own in pairs
        ],
    )

"""Objects that no list has shown: a Poisson process of their number and states."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.filters.ekf import propagated
from fgtrack.models.motion import MotionModel
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.decisions.measurements import correct, log_densities, split

_LEAST_NUMBER = 1e-5


class Unseen(NamedTuple):
    """Objects that no list has shown and whose states have one Gaussian density."""

    number: float
    """Expected number."""
    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class BirthPrior:
    """Objects that appear: their rate, and mean and covariance of their first state."""

    per_s: float
    mean: FloatArray
    covariance: FloatArray

    def predicted(
        self,
        unseen: Sequence[Unseen],
        dt_s: float,
        is_first: bool,
        lifetime_s: float,
        motion: MotionModel,
    ) -> tuple[Unseen, ...]:
        """Return `unseen`, and the objects that have appeared, `dt_s` later.

        Before the first list, objects have appeared for long.
        """
        survival = math.exp(-dt_s / lifetime_s)
        found = []
        kept = [each for each in unseen if each.number > _LEAST_NUMBER]
        if kept:
            numbers, means, covariances = zip(*kept, strict=True)
            x, F, Q = motion.transition(np.array(means), np.full(len(kept), dt_s))
            P = propagated(F, np.array(covariances), Q)
            found = [
                Unseen(number * survival, *each)
                for number, *each in zip(numbers, x, P, strict=True)
            ]
        appeared = self.per_s * lifetime_s * (1.0 if is_first else 1.0 - survival)
        return (*found, Unseen(appeared, self.mean, self.covariance))


def densities_of(entry: Entry, unseen: Sequence[Unseen]) -> FloatArray:
    """Return the density of each candidate as a first detection of each kind of unseen objects, shape (k, m)."""
    k, m = len(unseen), len(entry.candidates)
    means = np.array([each.mean for each in unseen])
    P = np.array([each.covariance for each in unseen])
    numbers = np.array([each.number for each in unseen])
    rows, columns = np.repeat(np.arange(k), m), np.tile(np.arange(m), k)
    found = np.nan_to_num(np.exp(log_densities(entry, rows, columns, means, P)))
    weights = numbers * entry.sensor.detection_probability
    return np.asarray(weights[:, None] * found.reshape(k, m))


def first_state(
    entry: Entry, column: int, unseen: Sequence[Unseen]
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of the likeliest unseen object, given a candidate."""
    likeliest = unseen[int(densities_of(entry, unseen)[:, column].argmax())]
    mean, covariance = likeliest.mean[None].copy(), likeliest.covariance[None].copy()
    for group, members, _ in split(entry.groups, np.array([column])):
        correct(group, members, mean, covariance)
    return mean[0], covariance[0]


def not_shown(entry: Entry, unseen: Sequence[Unseen]) -> tuple[Unseen, ...]:
    """Return `unseen` after a list has not shown them."""
    sensor = entry.sensor
    if not (sensor.gives_position and sensor.scan):
        return tuple(unseen)
    missed = 1.0 - sensor.detection_probability
    return tuple([each._replace(number=each.number * missed) for each in unseen])

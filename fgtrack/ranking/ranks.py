"""Ranks with ties, and intervals of errors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.intervals import Estimate, average, paired
from fgtrack.evaluation.tables import NO_VALUE, Column, Record

_FEWEST_RUNS = 3
"""Fewest runs of an interval that the table shows."""


class Ranked(Protocol):
    """Result of a method."""

    @property
    def method(self) -> str:
        """Name of the method."""
        ...

    @property
    def error(self) -> FloatArray:
        """Error by run, shape (runs,); empty without answers."""
        ...

    @property
    def is_complete(self) -> bool:
        """True if the method has answered all queries that rank it."""
        ...


R = TypeVar("R", bound=Ranked)


def ranked(results: Sequence[R]) -> list[tuple[R, int | None]]:
    """Return the results with their ranks, the best first; methods whose answers are not complete stand last.

    A method shares the rank of the best method of the rank before, if the interval of
    their paired difference contains 0. A method without all answers has no rank.
    """
    found: list[tuple[R, int | None]] = []
    first: R | None = None
    rank = 0
    complete = [each for each in results if each.is_complete]
    for number, each in enumerate(sorted(complete, key=_by_error), start=1):
        if first is None or paired(each.error, first.error).low > 0.0:
            first, rank = each, number
        found.append((each, rank))
    others = [each for each in results if not each.is_complete]
    return [*found, *((each, None) for each in sorted(others, key=_by_error))]


def _by_error(result: Ranked) -> tuple[float, str]:
    """Return the key of the order of results: an unknown error stands last."""
    mean = average(result.error).mean
    return math.inf if math.isnan(mean) else mean, result.method


def positive(values: FloatArray) -> Estimate:
    """Mean of positive `values`, one per run, and its 95 % interval, which is positive.

    The interval is computed for the logarithm of the mean, to first order. It is unknown
    for fewer than three runs.
    """
    linear = average(values)
    if linear.count < _FEWEST_RUNS or not linear.mean > 0.0:
        return Estimate(linear.mean, math.nan, math.nan, linear.count)
    factor = math.exp((linear.high - linear.mean) / linear.mean)
    return Estimate(
        linear.mean, linear.mean / factor, linear.mean * factor, linear.count
    )


@dataclass(frozen=True)
class WithInterval(Column):
    """Column of a number and its interval, which is left out if it is unknown."""

    def cell(self, record: Record) -> str:
        """Return the text of the number, with its interval in brackets if that is known."""
        text = super().cell(record)
        return text.removesuffix(f" ({NO_VALUE} to {NO_VALUE})")


def interval(name: str, estimate: Estimate, unit: str) -> dict[str, float]:
    """Return an estimate and its interval as the values of a record."""
    return {
        f"{name}{unit}": estimate.mean,
        f"{name}_low{unit}": estimate.low,
        f"{name}_high{unit}": estimate.high,
    }

"""Ranks with ties: methods that do not differ significantly share a rank."""

from collections.abc import Sequence
from typing import Protocol, TypeVar

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.intervals import Estimate, average, paired


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


R = TypeVar("R", bound=Ranked)


def ranked(results: Sequence[R]) -> list[tuple[R, int | None]]:
    """Return the results with their ranks, the best first; a method without answers has no rank.

    A method shares the rank of the best method of the rank before, if the interval of
    their paired difference contains 0.
    """
    known = [each for each in results if len(each.error)]
    known.sort(key=lambda each: (average(each.error).mean, each.method))
    found: list[tuple[R, int | None]] = []
    first: R | None = None
    rank = 0
    for number, each in enumerate(known, start=1):
        if first is None or paired(each.error, first.error).low > 0.0:
            first, rank = each, number
        found.append((each, rank))
    return [*found, *((each, None) for each in results if not len(each.error))]


def interval(name: str, estimate: Estimate, unit: str) -> dict[str, float]:
    """Return an estimate and its interval as the values of a record."""
    return {
        f"{name}{unit}": estimate.mean,
        f"{name}_low{unit}": estimate.low,
        f"{name}_high{unit}": estimate.high,
    }

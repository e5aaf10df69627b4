"""Who is best, and how much worse the others are."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.paired import Estimate
from fgtrack.evaluation.tables import Column, Value, short, two_digits

Standing = Literal["best", "tie", "worse"]
Row = TypeVar("Row")

STANDING_NOTE = "+: best; =: ties with the best, as the interval has 0 inside (block bootstrap)"
"""What the marks of `value_column` mean, for a table within a run."""

_MARKS: Mapping[Value, str] = {"best": "+", "tie": "=", "worse": " "}


@dataclass(frozen=True)
class Entry:
    """One of those that are compared in one quantity."""

    name: str
    """Of the run, or of the estimator."""
    value: float
    worse_by: Estimate | None
    """How much worse than the best; None of the best itself."""
    standing: Standing
    """`tie` where the interval of the difference to the best has 0 inside; `best` only without any tie."""


def ranked(
    names: Sequence[str],
    values: Sequence[float] | FloatArray,
    costs: Sequence[float] | FloatArray,
    worse_by: Callable[[int, int], Estimate],
) -> tuple[Entry, ...]:
    """Entries from the least of the `costs` to the largest; `worse_by` gives the cost of one place minus another's."""
    best, *others = np.argsort(costs, kind="stable").tolist()
    differences = {one: worse_by(one, best) for one in others}
    standings: dict[int, Standing] = {k: "worse" if d.is_significant else "tie" for k, d in differences.items()}
    first: Standing = "tie" if "tie" in standings.values() else "best"
    return (
        Entry(names[best], float(values[best]), None, first),
        *(Entry(names[k], float(values[k]), differences[k], standings[k]) for k in others),
    )


def value_column(heading: str, name: str, entry_of: Callable[[Row], Entry]) -> Column[Row]:
    """The column `name` of `Entry.value` and its standing, the best one bold."""
    return Column(
        f"{heading}  ",
        (name, "standing"),
        lambda row: (entry_of(row).value, entry_of(row).standing),
        "{} {}",
        text=lambda value: _MARKS.get(value, "") or short(value),
        bold=lambda row: entry_of(row).standing == "best",
    )


def worse_columns(entry_of: Callable[[Row], Entry]) -> list[Column[Row]]:
    """Columns of `Entry.worse_by` and its interval."""

    def mean(row: Row) -> tuple[Value, ...] | None:
        found = entry_of(row).worse_by
        return None if found is None else (found.mean,)

    def interval(row: Row) -> tuple[Value, ...] | None:
        found = entry_of(row).worse_by
        return (found.low, found.high) if found is not None and found.is_known else None

    return [
        Column("worse\nby", ("worse_by",), mean, text=two_digits),
        Column("95 % interval", ("low", "high"), interval, "{} to {}", text=two_digits),
    ]

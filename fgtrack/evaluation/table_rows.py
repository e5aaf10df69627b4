"""What the tables of a comparison share: their rows, the column of the runs, names and units."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from fgtrack.evaluation.tables import Column, Value

ERRORS = {
    "position_m": "pos.\n[m]",
    "along_m": "along\n[m]",
    "across_m": "across\n[m]",
    "yaw_rad": "yaw\n[rad]",
    "speed_mps": "speed\n[m/s]",
}
"""Errors by name, and their headings."""
PERCENT = 100.0
MS = 1e3

T = TypeVar("T")
Values = tuple[Value, ...]


@dataclass(frozen=True)
class Row(Generic[T]):
    """What a row is made of."""

    run: str
    of: T
    part: str = ""
    """What distinguishes it from the other rows of the run."""


def run_column(rows: Sequence[Row[T]]) -> Column[Row[T]]:
    """The column with the run of each of `rows`."""
    return Column("run", ("run",), lambda row: (row.run,), left=True)


def named(name: str, moment: str) -> str:
    """`name` of a quantity with the `moment` before its unit: position_rmse_m."""
    quantity, _, unit = name.rpartition("_")
    return f"{quantity}_{moment}_{unit}"

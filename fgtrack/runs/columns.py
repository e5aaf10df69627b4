"""Columns of a table, which are selected at first use."""

from collections.abc import Iterator, Mapping

import numpy as np

from fgtrack.core.types import BoolArray, IntArray
from fgtrack.runs.schema import Column, column_type


class Columns(Mapping[str, Column]):
    """Columns of a table by name: read-only NumPy arrays of shape (rows,); `len` is the number of columns.

    In a float column, an empty cell and a number beyond 1e60 are NaN. In an integer
    column, an empty cell is `NO_TRACK`.
    """

    def __init__(self, columns: Mapping[str, Column]) -> None:
        self._names = tuple(columns)
        self._columns = {name: read_only(values) for name, values in columns.items()}

    def __getitem__(self, name: str) -> Column:
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    @property
    def num_rows(self) -> int:
        """Length of every column."""
        return len(next(iter(self._columns.values()), ()))

    def equals(self, other: "Columns") -> bool:
        """True if both tables have the same columns, equal to the bit; NaN equals NaN."""
        return list(self) == list(other) and all(
            np.array_equal(
                self[name], other[name], equal_nan=column_type(name) is float
            )
            for name in self
        )

    def where(self, rows: BoolArray | IntArray) -> "Columns":
        """Return the rows selected by a mask, shape (rows,), or by indices."""
        return _Selection(self, rows)


class _Selection(Columns):
    """Rows of another table, whose columns are selected at first use.

    A selection from a selection selects from the first table, so it makes no column
    that nobody uses.
    """

    _table: Columns
    _rows: IntArray

    def __init__(self, table: Columns, rows: BoolArray | IntArray) -> None:
        index: IntArray = (
            np.flatnonzero(rows)
            if np.asarray(rows).dtype == np.bool_
            else np.asarray(rows, dtype=np.int64)
        )
        if isinstance(table, _Selection):
            index = table._rows[index]
            table = table._table
        self._table = table
        self._rows = index
        self._names = tuple(table)
        self._columns = {}

    def __getitem__(self, name: str) -> Column:
        if name not in self._columns:
            self._columns[name] = read_only(self._table[name][self._rows])
        return self._columns[name]

    @property
    def num_rows(self) -> int:
        return len(self._rows)


def read_only(values: Column) -> Column:
    """Return a view of `values` that cannot be written."""
    view = values.view()
    view.flags.writeable = False
    return view

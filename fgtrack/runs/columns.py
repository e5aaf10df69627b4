"""Columns of a table, which are selected at first use."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from weakref import WeakValueDictionary

import numpy as np

from fgtrack.core.types import BoolArray, IntArray
from fgtrack.runs.schema import Column, column_type

#: Largest column that is kept. To make such a column again for each of its rows would take minutes.
KEPT_BYTES = 1 << 23


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


class MadeColumns(Columns):
    """Columns that are made at first use.

    A column of more than 8 MB is kept only while it is in use, so a long table needs the
    memory of a few columns.
    """

    _in_use: WeakValueDictionary[str, Column]

    def __init__(self, names: Iterable[str]) -> None:
        self._names = tuple(names)
        self._columns = {}
        self._in_use = WeakValueDictionary()

    def __getitem__(self, name: str) -> Column:
        values = self._in_use.get(name)
        if values is None:
            if name not in self._names:
                raise KeyError(name)
            self._in_use[name] = values = read_only(self._made(name))
            if values.nbytes <= KEPT_BYTES:
                self._columns[name] = values
        return values

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __reduce__(self) -> tuple[type[Columns], tuple[Mapping[str, Column]]]:
        return Columns, (dict(self),)

    @property
    @abstractmethod
    def num_rows(self) -> int:
        """Length of every column."""

    @abstractmethod
    def _made(self, name: str) -> Column:
        """Return the column `name`."""


class _Selection(MadeColumns):
    """Rows of another table.

    A selection from a selection selects from the first table, so it makes no column
    that nobody uses.
    """

    _table: Columns
    _rows: IntArray

    def __init__(self, table: Columns, rows: BoolArray | IntArray) -> None:
        super().__init__(table)
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

    @property
    def num_rows(self) -> int:
        return len(self._rows)

    def _made(self, name: str) -> Column:
        return np.asarray(self._table[name][self._rows])


def read_only(values: Column) -> Column:
    """Return `values` if they cannot be written, otherwise a view of them that cannot be written."""
    if not values.flags.writeable:
        return values
    view = values.view()
    view.flags.writeable = False
    return view

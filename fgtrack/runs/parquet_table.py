"""Tables of a run as Parquet files: the columns, types and digest are those of the CSV files.

The module needs the package pyarrow (extra `parquet`).
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fgtrack.core.errors import DataError
from fgtrack.inputs.errors import one_line
from fgtrack.runs.columns import Columns, MadeColumns
from fgtrack.runs.rows import Row, text, text_header
from fgtrack.runs.schema import (
    ADDED_COLUMNS,
    COLUMNS,
    NO_TRACK,
    Column,
    column,
    column_type,
    written_columns,
)

#: Number of rows that are written together; a larger number compresses no better.
_GROUP_ROWS = 1 << 16
#: Largest number of batches of a few rows that are kept apart.
_MOST_SMALL = 64
_BLOCK_ROWS = 1 << 13
_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64()}
#: A stream of bytes for each byte of a number compresses best: neighbours share exponents, but no digits.
_ENCODINGS = {int: "DELTA_BINARY_PACKED", float: "BYTE_STREAM_SPLIT"}


class ParquetTable:
    """Writer of the Parquet file of a table, which is readable after `close`."""

    def __init__(self, path: Path, table: str, is_scored: bool) -> None:
        names = written_columns(table, is_scored)
        kinds = {name: column_type(name) for name in names}
        self._schema = pa.schema([(name, _TYPES[kind]) for name, kind in kinds.items()])
        self._batches: list[Any] = []  # Any: pyarrow has no types
        self._small: list[Any] = []
        self._num_rows = 0
        self._file = pq.ParquetWriter(
            path,
            self._schema,
            compression="zstd",
            use_dictionary=[name for name, kind in kinds.items() if kind is str],
            column_encoding={
                name: _ENCODINGS[kind]
                for name, kind in kinds.items()
                if kind in _ENCODINGS
            },
        )

    def append(self, rows: Sequence[Row]) -> None:
        """Append `rows`, whose columns are those of the table; they are written in groups."""
        if rows:
            self._add(
                [
                    pa.array(cells, field.type)
                    for field, cells in zip(
                        self._schema, zip(*rows, strict=True), strict=True
                    )
                ]
            )

    def append_columns(self, columns: Columns) -> None:
        """Append the rows of `columns`; a missing number becomes an empty cell."""
        arrays = []
        for field in self._schema:
            values = columns[field.name]
            empty = None
            if column_type(field.name) is float:
                empty = np.isnan(values)
            elif field.name == "track_id":
                empty = values == NO_TRACK
            arrays.append(pa.array(values, field.type, mask=empty))
        self._add(arrays)

    def close(self) -> None:
        """Write the remaining rows and the end of the file."""
        self._write()
        self._file.close()

    def _add(self, arrays: list[Any]) -> None:
        batch = pa.record_batch(arrays, schema=self._schema)
        self._small.append(batch)
        self._num_rows += batch.num_rows
        if len(self._small) >= _MOST_SMALL:
            self._combine()
        if self._num_rows >= _GROUP_ROWS:
            self._write()

    def _combine(self) -> None:
        """Make one batch of the small batches, whose rows take seven times as much memory."""
        rows = pa.Table.from_batches(self._small, self._schema).combine_chunks()
        self._batches += rows.to_batches()
        self._small = []

    def _write(self) -> None:
        if self._num_rows:
            self._combine()
            rows = pa.Table.from_batches(self._batches, self._schema).combine_chunks()
            self._file.write_table(rows, row_group_size=_GROUP_ROWS)
        self._batches = []
        self._num_rows = 0


class ParquetColumns(MadeColumns):
    """Columns of a Parquet file. Raises `DataError` where a column cannot be read."""

    def __init__(self, path: Path, table: str) -> None:
        super().__init__(COLUMNS[table])
        self._path = path
        # The open file stays the file of this run where another run replaces it.
        self._file = pq.ParquetFile(path)
        self._written = frozenset(self._file.schema_arrow.names)
        expected = [
            name
            for name in self._names
            if name in self._written or name not in ADDED_COLUMNS
        ]
        types = [_TYPES[column_type(name)] for name in expected]
        if self._file.schema_arrow != pa.schema(zip(expected, types, strict=True)):
            raise ValueError(f"the columns must be {','.join(self._names)}")

    @property
    def num_rows(self) -> int:
        """Length of every column."""
        return int(self._file.metadata.num_rows)

    def _made(self, name: str) -> Column:
        if name not in self._written:
            return column(name, [ADDED_COLUMNS[name]] * self.num_rows)
        try:
            cells = self._file.read([name], use_threads=False).column(0)
        except (OSError, ValueError) as error:
            raise DataError(
                f"{self._path}: cannot be read ({one_line(error)}), repeat the run"
            ) from error
        if column_type(name) is not str:
            empty = NO_TRACK if column_type(name) is int else np.nan
            values = cells.fill_null(empty) if cells.null_count else cells
            return column(name, values.to_numpy())
        coded = cells.dictionary_encode().unify_dictionaries().combine_chunks()
        coded = coded.chunk(0) if isinstance(coded, pa.ChunkedArray) else coded
        texts = np.array([*coded.dictionary.to_pylist(), ""], dtype=np.str_)
        codes = coded.indices.fill_null(len(texts) - 1)
        return np.asarray(texts[codes.to_numpy()])


def read_parquet(path: Path, table: str, complete: bool) -> ParquetColumns:
    """Return the table in the Parquet file `path`; raises `ValueError` for other content."""
    return ParquetColumns(path, table)


def parquet_blocks(path: Path, table: str) -> Iterator[bytes]:
    """Yield the bytes that the CSV file of the table in the Parquet file `path` would have."""
    with pq.ParquetFile(path) as file:
        yield text_header(table, file.schema_arrow.names == list(COLUMNS[table]))
        for batch in file.iter_batches(_BLOCK_ROWS, use_threads=False):
            cells = [column.to_pylist() for column in batch.columns]
            yield text(table, list(zip(*cells, strict=True))).encode()

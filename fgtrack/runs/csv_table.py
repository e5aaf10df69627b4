"""Tables of a run as CSV files."""

import math
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO, TextIOWrapper
from pathlib import Path
from warnings import catch_warnings

import numpy as np

from fgtrack.core.cells import guarded, unguarded
from fgtrack.core.files import open_file
from fgtrack.runs.columns import Columns
from fgtrack.runs.rows import Row, text, text_header
from fgtrack.runs.schema import (
    ADDED_COLUMNS,
    COLUMNS,
    NO_TRACK,
    SCORE,
    column,
    column_type,
)

_BLOCK_BYTES = 1 << 20


class CsvTable:
    """Writer of the CSV file of a table; the rows are in the file after every call."""

    def __init__(self, path: Path, table: str, is_scored: bool) -> None:
        self._table = table
        self._is_scored = is_scored
        self._file = path.open("wb")
        self._write(text_header(table, is_scored))

    def append(self, rows: Sequence[Row]) -> None:
        """Append `rows`, each with a value for every column of the table."""
        self._write(text(self._table, rows).encode())

    def append_columns(self, columns: Columns) -> None:
        """Append the rows of `columns`."""
        self._write(_lines(self._table, columns, self._is_scored).encode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _write(self, content: bytes) -> None:
        self._file.write(content)
        self._file.flush()


def csv_blocks(path: Path) -> Iterator[bytes]:
    """Yield the bytes of the CSV file `path`."""
    with open_file(path) as file:
        while block := file.read(_BLOCK_BYTES):
            yield block


def read_csv(path: Path, table: str, complete: bool) -> Columns:
    """Return the table in the CSV file `path`, without a half-written last row.

    Raises `ValueError` for other content, and for a half-written row of a `complete`
    run.
    """
    with open_file(path) as file:
        content = file.read()
    if complete and (not content.endswith(b"\n") or content.endswith(b"\n\n")):
        raise ValueError("breaks off in its last row")
    return parse_csv(table, content[: content.rfind(b"\n") + 1] or text_header(table))


def parse_csv(table: str, content: bytes | bytearray) -> Columns:
    """Return the columns of a table from the content of its CSV file; raises `ValueError` for other content."""
    names = COLUMNS[table]
    text = TextIOWrapper(BytesIO(content), newline="")
    written = tuple(text.readline().rstrip("\n").split(","))
    if (
        tuple(name for name in names if name in written or name not in ADDED_COLUMNS)
        != written
    ):
        raise ValueError(f"the columns must be {','.join(names)}")
    # NumPy warns about a file without rows.
    with catch_warnings(action="ignore", category=UserWarning):
        cells = np.loadtxt(
            text,
            dtype=[(name, _TYPES[column_type(name)]) for name in written],
            delimiter=",",
            quotechar='"',
            comments=None,
            converters=dict(enumerate(map(_converter, written))),
            ndmin=1,
        )
    # Runs of fgtrack 0.2 lack these columns.
    added = {
        name: [ADDED_COLUMNS[name]] * len(cells)
        for name in names
        if name not in written
    }
    return Columns(
        {
            name: column(name, added[name] if name in added else cells[name])
            for name in names
        }
    )


_TYPES = {str: object, int: np.int64, float: np.float64}


def _converter(name: str) -> Callable[[str], str | int | float]:
    """Return the function that converts a cell of the column `name`."""
    if column_type(name) is float:
        return lambda cell: float(cell) if cell else math.nan
    return (
        unguarded
        if column_type(name) is str
        else lambda cell: int(cell) if cell or name != "track_id" else NO_TRACK
    )


def _lines(table: str, columns: Columns, is_scored: bool) -> str:
    """Return the columns as lines of the table's CSV file; floats have 17 significant digits."""
    import pandas

    frame = pandas.DataFrame(dict(columns))
    if table == "tracks" and not is_scored:
        frame = frame.drop(columns=SCORE)
    for name in frame:
        if column_type(name) is str:
            frame[name] = frame[name].map(guarded)
    if table == "updates":
        frame["track_id"] = (
            frame["track_id"].astype("Int64").replace(NO_TRACK, pandas.NA)
        )
    return _with_quoted_returns(
        frame.to_csv(
            header=False, index=False, float_format="%.17g", lineterminator="\r\n"
        )
    )


def _with_quoted_returns(text: str) -> str:
    """Return CSV text whose lines end in a line feed alone; carriage returns stay inside quotes.

    pandas quotes a carriage return only where lines end in it.
    """
    if '"' not in text:
        return text.replace("\r\n", "\n")
    parts = text.split('"')
    parts[::2] = [part.replace("\r\n", "\n") for part in parts[::2]]
    return '"'.join(parts)

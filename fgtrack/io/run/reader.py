"""Reads a run folder into columns."""

import csv
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgtrack.core.errors import DataError
from fgtrack.core.types import BoolArray
from fgtrack.io.run.schema import COLUMNS, OPTIONAL_TABLES, RUN_FORMAT

# A column holds floats, integers or strings, as its name says; the reader of it knows which.
Column = npt.NDArray[Any]

_TEXT_COLUMNS = frozenset({"status", "sensor", "disposition", "kind"})
_INTEGER_COLUMNS = frozenset(
    {
        *("tick", "now_ns", "stamp_ns", "receipt_ns", "process_ns", "track_id", "object_id"),
        *("index", "num_measured", "num_tracks", "num_detections"),
    }
)

NO_TRACK = -1
"""Track id of an update that belongs to no track."""


@dataclass(frozen=True)
class Table:
    """Columns of one CSV file by name, each of shape (rows,).

    An empty cell is NaN in a float column and `NO_TRACK` in an integer one.
    """

    columns: Mapping[str, Column]

    def __getitem__(self, name: str) -> Column:
        return self.columns[name]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def where(self, mask: BoolArray) -> "Table":
        """The rows where `mask`, shape (rows,), is true."""
        return Table({name: column[mask] for name, column in self.columns.items()})


@dataclass(frozen=True)
class Run:
    """A run as evaluation sees it."""

    path: Path | None
    """Folder of the run; None for a run in memory."""
    meta: Mapping[str, Any]
    """Content of meta.json; JSON values."""
    config_text: str
    tracks: Table
    updates: Table
    smoothed: Table
    lagged: Table
    timing: Table
    truth: Table


def load_run(path: Path | str) -> Run:
    """Read the run folder `path`.

    Of a run that did not finish (`meta["complete"]` is false) a half-written last row is left out.

    Raises
    ------
    DataError
        A file is missing or damaged; the message names it.
    """
    path = Path(path)
    meta = _read_meta(path)
    complete = bool(meta.get("complete"))
    tables = {name: _read_table(path / f"{name}.csv", name, complete) for name in COLUMNS}
    return Run(path, meta, _read_text(path / "config.yaml"), **tables)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is not UTF-8 text (byte {error.start}), repeat the run") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}), is this a run folder?") from error


def _read_meta(path: Path) -> Mapping[str, Any]:
    file = path / "meta.json"
    try:
        meta = json.loads(_read_text(file))
    except ValueError as error:
        raise DataError(f"{file}: is not JSON ({error}), repeat the run") from error
    if not isinstance(meta, dict) or meta.get("format") != RUN_FORMAT:
        raise DataError(f"{file}: does not say format {RUN_FORMAT!r}, so this is not a run folder")
    return meta


def _read_table(path: Path, table: str, complete: bool) -> Table:
    names = COLUMNS[table]
    if table in OPTIONAL_TABLES and not path.exists():
        return Table({name: column(name, ()) for name in names})
    text = _read_text(path)
    if not text.endswith("\n"):
        if complete:
            raise DataError(f"{path}: breaks off in its last row, repeat the run")
        text = text[: text.rfind("\n") + 1]
    try:
        rows = list(csv.reader(io.StringIO(text, newline="")))
    except csv.Error as error:
        raise DataError(f"{path}: is not CSV ({error}), repeat the run") from error
    if not rows or tuple(rows[0]) != names:
        raise DataError(f"{path}:1: the header must be {','.join(names)}")
    for line, row in enumerate(rows, 1):
        if len(row) != len(names):
            raise DataError(f"{path}:{line}: {len(row)} cells instead of {len(names)}, repeat the run")
    cells = zip(*rows[1:], strict=True) if len(rows) > 1 else ((),) * len(names)
    try:
        return Table({name: column(name, values) for name, values in zip(names, cells, strict=True)})
    except (ValueError, OverflowError) as error:
        raise DataError(f"{path}: holds a bad cell ({error}), repeat the run") from error


def column(name: str, cells: Sequence[str | int | float | None]) -> Column:
    """The column `name` from its cells, values or their text, shape (rows,); None and "" are empty."""
    if name in _TEXT_COLUMNS:
        return np.array(cells, dtype=np.str_)
    convert: Callable[[str | int | float], float] = int if name in _INTEGER_COLUMNS else float
    empty = NO_TRACK if name in _INTEGER_COLUMNS else np.nan
    dtype = np.int64 if name in _INTEGER_COLUMNS else np.float64
    return np.array([empty if cell is None or cell == "" else convert(cell) for cell in cells], dtype=dtype)

"""CSV files whose columns the configuration names: the ego, detections and truth in one file or several.

A row is a state of the ego, a detection or a true object. Rows of one stamp and one receipt are one list of detections;
a row in which nothing is measured says that nothing was seen. Units, signs and angles are converted as in `Field`; an
empty cell is a value that is not given. Files are sorted by receipt when they are read, so they need not be.
"""

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from functools import partial
from itertools import chain, groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import open_text
from fgtrack.core.types import (
    DESCRIBING,
    MEASURABLE,
    STATE_NAMES,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.io.adapters.fields import converted
from fgtrack.io.adapters.fusiontracking import LOG_NAME
from fgtrack.io.adapters.ids import object_id
from fgtrack.io.config import CsvInput, CsvTable, Field, FieldPath, InputConfig
from fgtrack.io.source import FileFormat

__all__ = ["FORMAT", "read_tables"]

_ENDINGS = (".csv", ".tsv")
_TIMES = ("stamp", "receipt")
_TEXTS = frozenset({"class_name", "object_id"})
_EGO = frozenset({*_TIMES, *STATE_NAMES})
_OBJECT = frozenset({*_TIMES, "object_id", *MEASURABLE, *DESCRIBING})
_TRUTH = frozenset({*_TIMES, "object_id", *STATE_NAMES})
_NS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
_LONGEST_LINE = 1_000_000
_MOST_ROWS = 1_000_000
_LONGEST_TIME = 25  # digits of a time before and behind the point


class Cells(NamedTuple):
    """A row of a file."""

    place: str
    """File and line, for messages."""
    values: dict[str, str]


class _Times(NamedTuple):
    stamp_ns: int
    receipt_ns: int


Make = Callable[[Cells, _Times], Any]
"""An `EgoState`, a `TruthState`, or a `Detection` (None of a row without one)."""


def read_tables(tables: Sequence[tuple[Path, CsvTable, str]]) -> Iterator[Message]:
    """Messages of the tables, each with its file and what it holds: `ego`, `truth` or `detections SENSOR`.

    They come in the order of receipt; at one receipt the truth first, then the ego, then the detections.

    Raises
    ------
    DataError
        A row is not what the mapping says; raised after all messages up to the last receipt before that row.
    """
    found: list[Message] = []
    breaks: list[tuple[float, DataError]] = []
    for file, table, role in tables:
        messages, error = _read(file, table, role)
        found += messages
        if error is not None:
            breaks.append((max((one.receipt_ns for one in messages), default=-math.inf), error))
    until_ns, broken = min(breaks, key=lambda one: one[0], default=(math.inf, None))
    for message in sorted(found, key=attrgetter("receipt_ns")):
        if message.receipt_ns > until_ns:
            break
        yield message
    if broken is not None:
        raise broken


def _read(file: Path, table: CsvTable, role: str) -> tuple[list[Message], DataError | None]:
    """All messages of a table, up to its end or to what is wrong with it."""
    rows: list[tuple[_Times, Any]] = []
    left_out: list[str] = []
    first: Cells | None = None  # of those left out
    error = None
    make: Make = partial(_state, table, role) if role in ("ego", "truth") else partial(_detection, table)
    try:
        for cells in _rows(file, table):
            refused = (name for name, each in table.filters.items() if not each.passes(_typed(cells.values[name])))
            if (name := next(refused, None)) is not None:
                left_out.append(f"filters.{name}")
                first = first or cells
                continue
            times = _times(cells, table)
            rows.append((times, make(cells, times)))
        if not rows and first is not None and role not in ("ego", "truth"):
            rows.append((_times(first, table), None))  # an empty list, to say what was left out
    except DataError as found:
        error = found
    if role in ("ego", "truth"):
        return [state for _, state in rows], error
    lists = list(_lists(rows, role.removeprefix("detections "), table))
    if lists:
        lists[0] = replace(lists[0], left_out=tuple(left_out))  # their own times are not read
    return [*lists], error


def _lists(rows: list[tuple[_Times, Detection | None]], sensor: str, table: CsvTable) -> Iterator[DetectionList]:
    rows.sort(key=lambda row: (row[0].receipt_ns, row[0].stamp_ns))
    for times, group in groupby(rows, key=lambda row: row[0]):
        objects = [item for _, item in group if item is not None]
        yield DetectionList(sensor, times.stamp_ns, times.receipt_ns, objects, table.frame or "ego")


def _rows(file: Path, table: CsvTable) -> Iterator[Cells]:
    try:
        with open_text(file, "utf-8-sig", newline="") as text:
            first = text.readline(_LONGEST_LINE)
            text.seek(0)
            delimiter = table.delimiter or max(",;\t", key=first.count)
            reader = csv.reader(_lines(file, text), delimiter=delimiter, skipinitialspace=True)
            header = [name.strip() for name in next(reader, [])]
            _check_columns(file, table, header)
            for count, cells in enumerate(reader):
                if count >= _MOST_ROWS:
                    raise DataError(f"{file}: has more than {_MOST_ROWS} rows, give it in parts")
                if not any(cells):
                    continue
                if len(cells) != len(header):
                    raise DataError(f"{file}:{reader.line_num}: has {len(cells)} cells, the header has {len(header)}")
                yield Cells(f"{file}:{reader.line_num}", dict(zip(header, map(str.strip, cells), strict=True)))
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{file}: is no UTF-8 text ({error.reason})") from error
    except csv.Error as error:
        raise DataError(f"{file}:{reader.line_num}: is no CSV ({error})") from error


def _lines(file: Path, text: TextIO) -> Iterator[str]:
    for number, line in enumerate(iter(partial(text.readline, _LONGEST_LINE), ""), start=1):
        if len(line) == _LONGEST_LINE:
            raise DataError(f"{file}:{number}: is longer than {_LONGEST_LINE} characters")
        yield line


def _check_columns(file: Path, table: CsvTable, header: list[str]) -> None:
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise DataError(f"{file}:1: has the column {twice!r} twice")
    for name in [*chain.from_iterable(map(_names, table.columns.values())), *table.filters]:
        if name not in header:
            raise DataError(f"{file}:1: has no column {name!r}, but {', '.join(header)}")


def _names(path: FieldPath) -> Sequence[str]:
    path = path.path if isinstance(path, Field) else path
    return [path] if isinstance(path, str) else path


def _times(cells: Cells, table: CsvTable) -> _Times:
    stamp_ns = _time(cells, table, "stamp")
    receipt_ns = _time(cells, table, "receipt") if "receipt" in table.columns else stamp_ns
    return _Times(receipt_ns if table.stamp_from == "receipt" else stamp_ns, receipt_ns)


def _time(cells: Cells, table: CsvTable, name: str) -> int:
    """Integer nanoseconds of the decimal text; a float would lose the last hundred of them."""
    (column,) = _names(table.columns[name])
    text = cells.values[column]
    try:
        value = Decimal(text)
        if not value.is_finite() or abs(value.adjusted()) > _LONGEST_TIME:
            raise InvalidOperation
        return round(value.scaleb(_NS[table.time_unit]))
    except InvalidOperation as error:
        raise DataError(f"{cells.place}: {column}: {text[:40]!r} is no time") from error


def _state(table: CsvTable, role: str, cells: Cells, times: _Times) -> EgoState | TruthState:
    named = [name for name in STATE_NAMES if name in table.columns]
    values: dict[str, Any] = {name: _number(cells, table.columns[name], name) for name in named}
    if role == "ego":
        given = {name: value for name, value in values.items() if value is not None}
        for name in ("x_m", "y_m", "yaw_rad", "speed_mps"):
            given.setdefault(name, math.nan)  # an empty cell; the tracker counts a state without it as refused
        return EgoState(times.stamp_ns, times.receipt_ns, **given)
    x_m, y_m = (math.nan if values[name] is None else values[name] for name in ("x_m", "y_m"))
    values |= {"x_m": x_m, "y_m": y_m}
    return TruthState(times.stamp_ns, times.receipt_ns, _id(cells, table) or 0, **values)


def _detection(table: CsvTable, cells: Cells, times: _Times) -> Detection | None:
    numbers = [name for name in (*MEASURABLE, *DESCRIBING) if name in table.columns and name not in _TEXTS]
    values: dict[str, Any] = {name: _number(cells, table.columns[name], name) for name in numbers}
    if all(values[name] is None for name in numbers if name in MEASURABLE):
        return None
    if "class_name" in table.columns:
        (column,) = _names(table.columns["class_name"])
        values["class_name"] = cells.values[column] or None
    return Detection(**values, object_id=_id(cells, table))


def _id(cells: Cells, table: CsvTable) -> int | None:
    if "object_id" not in table.columns:
        return None
    (column,) = _names(table.columns["object_id"])
    return object_id(cells.values[column])


def _number(cells: Cells, path: FieldPath, name: str) -> float | None:
    parts = []
    for column in _names(path):
        text = cells.values[column]
        if not text:
            return None
        try:
            parts.append(float(text))
        except ValueError as error:
            raise DataError(f"{cells.place}: {column}: {text[:40]!r} is no number") from error
    return converted(parts[0] if len(parts) == 1 else math.hypot(*parts), path, name)


def _typed(text: str) -> float | str:
    """What a filter compares: a number where it is one."""
    try:
        return float(text)
    except ValueError:
        return text


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return not (path / "meta.json").exists() and any(file.suffix in _ENDINGS for file in path.iterdir())
    return path.suffix in _ENDINGS and path.name != LOG_NAME  # which is no input by itself


def _open(path: Path, config: InputConfig) -> Callable[[], Iterator[Message]]:
    tables = list(_tables(path, config.csv))
    if not tables:
        raise CallError(
            f"{path}: is CSV, so the configuration must say what its columns are (input.csv.detections ...)"
        )
    return partial(read_tables, tables)


def _tables(path: Path, config: CsvInput) -> Iterator[tuple[Path, CsvTable, str]]:
    """The truth first, then the ego, then the sensors, each with its file."""
    named = [("truth", config.truth, _TRUTH), ("ego", config.ego, _EGO)]
    named += [(f"detections {name}", table, _OBJECT) for name, table in config.detections.items()]
    for role, table, known in named:
        if table is None:
            continue
        where = f"input.csv.{role.replace(' ', '.')}.columns"
        for name in sorted(set(table.columns) - known):
            raise CallError(f"{where}: unknown column {name!r}, known are {', '.join(sorted(known))}")
        needed = ("stamp",) if known is _OBJECT else ("stamp", "x_m", "y_m")
        for name in (*needed, *(("yaw_rad", "speed_mps") if role == "ego" else ())):
            if name not in table.columns:
                raise CallError(f"{where}: must name {name}")
        if known is _OBJECT and set(table.columns).isdisjoint(MEASURABLE):
            raise CallError(f"{where}: must name what is measured, one of {', '.join(MEASURABLE)}")
        for name in (*_TIMES, *_TEXTS):
            if len(_names(table.columns.get(name, ""))) != 1 or isinstance(table.columns.get(name), Field):
                raise CallError(f"{where}.{name}: the name of one column is needed")
        yield _file(path, table, role), table, role


def _file(path: Path, table: CsvTable, role: str) -> Path:
    if table.file is None:
        if path.is_dir():
            raise CallError(f"{path}: is a folder, so input.csv.{role.replace(' ', '.')} must name its file")
        return path
    file = (path if path.is_dir() else path.parent) / table.file
    if not file.is_file():
        raise CallError(f"{file}: there is no such file (input.csv.{role.replace(' ', '.')}.file)")
    return file


FORMAT = FileFormat("CSV (.csv, .tsv, or a folder of them) with a mapping of its columns", _recognises, _open)

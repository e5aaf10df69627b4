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
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from fgtrack.core.checks import is_stamp
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import open_text
from fgtrack.core.time import NS_PER_UNIT, epoch_unit
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

__all__ = ["FORMAT", "headers", "read_tables", "rows"]

_ENDINGS = (".csv", ".tsv")
_TIMES = ("stamp", "receipt")
_TEXTS = frozenset({"class_name", "object_id"})
_NO_NUMBERS = _TEXTS | set(_TIMES)
_EGO = frozenset({*_TIMES, *STATE_NAMES})
_OBJECT = frozenset({*_TIMES, "object_id", *MEASURABLE, *DESCRIBING})
_TRUTH = frozenset({*_TIMES, "object_id", *STATE_NAMES})
_SHORTEST_NS = 100_000  # between two times of a table: 10 kHz
_FEWEST = 10  # rows whose times have a period
_LONGEST_HEADER = 1_000_000
_LONGEST_TIME = 25  # digits of a time before and behind the point


class Cells(NamedTuple):
    """A row of a file."""

    place: str
    """File and line, for messages."""
    values: dict[str, str]


def read_tables(tables: Sequence[tuple[Path, CsvTable, str]]) -> Iterator[Message]:
    """Messages of the tables, each with its file and what it holds: `ego`, `truth` or `detections SENSOR`.

    They come in the order of receipt; at one receipt the truth first, then the ego, then the detections.

    Raises
    ------
    DataError
        A row is not what the mapping says; raised after all messages up to the last receipt before that row.
    """
    found: list[tuple[tuple[int, int, int], Message]] = []
    until_ns, broken = math.inf, None
    for number, (file, table, role) in enumerate(tables):
        messages, error = _read(file, table, role)
        for one in messages:
            found.append(((one.receipt_ns, number, one.stamp_ns if isinstance(one, DetectionList) else 0), one))
        last_ns = max((one.receipt_ns for one in messages), default=-math.inf)
        if error is not None and last_ns < until_ns:
            until_ns, broken = last_ns, error
    found.sort(key=itemgetter(0))
    for (receipt_ns, _, _), group in groupby(found, key=itemgetter(0)):
        if receipt_ns > until_ns:
            break
        rows = [one for _, one in group]
        lists = [one for one in rows if isinstance(one, DetectionList)]
        objects, left_out = (
            tuple(chain.from_iterable(map(attrgetter(name), lists))) for name in ("objects", "left_out")
        )
        yield from [replace(lists[0], objects=objects, left_out=left_out)] if lists else rows
    if broken is not None:
        raise broken


def _read(file: Path, table: CsvTable, role: str) -> tuple[list[Message], DataError | None]:
    """A message of every row of a table, and the error that ends it."""
    messages: list[Message] = []
    left_out: list[str] = []
    skipped: Cells | None = None
    sample: Cells | None = None
    error = None
    try:
        for cells in _rows(file, table):
            refused = (name for name, each in table.filters.items() if not each.passes(_typed(cells.values[name])))
            if (name := next(refused, None)) is not None:
                left_out.append(f"filters.{name}")
                skipped = skipped or cells
                continue
            messages.append(_message(cells, table, role))
            sample = sample or cells
        if not messages and skipped is not None and role not in ("ego", "truth"):  # to report what was left out
            messages.append(_message(skipped, replace(table, columns=_times_of(table)), role))
    except DataError as found:
        error = found
    if sample is not None and (wrong := _wrong_unit([one.stamp_ns for one in messages], sample, table, role)):
        return [], DataError(wrong)
    if messages and isinstance(messages[0], DetectionList):
        messages[0] = replace(messages[0], left_out=tuple(left_out))  # their own times are not read
    return messages, error


def _rows(file: Path, table: CsvTable) -> Iterator[Cells]:
    found = rows(file, table.delimiter)
    _check_columns(file, table, list(next(found).values))
    return found


def rows(file: Path, delimiter: str | None = None) -> Iterator[Cells]:
    """Cells of every line of `file` by column, the header first; without a delimiter the likeliest of `,`, `;` and tab.

    Raises
    ------
    DataError
        The file is not a table.
    """
    try:
        with open_text(file, "utf-8-sig", newline="") as text:
            first = text.readline(_LONGEST_HEADER)
            text.seek(0)
            reader = csv.reader(text, delimiter=delimiter or max(",;\t", key=first.count), skipinitialspace=True)
            header = [name.strip() for name in next(reader, [])]
            twice = next((name for name in header if header.count(name) > 1), None)
            if twice is not None:
                raise DataError(f"{file}:1: has the column {twice!r} twice")
            yield Cells(f"{file}:1", dict(zip(header, header, strict=True)))
            for cells in reader:
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


def _check_columns(file: Path, table: CsvTable, header: list[str]) -> None:
    for name in [*chain.from_iterable(map(_names, table.columns.values())), *table.filters]:
        if name not in header:
            raise DataError(f"{file}:1: has no column {name!r}, but {', '.join(header)}")


def _names(path: FieldPath) -> Sequence[str]:
    path = path.path if isinstance(path, Field) else path
    return [path] if isinstance(path, str) else path


def _times_of(table: CsvTable) -> dict[str, FieldPath]:
    return {name: path for name, path in table.columns.items() if name in _TIMES}


def _time(cells: Cells, table: CsvTable, name: str) -> int:
    """Integer nanoseconds of the decimal text; a float would lose the last hundred of them."""
    column = str(table.columns[name])
    text = cells.values[column]
    try:
        value = Decimal(text)
        if not value.is_finite() or abs(value.adjusted()) > _LONGEST_TIME:
            raise InvalidOperation
        time_ns = round(value * NS_PER_UNIT[table.time_unit])
    except InvalidOperation as error:
        raise DataError(f"{cells.place}: {column}: {text[:40]!r} is not a time") from error
    if not is_stamp(time_ns):
        unit = epoch_unit(float(value))
        meant = f"set `time_unit: {unit}`" if unit else "change `time_unit`"
        raise DataError(
            f"{cells.place}: {column}: {text[:40]} {table.time_unit} is beyond the year 2096: {meant} of this table"
        )
    return time_ns


def _wrong_unit(times_ns: Sequence[int], sample: Cells, table: CsvTable, role: str) -> str | None:
    """Sentence about the unit of `times_ns`, where rows follow each other faster than any sensor sends.

    `sample` is the first of the rows.
    """
    num_times, span_ns = len(set(times_ns)), max(times_ns) - min(times_ns)
    column = str(table.columns["stamp"])
    unit = epoch_unit(float(sample.values[column]))
    is_other = unit not in (None, table.time_unit)
    if len(times_ns) < _FEWEST or span_ns >= _SHORTEST_NS * num_times or not (is_other or num_times > 2):
        return None
    return (
        f"{sample.place}: {column}: {sample.values[column][:40]} and the times after it in {table.time_unit} are "
        f"{span_ns * 1e-9:.3g} s long, {len(times_ns)} rows that no sensor sends so fast: "
        f"{f'set `time_unit: {unit}`' if is_other else 'change `time_unit`'} (input.csv.{role.replace(' ', '.')})"
    )


def _message(cells: Cells, table: CsvTable, role: str) -> Message:
    """The state in a row, or a list of its detection; empty where nothing is measured."""
    receipt_ns = stamp_ns = _time(cells, table, "stamp")
    if "receipt" in table.columns:
        receipt_ns = _time(cells, table, "receipt")
    times = (receipt_ns if table.stamp_from == "receipt" else stamp_ns, receipt_ns)
    columns = table.columns
    values: dict[str, Any] = {name: _number(cells, columns[name], name) for name in columns.keys() - _NO_NUMBERS}
    number = object_id(cells.values[str(columns["object_id"])]) if "object_id" in columns else None
    if role == "ego":  # an empty cell is not a number: the tracker counts a state without it as refused
        given = {name: value for name, value in values.items() if value is not None}
        return EgoState(*times, **dict.fromkeys(("x_m", "y_m", "yaw_rad", "speed_mps"), math.nan) | given)
    if role == "truth":
        values |= {name: math.nan for name in ("x_m", "y_m") if values[name] is None}
        return TruthState(*times, number or 0, **values)
    if "class_name" in columns:
        values["class_name"] = cells.values[str(columns["class_name"])] or None
    is_measured = any(values.get(name) is not None for name in MEASURABLE)
    objects = (Detection(**values, object_id=number),) if is_measured else ()
    return DetectionList(role.removeprefix("detections "), *times, objects, table.frame or "ego")


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
    """Value that a filter compares: a number where it is one."""
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
        found = "; ".join(f"{file.name} has {', '.join(columns)}" for file, columns in headers(path).items())
        raise CallError(
            f"{path}: is CSV, name its columns in input.csv: {found} (`fgtrack info {path} --write my.yaml` guesses)"
        )
    return partial(read_tables, tables)


def headers(path: Path) -> dict[Path, list[str]]:
    """Columns of the CSV file `path`, or of every one in the folder, by file. Raises `DataError` as `read_tables`."""
    files = sorted(file for file in path.iterdir() if file.suffix in _ENDINGS) if path.is_dir() else [path]
    return {file: list(next(rows(file)).values) for file in files}


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
            if not isinstance(table.columns.get(name, ""), str):
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

"""CSV files whose columns the configuration names: the ego, detections and truth in one file or several.

A row is a state of the ego, a detection or a true object. Rows of one stamp and one receipt are one list of detections;
a row in which nothing is measured is an empty scan. Columns are converted as in `fields.mapped`; an empty cell is a
missing value. Rows are sorted by receipt.
"""

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from decimal import Decimal
from functools import partial
from io import TextIOWrapper
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path

from fgtrack.core.checks import is_stamp
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import open_file
from fgtrack.core.time import NS_PER_UNIT, epoch_unit, wrong_unit
from fgtrack.core.types import MEASURABLE, STATE_NAMES, Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.io.adapters.fields import COMPONENTS, FieldError, mapped, paths_of, single_path
from fgtrack.io.adapters.fusiontracking import LOG_NAME
from fgtrack.io.config import CsvTable, InputConfig
from fgtrack.io.source import FileFormat

__all__ = ["FORMAT", "headers", "read_tables", "rows"]

_ENDINGS = (".csv", ".tsv")
_LONGEST_HEADER = 1_000_000
_TIMES = ("stamp", "receipt")
_EGO_NEEDS = ("x_m", "y_m", "yaw_rad", "speed_mps")
#: Components of the rows of the ego and of truth; all others are of detections.
_NAMES = {"ego": STATE_NAMES, "truth": ("object_id", *STATE_NAMES)}

Row = tuple[str, dict[str, str]]
"""File and line, for messages, and cells by column."""


def read_tables(tables: Sequence[tuple[Path, CsvTable, str]]) -> Iterator[Message]:
    """Messages of the tables, each given with its file and its role: `ego`, `truth` or `detections.SENSOR`.

    They come in the order of receipt; at equal receipts in the order of `tables`. Raises `DataError` where a row does
    not match the mapping, after all messages up to the last receipt before that row.
    """
    keyed: list[tuple[tuple[int, int, int], Message]] = []
    until_ns, broken = math.inf, None
    for number, table in enumerate(tables):
        messages, error = _read(*table)
        keyed += [((each.receipt_ns, number, each.stamp_ns), each) for each in messages]
        last_ns = max((each.receipt_ns for each in messages), default=-math.inf)
        if error is not None and last_ns < until_ns:
            until_ns, broken = last_ns, error
    keyed = sorted((each for each in keyed if each[0][0] <= until_ns), key=itemgetter(0))
    for _, group in groupby(keyed, key=itemgetter(0)):
        messages = [message for _, message in group]
        lists = [message for message in messages if isinstance(message, DetectionList)]
        objects = [item for each in lists for item in each.objects]
        left_out = tuple(item for each in lists for item in each.left_out)
        yield from [replace(lists[0], objects=objects, left_out=left_out)] if lists else messages
    if broken is not None:
        raise broken


def _read(file: Path, table: CsvTable, role: str) -> tuple[list[Message], DataError | None]:
    """A message of every row of a table that passes the filters, and the error that ends it."""
    messages: list[Message] = []
    left_out: list[str] = []
    first: Row | None = None
    skipped: Row | None = None
    times = {name: path for name, path in table.columns.items() if name in _TIMES}
    try:
        found = rows(file, table.delimiter)
        where, header = next(found)
        for column in [*chain.from_iterable(map(paths_of, table.columns.values())), *table.filters]:
            if column not in header:
                raise DataError(f"{where}: has no column {column!r}, but {', '.join(header)}")
        for row in found:
            if (name := _excluding_filter(table, row[1])) is not None:
                left_out.append(f"filters.{name}")
                skipped = skipped or row
                continue
            messages.append(_message(row, table, role))
            first = first or row
        if first is None and skipped is not None and role not in _NAMES:  # an empty list reports what was left out
            messages.append(_message(skipped, replace(table, columns=times), role))
    except DataError as error:
        return messages, error
    if messages and isinstance(messages[0], DetectionList):
        messages[0] = replace(messages[0], left_out=tuple(left_out))
    stamps_ns = [each.stamp_ns for each in messages]
    if first is not None and (text := wrong_unit(len(stamps_ns), min(stamps_ns), max(stamps_ns), table.time_unit)):
        column = single_path(table.columns["stamp"])
        return [], DataError(f"{first[0]}: {column}: {text}: change `time_unit` (input.csv.{role})")
    return messages, None


def rows(file: Path, delimiter: str | None = None) -> Iterator[Row]:
    """Rows of `file`, the header first; without a delimiter the most frequent of `,`, `;` and tab in the header.

    Raises `DataError` where the file is not a table.
    """
    where = f"{file}:1"
    try:
        with TextIOWrapper(open_file(file), encoding="utf-8-sig", errors="replace", newline="") as text:
            first = text.readline(_LONGEST_HEADER)
            text.seek(0)
            reader = csv.reader(text, delimiter=delimiter or max(",;\t", key=first.count), skipinitialspace=True)
            header = [name.strip() for name in next(reader, [])]
            if len(set(header)) < len(header):
                raise DataError(f"{where}: has a column twice: {', '.join(header)}")
            yield where, dict(zip(header, header, strict=True))
            for cells in reader:
                where = f"{file}:{reader.line_num}"
                if any(cells) and len(cells) != len(header):
                    raise DataError(f"{where}: has {len(cells)} cells, the header has {len(header)}")
                if any(cells):
                    yield where, dict(zip(header, map(str.strip, cells), strict=True))
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror})") from error
    except csv.Error as error:
        raise DataError(f"{file}:{reader.line_num}: is not CSV ({error})") from error


def _excluding_filter(table: CsvTable, cells: Mapping[str, str]) -> str | None:
    """First filter that a row does not pass; a text that is a number is compared as one."""
    for name, each in table.filters.items():
        value: float | str = cells[name]
        with suppress(ValueError):
            value = float(value)
        if not each.passes(value):
            return name
    return None


def _message(row: Row, table: CsvTable, role: str) -> Message:
    """The state in a row, or a list of its detection; empty where nothing is measured."""
    where, cells = row
    try:
        times = {name: _time(cells, table, name) for name in _TIMES if name in table.columns}
        values = mapped(table.columns, _NAMES.get(role, COMPONENTS), lambda column: cells[column] or None)
    except FieldError as error:
        raise DataError(f"{where}: {error}") from error
    receipt_ns = times.get("receipt", times["stamp"])
    stamp_ns = receipt_ns if table.stamp_from == "receipt" else times["stamp"]
    if role in _NAMES:  # a state that is not finite is counted by the tracker
        values |= {name: math.nan for name in _EGO_NEEDS[: 4 if role == "ego" else 2] if values[name] is None}
    if role == "ego":
        return EgoState(stamp_ns, receipt_ns, **{name: value for name, value in values.items() if value is not None})
    if role == "truth":
        return TruthState(stamp_ns, receipt_ns, **values | {"object_id": values.get("object_id") or 0})
    is_measured = any(values.get(name) is not None for name in MEASURABLE)
    objects = (Detection(**values),) if is_measured else ()
    return DetectionList(role.removeprefix("detections."), stamp_ns, receipt_ns, objects, table.frame or "ego")


def _time(cells: Mapping[str, str], table: CsvTable, name: str) -> int:
    """Integer nanoseconds of the decimal text; a float would lose the last hundred of them."""
    column = single_path(table.columns[name])
    text = cells[column][:40]
    try:
        time_ns = round(Decimal(text) * NS_PER_UNIT[table.time_unit]) if abs(Decimal(text)) < 1e25 else None
    except ArithmeticError:  # of `decimal`
        time_ns = None
    if time_ns is None:
        raise FieldError(f"{column}: {text!r} is not a time")
    if not is_stamp(time_ns):
        unit = epoch_unit(float(text)) or "of another unit"
        raise FieldError(f"{column}: {text} {table.time_unit} is beyond the year 2096: set `time_unit: {unit}`")
    return time_ns


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return not (path / "meta.json").exists() and any(file.suffix in _ENDINGS for file in path.iterdir())
    return path.suffix in _ENDINGS and path.name != LOG_NAME  # which is not an input by itself


def _open(path: Path, config: InputConfig) -> Callable[[], Iterator[Message]]:
    sensors = {f"detections.{name}": table for name, table in config.csv.detections.items()}
    named = {"truth": config.csv.truth, "ego": config.csv.ego, **sensors}
    tables = [(_file(path, table, role), table, role) for role, table in named.items() if table is not None]
    if not tables:
        found = "; ".join(f"{file.name} has {', '.join(columns)}" for file, columns in headers(path).items())
        raise CallError(
            f"{path}: is CSV, name its columns in input.csv: {found} (`fgtrack info {path} --write my.yaml` guesses)"
        )
    return partial(read_tables, tables)


def headers(path: Path) -> dict[Path, list[str]]:
    """Columns of the CSV file `path`, or of every one in the folder, by file. Raises `DataError` as `read_tables`."""
    files = sorted(file for file in path.iterdir() if file.suffix in _ENDINGS) if path.is_dir() else [path]
    return {file: list(next(rows(file))[1]) for file in files}


def _file(path: Path, table: CsvTable, role: str) -> Path:
    """File of `table`, whose columns are checked."""
    where, columns = f"input.csv.{role}", table.columns.keys()
    known = {*_TIMES, *_NAMES.get(role, COMPONENTS)}
    needed = {"stamp", *(_EGO_NEEDS if role == "ego" else _EGO_NEEDS[:2] if role == "truth" else ())}
    if columns - known:
        raise CallError(
            f"{where}.columns: unknown column {min(columns - known)!r}, known are {', '.join(sorted(known))}"
        )
    if needed - columns or (role not in _NAMES and columns.isdisjoint(MEASURABLE)):
        measured = "" if role in _NAMES else f" and what is measured, one of {', '.join(MEASURABLE)}"
        raise CallError(f"{where}.columns: must name {', '.join(sorted(needed))}{measured}")
    if table.file is None and path.is_dir():
        raise CallError(f"{path}: is a folder, so {where} must name its file")
    return path if table.file is None else (path if path.is_dir() else path.parent) / table.file


FORMAT = FileFormat("CSV (.csv, .tsv, or a folder of them) with a mapping of its columns", _recognises, _open)

"""CSV tables with configured columns: the ego, detections and truth in one file or in several.

Rows with equal stamp and receipt make one list of detections. A row without a measured
value is an empty scan. An empty cell is a missing value. Columns are converted as in
`fields.mapped`. Rows are sorted by receipt.
"""

import csv
import gzip
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from decimal import Decimal
from functools import partial
from io import TextIOWrapper
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, cast

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import GZIP_MAGIC, open_file
from fgtrack.core.time import wrong_unit
from fgtrack.core.types import (
    MEASURABLE,
    STATE_NAMES,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.inputs.formats.common import exact_ns
from fgtrack.inputs.formats.fields import (
    COMPONENTS,
    RELATIVE_IN_MAP,
    FieldError,
    is_relative_velocity,
    mapped,
    paths_of,
)
from fgtrack.inputs.formats.fusiontracking import LOG_NAME
from fgtrack.inputs.geodetic import GEODETIC, LocalPlane
from fgtrack.inputs.settings import CsvTable, InputConfig
from fgtrack.inputs.source import FileFormat
from fgtrack.inputs.stream import PACKED_TABLES

_ENDINGS = (".csv", ".tsv", *PACKED_TABLES)
_LONGEST_HEADER = 1_000_000
_DATE = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)Z?(\.\d+)?(?:Z|([+-]\d\d:\d\d))?"
)
_TIMES = ("stamp", "receipt")
#: Components of the ego and of truth; other roles are detections.
_NAMES = {
    "ego": (*STATE_NAMES, *GEODETIC),
    "truth": ("object_id", *STATE_NAMES, *GEODETIC),
}
#: Required components of the ego and of truth.
_NEEDS = {"ego": STATE_NAMES[:4], "truth": STATE_NAMES[:2]}
Cells = Mapping[str, str]


def read_tables(
    tables: Sequence[tuple[Path, CsvTable, str]], plane: LocalPlane | None = None
) -> Iterator[Message]:
    """Yield the messages of `tables` in receipt order; a table is given with its file and its role.

    Roles are `ego`, `truth` and `detections.SENSOR`. Raises `DataError` for a row that
    does not match the mapping, after all messages up to the receipt of the row before.
    """
    plane = plane or LocalPlane()
    keyed: list[tuple[tuple[int, int, int], Message]] = []
    breaks: list[tuple[float, DataError]] = []
    for number, table in enumerate(tables):
        messages, error = _read(*table, plane)
        keyed += [((each.receipt_ns, number, each.stamp_ns), each) for each in messages]
        if error is not None:
            breaks.append(
                (max((each.receipt_ns for each in messages), default=-math.inf), error)
            )
    until_ns, broken = min(breaks, key=itemgetter(0), default=(math.inf, None))
    for _, message in sorted(keyed, key=itemgetter(0)):
        if message.receipt_ns <= until_ns:
            yield message
    if broken is not None:
        raise broken


def _read(
    file: Path, table: CsvTable, role: str, plane: LocalPlane
) -> tuple[list[Message], DataError | None]:
    """Return the messages of the rows that pass the filters, and the error that ends the table."""
    messages: list[Message] = []
    scans: dict[tuple[int, int], list[Detection]] = {}
    stamps_ns: list[int] = []
    left_out: list[str] = []
    skipped = None
    error = None
    where = str(file)
    try:
        result = rows(file, table.delimiter)
        where, header = next(result)
        for column in [
            *chain.from_iterable(map(paths_of, table.columns.values())),
            *table.filters,
        ]:
            if column not in header:
                raise DataError(
                    f"{where}: has no column {column!r}; its columns are {', '.join(header)}"
                )
        for where, cells in result:  # noqa: B007 - the error below contains it
            if (name := _excluding_filter(table, cells)) is not None:
                left_out.append(f"filters.{name}")
                skipped = skipped or cells
                continue
            times = _times(cells, table)
            values = _values(cells, table, role, plane)
            stamps_ns.append(times[0])
            if role == "ego":
                messages.append(EgoState(*times, **values))
            elif role == "truth":
                messages.append(TruthState(*times, **{"object_id": 0} | values))
            else:
                is_measured = not values.keys().isdisjoint(MEASURABLE)
                scans.setdefault(times, []).extend(
                    [Detection(**values)] if is_measured else []
                )
        # An empty list reports the rows that were left out.
        if skipped is not None and not scans and role not in _NAMES:
            scans[_times(skipped, table)] = []
    except FieldError as wrong:
        error = DataError(f"{where}: {wrong}")
    except DataError as broken:
        error = broken
    stamps_ns.sort()
    few = len(stamps_ns) // 100  # at both ends: single rows may have wrong times
    if stamps_ns and (
        text := wrong_unit(
            len(stamps_ns), stamps_ns[few], stamps_ns[-1 - few], table.time_unit
        )
    ):
        return [], DataError(f"{file}: {text}: change `time_unit` (input.csv.{role})")
    for (stamp_ns, receipt_ns), objects in scans.items():
        counted = tuple(left_out)
        left_out = []
        sensor = role.removeprefix("detections.")
        frame = table.frame or ("map" if GEODETIC[0] in table.columns else "ego")
        messages.append(
            DetectionList(
                sensor, stamp_ns, receipt_ns, objects, frame, counted, plane.origin_deg
            )
        )
    return messages, error


def rows(file: Path, delimiter: str | None = None) -> Iterator[tuple[str, Cells]]:
    """Yield for each row of `file` its file and line, and its cells by column; the first row is the header.

    Without a `delimiter`, the most frequent of `,`, `;` and tab in the header is used.
    Raises `DataError` if the file is not a table.
    """
    where = f"{file}:1"
    try:
        with (
            open_file(file) as raw,
            TextIOWrapper(
                _unpacked(raw), encoding="utf-8-sig", errors="replace", newline=""
            ) as text,
        ):
            first = text.readline(_LONGEST_HEADER)
            text.seek(0)
            separator = delimiter or max(",;\t", key=first.count)
            lines = iter(text)
            if separator not in first and delimiter is None and " " in first.strip():
                separator = " "
                lines = (" ".join(line.split()) for line in text)
            reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
            header = [name.strip() for name in next(reader, [])]
            named = [name for name in header if name]
            if len(set(named)) < len(named):
                raise DataError(
                    f"{where}: two columns have the same name: {', '.join(header)}"
                )
            yield where, dict(zip(header, header, strict=True))
            for cells in filter(any, reader):
                where = f"{file}:{reader.line_num}"
                if len(cells) != len(header):
                    raise DataError(
                        f"{where}: has {len(cells)} cells, but the header has {len(header)}"
                    )
                yield where, dict(zip(header, map(str.strip, cells), strict=True))
    except (OSError, EOFError, zlib.error, csv.Error) as error:
        raise DataError(f"{where}: cannot be read any further ({error})") from error


def _unpacked(raw: BinaryIO) -> BinaryIO:
    """The file `raw`, decompressed if it is gzipped."""
    is_packed = raw.read(2) == GZIP_MAGIC
    raw.seek(0)
    return cast(BinaryIO, gzip.GzipFile(fileobj=raw)) if is_packed else raw


def _time_ns(text: str, unit: str) -> int:
    """Convert a number in `unit`, or a date and time (ISO 8601, UTC without a zone), to integer nanoseconds."""
    if (date := _DATE.fullmatch(text)) is None:
        return exact_ns(text, unit)
    day, time, fraction, zone = date.groups()
    whole_s = datetime.fromisoformat(f"{day}T{time}{zone or '+00:00'}").timestamp()
    return exact_ns(Decimal(int(whole_s)) + Decimal(fraction or 0))


def _excluding_filter(table: CsvTable, cells: Cells) -> str | None:
    """Return the first filter that excludes the row, or None; a text that is a number is compared as a number."""
    for name, each in table.filters.items():
        value: float | str = cells[name]
        with suppress(ValueError):
            value = float(value)
        if not each.passes(value):
            return name
    return None


def _values(
    cells: Cells, table: CsvTable, role: str, plane: LocalPlane
) -> dict[str, Any]:  # Any: see `mapped`
    """Return the values of a row; a required component that is missing becomes NaN, which the tracker counts."""
    values = plane.in_plane(
        mapped(
            table.columns,
            _NAMES.get(role, COMPONENTS),
            lambda column: cells[column] or None,
        )
    )
    values |= {name: math.nan for name in _NEEDS.get(role, ()) if values[name] is None}
    return {name: value for name, value in values.items() if value is not None}


def _times(cells: Cells, table: CsvTable) -> tuple[int, int]:
    """Return stamp and receipt of a row in integer nanoseconds."""
    times: list[int] = []
    for name in _TIMES:
        columns = paths_of(table.columns.get(name, table.columns["stamp"]))
        if len(columns) > 2:
            raise FieldError(
                f"{columns}: a time is one column, or seconds and nanoseconds"
            )
        units = [table.time_unit] if len(columns) == 1 else ["s", "ns"]
        time_ns = 0
        for column, unit in zip(columns, units, strict=True):
            try:
                time_ns += _time_ns(cells[column], unit)
            except (ArithmeticError, ValueError) as error:
                raise FieldError(
                    f"{column}: {cells[column]!r:.40} is not a time in {unit}: "
                    "correct the cell or `time_unit`"
                ) from error
        times.append(time_ns)
    stamp_ns, receipt_ns = times
    return receipt_ns if table.stamp_from == "receipt" else stamp_ns, receipt_ns


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return not (path / "meta.json").exists() and any(
            file.name.endswith(_ENDINGS) for file in path.iterdir()
        )
    # A FusionTracking log is read as a folder.
    return path.name.endswith(_ENDINGS) and path.name != LOG_NAME


def _open(path: Path, config: InputConfig) -> Callable[[], Iterator[Message]]:
    sensors = {
        f"detections.{name}": table for name, table in config.csv.detections.items()
    }
    named = {"truth": config.csv.truth, "ego": config.csv.ego, **sensors}
    tables = [
        (_file(path, table, role), table, role)
        for role, table in named.items()
        if table is not None
    ]
    if not tables:
        listed = "; ".join(
            f"{file.name} has {', '.join(columns)}"
            for file, columns in headers(path).items()
        )
        raise CallError(
            f"{path}: is CSV, name its columns in input.csv: {listed} "
            f"(`fgtrack info {path} --write my.yaml` guesses them)"
        )
    return partial(read_tables, tables, LocalPlane(config.origin))


def headers(path: Path) -> dict[Path, list[str]]:
    """Return the columns of the CSV file `path`, or of every CSV file in the folder, by file.

    Raises `DataError` as `rows`.
    """
    files = (
        sorted(file for file in path.iterdir() if file.name.endswith(_ENDINGS))
        if path.is_dir()
        else [path]
    )
    return {file: list(next(rows(file))[1]) for file in files}


def _file(path: Path, table: CsvTable, role: str) -> Path:
    """Return the file of `table` after checking the mapped columns."""
    where = f"input.csv.{role}"
    columns = table.columns.keys()
    available = columns | ({"x_m", "y_m"} if columns >= set(GEODETIC) else set())
    known = {*_TIMES, *_NAMES.get(role, COMPONENTS)}
    needed = {"stamp", *_NEEDS.get(role, ())}
    if columns - known:
        raise CallError(
            f"{where}.columns: unknown component {min(columns - known)!r}: there are {', '.join(sorted(known))}"
        )
    if needed - available or (role not in _NAMES and available.isdisjoint(MEASURABLE)):
        measured = (
            ""
            if role in _NAMES
            else f" and a measured component, one of {', '.join(MEASURABLE)}"
        )
        raise CallError(
            f"{where}.columns: must name {', '.join(sorted(needed))}{measured}"
        )
    if is_relative_velocity(table.columns) and (
        table.frame == "map" or GEODETIC[0] in table.columns
    ):
        raise CallError(f"{where}.columns: {RELATIVE_IN_MAP}")
    if table.file is None and path.is_dir():
        raise CallError(f"{path}: is a folder, so {where} must name its file")
    if table.file is None:
        return path
    return (path if path.is_dir() else path.parent) / table.file


FORMAT = FileFormat(
    "CSV (.csv, .tsv, or a folder of these) with configured columns",
    _recognises,
    _open,
)

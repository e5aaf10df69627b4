"""CSV tables with configured columns: the ego, detections and truth in one file or in several.

Rows with equal stamp and receipt make one list of detections. A row without a measured
value is an empty scan. An empty cell is a missing value. Columns are converted as in
`fields.mapped`. Rows are sorted by receipt.
"""

import csv
import gzip
import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from io import StringIO, TextIOWrapper
from itertools import chain, islice
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
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.formats.ego_motion import completed_states, missing_motion
from fgtrack.inputs.formats.fields import (
    COMPONENTS,
    RELATIVE_IN_MAP,
    FieldError,
    is_relative_velocity,
    mapped,
    paths_of,
)
from fgtrack.inputs.formats.fusiontracking import LOG_NAME
from fgtrack.inputs.formats.table_text import encoding_of, is_table, text_form
from fgtrack.inputs.formats.table_times import (
    TIMES,
    Cells,
    Day,
    TableTimes,
    WrongTimeError,
)
from fgtrack.inputs.formats.time_outliers import WRONG_TIME
from fgtrack.inputs.geodetic import GEODETIC, LocalPlane, warn_once
from fgtrack.inputs.settings import CsvTable, Field, InputConfig
from fgtrack.inputs.source import FileFormat
from fgtrack.inputs.stream import PACKED_TABLES

_ENDINGS = (".csv", ".tsv", *PACKED_TABLES)
#: Other endings of file names. A file with such an ending is a table if its content is a table.
_TEXT_ENDINGS = (".txt", ".dat", ".asc", ".tum")
#: Largest number of files with such an ending in a folder of tables.
_MOST_TEXTS = 50
#: Rows from which the form of dates is inferred.
_SAMPLES = 1000
#: Bytes from which the form of the text is inferred.
_SAMPLE_BYTES = 1 << 18
#: Components of the ego and of truth; other roles are detections.
_NAMES = {
    "ego": (*STATE_NAMES, *GEODETIC),
    "truth": ("object_id", *STATE_NAMES, *GEODETIC),
}
_UNKNOWN_MOTION = {"yaw_rad": math.nan, "speed_mps": math.nan}
#: Required components of the ego and of truth.
_NEEDS = {"ego": STATE_NAMES[:2], "truth": STATE_NAMES[:2]}


def read_tables(
    tables: Sequence[tuple[Path, CsvTable, str]], plane: LocalPlane | None = None
) -> Iterator[Message]:
    """Yield the messages of `tables` in receipt order; a table is given with its file and its role.

    Roles are `ego`, `truth` and `detections.SENSOR`. Raises `DataError` for a row that
    does not match the mapping, after all messages up to the receipt of the row before.
    """
    plane = plane or LocalPlane()
    day = Day()
    keyed: list[tuple[tuple[int, int, int], Message]] = []
    breaks: list[tuple[float, DataError]] = []
    for number, table in enumerate(tables):
        messages, error = _read(*table, plane, day)
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
    file: Path,
    table: CsvTable,
    role: str,
    plane: LocalPlane,
    day: Day,
    accepts_wrong_times: bool = True,
) -> tuple[list[Message], DataError | None]:
    """Return the messages of the rows that pass the filters, and the error that ends the table.

    Rows with wrong times are left out, unless they are more than a tenth of the rows.
    """
    error = None
    where = str(file)
    made = _Messages(table, role, plane)
    try:
        result = rows(file, table.delimiter)
        where, header = next(result)
        _check_columns(table, header, where)
        readable = UntilBreak(result)
        rest = iter(readable)
        head = list(islice(rest, _SAMPLES))
        times = TableTimes(table, [cells for _, cells in head], day)
        for where, cells in chain(head, rest):  # noqa: B007 - the errors below contain it
            try:
                made.add(cells, times)
            except WrongTimeError:
                if not accepts_wrong_times:
                    raise
                made.left_out.append(WRONG_TIME)
        made.report_left_out(times)
        readable.raise_error()
    except FieldError as wrong:
        error = DataError(f"{where}: {wrong}")
    except DataError as broken:
        error = broken
    num_wrong = made.left_out.count(WRONG_TIME)
    if num_wrong > made.num_rows // 10:
        return _read(file, table, role, plane, day, accepts_wrong_times=False)
    if num_wrong and role in _NAMES:
        warn_once(f"{file}: left out {num_wrong} rows with wrong times")
    made.stamps_ns.sort()
    few = made.num_rows // 100  # at both ends: single rows may have wrong times
    if made.stamps_ns and (
        text := wrong_unit(
            made.num_rows,
            made.stamps_ns[few],
            made.stamps_ns[-1 - few],
            table.time_unit,
        )
    ):
        return [], DataError(f"{file}: {text}: change `time_unit` (input.csv.{role})")
    return made.messages(), error


def _check_columns(table: CsvTable, header: Cells, where: str) -> None:
    """Raise `DataError` if `header` lacks a column of `table`."""
    mapped_columns = chain.from_iterable(map(paths_of, table.columns.values()))
    conditions = [
        column
        for path in table.columns.values()
        if isinstance(path, Field)
        for column in path.least
    ]
    for column in [*mapped_columns, *conditions, *table.filters]:
        if column not in header:
            raise DataError(
                f"{where}: has no column {column!r}; its columns are {', '.join(header)}"
            )


class _Messages:
    """Messages of a table, made row by row."""

    def __init__(self, table: CsvTable, role: str, plane: LocalPlane) -> None:
        self._table = table
        self._role = role
        self._plane = plane
        self._states: list[Message] = []
        self._scans: dict[tuple[int, int], list[Detection]] = {}
        self._excluded: Cells | None = None
        self.stamps_ns: list[int] = []
        """Stamps of the rows that were read."""
        self.left_out: list[str] = []
        """Reasons of the rows that were left out."""

    @property
    def num_rows(self) -> int:
        """Number of rows that were read."""
        return len(self.stamps_ns)

    def add(self, cells: Cells, times: TableTimes) -> None:
        """Add a row; raises `FieldError` for a row that does not match the mapping."""
        if (name := _excluding_filter(self._table, cells)) is not None:
            self.left_out.append(f"filters.{name}")
            self._excluded = self._excluded or cells
            return
        at = times(cells)
        values = _values(cells, self._table, self._role, self._plane)
        self.stamps_ns.append(at[0])
        if self._role == "ego":
            self._states.append(EgoState(*at, **_UNKNOWN_MOTION | values))
        elif self._role == "truth":
            self._states.append(TruthState(*at, **{"object_id": 0} | values))
        else:
            is_measured = not values.keys().isdisjoint(MEASURABLE)
            self._scans.setdefault(at, []).extend(
                [Detection(**values)] if is_measured else []
            )

    def report_left_out(self, times: TableTimes) -> None:
        """Add an empty list if all rows were excluded; the list reports them."""
        if self._excluded is None or self._scans or self._role in _NAMES:
            return
        self._scans[times(self._excluded)] = []

    def messages(self) -> list[Message]:
        """Return the messages; the first list of detections counts the rows that were left out."""
        columns = self._table.columns
        if self._role == "ego":
            egos = [each for each in self._states if isinstance(each, EgoState)]
            return list(completed_states(egos, missing_motion(columns)))
        sensor = self._role.removeprefix("detections.")
        frame = self._table.frame or ("map" if GEODETIC[0] in columns else "ego")
        counted = tuple(self.left_out)
        lists = []
        for (stamp_ns, receipt_ns), objects in self._scans.items():
            at = sensor, stamp_ns, receipt_ns
            origin_deg = self._plane.origin_deg
            lists.append(DetectionList(*at, objects, frame, counted, origin_deg))
            counted = ()
        return [*self._states, *lists]


def rows(file: Path, delimiter: str | None = None) -> Iterator[tuple[str, Cells]]:
    """Yield file and line of each row, as `file:line`, and its cells by column. The first row is the header.

    Encoding, separator and decimal comma are inferred (`table_text`). Raises
    `DataError` if the file is not a table.
    """
    where = f"{file}:1"
    try:
        with open_file(file) as packed:
            raw = _unpacked(packed)
            sample = raw.read(_SAMPLE_BYTES)
            raw.seek(0)
            text = TextIOWrapper(raw, encoding_of(sample), "replace", newline="")
            lines = list(StringIO(sample.decode(text.encoding, "replace"), newline=""))
            form = text_form(lines, delimiter, where)
            where = f"{file}:{max(form.num_head_lines, 1)}"
            header = form.header
            named = [name for name in header if name]
            if len(set(named)) < len(named):
                raise DataError(
                    f"{where}: two columns have the same name: {', '.join(header)}"
                )
            yield where, dict(zip(header, header, strict=True))
            for number, cells in form.cells(text):
                where = f"{file}:{number}"
                if len(cells) != len(header):
                    raise DataError(
                        f"{where}: has {len(cells)} cells, but the header has {len(header)}"
                    )
                yield where, dict(zip(header, cells, strict=True))
    except (OSError, EOFError, zlib.error, csv.Error) as error:
        raise DataError(f"{where}: cannot be read any further ({error})") from error


def _unpacked(raw: BinaryIO) -> BinaryIO:
    """Return the file `raw`, or a file with its decompressed content if `raw` is gzipped."""
    is_packed = raw.read(2) == GZIP_MAGIC
    raw.seek(0)
    return cast(BinaryIO, gzip.GzipFile(fileobj=raw)) if is_packed else raw


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


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return not (path / "meta.json").exists() and bool(_files(path))
    # A FusionTracking log is read as a folder.
    return bool(_files(path)) and path.name != LOG_NAME


def _files(path: Path) -> list[Path]:
    """Return the tables at `path`: the file itself, or the files in the folder with a suitable name or content."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    usual = [file for file in files if file.name.endswith(_ENDINGS)]
    others = [file for file in files if file.suffix in _TEXT_ENDINGS and file.is_file()]
    if len(others) > _MOST_TEXTS:
        return usual
    return sorted(usual + [file for file in others if is_table(_first_lines(file))])


def _first_lines(file: Path) -> list[str]:
    with open_file(file) as raw:
        sample = raw.read(_SAMPLE_BYTES)
    text = sample.decode(encoding_of(sample), "replace")
    lines = list(StringIO(text, newline=""))
    return [] if "\0" in text else lines[: -1 if len(sample) == _SAMPLE_BYTES else None]


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
    return {file: list(next(rows(file))[1]) for file in _files(path)}


def _file(path: Path, table: CsvTable, role: str) -> Path:
    """Return the file of `table` after checking the mapped columns.

    Raises `CallError` if the columns do not suit the role.
    """
    where = f"input.csv.{role}"
    columns = table.columns.keys()
    available = columns | ({"x_m", "y_m"} if columns >= set(GEODETIC) else set())
    known = {*TIMES, *_NAMES.get(role, COMPONENTS)}
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

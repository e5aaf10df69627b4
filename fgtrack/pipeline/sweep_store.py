"""What a sweep leaves in its folder: a part for each finished job, and tables made from the parts."""

import csv
import io
import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from pydantic import ConfigDict, TypeAdapter

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import read_head, read_whole
from fgtrack.io.output import check_output, write_file
from fgtrack.pipeline.sweep_plan import KEY_COLUMNS, Plan, Value, compact

PART_FORMAT = "fgtrack-sweep-part/1"
_PART_START = json.dumps({"format": PART_FORMAT})[:-1].encode()
SWEEP_TABLE, TIMING_TABLE, ERROR_TABLE = "sweep.csv", "timing.csv", "errors.csv"
PAIRED_TABLE, SUMMARY_TABLE = "paired.csv", "summary.csv"
_PARTS = "parts"
_TABLES = (SWEEP_TABLE, TIMING_TABLE, ERROR_TABLE, PAIRED_TABLE, SUMMARY_TABLE)
#: All that a sweep writes into its folder.
PRODUCTS = (*_TABLES, _PARTS)
_LONGEST_HEAD = 100_000
_LARGEST_PART_MB = 64.0
_LONGEST_NAME = 1000  # of a column, or a text in it
_INT64_LIMIT = 1 << 63
_RESERVED = (*KEY_COLUMNS, "error")

_logger = logging.getLogger(__name__)

Scalar = str | bool | int | float | None


@dataclass(frozen=True)
class Cell:
    """One estimator on the stream of one job."""

    estimator: str
    values: Mapping[str, Scalar]
    """Metrics by column: the same wherever and whenever the cell is computed."""
    times: Mapping[str, Scalar]
    """Wall times by column."""
    error: str | None = None
    """Why there is no result, in a line."""


@dataclass(frozen=True)
class SweepResult:
    """What the tables of a sweep hold."""

    num_cells: int
    """Cells of the plan: finished, bad and left ones."""
    num_good: int
    num_bad: int
    first_error: str | None
    unknown_metrics: tuple[str, ...]
    """The plan's metrics that stand for no column."""


_CELLS = TypeAdapter(tuple[Cell, ...], config=ConfigDict(strict=True, extra="forbid"))


class PartStore:
    """The parts of a sweep, each in a file named by the key of its job and written whole or not at all.

    Raises `CallError` where `folder` cannot be made one, or has a table, or a link, that no sweep wrote; without
    `overwrite` also for the tables of a sweep that has lost its parts. Of a sweep that could not keep a single part,
    the place for them is there, and `sweep.csv` has no row.
    """

    def __init__(self, folder: Path, overwrite: bool = False) -> None:
        self._folder = folder / _PARTS
        has_parts = any(map(_is_part, self._folder.glob("*.json")))
        goes_on = has_parts or (_is_empty(self._folder) and not _has_rows(folder / SWEEP_TABLE))
        for name in _TABLES:
            check_output(folder / name, overwrite or goes_on)
        try:
            if self._folder.is_symlink():
                raise CallError(f"{self._folder}: is a link, choose another folder")
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CallError(f"{folder}: cannot be made a folder ({error.strerror}), choose another one") from error

    def keys(self) -> frozenset[str]:
        """Keys of all parts, also those of other sweeps."""
        return frozenset(path.stem for path in self._folder.glob("*.json"))

    def read(self, key: str) -> tuple[Cell, ...] | None:
        """The cells of a job; None where it has no part, or one with what no sweep writes, which a warning names.

        Raises `DataError` for a file that is no part.
        """
        path = self._folder / f"{key}.json"
        if not path.exists():
            return None
        try:
            content = json.loads(read_whole(path, _LARGEST_PART_MB))
            if content["format"] != PART_FORMAT:
                raise DataError(f"{path}: does not say format {PART_FORMAT!r}, delete it")
            cells = _CELLS.validate_json(json.dumps(content["cells"]))
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise DataError(f"{path}: is no part of a sweep, delete it") from error
        fault = next((fault for cell in cells for fault in _faults(cell)), None)
        if fault is not None:
            _logger.warning("%s: %s, which no sweep writes: its job is done again", path, fault)
            return None
        return cells

    def write(self, key: str, cells: Sequence[Cell]) -> None:
        """Keep the cells of a finished job."""
        content = {"format": PART_FORMAT, "cells": [asdict(cell) for cell in cells]}
        write_file(self._folder / f"{key}.json", json.dumps(content))


def _faults(cell: Cell) -> Iterator[str]:
    """What is in a cell that no sweep writes."""
    if bool(cell.values) == (cell.error is not None):
        yield "a cell needs either values or an error"
    for name, value in (*cell.values.items(), *cell.times.items()):
        if not _is_name(name) or name in _RESERVED:
            yield f"a column named {name[:_LONGEST_NAME]!a}"
        elif isinstance(value, str) and not _is_name(value):
            yield f"{name} is {value[:_LONGEST_NAME]!a}"
        elif isinstance(value, float) and math.isinf(value):
            yield f"{name} is {value}"
        elif isinstance(value, int) and abs(value) >= _INT64_LIMIT:
            yield f"{name} has more than 64 bits"


def _is_name(text: str) -> bool:
    return 0 < len(text) <= _LONGEST_NAME and text.isprintable()


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())


def _has_rows(table: Path) -> bool:
    return bool(read_head(table, _LONGEST_HEAD).partition(b"\n")[2])


def _is_part(path: Path) -> bool:
    return read_head(path, len(_PART_START)) == _PART_START


def write_tables(folder: Path, plan: Plan, done: Mapping[str, Sequence[Cell]]) -> SweepResult:
    """Write sweep.csv, timing.csv and errors.csv from the cells of the finished jobs, by key, in grid order."""
    rows = list(_rows(plan, done))
    good = [(keys, cell) for keys, cell in rows if cell.error is None]
    bad = [(keys, {"error": cell.error}) for keys, cell in rows if cell.error is not None]
    names = (*plan.columns, *KEY_COLUMNS)
    columns = _columns([cell.values for _, cell in good])
    chosen, unknown = _chosen(columns, plan.metrics)
    _write_csv(folder / SWEEP_TABLE, names, chosen, [(keys, cell.values) for keys, cell in good])
    times = _columns([cell.times for _, cell in good])
    _write_csv(folder / TIMING_TABLE, names, times, [(keys, cell.times) for keys, cell in good])
    _write_csv(folder / ERROR_TABLE, names, ["error"], bad)
    return SweepResult(
        num_cells=len(plan.jobs) * len(plan.estimators),
        num_good=len(good),
        num_bad=len(bad),
        first_error=bad[0][1]["error"] if bad else None,
        unknown_metrics=tuple(unknown) if good else (),
    )


def _rows(plan: Plan, done: Mapping[str, Sequence[Cell]]) -> Iterator[tuple[tuple[Value, ...], Cell]]:
    for job in plan.jobs:
        problems = [Cell(name, {}, {}, job.problem) for name in plan.estimators]
        for cell in problems if job.problem is not None else done.get(job.key, ()):
            yield (*job.cells, job.seed, cell.estimator), cell


def _columns(rows: Sequence[Mapping[str, Scalar]]) -> list[str]:
    """Every column that occurs, in the order in which the rows bring them."""
    return list(dict.fromkeys(name for row in rows for name in row))


def _chosen(columns: Sequence[str], patterns: Sequence[str]) -> tuple[list[str], list[str]]:
    """The columns that `patterns` stand for, in their order, and the patterns that stand for none."""
    found = {pattern: [name for name in columns if fnmatchcase(name, pattern)] for pattern in patterns or ("*",)}
    chosen = list(dict.fromkeys(name for names in found.values() for name in names))
    return chosen, [pattern for pattern, names in found.items() if not names]


def _write_csv(
    path: Path,
    names: Sequence[str],
    columns: Sequence[str],
    rows: Sequence[tuple[Sequence[Value], Mapping[str, Scalar]]],
) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*names, *columns])
    for keys, values in rows:
        writer.writerow([_cell(value) for value in (*keys, *(values.get(name) for name in columns))])
    write_file(path, text.getvalue())


def _cell(value: Value) -> str:
    """Text of a cell: floats with all digits, lists and mappings as JSON."""
    if value is None or isinstance(value, str):
        return value or ""
    return repr(value) if isinstance(value, float) else compact(value)

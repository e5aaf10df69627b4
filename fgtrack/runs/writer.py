"""Writes a run folder while the run proceeds."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Literal, Protocol, Self, get_args

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import read_whole
from fgtrack.core.output import check_output, locked_folder, write_error, write_file
from fgtrack.core.types import TruthState
from fgtrack.runs.columns import Columns
from fgtrack.runs.csv_table import CsvTable, csv_blocks
from fgtrack.runs.recorded_truth import TruthHash
from fgtrack.runs.rows import Row
from fgtrack.runs.schema import COLUMNS, OPTIONAL_TABLES, RUN_FORMAT
from fgtrack.runs.sink import RunSink

NO_PYARROW = (
    "pyarrow is not installed, and Parquet tables need it: `pip install pyarrow`"
)
LARGEST_META_MB = 16.0
"""Largest meta.json or config.yaml that is read; both normally have some kB."""
_META = "meta.json"
#: Folder of a new run inside the folder of an older run.
_STAGE = "new.part"
TableFormat = Literal["csv", "parquet"]
"""Format of the tables of a run folder, and suffix of their files."""
TruthStorage = Literal["copy", "recording"]
"""Storage of the truth of a run: a copy in the run folder, or only in the recording."""
_FILES = (
    *(f"{table}.{suffix}" for table in COLUMNS for suffix in get_args(TableFormat)),
    *("metrics.json", "config.yaml", _META),
)


class TableWriter(Protocol):
    """Writer of the file of one table."""

    def append(self, rows: Sequence[Row]) -> None:
        """Append `rows`."""

    def append_columns(self, columns: Columns) -> None:
        """Append the rows of `columns`."""

    def close(self) -> None:
        """Complete the file."""


class RunWriter(RunSink):
    """Context manager that writes the run folder `path`, and keeps the folder locked until it is closed.

    The rows of a tick are in the CSV files within 0.2 s; a Parquet file is complete
    after `finish`. A killed run leaves readable CSV files, and a `meta.json` with
    `"complete": false`. An older run stays until `finish`: the new run is written into
    the subfolder `new.part`. Other files in the folder stay.

    With the truth in the `recording`, the folder has no table `truth`: meta.json has the
    number and the hash of its rows, and `load_run` reads them from the recording.

    Raises `CallError` for the format `parquet` without the package pyarrow.
    """

    def __init__(
        self,
        path: Path | str,
        config_text: str = "",
        meta: Mapping[str, object] | None = None,
        smoothed_lag_s: float | None = None,
        overwrite: bool = False,
        table_format: TableFormat = "csv",
        truth: TruthStorage = "copy",
    ) -> None:
        super().__init__(config_text, meta, smoothed_lag_s)
        self._writer_of = table_writer(table_format)
        self._suffix = table_format
        self._truth_hash = TruthHash() if truth == "recording" else None
        if table_format != "csv":
            self._meta["tables"] = table_format
        self.path = Path(path)
        self._folder: Path | None = None  # folder of the files, after the first tick
        self._files: dict[str, TableWriter] = {}
        with ExitStack() as stack:
            stack.enter_context(locked_folder(self.path))
            check_run(self.path, overwrite)
            self._open_tables = stack.enter_context(ExitStack())
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
        # An interrupt leaves the incomplete run, like a kill.
        if isinstance(error, Exception):
            shutil.rmtree(self.path / _STAGE, ignore_errors=True)

    def close(self) -> None:
        """Close the tables and unlock the folder; without a `finish` before, the run stays incomplete."""
        with suppress(OSError):  # a full disk was reported at the write
            self._open.close()

    def write_truth(self, truth: TruthState) -> None:
        """Add a row to the table `truth` or `ignored`, or count it where the truth stays in the recording."""
        if self._truth_hash is None or truth.ignored:
            super().write_truth(truth)
        else:
            self._truth_hash.add(truth)

    def finish(self, meta: Mapping[str, object]) -> dict[str, object]:
        """Complete the run as `RunSink.finish`, and replace an older run."""
        folder = self._begin()
        if self._truth_hash is not None and self._truth_hash.num_rows:
            meta = {**meta, "truth": self._truth_hash.as_meta()}
        finished = super().finish(meta)
        self._write_meta(folder)
        if folder != self.path:
            try:
                self._replace(folder)
            except OSError as error:
                raise write_error(self.path, error) from error
        return finished

    def _replace(self, folder: Path) -> None:
        # Without meta.json, which is moved last, the folder is no run.
        (self.path / _META).unlink(missing_ok=True)
        for name in _FILES:
            if (folder / name).exists():
                os.replace(folder / name, self.path / name)
            else:
                (self.path / name).unlink(missing_ok=True)
        folder.rmdir()

    def _append(self, table: str, rows: Sequence[Row]) -> None:
        with self._written(table) as file:
            file.append(rows)

    def write_columns(self, table: str, columns: Columns) -> None:
        """Append the rows of `columns` to the file of `table`."""
        with self._written(table) as file:
            file.append_columns(columns)

    @contextmanager
    def _written(self, table: str) -> Iterator[TableWriter]:
        """Return the writer of `table`; an `OSError` becomes the error of an output."""
        path = self._begin() / f"{table}.{self._suffix}"
        try:
            if table not in self._files:
                self._files[table] = self._writer_of(path, table, self.is_scored)
                self._open_tables.callback(self._files[table].close)
            yield self._files[table]
        except OSError as error:
            raise write_error(path, error) from error

    def _begin(self) -> Path:
        """Return the folder of the files, which are created at the first call, with the first tick.

        A run that fails before the first tick leaves nothing.
        """
        if self._folder is None:
            folder = self.path / _STAGE if any(self.path.iterdir()) else self.path
            if folder != self.path:
                shutil.rmtree(folder, ignore_errors=True)  # left by a killed command
                try:
                    folder.mkdir()
                except OSError as error:
                    raise write_error(self.path, error) from error
            self._folder = folder
            # meta.json is the first file, so a folder with a table is recognised as a run.
            self._write_meta(folder)
            write_file(folder / "config.yaml", self._config_text)
            for table in COLUMNS.keys() - OPTIONAL_TABLES:
                self._append(table, ())
        return self._folder

    def _write_meta(self, folder: Path) -> None:
        write_file(folder / _META, json.dumps(self._meta, indent=2) + "\n")

    def _digest(self) -> str:
        folder = self._folder or self.path
        try:
            self._open_tables.close()
        except OSError as error:
            raise write_error(folder, error) from error
        return digest(folder)


def check_run(path: Path, overwrite: bool) -> None:
    """Raise `CallError` if `RunWriter` may not write to `path`."""
    check_output(path, overwrite, is_run_folder, "a run folder")


def path_from_run(origin: str, folder: Path) -> str | None:
    """Return the path `origin` relative to the run folder `folder`; None if `origin` does not exist."""
    if not origin or not Path(origin).exists():
        return None
    return os.path.relpath(os.path.realpath(origin), os.path.realpath(folder))


def write_metrics(path: Path, metrics: Mapping[str, object]) -> None:
    """Write `metrics` as metrics.json into the run folder `path`, completely or not at all."""
    write_file(
        path / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    )


def digest(path: Path) -> str:
    """SHA-256 of tracks.csv followed by updates.csv in the run folder `path`, in hex.

    Parquet files have the digest of the CSV files with the same rows.
    """
    sha = hashlib.sha256()
    for table in ("tracks", "updates"):
        for block in _blocks(path, table):
            sha.update(block)
    return sha.hexdigest()


def _blocks(path: Path, table: str) -> Iterator[bytes]:
    """Return the bytes of the CSV file of `table`."""
    if (path / f"{table}.csv").exists():
        return csv_blocks(path / f"{table}.csv")
    from fgtrack.runs.parquet_table import parquet_blocks

    return parquet_blocks(path / f"{table}.parquet", table)


def table_writer(
    table_format: TableFormat,
) -> Callable[[Path, str, bool], TableWriter]:
    """Return the writer of `table_format`; raises `CallError` for an unknown format, or if its package is missing."""
    if table_format == "csv":
        return CsvTable
    if table_format not in get_args(TableFormat):
        raise CallError(
            f"{table_format!r}: is not a format of tables, give csv or parquet"
        )
    try:
        from fgtrack.runs.parquet_table import ParquetTable
    except ModuleNotFoundError as error:
        raise CallError(NO_PYARROW) from error
    return ParquetTable


def is_run_folder(path: Path) -> bool:
    """True if `path` contains a run, or an incomplete replacement: a `meta.json` with the format."""
    for file in (path / _META, path / _STAGE / _META):
        with suppress(DataError, LookupError, TypeError, ValueError, RecursionError):
            if json.loads(read_whole(file, LARGEST_META_MB))["format"] == RUN_FORMAT:
                return True
    return False

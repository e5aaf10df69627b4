"""Writes a run folder while the run proceeds."""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from io import BufferedWriter
from pathlib import Path
from types import TracebackType
from typing import Self

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file, read_whole
from fgtrack.core.output import check_output, locked_folder, write_error, write_file
from fgtrack.runs.rows import Row, text, text_header
from fgtrack.runs.schema import COLUMNS, OPTIONAL_TABLES, RUN_FORMAT
from fgtrack.runs.sink import RunSink

LARGEST_META_MB = 16.0
"""Largest meta.json or config.yaml that is read; both normally have some kB."""
_META = "meta.json"
#: Folder of a new run inside the folder of an older run.
_STAGE = "new.part"
_FILES = (*(f"{table}.csv" for table in COLUMNS), "metrics.json", "config.yaml", _META)


class RunWriter(RunSink):
    """Context manager that writes the run folder `path`, and keeps the folder locked until it is closed.

    The rows of a tick are in the files within 0.2 s. A killed run leaves readable
    files, and a `meta.json` with `"complete": false`. An older run stays until
    `finish`: the new run is written into the subfolder `new.part`. Other files in the
    folder stay.
    """

    def __init__(
        self,
        path: Path | str,
        config_text: str = "",
        meta: Mapping[str, object] | None = None,
        smoothed_lag_s: float | None = None,
        overwrite: bool = False,
    ) -> None:
        super().__init__(config_text, meta, smoothed_lag_s)
        self.path = Path(path)
        self._folder: Path | None = None  # folder of the files, after the first tick
        self._files: dict[str, BufferedWriter] = {}
        with ExitStack() as stack:
            stack.enter_context(locked_folder(self.path))
            check_run(self.path, overwrite)
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

    def finish(self, meta: Mapping[str, object]) -> dict[str, object]:
        """Complete the run as `RunSink.finish`, and replace an older run."""
        folder = self._begin()
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
        self.write_rows(table, text(table, rows))

    def write_rows(self, table: str, lines: str) -> None:
        """Append `lines` to the CSV file of `table`."""
        folder = self._begin()
        try:
            if table not in self._files:
                self._files[table] = self._open.enter_context(
                    (folder / f"{table}.csv").open("wb")
                )
                self._files[table].write(text_header(table, self.is_scored))
            self._files[table].write(lines.encode())
            self._files[table].flush()
        except OSError as error:
            raise write_error(folder / f"{table}.csv", error) from error

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
                self.write_rows(table, "")
        return self._folder

    def _write_meta(self, folder: Path) -> None:
        write_file(folder / _META, json.dumps(self._meta, indent=2) + "\n")

    def _digest(self) -> str:
        return digest(self._folder or self.path)


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
    """SHA-256 of the bytes of tracks.csv followed by updates.csv in the run folder `path`, in hex."""
    sha = hashlib.sha256()
    for name in ("tracks.csv", "updates.csv"):
        with open_file(path / name) as file:
            while block := file.read(1 << 20):
                sha.update(block)
    return sha.hexdigest()


def is_run_folder(path: Path) -> bool:
    """True if `path` contains a run, or an incomplete replacement: a `meta.json` with the format."""
    for file in (path / _META, path / _STAGE / _META):
        with suppress(DataError, LookupError, TypeError, ValueError, RecursionError):
            if json.loads(read_whole(file, LARGEST_META_MB))["format"] == RUN_FORMAT:
                return True
    return False

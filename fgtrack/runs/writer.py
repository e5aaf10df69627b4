"""Writes a run folder as the run goes."""

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
"""Largest meta.json and config.yaml, which have some kB."""
_META, _STAGE = "meta.json", "new.part"
_FILES = (*(f"{table}.csv" for table in COLUMNS), "metrics.json", "config.yaml", _META)


class RunWriter(RunSink):
    """Writes the run folder `path`, which is locked until the writer is closed; a context manager.
    Every tick reaches the files within 0.2 s: a killed run leaves readable files and a `meta.json` with
    `"complete": false`. An older run stays until `finish`: the new one grows in `new.part` beside it. Other files stay.
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
        self._folder: Path | None = None  # where the files are, once there are any
        self._files: dict[str, BufferedWriter] = {}
        with ExitStack() as claim:
            claim.enter_context(locked_folder(self.path))
            check_run(self.path, overwrite)
            self._open = claim.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
        if isinstance(
            error, Exception
        ):  # an interrupt leaves the beginning, as a kill does
            shutil.rmtree(self.path / _STAGE, ignore_errors=True)

    def close(self) -> None:
        """Close the tables and unlock the folder; without `finish` before, the run stays marked as incomplete."""
        with suppress(OSError):  # of a full disk, reported when it was written
            self._open.close()

    def finish(self, meta: Mapping[str, object]) -> dict[str, object]:
        """Complete the run, see `RunSink`, and replace an older one."""
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
        (self.path / _META).unlink(
            missing_ok=True
        )  # until both are renamed there is no run
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
        """Make the files, with the first tick: a run that fails before leaves nothing."""
        if self._folder is None:
            folder = self.path / _STAGE if any(self.path.iterdir()) else self.path
            if folder != self.path:
                shutil.rmtree(folder, ignore_errors=True)  # of a killed command
                try:
                    folder.mkdir()
                except OSError as error:
                    raise write_error(self.path, error) from error
            self._folder = folder
            self._write_meta(
                folder
            )  # the first, so that a folder with a table is known as a run
            write_file(folder / "config.yaml", self._config_text)
            for table in COLUMNS.keys() - OPTIONAL_TABLES:
                self.write_rows(table, "")
        return self._folder

    def _write_meta(self, folder: Path) -> None:
        write_file(folder / _META, json.dumps(self._meta, indent=2) + "\n")

    def _digest(self) -> str:
        return digest(self._folder or self.path)


def check_run(path: Path, overwrite: bool) -> None:
    """Raise `CallError` where `RunWriter` would for what is at `path`."""
    check_output(path, overwrite, is_run_folder, "a run folder")


def path_from_run(origin: str, folder: Path) -> str | None:
    """The path `origin` relative to the run folder `folder`; None if nothing is there."""
    if not origin or not Path(origin).exists():
        return None
    return os.path.relpath(os.path.realpath(origin), os.path.realpath(folder))


def write_metrics(path: Path, metrics: Mapping[str, object]) -> None:
    """Write `metrics` as metrics.json into the run folder `path`, whole or not at all."""
    write_file(
        path / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    )


def digest(path: Path) -> str:
    """SHA-256 of the bytes of tracks.csv and then updates.csv of the run folder `path`, in hex."""
    sha = hashlib.sha256()
    for name in ("tracks.csv", "updates.csv"):
        with open_file(path / name) as file:
            while block := file.read(1 << 20):
                sha.update(block)
    return sha.hexdigest()


def is_run_folder(path: Path) -> bool:
    """True if `path` holds a run, or one that was to replace it: a `meta.json` that names the format."""
    for file in (path / _META, path / _STAGE / _META):
        with suppress(DataError, LookupError, TypeError, ValueError, RecursionError):
            if json.loads(read_whole(file, LARGEST_META_MB))["format"] == RUN_FORMAT:
                return True
    return False

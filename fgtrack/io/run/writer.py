"""Writes a run folder as the run goes."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Self

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import open_file, read_head, read_whole
from fgtrack.io.exchange import EXCHANGED, exchanged
from fgtrack.io.output import Kind, check_output, claimed, part_of, write_error, write_file
from fgtrack.io.run.rows import Row, text, text_header
from fgtrack.io.run.schema import COLUMNS, LARGEST_META_MB, OPTIONAL_TABLES, RUN_FORMAT
from fgtrack.io.run.sink import RunSink

_FILES = (*(f"{table}.csv" for table in COLUMNS), "metrics.json", "config.yaml", "meta.json")
#: Tables that every run has and no recording, whose files may have the names of other tables.
_TELLING = ("tracks", "updates", "timing")


class RunWriter(RunSink):
    """Writes a run folder as the run goes; a context manager.

    The folder is locked until the writer is closed. Its files appear with the first tick, so a run that fails before
    leaves what was there. From then on every tick reaches the files before `write_tick` returns: a killed run leaves
    readable files and a `meta.json` with `"complete": false`.

    Parameters
    ----------
    path
        Folder of the run; made if need be.
    config_text, meta, smoothed_lag_s
        As of `RunSink`.
    overwrite
        Replace a run at `path`; other files beside it stay.

    Raises
    ------
    CallError
        Something is at `path`, or another writer holds it.
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
        self._overwrite = overwrite
        self._begun = False
        self._truth: dict[str, list[Row]] = {"truth": [], "ignored": []}  # what came before the first tick
        self._files: dict[str, FileIO] = {}
        with ExitStack() as claim:
            claim.enter_context(claimed(self.path))
            check_output(self.path, RUN, overwrite)
            self._claim = claim.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the tables and unlock the folder; without `finish` before, the run stays marked as incomplete."""
        while self._files:
            self._files.popitem()[1].close()
        self._claim.close()

    def finish(self, meta: Mapping[str, object]) -> dict[str, object]:
        """See `RunSink`; rewrites `meta.json`."""
        self._begin()
        finished = super().finish(meta)
        self._write_meta(self.path)
        return finished

    def _append(self, table: str, found: Sequence[Row]) -> None:
        if table in self._truth and not self._begun:
            self._truth[table] += found
            return
        self._begin()
        self._write(table, text(table, found))

    def _begin(self) -> None:
        """Make the files; an older run stays until all of them are there."""
        if self._begun:
            return
        self._begun = True
        with exchanged(self.path, _FILES, self._overwrite) as folder:
            write_file(folder / "config.yaml", self._config_text)
            for table in COLUMNS:
                if table not in OPTIONAL_TABLES:
                    self._write(table, "", folder)
            for table, found in self._truth.items():
                if found:
                    self._write(table, text(table, found), folder)
            self._write_meta(folder)

    def _write(self, table: str, lines: str, folder: Path | None = None) -> None:
        file, name = self._files.get(table), f"{table}.csv"
        try:
            if file is None:
                file = self._files[table] = FileIO((folder or self.path) / name, "x")
                _write_all(file, text_header(table))
            _write_all(file, lines.encode())
        except OSError as error:
            raise write_error(self.path / name, error) from error

    def _write_meta(self, folder: Path) -> None:
        write_file(folder / "meta.json", json.dumps(self._meta, indent=2) + "\n")

    def _digest(self) -> str:
        return digest(self.path)


def write_metrics(path: Path, metrics: Mapping[str, object]) -> None:
    """Write `metrics` as metrics.json into the run folder `path`, whole or not at all."""
    write_file(path / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n")


def digest(path: Path) -> str:
    """SHA-256 of the bytes of tracks.csv and then updates.csv of the run folder `path`, in hex."""
    sha = hashlib.sha256()
    for name in ("tracks.csv", "updates.csv"):
        with open_file(path / name) as file:
            while block := file.read(1 << 20):
                sha.update(block)
    return sha.hexdigest()


def is_run_folder(path: Path) -> bool:
    """Whether `path` holds a run: its `meta.json` names the format."""
    try:
        meta = json.loads(read_whole(path / "meta.json", LARGEST_META_MB))
    except (DataError, ValueError, RecursionError):
        return False
    return isinstance(meta, dict) and meta.get("format") == RUN_FORMAT


def _write_all(file: FileIO, data: bytes) -> None:
    """Write `data`; a disk that is about to be full takes only the first part of it at a time."""
    while data:
        data = data[file.write(data) :]


def _is_run(path: Path) -> bool:
    """Whether `path` holds a run, or what is left of one whose writer was killed at its beginning.

    Raises `CallError` where a run has another file in place of one of its own.
    """
    if not path.is_dir():
        return False
    there = [path / name for name in _FILES if os.path.lexists(path / name)]
    foreign = next((file for file in there if not _is_of_run(file)), None)
    if is_run_folder(path):
        if foreign is not None:
            raise CallError(f"{foreign}: is not what a run has there, move it away or choose another folder")
        return True
    if foreign is not None or not all(part_of(name) in (*_FILES, EXCHANGED) for name in os.listdir(path)):
        return False
    return not there or any(_begins(path / f"{table}.csv", text_header(table)) for table in _TELLING)


def _is_of_run(file: Path) -> bool:
    """Whether `file`, which has the name of one of a run, may be it; what a link leads to is not touched."""
    if file.is_symlink() or file.suffix != ".csv":
        return file.is_symlink() or file.is_file()
    header = text_header(file.stem)
    return file.is_file() and (_begins(file, header) or header.startswith(read_head(file, len(header))))


def _begins(file: Path, start: bytes) -> bool:
    return read_head(file, len(start)) == start


RUN = Kind("a run folder", _is_run)

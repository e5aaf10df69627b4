"""Keeps a run in memory: what `load_run` would give of the folder that `RunWriter` writes, without the files."""

import hashlib
from collections.abc import Sequence
from functools import cached_property

from fgtrack.runs.reader import Run, parsed
from fgtrack.runs.rows import Row, text, text_header
from fgtrack.runs.schema import COLUMNS
from fgtrack.runs.sink import RunSink


class MemoryRun(RunSink):
    """Takes what `RunWriter` takes; `run` is the run so far."""

    @property
    def run(self) -> Run:
        """The run; it has no path."""
        self._append_rows()
        tables = {
            table: parsed(table, content) for table, content in self._files.items()
        }
        return Run(None, dict(self._meta), self._config_text, tables)

    @cached_property
    def _files(self) -> dict[str, bytearray]:
        return {
            table: bytearray(text_header(table, self.is_scored)) for table in COLUMNS
        }

    def _append(self, table: str, rows: Sequence[Row]) -> None:
        self._files[table] += text(table, rows).encode()

    def _digest(self) -> str:
        return hashlib.sha256(
            self._files["tracks"] + self._files["updates"]
        ).hexdigest()

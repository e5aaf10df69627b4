"""Keeps a run in memory, with the contents of the run folder but without files."""

import hashlib
from collections.abc import Sequence
from functools import cached_property

from fgtrack.runs.csv_table import parse_csv
from fgtrack.runs.reader import Run
from fgtrack.runs.rows import Row, text, text_header
from fgtrack.runs.schema import COLUMNS
from fgtrack.runs.sink import RunSink


class MemoryRun(RunSink):
    """Sink that keeps the run in memory; `run` equals the run that `load_run` would read from a run folder."""

    @property
    def run(self) -> Run:
        """The run up to now; its path is None."""
        self._append_rows()
        tables = {
            table: parse_csv(table, content) for table, content in self._files.items()
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

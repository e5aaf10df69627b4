"""Keeps a run in memory: what `load_run` would give of the folder that `RunWriter` writes, without the files."""

import hashlib
from collections.abc import Mapping, Sequence
from operator import itemgetter

import numpy as np

from fgtrack.io.run.reader import Run, Table
from fgtrack.io.run.rows import Row, text, text_header
from fgtrack.io.run.schema import COLUMNS, Column, column
from fgtrack.io.run.sink import RunSink

_CHUNK = 4096  # rows that wait for becoming columns, which take a tenth of the memory


class MemoryRun(RunSink):
    """Takes what `RunWriter` takes; `run` is the run so far. Parameters as of `RunSink`."""

    def __init__(
        self,
        config_text: str = "",
        meta: Mapping[str, object] | None = None,
        smoothed_lag_s: float | None = None,
    ) -> None:
        super().__init__(config_text, meta, smoothed_lag_s)
        self._waiting: dict[str, list[Row]] = {table: [] for table in COLUMNS}
        self._columns: dict[str, dict[str, list[Column]]] = {
            table: {name: [column(name, ())] for name in names} for table, names in COLUMNS.items()
        }
        # The digest is that of tracks.csv and then updates.csv, so only the text of the second has to wait.
        self._tracks = hashlib.sha256(text_header("tracks"))
        self._updates = bytearray(text_header("updates"))

    @property
    def run(self) -> Run:
        """The run; it has no path."""
        tables = {}
        for table in COLUMNS:
            self._pack(table)
            tables[table] = Table({name: np.concatenate(parts) for name, parts in self._columns[table].items()})
        return Run(None, dict(self._meta), self._config_text, tables)

    def _append(self, table: str, rows: Sequence[Row]) -> None:
        if table == "tracks":
            self._tracks.update(text(table, rows).encode())
        elif table == "updates":
            self._updates += text(table, rows).encode()
        self._waiting[table] += rows
        if len(self._waiting[table]) >= _CHUNK:
            self._pack(table)

    def _pack(self, table: str) -> None:
        waiting = self._waiting[table]
        if waiting:
            for place, (name, parts) in enumerate(self._columns[table].items()):
                parts.append(column(name, list(map(itemgetter(place), waiting))))
            waiting.clear()

    def _digest(self) -> str:
        sha = self._tracks.copy()
        sha.update(self._updates)
        return sha.hexdigest()

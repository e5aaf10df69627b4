"""Keeps a run in memory: what `load_run` would give of the folder that `RunWriter` writes, without the files."""

import hashlib
from collections.abc import Mapping, Sequence
from operator import itemgetter

import numpy as np

from fgtrack.io.run.reader import Column, Run, Table, column
from fgtrack.io.run.rows import Row, text
from fgtrack.io.run.schema import COLUMNS
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
        self._text = {table: bytearray((",".join(COLUMNS[table]) + "\n").encode()) for table in ("tracks", "updates")}

    @property
    def run(self) -> Run:
        """The run; it has no path."""
        tables = {}
        for table in COLUMNS:
            self._pack(table)
            tables[table] = Table({name: np.concatenate(parts) for name, parts in self._columns[table].items()})
        return Run(None, dict(self._meta), self._config_text, **tables)

    def _append(self, table: str, found: Sequence[Row]) -> None:
        if table in self._text:
            self._text[table] += text(table, found).encode()
        self._waiting[table] += found
        if len(self._waiting[table]) >= _CHUNK:
            self._pack(table)

    def _pack(self, table: str) -> None:
        waiting = self._waiting[table]
        if waiting:
            for place, (name, parts) in enumerate(self._columns[table].items()):
                parts.append(column(name, list(map(itemgetter(place), waiting))))
            waiting.clear()

    def _digest(self) -> str:
        return hashlib.sha256(self._text["tracks"] + self._text["updates"]).hexdigest()

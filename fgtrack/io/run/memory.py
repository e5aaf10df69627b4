"""Keeps a run in memory: what `load_run` would give of the folder that `RunWriter` writes, without the files."""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from fgtrack.core.types import (
    MEASURABLE,
    STATE_NAMES,
    Disposition,
    FloatArray,
    IntArray,
    SmoothedReport,
    TickReport,
    TrackState,
    TruthState,
)
from fgtrack.io.run.reader import Column, Run, Table, column
from fgtrack.io.run.schema import COLUMNS, COVARIANCE_COLUMNS, COVARIANCE_STATES, RUN_FORMAT
from fgtrack.io.run.writer import disposition_counts, kept_smoothed

_Cell = str | int | float | None

#: Columns of a state, in the order of `_state_row`.
_STATE_COLUMNS = (*STATE_NAMES, *COVARIANCE_COLUMNS)


class MemoryRun:
    """Takes what `RunWriter` takes; `run` is the run so far.

    States are copied when they come in, as the writer turns them into text at once. There is no digest, which is
    one of files.

    Parameters
    ----------
    config_text, meta, smoothed_lag_s
        As of `RunWriter`.
    """

    def __init__(
        self,
        config_text: str = "",
        meta: Mapping[str, object] | None = None,
        smoothed_lag_s: float | None = None,
    ) -> None:
        self._config_text = config_text
        self._meta: dict[str, object] = {"format": RUN_FORMAT, **(meta or {}), "complete": False}
        self._smoothed_lag_s = smoothed_lag_s
        self._rows: dict[str, list[tuple[_Cell, ...]]] = {table: [] for table in COLUMNS}
        self._states: dict[str, list[FloatArray]] = {table: [] for table in COLUMNS}
        self._counts: dict[str, Counter[Disposition]] = {}

    def write_tick(self, report: TickReport, process_ns: int, num_detections: int) -> None:
        """See `RunWriter.write_tick`."""
        tick, now_ns = report.tick, report.now_ns
        for track in report.tracks:
            ids = (tick, now_ns, track.state.stamp_ns, track.track_id, track.status.value, track.num_measured)
            self._append("tracks", ids, track.state)
        for record in report.updates:
            self._counts.setdefault(record.sensor, Counter())[record.disposition] += 1
            times = (record.stamp_ns, record.receipt_ns)
            outcome = (record.index, record.disposition.value, record.track_id, record.nis)
            innovation = [record.innovation.get(name) for name in MEASURABLE]
            self._rows["updates"].append((tick, record.sensor, *times, *outcome, *innovation))
        smoothed = kept_smoothed(report)
        for row in smoothed:
            if row.lag_s is not None:
                self._append("lagged", (tick, now_ns, row.lag_s, row.track_id, row.state.stamp_ns), row.state)
        self.write_smoothed([row for row in smoothed if row.lag_s in (None, self._smoothed_lag_s)])
        self._rows["timing"].append((tick, now_ns, process_ns, len(report.tracks), num_detections))

    def write_smoothed(self, reports: Sequence[SmoothedReport]) -> None:
        """See `RunWriter.write_smoothed`."""
        for row in reports:
            kind = "final" if row.lag_s is None else "lagged"
            self._append("smoothed", (row.track_id, row.state.stamp_ns, kind), row.state)

    def write_truth(self, truth: TruthState) -> None:
        """See `RunWriter.write_truth`."""
        state = [getattr(truth, name) for name in STATE_NAMES]
        self._rows["truth"].append((truth.stamp_ns, truth.object_id, *state))

    def finish(self, meta: Mapping[str, object]) -> dict[str, object]:
        """See `RunWriter.finish`."""
        self._meta |= {**meta, "counts": disposition_counts(self._counts), "complete": True}
        return dict(self._meta)

    @property
    def run(self) -> Run:
        """The run; it has no path."""
        return Run(None, dict(self._meta), self._config_text, **{table: self._table(table) for table in COLUMNS})

    def _append(self, table: str, ids: tuple[_Cell, ...], state: TrackState) -> None:
        self._rows[table].append(ids)
        self._states[table].append(_state_row(state))

    def _table(self, table: str) -> Table:
        columns: dict[str, Column] = {}
        if COVARIANCE_COLUMNS[0] in COLUMNS[table]:
            states = np.array(self._states[table]).reshape(-1, len(_STATE_COLUMNS))
            columns.update(zip(_STATE_COLUMNS, states.T.copy(), strict=True))
        names = [name for name in COLUMNS[table] if name not in columns]
        rows = self._rows[table]
        cells = zip(*rows, strict=True) if rows else ((),) * len(names)
        columns.update((name, column(name, values)) for name, values in zip(names, cells, strict=True))
        return Table({name: columns[name] for name in COLUMNS[table]})


def _state_row(state: TrackState) -> FloatArray:
    """Mean and covariance in the order of `_STATE_COLUMNS`; NaN where the model has no such entry."""
    cells, rows, columns = _places(len(state.mean))
    row = np.full(len(_STATE_COLUMNS), np.nan)
    row[: len(state.mean)] = state.mean
    row[cells] = state.covariance[rows, columns]
    return row


@lru_cache
def _places(size: int) -> tuple[IntArray, IntArray, IntArray]:
    """Where the upper triangle of a covariance of `size` states goes in a row, and its rows and columns."""
    rows, columns = np.triu_indices(len(COVARIANCE_STATES))
    known = columns < size
    return len(STATE_NAMES) + np.flatnonzero(known), rows[known], columns[known]

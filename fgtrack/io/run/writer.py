"""Writes a run folder as the run goes."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from fgtrack.core.types import (
    MEASURABLE,
    STATE_NAMES,
    Disposition,
    SmoothedReport,
    TickReport,
    TrackReport,
    TrackState,
    TruthState,
    UpdateRecord,
)
from fgtrack.io.output import Kind, check_output, claimed, write_error, write_file
from fgtrack.io.run.schema import COLUMNS, COVARIANCE_STATES, OPTIONAL_TABLES, RUN_FORMAT

_FILES = ("meta.json", "config.yaml", "metrics.json", *(f"{table}.csv" for table in COLUMNS))


class RunWriter:
    """Writes a run folder as the run goes; a context manager.

    The folder is locked until the writer is closed. Its files appear with the first tick, so a run that fails before
    leaves what was there. From then on every tick reaches the files before `write_tick` returns: a killed run leaves
    readable files and a `meta.json` with `"complete": false`.

    Parameters
    ----------
    path
        Folder of the run; made if need be.
    config_text
        Text of `config.yaml`, the resolved configuration.
    meta
        What `meta.json` says from the start on.
    smoothed_lag_s
        The lag whose states go to smoothed.csv beside the final ones; lagged.csv gets those of every lag.
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
        self.path = Path(path)
        self._config_text = config_text
        self._overwrite = overwrite
        self._early: list[tuple[str, str]] | None = []  # rows before the files are there
        self._smoothed_lag_s = smoothed_lag_s
        self._files: dict[str, BinaryIO] = {}
        self._counts: dict[str, Counter[Disposition]] = {}
        self._meta: dict[str, object] = {"format": RUN_FORMAT, **(meta or {})}
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
        self._close_tables()
        self._claim.close()

    def _close_tables(self) -> None:
        while self._files:
            self._files.popitem()[1].close()

    def write_tick(self, report: TickReport, process_ns: int, num_detections: int) -> None:
        """Append all rows of one tick; lagged states only of the tracks that the tick reports.

        Parameters
        ----------
        report
            What the tracker gave.
        process_ns
            Wall time of the tick.
        num_detections
            Detections that the tick received.
        """
        self._begin()
        prefix = f"{report.tick},{report.now_ns},"
        if report.tracks:
            self._append("tracks", "".join([prefix + _track_row(track) for track in report.tracks]))
        if report.updates:
            self._append("updates", "".join([f"{report.tick},{_update_row(row)}" for row in report.updates]))
            for record in report.updates:
                self._counts.setdefault(record.sensor, Counter())[record.disposition] += 1
        smoothed = kept_smoothed(report)
        if lagged := [prefix + _lagged_row(row) for row in smoothed if row.lag_s is not None]:
            self._append("lagged", "".join(lagged))
        self.write_smoothed([row for row in smoothed if row.lag_s in (None, self._smoothed_lag_s)])
        counts = f"{len(report.tracks)},{num_detections}"
        self._append("timing", f"{report.tick},{report.now_ns},{process_ns},{counts}\n")

    def write_smoothed(self, reports: Sequence[SmoothedReport]) -> None:
        """Append rows to smoothed.csv."""
        if reports:
            self._append("smoothed", "".join([_smoothed_row(row) for row in reports]))

    def write_truth(self, truth: TruthState) -> None:
        """Append one row to truth.csv."""
        state = ",".join([_cell(getattr(truth, name)) for name in STATE_NAMES])
        self._append("truth", f"{truth.stamp_ns},{truth.object_id},{state}\n")

    def finish(self, meta: Mapping[str, object]) -> dict[str, object]:
        """Close the tables and rewrite `meta.json` with `meta`, the counts and the digest; gives its content.

        `counts` holds, per sensor, the number of detections of every disposition.
        """
        self._begin()
        self._close_tables()
        self._meta |= {**meta, "counts": disposition_counts(self._counts), "digest": digest(self.path)}
        self._write_meta(complete=True)
        return dict(self._meta)

    def _begin(self) -> None:
        """Make the files; of an older run there, meta.json goes first and is new last."""
        if self._early is None:
            return
        early, self._early = self._early, None
        try:
            for name in _FILES if self._overwrite else ():
                (self.path / name).unlink(missing_ok=True)
        except OSError as error:
            raise write_error(self.path, error) from error
        write_file(self.path / "config.yaml", self._config_text)
        for table in COLUMNS:
            if table not in OPTIONAL_TABLES:
                self._append(table, "")
        for table, rows in early:
            self._append(table, rows)
        self._write_meta(complete=False)

    def _append(self, table: str, rows: str) -> None:
        if self._early is not None:
            self._early.append((table, rows))
            return
        file = self._files.get(table)
        path = self.path / f"{table}.csv"
        try:
            if file is None:
                file = self._files[table] = path.open("xb", buffering=0)
                rows = ",".join(COLUMNS[table]) + "\n" + rows
            file.write(rows.encode())
        except OSError as error:
            raise write_error(path, error) from error

    def _write_meta(self, complete: bool) -> None:
        self._meta["complete"] = complete
        write_file(self.path / "meta.json", json.dumps(self._meta, indent=2) + "\n")


def kept_smoothed(report: TickReport) -> list[SmoothedReport]:
    """The smoothed states of a tick that a run keeps: all final ones, lagged ones of the tracks that it reports."""
    tracked = {track.track_id for track in report.tracks}
    return [row for row in report.smoothed if row.lag_s is None or row.track_id in tracked]


def disposition_counts(counts: Mapping[str, Counter[Disposition]]) -> dict[str, dict[str, int]]:
    """Number of detections of every disposition, per sensor, as meta.json says them."""
    return {
        sensor: {disposition.value: counter[disposition] for disposition in Disposition}
        for sensor, counter in sorted(counts.items())
    }


def write_metrics(path: Path, metrics: Mapping[str, object]) -> None:
    """Write `metrics` as metrics.json into the run folder `path`, whole or not at all."""
    write_file(path / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n")


def digest(path: Path) -> str:
    """SHA-256 of the bytes of tracks.csv and then updates.csv of the run folder `path`, in hex."""
    sha = hashlib.sha256()
    for name in ("tracks.csv", "updates.csv"):
        with (path / name).open("rb") as file:
            while block := file.read(1 << 20):
                sha.update(block)
    return sha.hexdigest()


def is_run_folder(path: Path) -> bool:
    """Whether `path` holds a run: its `meta.json` names the format."""
    try:
        meta = json.loads((path / "meta.json").read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(meta, dict) and meta.get("format") == RUN_FORMAT


def _is_run(path: Path) -> bool:
    """Whether `path` holds a run, or what is left of one whose writer was killed at its beginning."""
    return is_run_folder(path) or (path.is_dir() and {file.name for file in path.iterdir()} <= set(_FILES))


RUN = Kind("a run folder", _is_run)


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.17g}"


@lru_cache
def _text(name: str) -> str:
    """`name` as a CSV cell."""
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\r\n') else name


@lru_cache
def _state_layout(size: int) -> tuple[str, str, Callable[[list[float]], tuple[float, ...]]]:
    """Format of the mean and of the covariance of `size` states, and what picks its upper triangle."""
    kept = range(len(COVARIANCE_STATES))
    cells = [(i, j) for i in kept for j in kept[i:]]
    mean = ",".join("%.17g" if i < size else "" for i in range(len(STATE_NAMES)))
    covariance = ",".join("%.17g" if j < size else "" for _, j in cells)
    # itemgetter's result type depends on the number of its arguments, which is 3 or more here.
    pick: Any = itemgetter(*[i * size + j for i, j in cells if j < size])
    return mean, covariance, pick


@lru_cache
def _track_format(size: int) -> str:
    mean, covariance, _ = _state_layout(size)
    return f"%d,%d,%s,{mean},%d,{covariance}\n"


@lru_cache
def _smoothed_format(size: int) -> str:
    mean, covariance, _ = _state_layout(size)
    return f"%d,%d,%s,{mean},{covariance}\n"


@lru_cache
def _lagged_format(size: int) -> str:
    mean, covariance, _ = _state_layout(size)
    return f"%.17g,%d,%d,{mean},{covariance}\n"


def _upper_triangle(state: TrackState) -> Iterable[float]:
    pick = _state_layout(len(state.mean))[2]
    return pick(state.covariance.ravel().tolist())


def _track_row(track: TrackReport) -> str:
    state = track.state
    mean = state.mean.tolist()
    return _track_format(len(mean)) % (
        *(state.stamp_ns, track.track_id, track.status),
        *mean,
        track.num_measured,
        *_upper_triangle(state),
    )


def _smoothed_row(row: SmoothedReport) -> str:
    mean = row.state.mean.tolist()
    ids = (row.track_id, row.state.stamp_ns, "final" if row.lag_s is None else "lagged")
    return _smoothed_format(len(mean)) % (*ids, *mean, *_upper_triangle(row.state))


def _lagged_row(row: SmoothedReport) -> str:
    mean = row.state.mean.tolist()
    ids = (row.lag_s, row.track_id, row.state.stamp_ns)
    return _lagged_format(len(mean)) % (*ids, *mean, *_upper_triangle(row.state))


def _update_row(row: UpdateRecord) -> str:
    track = "" if row.track_id is None else row.track_id
    innovation = ",".join([_cell(row.innovation.get(name)) for name in MEASURABLE])
    return (
        f"{_text(row.sensor)},{row.stamp_ns},{row.receipt_ns},{row.index},{row.disposition},{track},"
        f"{_cell(row.nis)},{innovation}\n"
    )

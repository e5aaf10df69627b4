"""Reads a run folder; each table becomes columns."""

import json
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from ruamel.yaml.error import YAMLError

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import read_whole
from fgtrack.core.time import NS_PER_S
from fgtrack.core.yaml_text import safe_yaml
from fgtrack.inputs.errors import one_line
from fgtrack.inputs.settings import Origin
from fgtrack.runs.columns import Columns
from fgtrack.runs.csv_table import parse_csv, read_csv
from fgtrack.runs.recorded_truth import RecordedTruth
from fgtrack.runs.rows import text_header
from fgtrack.runs.schema import (
    COLUMNS,
    OPTIONAL_TABLES,
    RUN_FORMAT,
    column,
)
from fgtrack.runs.writer import (
    LARGEST_META_MB,
    NO_PYARROW,
    RunWriter,
    TableFormat,
    path_from_run,
)

if TYPE_CHECKING:  # takes half a second to import
    from pandas import DataFrame


def _frame(table: str, doc: str) -> "cached_property[DataFrame]":
    """Property of a run: the table as a pandas DataFrame, with the docstring `doc`."""

    def made(run: "Run") -> "DataFrame":
        import pandas

        return pandas.DataFrame(dict(run.tables[table]))

    made.__doc__ = doc
    return cached_property(made)


@dataclass(frozen=True, repr=False)
class Run:
    """The tables, the meta data and the configuration of a run."""

    path: Path | None
    """Folder of the run; None for a run in memory."""
    meta: Mapping[str, Any]
    """JSON values of meta.json."""
    config_text: str
    """Text of config.yaml."""
    tables: Mapping[str, Columns]
    """Columns of every table by name; a table without a file has no rows."""

    def __post_init__(self) -> None:
        empty = {
            name: Columns({key: column(key, ()) for key in COLUMNS[name]})
            for name in COLUMNS
        }
        object.__setattr__(self, "tables", empty | dict(self.tables))

    tracks = _frame("tracks", "States of every track at every tick.")
    updates = _frame(
        "updates",
        "A row for each detection: its disposition, track, NIS and innovation.",
    )
    smoothed = _frame("smoothed", "Final states, and the lagged states of one lag.")
    lagged = _frame("lagged", "Lagged states of every lag.")
    revisions = _frame(
        "revisions",
        "A row for each decision about a detection that late data has changed.",
    )
    final_tracks = _frame(
        "final_tracks",
        "What each track was in the end, if late data changes decisions.",
    )
    timing = _frame(
        "timing",
        "A row for each tick: its time, processing time, numbers of tracks and detections.",
    )
    truth = _frame("truth", "True objects.")
    ignored = _frame(
        "ignored",
        "Objects and regions that the evaluation ignores: tracks there are neither right nor false.",
    )
    ego = _frame("ego", "States of the ego, in order of receipt.")
    objects = _frame(
        "objects",
        "Class and size of the tracks' objects, if detections report them.",
    )
    detections = _frame(
        "detections", "Detections in order of receipt, a row for each row of `updates`."
    )

    def __repr__(self) -> str:
        meta = self.meta
        updates = self.tables["updates"]
        truth = self.tables["truth"]
        tracks = self.tables["tracks"]
        now_ns = self.tables["timing"]["now_ns"].tolist()
        counts = Counter(updates["disposition"].tolist())
        length_s = (now_ns[-1] - now_ns[0]) / NS_PER_S if now_ns else 0.0
        lines = {
            "estimator": self.estimator,
            "folder": self.path or "in memory",
            "recording": (meta.get("input") or {}).get("path"),
            "time": f"{len(now_ns)} ticks, {length_s:.1f} s",
            "tracks": f"{len(np.unique(tracks['track_id']))}, {tracks.num_rows} states",
            "detections": ", ".join(
                f"{count} {name}" for name, count in counts.most_common()
            ),
            "truth": f"{len(np.unique(truth['object_id']))} objects"
            if truth.num_rows
            else None,
            "digest": meta.get("digest"),
        }
        return "\n".join(
            ["Run", *(f"  {name}: {value}" for name, value in lines.items() if value)]
        )

    def _repr_html_(self) -> str:
        return f"<pre>{escape(repr(self))}</pre>"

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return str(self.meta.get("estimator", ""))

    @property
    def config(self) -> Mapping[str, Any]:
        """Values of config.yaml; raises `DataError` if the file is not YAML, or contains no mapping."""
        try:
            config = _cached_yaml(self.config_text)
        except YAMLError as error:
            raise DataError(
                f"{self.config_path}: is not YAML, repeat the run"
            ) from error
        if not isinstance(config, dict | None):
            raise DataError(f"{self.config_path}: has no settings, repeat the run")
        return config or {}

    @property
    def config_path(self) -> Path:
        """Path of the configuration, for messages."""
        return Path(self.path or "") / "config.yaml"

    @property
    def recording(self) -> Path | None:
        """Path of the recording, relative to the run folder or as given; None if it does not exist."""
        return recording_of(self.path, self.meta)

    def with_tables(self, **tables: Columns) -> "Run":
        """Return the run in which `tables` replace the tables of the same names. Its other tables stay."""
        return replace(self, tables={**self.tables, **tables})

    def save(
        self,
        path: Path | str,
        *,
        overwrite: bool = False,
        table_format: TableFormat = "csv",
    ) -> None:
        """Write the run folder `path`, with a copy of the truth.

        Raises `CallError` if something exists there, as `RunWriter`.
        """
        meta = {
            key: value
            for key, value in self.meta.items()
            if key not in ("tables", "truth")
        }
        if self.recording is not None:
            meta["input"] = {
                **meta["input"],
                "path_from_run": path_from_run(str(self.recording), Path(path)),
            }
        with RunWriter(
            path,
            self.config_text,
            meta,
            overwrite=overwrite,
            table_format=table_format,
        ) as writer:
            for table, columns in self.tables.items():
                if columns.num_rows:
                    writer.write_columns(table, columns)
            writer.finish(meta)


_cached_yaml = lru_cache(maxsize=64)(safe_yaml)
"""Cached YAML values of a text. Parsing takes longer than evaluating a run of 20 s, and sweeps repeat the text."""


def load_run(path: Path | str) -> Run:
    """Read the run folder `path`, without a half-written last row.

    Raises `DataError` if a file is missing or damaged.
    """
    path = Path(path)
    file = path / "meta.json"
    config = path / "config.yaml"
    try:
        meta = json.loads(read_whole(file, LARGEST_META_MB))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file}: is not JSON ({error}), repeat the run") from error
    if not isinstance(meta, dict) or meta.get("format") != RUN_FORMAT:
        raise DataError(
            f"{file}: does not contain format {RUN_FORMAT!r}, so this is not a run folder"
        )
    complete = bool(meta.get("complete"))
    config_text = (
        read_whole(config, LARGEST_META_MB).decode(errors="replace")
        if complete or config.exists()
        else ""
    )
    table_format = meta.get("tables", "csv")
    if table_format not in get_args(TableFormat):
        raise DataError(
            f"{file}: its tables have the format {table_format!r}, which this version does not read"
        )
    read = _table_reader(table_format, file)
    tables = {
        name: _read_table(read, path / f"{name}.{table_format}", name, complete)
        for name in COLUMNS
    }
    if isinstance(meta.get("truth"), dict):
        recording = recording_of(path, meta)
        tables["truth"] = RecordedTruth(
            path, recording, meta, lambda: _origin(config_text)
        )
    if (np.diff(tables["timing"]["tick"]) <= 0).any():
        raise DataError(
            f"{path}/timing.{table_format}: its ticks do not increase, repeat the run"
        )
    return Run(path, meta, config_text, tables)


def _origin(config_text: str) -> Origin | None:
    """Return the origin of the map in a configuration; None if the first position of the recording is the origin."""
    given = ((_cached_yaml(config_text) or {}).get("input") or {}).get("origin")
    return None if given is None else Origin(**given)


def recording_of(folder: Path | None, meta: Mapping[str, Any]) -> Path | None:
    """Return the path of the recording, relative to the run folder or as given; None if it does not exist."""
    source = meta.get("input") or {}
    given = [source["path"]] if source.get("path") else []
    if folder is not None and source.get("path_from_run"):
        given.insert(0, folder / str(source["path_from_run"]))
    return next(
        (path for path in map(Path, map(os.path.realpath, given)) if path.exists()),
        None,
    )


def _table_reader(
    table_format: TableFormat, file: Path
) -> Callable[[Path, str, bool], Columns]:
    """Return the reader of `table_format`, which gets a path, the table, and True for a complete run."""
    if table_format == "csv":
        return read_csv
    try:
        from fgtrack.runs.parquet_table import read_parquet
    except ModuleNotFoundError as error:
        raise CallError(f"{file}: {NO_PYARROW}") from error
    return read_parquet


def _read_table(
    read: Callable[[Path, str, bool], Columns], path: Path, table: str, complete: bool
) -> Columns:
    # A run that was killed at its beginning lacks tables.
    if (table in OPTIONAL_TABLES or not complete) and not path.exists():
        return parse_csv(table, text_header(table))
    try:
        return read(path, table, complete)
    except (OSError, ValueError, OverflowError) as error:
        raise DataError(
            f"{path}: cannot be read ({one_line(error)}), repeat the run"
        ) from error

"""Reads a run folder; each table becomes columns."""

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from html import escape
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any
from warnings import catch_warnings

import numpy as np
from ruamel.yaml.error import YAMLError

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file, read_whole
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, IntArray
from fgtrack.core.yaml_text import safe_yaml
from fgtrack.inputs.errors import one_line
from fgtrack.runs.rows import text_header
from fgtrack.runs.schema import (
    ADDED_COLUMNS,
    COLUMNS,
    NO_TRACK,
    OPTIONAL_TABLES,
    RUN_FORMAT,
    SCORE,
    Column,
    column,
    column_type,
)
from fgtrack.runs.writer import LARGEST_META_MB, RunWriter, path_from_run

if TYPE_CHECKING:  # takes half a second to import
    from pandas import DataFrame


class Columns(dict[str, Column]):
    """Columns of a table by name: read-only NumPy arrays of shape (rows,); `len` is the number of columns.

    In a float column, an empty cell and a number beyond 1e60 are NaN. In an integer
    column, an empty cell is `NO_TRACK`.
    """

    def __init__(self, columns: Mapping[str, Column]) -> None:
        super().__init__({name: values.view() for name, values in columns.items()})
        for values in self.values():
            values.flags.writeable = False

    @property
    def num_rows(self) -> int:
        """Length of every column."""
        return len(next(iter(self.values()), ()))

    def equals(self, other: "Columns") -> bool:
        """True if both tables have the same columns, equal to the bit; NaN equals NaN."""
        return list(self) == list(other) and all(
            np.array_equal(
                self[name], other[name], equal_nan=column_type(name) is float
            )
            for name in self
        )

    def where(self, rows: BoolArray | IntArray) -> "Columns":
        """Return the rows selected by a mask, shape (rows,), or by indices."""
        return Columns({name: values[rows] for name, values in self.items()})


def _frame(table: str, doc: str) -> "cached_property[DataFrame]":
    """Property of a run: the table as a pandas DataFrame, with the docstring `doc`."""

    def made(run: "Run") -> "DataFrame":
        import pandas

        return pandas.DataFrame(run.tables[table])

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
        source = self.meta.get("input") or {}
        given = [source["path"]] if source.get("path") else []
        if self.path is not None and source.get("path_from_run"):
            given.insert(0, self.path / str(source["path_from_run"]))
        return next(
            (path for path in map(Path, map(os.path.realpath, given)) if path.exists()),
            None,
        )

    def with_tables(self, **tables: Columns) -> "Run":
        """Return the run in which `tables` replace the tables of the same names. Its other tables stay."""
        return replace(self, tables={**self.tables, **tables})

    def save(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the run folder `path`; raises `CallError` if something exists there, as `RunWriter`."""
        meta = dict(self.meta)
        if self.recording is not None:
            meta["input"] = {
                **meta["input"],
                "path_from_run": path_from_run(str(self.recording), Path(path)),
            }
        with RunWriter(path, self.config_text, meta, overwrite=overwrite) as writer:
            for table, columns in self.tables.items():
                if columns.num_rows:
                    writer.write_rows(table, _lines(table, columns, writer.is_scored))
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
    tables = {
        name: _read_table(path / f"{name}.csv", name, complete) for name in COLUMNS
    }
    if (np.diff(tables["timing"]["tick"]) <= 0).any():
        raise DataError(
            f"{path / 'timing.csv'}: its ticks do not increase, repeat the run"
        )
    has_config = complete or config.exists()
    return Run(
        path,
        meta,
        read_whole(config, LARGEST_META_MB).decode(errors="replace")
        if has_config
        else "",
        tables,
    )


def _read_table(path: Path, table: str, complete: bool) -> Columns:
    # A run that was killed at its beginning lacks tables.
    if (table in OPTIONAL_TABLES or not complete) and not path.exists():
        return parse_csv(table, text_header(table))
    try:
        with open_file(path) as file:
            content = file.read()
        if complete and (not content.endswith(b"\n") or content.endswith(b"\n\n")):
            raise DataError(f"{path}: breaks off in its last row, repeat the run")
        return parse_csv(
            table, content[: content.rfind(b"\n") + 1] or text_header(table)
        )
    except (OSError, ValueError, OverflowError) as error:
        raise DataError(
            f"{path}: cannot be read ({one_line(error)}), repeat the run"
        ) from error


def parse_csv(table: str, content: bytes | bytearray) -> Columns:
    """Return the columns of a table from the content of its CSV file; raises `ValueError` for other content."""
    names = COLUMNS[table]
    text = TextIOWrapper(BytesIO(content), newline="")
    written = tuple(text.readline().rstrip("\n").split(","))
    if (
        tuple(name for name in names if name in written or name not in ADDED_COLUMNS)
        != written
    ):
        raise ValueError(f"the columns must be {','.join(names)}")
    # NumPy warns about a file without rows.
    with catch_warnings(action="ignore", category=UserWarning):
        cells = np.loadtxt(
            text,
            dtype=[(name, _TYPES[column_type(name)]) for name in written],
            delimiter=",",
            quotechar='"',
            comments=None,
            converters=dict(enumerate(map(_converter, written))),
            ndmin=1,
        )
    # Runs of fgtrack 0.2 lack these columns.
    added = {
        name: [ADDED_COLUMNS[name]] * len(cells)
        for name in names
        if name not in written
    }
    return Columns(
        {
            name: column(name, added[name] if name in added else cells[name])
            for name in names
        }
    )


_TYPES = {str: object, int: np.int64, float: np.float64}


def _converter(name: str) -> Callable[[str], str | int | float]:
    """Return the function that converts a cell of the column `name`."""
    if column_type(name) is float:
        return lambda cell: float(cell) if cell else math.nan
    return (
        str
        if column_type(name) is str
        else lambda cell: int(cell) if cell or name != "track_id" else NO_TRACK
    )


def _lines(table: str, columns: Columns, is_scored: bool) -> str:
    """Return the columns as lines of the table's CSV file; floats have 17 significant digits."""
    import pandas

    frame = pandas.DataFrame(columns)
    if table == "tracks" and not is_scored:
        frame = frame.drop(columns=SCORE)
    if table == "updates":
        frame["track_id"] = (
            frame["track_id"].astype("Int64").replace(NO_TRACK, pandas.NA)
        )
    return str(
        frame.to_csv(
            header=False, index=False, float_format="%.17g", lineterminator="\n"
        )
    )

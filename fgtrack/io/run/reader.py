"""Reads a run folder into columns."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import numpy.typing as npt
from ruamel.yaml.error import YAMLError

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file, open_text, read_whole
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray
from fgtrack.io.run.relied import check_config, check_meta
from fgtrack.io.run.schema import COLUMNS, LARGEST_META_MB, OPTIONAL_TABLES, RUN_FORMAT
from fgtrack.io.yaml_text import safe_yaml

# A column holds floats, integers or strings, as its name says; the reader of it knows which.
Column = npt.NDArray[Any]

_TEXT_COLUMNS = frozenset({"status", "sensor", "disposition", "kind", "frame", "class_name", "outline_m"})
_INTEGER_COLUMNS = frozenset(
    {
        *("tick", "now_ns", "stamp_ns", "receipt_ns", "process_ns", "track_id", "object_id"),
        *("index", "num_measured", "num_tracks", "num_detections"),
    }
)

CHUNK = 4096
"""Rows that wait for becoming columns, which take a tenth of the memory."""

_LONGEST_LINE = 1_000_000
_LARGEST = 1e60  # its square is a number; more is no measurement, and no state
_WIDE_BYTES, _WIDER_THAN_FILE = 1e8, 100.0  # of a column of text, all cells of which are as wide as its longest

NO_TRACK = -1
"""Track id of an update that belongs to no track."""


class Table(dict[str, Column]):
    """Columns by name, each of shape (rows,) and read-only: `pandas.DataFrame(table)` is the table.

    An empty cell, and a number beyond 1e60, is NaN in a float column; an empty one is `NO_TRACK` in an integer one.
    `len` is the number of columns.
    """

    def __init__(self, columns: Mapping[str, Column]) -> None:
        super().__init__({name: values.view() for name, values in columns.items()})
        for values in self.values():
            values.flags.writeable = False

    @property
    def num_rows(self) -> int:
        """Length of every column."""
        return len(next(iter(self.values()), ()))

    def where(self, mask: BoolArray) -> "Table":
        """The rows where `mask`, shape (rows,), is true."""
        return Table({name: values[mask] for name, values in self.items()})

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Table) or list(self) != list(other):
            return False
        pairs = zip(self.values(), other.values(), strict=True)
        return all(mine.dtype == its.dtype and mine.tobytes() == its.tobytes() for mine, its in pairs)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __repr__(self) -> str:
        return f"<Table of {self.num_rows} rows: {', '.join(self)}>"


def _length_s(timing: Table) -> float:
    now_ns = timing["now_ns"]
    return (int(now_ns[-1]) - int(now_ns[0])) / NS_PER_S if len(now_ns) else 0.0


@dataclass(frozen=True, repr=False)
class Run:
    """A run as evaluation sees it."""

    path: Path | None
    """Folder of the run; None for a run in memory."""
    meta: Mapping[str, Any]
    """Content of meta.json; JSON values."""
    config_text: str
    tracks: Table
    updates: Table
    smoothed: Table
    lagged: Table
    timing: Table
    truth: Table
    ego: Table
    """What was told of the ego, in order of receipt."""
    detections: Table
    """What the sensors said, in order of receipt; a row for each of `updates`. Of runs of fgtrack 0.1 it is empty."""
    ignored: Table = field(default_factory=lambda: Table({name: column(name, ()) for name in COLUMNS["ignored"]}))
    """Objects and regions at which a track is neither right nor false."""
    objects: Table = field(default_factory=lambda: Table({name: column(name, ()) for name in COLUMNS["objects"]}))
    """Class and size of the objects of tracks, as far as detections say them."""

    def __repr__(self) -> str:
        meta = self.meta
        fates = Counter(self.updates["disposition"].tolist())
        lines = {
            "estimator": meta.get("estimator"),
            "folder": self.path or "in memory",
            "recording": (meta.get("input") or {}).get("path"),
            "time": f"{self.timing.num_rows} ticks, {_length_s(self.timing):.1f} s",
            "tracks": f"{len(np.unique(self.tracks['track_id']))}, {self.tracks.num_rows} states",
            "detections": ", ".join(f"{count} {fate}" for fate, count in fates.most_common()),
            "truth": f"{len(np.unique(self.truth['object_id']))} objects" if self.truth.num_rows else None,
            "digest": meta.get("digest"),
        }
        return "\n".join(["Run", *(f"  {name}: {value}" for name, value in lines.items() if value)])

    def _repr_html_(self) -> str:
        _, *lines = repr(self).splitlines()
        cells = (line.strip().split(": ", 1) for line in lines)
        rows = (f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in cells)
        return f"<table>{''.join(rows)}</table>"

    @property
    def config(self) -> Mapping[str, Any]:
        """Values of config.yaml. Raises `DataError` where it is no YAML mapping, or not that of a run."""
        try:
            config = _parsed(self.config_text)
        except YAMLError as error:
            raise DataError(f"{self.config_path}: is not YAML, repeat the run") from error
        if not isinstance(config, dict | None):
            raise DataError(f"{self.config_path}: holds no settings, repeat the run")
        check_config(config or {}, self.config_path)
        return config or {}

    @property
    def config_path(self) -> Path:
        """Where the configuration is, for messages."""
        return Path(self.path or "") / "config.yaml"


@lru_cache(maxsize=64)
def _parsed(text: str) -> Any:
    """The YAML values of `text`. Cached: parsing takes longer than evaluating a run of 20 s, and sweeps repeat it."""
    return safe_yaml(text)


def load_run(path: Path | str) -> Run:
    """Read the run folder `path`.

    Of a run that did not finish (`meta["complete"]` is false) a half-written last row is left out.

    Raises
    ------
    DataError
        A file is missing or damaged; the message names it.
    """
    path = Path(path)
    meta = _read_meta(path)
    complete = bool(meta.get("complete"))
    tables = {name: _read_table(path / f"{name}.csv", name, complete) for name in COLUMNS}
    if (np.diff(tables["timing"]["tick"]) <= 0).any():
        raise DataError(f"{path / 'timing.csv'}: its ticks do not increase, repeat the run")
    return Run(path, meta, _read_text(path / "config.yaml"), **tables)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is not UTF-8 text ({error.reason}), repeat the run") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}), is this a run folder?") from error


def _read_text(path: Path) -> str:
    with _reading(path):
        return read_whole(path, LARGEST_META_MB).decode("utf-8")


def _read_meta(path: Path) -> Mapping[str, Any]:
    file = path / "meta.json"
    if not file.exists() and (path / "config.yaml").is_file():
        raise DataError(f"{path}: has no meta.json, what wrote it was killed at its beginning: repeat the run")
    try:
        meta = json.loads(_read_text(file))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file}: is not JSON ({error}), repeat the run") from error
    if not isinstance(meta, dict) or meta.get("format") != RUN_FORMAT:
        raise DataError(f"{file}: does not say format {RUN_FORMAT!r}, so this is not a run folder")
    check_meta(meta, file)
    return meta


def _read_table(path: Path, table: str, complete: bool) -> Table:
    names = COLUMNS[table]
    if table in OPTIONAL_TABLES and not path.exists():
        return Table({name: column(name, ()) for name in names})
    texts = {name: [column(name, ())] for name in names if name in _TEXT_COLUMNS}
    num_rows, longest = 0, dict.fromkeys(texts, 1)
    with _reading(path), open_text(path, newline="\n") as file:
        most = _most_rows(path, names)
        numbers = {name: np.empty(most, column(name, ()).dtype) for name in names if name not in texts}
        reader = csv.reader(_whole_lines(path, file, complete))
        try:
            header = next(reader, None)
            if header is None and not complete and table in OPTIONAL_TABLES:
                pass  # killed while it was begun
            elif tuple(header or ()) != names:
                raise DataError(f"{path}:1: the header must be {','.join(names)}")
            while rows := list(islice(reader, CHUNK)):
                short = next((row for row in rows if len(row) != len(names)), None)
                if short is not None:
                    line = reader.line_num - len(rows) + 1 + rows.index(short)
                    raise DataError(f"{path}:{line}: {len(short)} cells instead of {len(names)}, repeat the run")
                place = slice(num_rows, num_rows + len(rows))
                num_rows = place.stop
                for name, cells in zip(names, zip(*rows, strict=True), strict=True):
                    if name in texts:
                        longest[name] = max(longest[name], max(map(len, cells)))
                        if 4.0 * num_rows * longest[name] > max(_WIDE_BYTES, _WIDER_THAN_FILE * path.stat().st_size):
                            raise DataError(f"{path}: {name} of {longest[name]} characters, repeat the run")
                        texts[name].append(column(name, cells))
                    else:
                        numbers[name][place] = column(name, _values(name, cells))
        except csv.Error as error:
            raise DataError(f"{path}: is not CSV ({error}), repeat the run") from error
        except UnicodeDecodeError:  # which is a ValueError
            raise
        except (ValueError, OverflowError) as error:
            raise DataError(f"{path}: holds a bad cell ({error}), repeat the run") from error
    return Table({name: np.concatenate(texts[name]) if name in texts else numbers[name][:num_rows] for name in names})


def _most_rows(path: Path, names: Sequence[str]) -> int:
    """As many as there are lines and, as a row has as many bytes as cells at least, fit into the file."""
    with open_file(path) as file:
        lines = sum(block.count(b"\n") for block in iter(partial(file.read, 1 << 20), b""))
    return min(lines, path.stat().st_size // len(names))


def _whole_lines(path: Path, file: TextIO, complete: bool) -> Iterator[str]:
    """The lines of a table, without a half-written last one, which only a run that did not finish may have."""
    while line := file.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise DataError(f"{path}: a line of {_LONGEST_LINE} characters, repeat the run")
        if not line.endswith("\n"):
            if complete:
                raise DataError(f"{path}: breaks off in its last row, repeat the run")
            return
        yield line


def column(name: str, cells: Sequence[str | int | float | None]) -> Column:
    """The column `name` from its cells, shape (rows,); None is empty, and a number beyond 1e60 is NaN."""
    if name in _TEXT_COLUMNS:
        return np.array(["" if cell is None else cell for cell in cells], dtype=np.str_)
    if name in _INTEGER_COLUMNS:
        return np.array([NO_TRACK if cell is None else cell for cell in cells], dtype=np.int64)
    numbers = np.array(cells, dtype=np.float64)
    numbers[np.abs(numbers) > _LARGEST] = np.nan
    return numbers


def _values(name: str, cells: Sequence[str]) -> Sequence[int | float | None]:
    """The numbers of the column `name` from their text."""
    convert: Callable[[str], float] = int if name in _INTEGER_COLUMNS else float
    return [convert(cell) if cell else None for cell in cells]

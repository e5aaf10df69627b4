"""Truth of a run that stays in its recording, and is read from there."""

import hashlib
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any
from weakref import WeakValueDictionary, finalize

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.types import STATE_NAMES, TruthState
from fgtrack.inputs.geodetic import LocalPlane
from fgtrack.inputs.settings import Origin
from fgtrack.inputs.stream import read_stream, read_truth_records
from fgtrack.runs.columns import KEPT_BYTES, Columns, MadeColumns
from fgtrack.runs.rows import Row, state_cells
from fgtrack.runs.schema import COLUMNS, Column, column

_KEYS = ("stamp_ns", "object_id")
_TYPE = np.dtype(
    [(name, "<i8") for name in _KEYS] + [(name, "<f8") for name in STATE_NAMES]
)
_PACK = struct.Struct(f"<{len(_KEYS)}q{len(STATE_NAMES)}d").pack
_BLOCK_ROWS = 1 << 15
_CELL_BYTES = 8


class TruthHash:
    """Number and SHA-256 of the true states of a run, which show later that a recording still contains them."""

    def __init__(self) -> None:
        self.num_rows = 0
        self._sha = hashlib.sha256()

    def add(self, truth: TruthState) -> None:
        """Add a true state."""
        cells = state_cells(truth)
        self._sha.update(
            _PACK(
                truth.stamp_ns,
                truth.object_id,
                *(np.nan if cell is None else cell for cell in cells),
            )
        )
        self.num_rows += 1

    def as_meta(self) -> dict[str, object]:
        """Return the entry `truth` of meta.json."""
        return {"rows": self.num_rows, "sha256": self._sha.hexdigest()}


class RecordedTruth(MadeColumns):
    """Table `truth` of a run, which is read from its recording at first use.

    Runs of the same recording share the columns. Raises `DataError` where the recording
    is missing, or has other true states than in the replay.
    """

    def __init__(
        self,
        folder: Path,
        recording: Path | None,
        meta: Mapping[str, Any],
        origin: Callable[[], Origin | None],
    ) -> None:
        super().__init__(COLUMNS["truth"])
        self._folder = folder
        self._recording = recording
        self._given = str((meta.get("input") or {}).get("path", "its recording"))
        self._num_rows = int(meta["truth"]["rows"])
        self._sha256 = str(meta["truth"]["sha256"])
        self._origin = origin
        self._shared: Columns | None = None

    @property
    def num_rows(self) -> int:
        """Length of every column."""
        return self._num_rows

    def _made(self, name: str) -> Column:
        if self._shared is None:
            self._shared = self._read()
        return self._shared[name]

    def _read(self) -> Columns:
        """Return the columns, after a comparison of their hash with the hash of the replay."""
        if self._recording is None:
            raise DataError(
                f"{self._folder}: its truth is in {self._given}, which is missing: "
                "restore the recording, or repeat the run with --truth copy"
            )
        key = (self._recording, self._sha256)
        if (known := _READ.get(key)) is not None:
            return known
        for read in (self._fast_rows, self._validated_rows):
            try:
                table = _FileOfTruth(read(self._recording), self._num_rows)
            except (TypeError, ValueError):  # a value that the reader must convert
                continue
            if table.sha256 == self._sha256:
                _READ[key] = table
                return table
        raise DataError(
            f"{self._folder}: its truth is in {self._recording}, which has changed since the replay: "
            "restore the recording, or repeat the run"
        )

    def _fast_rows(self, path: Path) -> Iterator[Row]:
        for record in read_truth_records(path):
            if not record.get("ignored"):
                yield tuple(map(record.get, self._names))

    def _validated_rows(self, path: Path) -> Iterator[Row]:
        for message in read_stream(path, LocalPlane(self._origin())):
            if isinstance(message, TruthState) and not message.ignored:
                yield (message.stamp_ns, message.object_id, *state_cells(message))


#: Tables in use by recording and hash.
_READ: WeakValueDictionary[tuple[Path, str], Columns] = WeakValueDictionary()


class _FileOfTruth(MadeColumns):
    """The first `num_rows` true states in a temporary file, column after column, and their SHA-256.

    To parse an hour again for each use would take minutes, and to keep it takes 250 MB.
    """

    def __init__(self, rows: Iterable[Row], num_rows: int) -> None:
        super().__init__(COLUMNS["truth"])
        self._num_rows = num_rows
        self._file = TemporaryFile()  # noqa: SIM115
        sha = hashlib.sha256()
        first = 0
        left = islice(rows, num_rows)
        while block := list(islice(left, _BLOCK_ROWS)):
            cells = np.array(block, dtype=_TYPE)
            sha.update(cells.tobytes())
            for name in self._names:
                self._file.seek(self._position(name) + first * _CELL_BYTES)
                self._file.write(cells[name].tobytes())
            first += len(block)
        self.sha256 = sha.hexdigest()
        finalize(self, self._file.close)
        if num_rows * _CELL_BYTES <= KEPT_BYTES:
            dict(self)  # short columns stay in memory, so many runs need no open files
            self._file.close()

    @property
    def num_rows(self) -> int:
        """Length of every column."""
        return self._num_rows

    def _made(self, name: str) -> Column:
        self._file.seek(self._position(name))
        values = np.fromfile(self._file, _TYPE[name], self._num_rows)
        return column(name, values)

    def _position(self, name: str) -> int:
        """Return the first byte of a column in the file."""
        return self._names.index(name) * self._num_rows * _CELL_BYTES

"""Rows of arrays that hold one track each."""

from collections.abc import Iterable
from typing import ClassVar

import numpy as np

from fgtrack.core.state import Stateful
from fgtrack.core.types import IntArray

FEWEST = 8
"""Rows that arrays begin with."""


class TrackRows(Stateful):
    """Row of each track in arrays. A new track takes the row of a track that has ended, or else the next row.

    The owner makes its arrays longer than `following` before it calls `begin`.
    """

    STATE: ClassVar[tuple[str, ...]] = ("by_id", "_free", "_ids", "_rows", "_every")

    def __init__(self) -> None:
        self.by_id: dict[int, int] = {}
        """Row of each track, by track id in order of birth."""
        self._free: list[int] = []
        self._ids: tuple[int, ...] | None = None  # of the last call of `of`
        self._rows = np.zeros(0, dtype=np.int64)
        self._every: IntArray | None = None

    @property
    def following(self) -> int:
        """Row that the next track takes."""
        return self._free[-1] if self._free else len(self.by_id)

    @property
    def every(self) -> IntArray:
        """Rows of all tracks in order of birth, shape (m,). The array is not to be changed."""
        if self._every is None:
            self._every = np.array([*self.by_id.values()], dtype=np.int64)
        return self._every

    def of(self, track_ids: Iterable[int]) -> IntArray:
        """Return the rows of tracks, shape (m,). The rows of the last call are kept for the same tracks."""
        ids = tuple(track_ids)
        if ids != self._ids:
            rows = np.array([*map(self.by_id.__getitem__, ids)], dtype=np.int64)
            self._ids, self._rows = ids, rows
        return self._rows

    def begin(self, track_id: int) -> int:
        """Return the row of a new track."""
        row = self.following
        self._ids = self._every = None
        self.by_id[track_id] = row
        if self._free:
            self._free.pop()
        return row

    def end(self, track_id: int) -> int | None:
        """Free the row of a track, and return it; None for a track without one."""
        row = self.by_id.pop(track_id, None)
        if row is None:
            return None
        self._ids = self._every = None
        if row not in self._free:  # its beginning was interrupted
            self._free.append(row)
        return row

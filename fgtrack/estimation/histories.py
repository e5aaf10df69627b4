"""What has been fused of many tracks, in the order of the stamps: places in arrays, not lists for each track."""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fgtrack.core.types import IntArray

NEVER_NS = int(np.iinfo(np.int64).max)
_FEW_TRACKS, _FEW_PLACES = 4, 4  # most tracks of a cluttered list have one entry, and end with it

_Scalar = TypeVar("_Scalar", bound=np.generic)


def grown(values: npt.NDArray[_Scalar], size: int) -> npt.NDArray[_Scalar]:
    """A copy of `values` with zeros behind them, `size` rows in all."""
    found = np.zeros((size, *values.shape[1:]), values.dtype)
    found[: len(values)] = values
    return found


def _numbered(first: int, tracks: int, places: int) -> IntArray:
    """Numbers from `first` on, shape (tracks, places). Those of one place are neighbours: what is kept of places that
    no track has reached takes no memory.
    """
    return np.ascontiguousarray(first + np.arange(tracks * places).reshape(places, tracks).T)


class Histories:
    """A row of places for each track, in order of stamps, and the number under which the values of each are kept.

    An entry keeps its number as long as it lives, so that an insertion moves no values.

    Parameters
    ----------
    places
        Of each track, at first.
    """

    def __init__(self, places: int = _FEW_PLACES) -> None:
        shape = _FEW_TRACKS, places
        self.stamps_ns: IntArray = np.full(shape, NEVER_NS)
        """Shape (tracks, places); `NEVER_NS` from `count` on."""
        self.numbers: IntArray = _numbered(0, *shape)
        """Shape (tracks, places); those from `count` on are free."""
        self.count: IntArray = np.zeros(_FEW_TRACKS, dtype=np.int64)
        """Number of entries of each track."""

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return self.numbers.size

    def fitted(self, values: npt.NDArray[_Scalar]) -> npt.NDArray[_Scalar]:
        """A copy of `values` by number with room for all numbers; only what belongs to entries is kept, and only the
        pages of that are made.
        """
        found = np.zeros((self.size, *values.shape[1:]), values.dtype)
        kept = self.numbers[np.arange(self.numbers.shape[1]) < self.count[:, None]]
        kept = kept[kept < len(values)]
        found[kept] = values[kept]
        return found

    def at(self, tracks: IntArray, places: IntArray) -> IntArray:
        """Numbers of the entries at `places`; both of one shape."""
        return self.numbers[tracks, places]

    def place_before(self, tracks: IntArray, stamps_ns: IntArray) -> IntArray:
        """Place of the newest entry at or before `stamps_ns`, of each track; -1 where all are after it."""
        if len(tracks) == 1:
            return np.asarray(self.stamps_ns[tracks[0]].searchsorted(stamps_ns, side="right") - 1)
        return np.asarray((self.stamps_ns[tracks] <= stamps_ns[:, None]).sum(axis=1) - 1)

    def begin(self, track: int, stamp_ns: int) -> int:
        """Forget all of `track`, and let it begin with one entry; its number."""
        while track >= len(self.count):
            self._grow_tracks()
        self.stamps_ns[track] = NEVER_NS
        self.stamps_ns[track, 0] = stamp_ns
        self.count[track] = 1
        return int(self.numbers[track, 0])

    def make_room(self, tracks: IntArray) -> None:
        """Make room for one more entry of each of `tracks`."""
        if self.count[tracks].max(initial=0) >= self.stamps_ns.shape[1]:
            self._grow_places()

    def reserve(self, tracks: IntArray) -> IntArray:
        """`make_room`; the numbers that `insert` will give the entries."""
        self.make_room(tracks)
        return self.numbers[tracks, self.count[tracks]]

    def insert(self, tracks: IntArray, places: IntArray, stamp_ns: int) -> IntArray:
        """New entries at `places`, one for each of `tracks`, under the numbers of `reserve`; later ones move up."""
        count = self.count[tracks]
        numbers = self.numbers[tracks, count]
        if (places < count).any():
            columns = np.arange(int(places.min()), int(count.max()) + 1)
            moved = (columns > places[:, None]) & (columns <= count[:, None])
            rows, source = tracks[:, None], columns - moved
            for values in (self.stamps_ns, self.numbers):
                values[rows, columns] = values[rows, source]
        self.stamps_ns[tracks, places], self.numbers[tracks, places] = stamp_ns, numbers
        self.count[tracks] = count + 1
        return numbers

    def drop(self, tracks: IntArray, many: IntArray) -> None:
        """Forget so `many` of the oldest entries of each of `tracks`."""
        columns = np.arange(self.stamps_ns.shape[1])
        source = (columns + many[:, None]) % len(columns)
        left = columns < (self.count[tracks] - many)[:, None]
        self.stamps_ns[tracks] = np.where(left, np.take_along_axis(self.stamps_ns[tracks], source, axis=1), NEVER_NS)
        self.numbers[tracks] = np.take_along_axis(self.numbers[tracks], source, axis=1)
        self.count[tracks] -= many

    def _grow_tracks(self) -> None:
        size, (tracks, places) = self.size, self.stamps_ns.shape
        self.stamps_ns = np.concatenate([self.stamps_ns, np.full((tracks, places), NEVER_NS)])
        self.numbers = np.concatenate([self.numbers, _numbered(size, tracks, places)])
        self.count = grown(self.count, 2 * tracks)

    def _grow_places(self) -> None:
        size, (tracks, places) = self.size, self.stamps_ns.shape
        self.stamps_ns = np.concatenate([self.stamps_ns, np.full((tracks, places), NEVER_NS)], axis=1)
        self.numbers = np.concatenate([self.numbers, _numbered(size, tracks, places)], axis=1)

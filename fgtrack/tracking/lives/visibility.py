"""Existence of objects and their visibility to each sensor: evidence of lists in arrays.

An object does not exist, or exists and is visible to a sensor, or exists and is not: integrated probabilistic data
association with an observability state (Musicki, Evans, Stankovic, IEEE Trans. Automatic Control 39, 1994; Musicki,
Evans, IEEE T-AES 40, 2004). Given that it exists, its visibility to a sensor is a Markov chain in continuous time,
observed by the lists of that sensor alone, so the joint probability is the product of existence and visibilities.
"""

from typing import ClassVar

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.state import Stateful
from fgtrack.core.types import FloatArray, IntArray

#: Bounds of log-odds: a probability that differs from 0 or 1 by less adds nothing.
LARGEST_LOG_ODDS = 30.0
#: Columns of an evidence: likelihood ratio if visible (NaN out of view), then, after it, log-odds of existence and the
#: probabilities of being visible to each sensor, given that the object exists.
RATIO, LOG_ODDS, VISIBLE = range(3)
#: Its stamp and sensor, and after it the newest stamp at which each sensor could show the object.
STAMP, SENSOR, VIEWED = range(3)
NEVER = -(2**62)
_FEWEST_TRACKS, _FEWEST_ENTRIES = 8, 32
_KERNELS = "fgtrack.tracking.lives.visibility_kernels"


class Histories(Stateful):
    """Evidence of all tracks by stamp, and the probabilities after each entry. Neither depends on the order of
    arrival.

    Entry 0 of a track is its birth, or summarises all evidence that is older than the remembered evidence.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "numbers",
        "entries",
        "counts",
    )

    def __init__(
        self,
        num_sensors: int,
        lifetime_s: float,
        visible_share: float,
        visible_s: float,
    ) -> None:
        """Prepare empty histories.

        `lifetime_s` is the mean time for which objects exist. `visible_share` is the share of this time for which they
        are visible to a sensor. `visible_s` is the time constant of the visibility.
        """
        self._chain = lifetime_s, visible_share, visible_s
        self.numbers: FloatArray = np.zeros(
            (_FEWEST_TRACKS, _FEWEST_ENTRIES, VISIBLE + num_sensors)
        )
        self.entries: IntArray = np.zeros(
            (_FEWEST_TRACKS, _FEWEST_ENTRIES, VIEWED + num_sensors), dtype=np.int64
        )
        """See `RATIO` and `STAMP`, shape (tracks, entries, columns)."""
        self.counts = np.zeros(_FEWEST_TRACKS, dtype=np.int64)
        """Number of entries of each track, 0 of a free row."""

    def begin(self, row: int, stamp_ns: int, sensor: int, log_odds: float) -> None:
        """Begin a track in a `row` with the log-odds of its existence. The object is visible to the `sensor`."""
        while row >= len(self.counts):
            self._grow(axis=0)
        numbers, entries = self.numbers[row, 0], self.entries[row, 0]
        numbers[:], entries[:] = 0.0, NEVER
        numbers[LOG_ODDS], numbers[VISIBLE + sensor] = (
            min(max(log_odds, -LARGEST_LOG_ODDS), LARGEST_LOG_ODDS),
            1.0,
        )
        entries[STAMP] = entries[VIEWED + sensor] = stamp_ns
        self.counts[row] = 1

    def learn(
        self, rows: IntArray, stamps_ns: IntArray, sensors: IntArray, ratios: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Add evidence of lists at `stamps_ns` (m,) of `sensors` (m,) on the tracks in `rows` (m,), in this order; see
        `RATIO`.

        Evidence older than all remembered evidence counts at the oldest stamp. Returns two probabilities after each
        addition, shape (m,): that the object is visible to the sensor, and that it exists. The second is the largest
        probability at the stamp of the evidence and at newer stamps.
        """
        while (
            len(rows)
            and self.counts[rows].max() + np.bincount(rows).max()
            > self.numbers.shape[1]
        ):
            self._grow(axis=1)
        history = self.numbers, self.entries, self.counts, *self._chain
        visible, exists = kernels(_KERNELS).learn(
            rows, stamps_ns, sensors, ratios, *history
        )
        return visible, exists

    @property
    def arrays(self) -> tuple[FloatArray, IntArray, IntArray, float]:
        """Last arguments of `fgtrack.tracking.lives.visibility_kernels.existing_at`."""
        return self.numbers, self.entries, self.counts, self._chain[0]

    def present(self, rows: IntArray, stamps_ns: IntArray | int) -> FloatArray:
        """Return the probabilities (m,) that the objects exist at `stamps_ns`, or at newer evidence."""
        return self._existing(rows, stamps_ns, is_known=False)

    def known(self, rows: IntArray, stamps_ns: IntArray | int) -> FloatArray:
        """Return the probabilities (m,) that the objects exist at `stamps_ns`, from the evidence up to these stamps."""
        return self._existing(rows, stamps_ns, is_known=True)

    def _existing(
        self, rows: IntArray, stamps_ns: IntArray | int, is_known: bool
    ) -> FloatArray:
        own_ns = np.array(np.broadcast_to(stamps_ns, rows.shape), dtype=np.int64)
        found = kernels(_KERNELS).existing(rows, own_ns, is_known, *self.arrays)
        return np.asarray(found)

    def forget(self, oldest_ns: int) -> None:
        """Summarise evidence older than `oldest_ns` by the probabilities that follow from it."""
        kernels(_KERNELS).forget(oldest_ns, self.numbers, self.entries, self.counts)

    def end(self, row: int) -> None:
        """Forget the track in a `row`."""
        self.counts[row] = 0

    def _grow(self, axis: int) -> None:
        """Double the number of tracks, or of entries of each track. All arrays are allocated before one is replaced."""
        rows, columns = shape = [*self.numbers.shape[:2]]
        shape[axis] *= 2
        numbers = np.zeros((*shape, self.numbers.shape[2]))
        entries = np.zeros((*shape, self.entries.shape[2]), dtype=np.int64)
        counts = np.zeros(shape[0], dtype=np.int64)
        numbers[:rows, :columns], entries[:rows, :columns], counts[:rows] = (
            self.numbers,
            self.entries,
            self.counts,
        )
        self.numbers, self.entries, self.counts = numbers, entries, counts

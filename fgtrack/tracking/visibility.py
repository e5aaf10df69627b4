"""Existence of objects and their visibility to each sensor: evidence of lists in arrays, and what a sensor shows where.

An object does not exist, or exists and is visible to a sensor, or exists and is not: integrated probabilistic data
association with an observability state (Musicki, Evans, Stankovic, IEEE Trans. Automatic Control 39, 1994; Musicki,
Evans, IEEE T-AES 40, 2004). Given that it exists, its visibility to a sensor is a Markov chain in continuous time of
which only the lists of that sensor tell, so the joint probability is the product of existence and visibilities.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray

#: Bounds of log-odds: a probability that differs from 0 or 1 by less adds nothing.
LARGEST_LOG_ODDS = 30.0
#: Columns of an evidence: share of visible objects there and likelihood ratio if visible (NaN out of view), then, after
#: it, log-odds of existence and the probabilities of being visible to each sensor, given that the object exists.
SHARE, RATIO, LOG_ODDS, VISIBLE = range(4)
#: Its stamp, sensor and cell, and after it the newest stamp at which each sensor could show the object.
STAMP, SENSOR, CELL, VIEWED = range(4)
NEVER = -(2**62)
_FEWEST_TRACKS, _FEWEST_ENTRIES = 8, 32
_KERNELS = "fgtrack.tracking.visibility_kernels"


class Looks(NamedTuple):
    """Evidence that no late list changes any more, m entries."""

    rows: IntArray
    """Rows of the tracks."""
    stamps_ns: IntArray
    sensors: IntArray
    cells: IntArray
    shown: BoolArray
    """True where the list has shown the object."""
    weights: FloatArray
    """Probability that it existed, times the share of an independent look: those in a row show the same."""


class Histories:
    """Evidence of all tracks in order of its stamps, and the probabilities after each, whatever the order of arrival.
    Entry 0 of a track is its birth, or all that is older than what is remembered.
    """

    def __init__(self, num_sensors: int, lifetime_s: float, visible_s: float) -> None:
        """`lifetime_s`: mean time for which objects exist; `visible_s`: time constant of the visibility to a sensor."""
        self._times_s = lifetime_s, visible_s
        self.numbers = np.zeros((_FEWEST_TRACKS, _FEWEST_ENTRIES, VISIBLE + num_sensors))
        self.entries = np.zeros((_FEWEST_TRACKS, _FEWEST_ENTRIES, VIEWED + num_sensors), dtype=np.int64)
        """See `SHARE` and `STAMP`, shape (tracks, entries, columns)."""
        self.counts = np.zeros(_FEWEST_TRACKS, dtype=np.int64)
        """Number of entries of each track, 0 of a free row."""

    def begin(self, stamp_ns: int, sensor: int, log_odds: float) -> int:
        """Return the row of a new track with these log-odds, visible to the `sensor` that started it."""
        if self.counts.all():
            self.counts = np.concatenate([self.counts, np.zeros_like(self.counts)])
            self._grow(axis=0)
        row = int(np.argmin(self.counts))
        numbers, entries = self.numbers[row, 0], self.entries[row, 0]
        numbers[:], entries[:] = 0.0, NEVER
        numbers[LOG_ODDS], numbers[VISIBLE + sensor] = min(max(log_odds, -LARGEST_LOG_ODDS), LARGEST_LOG_ODDS), 1.0
        entries[STAMP] = entries[VIEWED + sensor] = stamp_ns
        self.counts[row] = 1
        return row

    def learn(
        self, rows: IntArray, stamp_ns: int, sensor: int, shares: FloatArray, ratios: FloatArray, cells: IntArray
    ) -> None:
        """Add the evidence of a list of `sensor` on the tracks in `rows`, all (m,); see `SHARE`.
        What is older than all that is remembered counts as the oldest.
        """
        if len(rows) and self.counts[rows].max() == self.numbers.shape[1]:
            self._grow(axis=1)
        history = self.numbers, self.entries, self.counts, *self._times_s
        kernels(_KERNELS).learn(rows, stamp_ns, sensor, shares, ratios, cells, *history)

    def present(self, rows: IntArray, present_ns: int) -> FloatArray:
        """Return the probabilities that the objects exist at `present_ns`, not before their newest evidence, (m,)."""
        history = self.numbers, self.entries, self.counts, self._times_s[0]
        return np.asarray(kernels(_KERNELS).present(rows, present_ns, *history))

    def last(self, rows: IntArray) -> tuple[FloatArray, IntArray]:
        """Return the visibilities to each sensor and when each could show the objects last, shapes (m, sensors)."""
        last = self.counts[rows] - 1
        return self.numbers[rows, last, VISIBLE:], self.entries[rows, last, VIEWED:]

    def forget(self, oldest_ns: int) -> Looks:
        """Remember what is older than `oldest_ns` by its outcome alone, and return it."""
        return Looks(*kernels(_KERNELS).forget(oldest_ns, self.numbers, self.entries, self.counts, self._times_s[1]))

    def end(self, row: int) -> Looks:
        """Free the `row` of a track and return its evidence."""
        one = slice(row, row + 1)
        history = self.numbers[one], self.entries[one], self.counts[one]
        looks = kernels(_KERNELS).forget(-NEVER, *history, self._times_s[1])
        self.counts[row] = 0
        return Looks(*looks)._replace(rows=np.full(len(looks[0]), row))

    def _grow(self, axis: int) -> None:
        self.numbers = np.concatenate([self.numbers, np.zeros_like(self.numbers)], axis=axis)
        self.entries = np.concatenate([self.entries, np.zeros_like(self.entries)], axis=axis)


class DetectionShares:
    """Share of the lists of each sensor that show an object, by range and bearing, learned from tracks.
    A cell counts looks with and without a detection; with a Beta prior, which is the share of its ring at any bearing,
    whose prior is the same everywhere. The counts are forgotten slowly. A list is judged by what had left the memory of
    evidence when its epoch of `memory_ns` began, which no late list changes: the order of arrival does not matter.
    """

    FORGET_S = 300.0
    """Time constant of forgetting."""
    PRIOR_LOOKS = 2.0
    """Independent looks that a prior is worth."""
    FIRST_RING_M, NUM_RINGS, NUM_SECTORS = 10.0, 16, 8
    """Up to the first ring bearings are as one; each further ring is sqrt(2) times as large: up to 1.8 km."""

    def __init__(self, memory_ns: int, priors: Sequence[float]) -> None:
        """`priors`: the share of each sensor where nothing is known."""
        self._memory_ns, self._priors = memory_ns, priors
        self._empty = np.zeros((len(priors), 2, self.NUM_RINGS, self.NUM_SECTORS))
        self._keep = math.exp(-memory_ns / NS_PER_S / self.FORGET_S)
        self._counts: dict[int, FloatArray] = {}  # looks without and with a detection, by epoch of their stamps
        self._known: dict[int, FloatArray] = {}  # sums of counts that lists of an epoch are judged by
        self._last = [(self._empty, self._empty)] * len(priors)  # such sums, and the shares by them, by sensor

    def cells(self, range_m: FloatArray, bearing_rad: FloatArray) -> IntArray:
        """Return the cells at these ranges and bearings from a sensor, shapes (m,)."""
        ring = np.floor(2.0 * np.log2(np.maximum(range_m, 1e-3) / self.FIRST_RING_M)) + 1.0
        sector = np.floor((bearing_rad / math.tau) % 1.0 * self.NUM_SECTORS)
        ring = np.clip(ring, 0.0, self.NUM_RINGS - 1.0)
        return np.asarray(ring * self.NUM_SECTORS + np.minimum(sector, self.NUM_SECTORS - 1.0), dtype=np.int64)

    def at(self, sensor: int, stamp_ns: int, cells: IntArray) -> FloatArray:
        """Return the shares of a list of `sensor` in `cells`, shapes (m,)."""
        counts = self._judging(stamp_ns // self._memory_ns)
        known, shares = self._last[sensor]
        if known is not counts:
            (missed, shown), weight = counts[sensor], self.PRIOR_LOOKS
            ring = (shown.sum(axis=1) + weight * self._priors[sensor]) / ((shown + missed).sum(axis=1) + weight)
            shares = ((shown + weight * ring[:, None]) / (shown + missed + weight)).ravel()
            self._last[sensor] = counts, shares
        return np.asarray(shares[cells])

    def learn(self, looks: Looks) -> None:
        """Count `looks`."""
        epochs = looks.stamps_ns // self._memory_ns
        for epoch in np.unique(epochs).tolist():
            counts = self._counts.setdefault(epoch, self._empty.copy())
            m = epochs == epoch
            ring, sector = np.divmod(looks.cells[m], self.NUM_SECTORS)
            np.add.at(counts, (looks.sensors[m], looks.shown[m].astype(np.int64), ring, sector), looks.weights[m])

    def _judging(self, epoch: int) -> FloatArray:
        """Return the sums of all counts that had left the memory when `epoch` began."""
        if epoch not in self._known:
            newest = max(self._known, default=epoch)
            if epoch < newest:
                return self._known[min(self._known)]
            sums = self._known.get(newest, self._empty) * self._keep ** (epoch - newest)
            for old in sorted(each for each in self._counts if each <= epoch - 2):
                sums = sums + self._counts.pop(old) * self._keep ** (epoch - 2 - old)
            self._known[epoch] = sums
            self._known = dict(sorted(self._known.items())[-3:])
        return self._known[epoch]

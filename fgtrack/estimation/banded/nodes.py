"""The nodes of all windows in arrays: which stamps they have, in which order, and where the values of each are kept.

Each track has a row of places in the order of the stamps, and a row of slots; a node keeps its slot as long as it
lives, so that an insertion moves no values. The first `first` places hold nodes that have left the window and are kept
for detections that are older (see `ring`); those from there up to `count` are the window.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.terms import MeasurementTerm

_NEVER_NS = np.iinfo(np.int64).max
_FEW_TRACKS, _FEW_NODES, _FEW_COMPONENTS = 4, 16, 4


class Place(NamedTuple):
    """Nodes of the tracks `tracks` at `slots`, both of one shape."""

    tracks: IntArray
    slots: IntArray


class Nodes:
    """Arrays of shape (tracks, slots, ...) with what is known of each node, and (tracks, places) with their order.

    Parameters
    ----------
    n
        Length of a state.
    """

    _ORDER = ("stamps_ns", "slots")
    _VALUES = (
        *("origin", "ahead", "F", "Q", "G", "y", "num_rows"),
        *("predicted", "P_predicted", "filtered", "P_filtered"),
        *("A", "b", "C", "step", "P"),
    )
    _TRACKS = ("first", "count")

    def __init__(self, n: int) -> None:
        self.dim = n
        shape = _FEW_TRACKS, _FEW_NODES
        self.stamps_ns: IntArray = np.full(shape, _NEVER_NS)
        self.slots: IntArray = np.tile(np.arange(_FEW_NODES), (_FEW_TRACKS, 1))
        self.first: IntArray = np.zeros(_FEW_TRACKS, dtype=np.int64)
        """Place of the oldest node of the window."""
        self.count: IntArray = np.zeros(_FEW_TRACKS, dtype=np.int64)
        """Number of nodes, with those behind the window."""
        k = _FEW_COMPONENTS
        self.origin = np.zeros((*shape, n))
        """Linearisation points x0."""
        self.ahead = np.zeros((*shape, n))
        """f(x0) at the next node."""
        self.F = np.zeros((*shape, n, n))
        self.Q = np.zeros((*shape, n, n))
        """Derivative of f at x0, and noise, up to the next node."""
        self.G = np.zeros((*shape, k, n))
        self.y = np.zeros((*shape, k))
        """What is measured, y = G (x - x0) + N(0, I); unused rows are 0."""
        self.num_rows: IntArray = np.zeros(shape, dtype=np.int64)
        """Used rows of G."""
        self.predicted, self.filtered, self.b, self.step = (np.zeros((*shape, n)) for _ in range(4))
        self.P_predicted, self.P_filtered, self.A, self.C, self.P = (np.zeros((*shape, n, n)) for _ in range(5))
        """Means relative to x0, and covariances: before and after the node's own measurements, given the next node
        (x - x0 = A (next - its x0) + b + N(0, C)), and given everything (`step`, `P`)."""
        self.terms: list[list[list[MeasurementTerm]]] = [[[] for _ in range(_FEW_NODES)] for _ in range(_FEW_TRACKS)]
        """What is measured at each node, by track and slot."""

    def at(self, tracks: IntArray, places: IntArray) -> Place:
        """Where the nodes at `places` are kept; both of one shape."""
        return Place(tracks, self.slots[tracks, places])

    def place_before(self, tracks: IntArray, stamps_ns: IntArray) -> IntArray:
        """Place of the newest node at or before `stamps_ns`, of each track; -1 where all are after it."""
        return np.asarray((self.stamps_ns[tracks] <= stamps_ns[:, None]).sum(axis=1) - 1)

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """The first node of a new track."""
        while track >= len(self.first):
            self._grow_tracks()
        self.stamps_ns[track] = _NEVER_NS
        self.stamps_ns[track, 0] = stamp_ns
        self.first[track], self.count[track] = 0, 1
        self._empty(np.array([track]), self.slots[track, :1])
        at = track, self.slots[track, 0]
        self.origin[at] = mean
        self.P_predicted[at] = self.P_filtered[at] = self.P[at] = covariance

    def insert(self, tracks: IntArray, places: IntArray, stamps_ns: IntArray, origins: FloatArray) -> None:
        """New nodes at `places`, one for each of `tracks`; those from there on move up."""
        if (self.count[tracks] >= self.stamps_ns.shape[1]).any():
            self._grow_nodes()
        columns = np.arange(self.stamps_ns.shape[1])
        count, place = self.count[tracks, None], places[:, None]
        moved = (columns > place) & (columns <= count)
        source = np.where(moved, columns - 1, columns)
        source[np.arange(len(tracks)), places] = self.count[tracks]
        self._reorder(tracks, source)
        self.stamps_ns[tracks, places] = stamps_ns
        self.count[tracks] += 1
        slots = self.slots[tracks, places]
        self._empty(tracks, slots)
        self.origin[tracks, slots] = origins

    def drop(self, tracks: IntArray, numbers: IntArray) -> None:
        """Forget the oldest `numbers` nodes of each of `tracks`."""
        capacity = self.stamps_ns.shape[1]
        columns = np.arange(capacity)
        for track, number in zip(tracks.tolist(), numbers.tolist(), strict=True):
            self.stamps_ns[track, :number] = _NEVER_NS
        self._reorder(tracks, (columns + numbers[:, None]) % capacity)
        self.first[tracks] -= numbers
        self.count[tracks] -= numbers

    def measure(self, place: Place, G: FloatArray, y: FloatArray) -> None:
        """Measurements y (m, k) with G (m, k, n) at m nodes, beside those that are there."""
        used, k = self.num_rows[place], y.shape[-1]
        while used.max(initial=0) + k > self.y.shape[-1]:
            self._grow_rows()
        rows = used[:, None] + np.arange(k)
        self.G[place.tracks[:, None], place.slots[:, None], rows] = G
        self.y[place.tracks[:, None], place.slots[:, None], rows] = y
        self.num_rows[place] = used + k

    def snapshot(self, tracks: IntArray) -> tuple[IntArray, ...]:
        """The order of the nodes of `tracks`, for `restore`."""
        return tuple(getattr(self, name)[tracks].copy() for name in (*self._ORDER, *self._TRACKS))

    def restore(self, tracks: IntArray, saved: Sequence[IntArray]) -> None:
        """Go back to the order of `snapshot`; the values of nodes that were new are lost."""
        for name, values in zip((*self._ORDER, *self._TRACKS), saved, strict=True):
            getattr(self, name)[tracks] = values

    def live(self, tracks: IntArray) -> tuple[IntArray, BoolArray]:
        """Places of the nodes in the windows of `tracks`, shape (m, longest), and which of them exist."""
        places = self.first[tracks, None] + np.arange(int((self.count - self.first)[tracks].max(initial=0)))
        inside = places < self.count[tracks, None]
        return np.where(inside, places, self.first[tracks, None]), inside

    def _reorder(self, tracks: IntArray, source: IntArray) -> None:
        for name in self._ORDER:
            values = getattr(self, name)
            values[tracks] = np.take_along_axis(values[tracks], source, axis=1)

    def _empty(self, tracks: IntArray, slots: IntArray) -> None:
        at = tracks, slots
        self.num_rows[at] = 0
        for values in (self.G, self.y, self.predicted, self.filtered, self.b, self.step):
            values[at] = 0.0
        for track, slot in zip(tracks.tolist(), slots.tolist(), strict=True):
            self.terms[track][slot] = []

    def _grow_tracks(self) -> None:
        tracks, nodes = self.stamps_ns.shape
        for name in (*self._ORDER, *self._TRACKS, *self._VALUES):
            values = getattr(self, name)
            setattr(self, name, np.concatenate([values, np.zeros_like(values)]))
        self.stamps_ns[tracks:] = _NEVER_NS
        self.slots[tracks:] = np.arange(nodes)
        self.terms += [[[] for _ in range(nodes)] for _ in range(tracks)]

    def _grow_nodes(self) -> None:
        nodes = self.stamps_ns.shape[1]
        for name in (*self._ORDER, *self._VALUES):
            values = getattr(self, name)
            setattr(self, name, np.concatenate([values, np.zeros_like(values)], axis=1))
        self.stamps_ns[:, nodes:] = _NEVER_NS
        self.slots[:, nodes:] = np.arange(nodes, 2 * nodes)
        for row in self.terms:
            row += [[] for _ in range(nodes)]

    def _grow_rows(self) -> None:
        self.G = np.concatenate([self.G, np.zeros_like(self.G)], axis=2)
        self.y = np.concatenate([self.y, np.zeros_like(self.y)], axis=2)

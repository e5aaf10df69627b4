"""The nodes of all windows in arrays: which stamps they have, in which order, and where the values of each are kept.

Each track has a row of places in the order of the stamps, and what is known of the node at a place is kept under its
number; a node keeps its number as long as it lives, so that an insertion moves no values. The first `first` places hold
nodes that have left the window and are kept for detections that are older (see `ring`); those from there up to `count`
are the window.
"""

from collections.abc import Sequence

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.histories import Histories, grown
from fgtrack.estimation.terms import MeasurementTerm
from fgtrack.estimation.whitening import whitened

_FEW_NODES, _FEW_COMPONENTS = 16, 4
_NEAR = 12  # so many of the newest nodes are looked at first


class Nodes(Histories):
    """Arrays of shape (tracks, places) with the order of the nodes, and (nodes, ...) with what is known of each.

    Vectors stand as a last column beside the matrix that moves with them: [F | Q | f(x0)], [P | x], [A | b].

    Parameters
    ----------
    n
        Length of a state.
    """

    _ORDER = ("stamps_ns", "numbers")
    _TRACKS = ("first", "count")
    _VALUES = (
        *("origin", "segment", "rows", "num_rows", "predicted", "filtered", "back", "C"),
        *("leap", "leap_C", "limit", "limit_at", "step", "P", "far"),
    )

    def __init__(self, n: int) -> None:
        super().__init__(_FEW_NODES)
        self.dim, size = n, self.size
        self.first: IntArray = np.zeros_like(self.count)
        """Place of the oldest node of the window."""
        self.origin = np.zeros((size, n))
        """Linearisation points x0."""
        self.segment = np.zeros((size, n, 2 * n + 1))
        """Up to the next node: F, the derivative of f at x0, the noise Q, and f(x0)."""
        self.rows = np.zeros((size, _FEW_COMPONENTS, n + 1))
        """What is measured: G and y of y = G (x - x0) + N(0, I); unused rows are 0."""
        self.num_rows: IntArray = np.zeros(size, dtype=np.int64)
        """How many of `rows` are used."""
        self.predicted, self.filtered = (np.zeros((size, n, n + 1)) for _ in range(2))
        """Covariances and means relative to x0, before and after the node's own measurements."""
        self.back, self.C = np.zeros((size, n, n + 1)), np.zeros((size, n, n))
        """The node given the next one: x - x0 = A (next - its x0) + b + N(0, C); A and b."""
        self.leap, self.leap_C = np.zeros((size, n, n + 1)), np.zeros((size, n, n))
        """The same given the end of its block, see `Blocks`."""
        self.limit, self.limit_at = np.zeros((size, n, n)), np.zeros((size, n))
        """Of the end of a block, see `Blocks`."""
        self.step, self.P = np.zeros((size, n)), np.zeros((size, n, n))
        """Mean relative to x0, and covariance, given everything."""
        self.far = np.zeros(size, dtype=bool)
        """Whether `step` is longer than it may be."""
        self.terms: dict[int, list[MeasurementTerm]] = {}
        """What is measured at each node."""

    def place_before(self, tracks: IntArray, stamps_ns: IntArray) -> IntArray:
        """See `Histories.place_before`."""
        if len(tracks) < 2:
            return super().place_before(tracks, stamps_ns)
        count = self.count[tracks]
        low = max(int(count.min()) - _NEAR, 0)
        near = self.stamps_ns[tracks, low : int(count.max())]
        places = (near <= stamps_ns[:, None]).sum(axis=1) + (low - 1)
        if low and (places < low).any():
            return np.asarray((self.stamps_ns[tracks] <= stamps_ns[:, None]).sum(axis=1) - 1)
        return np.asarray(places)

    def last_before(self, tracks: IntArray, places: IntArray, stamps_ns: IntArray) -> IntArray:
        """`place_before`, or the nodes at `places` where these are later; step by step from there."""
        last = self.stamps_ns.shape[1] - 1
        while True:
            after = np.minimum(places + 1, last)
            later = (self.stamps_ns[tracks, after] <= stamps_ns) & (after > places)
            if not later.any():
                return places
            places = places + later

    def begin_window(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """The first node of a new track."""
        number = self.begin(track, stamp_ns)
        self.first[track] = 0
        self._empty(np.array([number]))
        self.origin[number] = mean
        for values in (self.predicted, self.filtered):
            values[number, :, :-1], values[number, :, -1] = covariance, 0.0
        self.P[number], self.step[number] = covariance, 0.0

    def insert_at(self, tracks: IntArray, places: IntArray, stamp_ns: int, origins: FloatArray) -> None:
        """New nodes at `places`, one for each of `tracks`, linearised at `origins` (m, n); later ones move up."""
        self.make_room(tracks)
        numbers = self.insert(tracks, places, stamp_ns)
        self._empty(numbers)
        self.origin[numbers] = origins

    def shift(self, tracks: IntArray, numbers: IntArray, steps: FloatArray) -> None:
        """Move the linearisation points of nodes of `tracks`, one each, by `steps` (m, n): what is relative to them
        follows, measurements as if they were linear.
        """
        n = self.dim
        self.origin[numbers] += steps
        self.predicted[numbers, :, n] -= steps
        self.step[numbers] -= steps
        first = self.first[tracks]
        oldest = (first > 0) & (numbers == self.numbers[tracks, first])
        if oldest.any():  # what is known of the node behind it is relative to its linearisation point
            behind = self.at(tracks[oldest], first[oldest] - 1)
            self.back[behind, :, n] += np.matvec(self.back[behind, :, :n], steps[oldest])
        rows = self.rows[numbers]
        self.rows[numbers, :, n] = rows[..., n] - np.matvec(rows[..., :n], steps)

    def drop(self, tracks: IntArray, many: IntArray) -> None:
        """See `Histories.drop`: nodes behind the windows."""
        super().drop(tracks, many)
        self.first[tracks] -= many

    def measure(self, numbers: IntArray, rows: FloatArray) -> None:
        """Measurements [G | y] (m, k, n + 1) at m nodes, beside those that are there."""
        used, k = self.num_rows[numbers], rows.shape[-2]
        while int(used.max(initial=0)) + k > self.rows.shape[1]:
            self._grow_rows()
        if used.any():
            self.rows[numbers[:, None], used[:, None] + np.arange(k)] = rows
        else:
            self.rows[numbers, :k] = rows
        self.num_rows[numbers] = used + k

    def observe(self, numbers: IntArray, y: FloatArray, H: FloatArray, R: FloatArray, offsets: FloatArray) -> None:
        """`measure` y = H (x - guess) + N(0, R), shapes (m, k), (m, k, n), (m, k, k); guess - x0 is `offsets`, (m, n).

        Raises `numpy.linalg.LinAlgError` for an R that is not positive definite.
        """
        rows = whitened(y, H, R)
        rows[..., -1] += np.matvec(rows[..., :-1], offsets)
        self.measure(numbers, rows)

    def snapshot(self, tracks: IntArray) -> list[IntArray]:
        """The order of the nodes of `tracks`, for `restore` after at most one insertion in each."""
        self.make_room(tracks)
        return [getattr(self, name).take(tracks, axis=0) for name in (*self._ORDER, *self._TRACKS)]

    def restore(self, tracks: IntArray, saved: Sequence[IntArray]) -> None:
        """Go back to the order of `snapshot`; the values of nodes that were new are lost."""
        for name, values in zip((*self._ORDER, *self._TRACKS), saved, strict=True):
            getattr(self, name)[tracks] = values

    def _empty(self, numbers: IntArray) -> None:
        self.num_rows[numbers] = 0
        self.rows[numbers] = 0.0
        self.predicted[numbers, :, -1] = 0.0
        self.far[numbers] = False
        for number in numbers.tolist():
            self.terms[number] = []

    def _grow_tracks(self) -> None:
        super()._grow_tracks()
        self.first = grown(self.first, len(self.count))
        self._fit()

    def _grow_places(self) -> None:
        super()._grow_places()
        self._fit()

    def _fit(self) -> None:
        """As many values as there are numbers."""
        for name in self._VALUES:
            setattr(self, name, self.fitted(getattr(self, name)))

    def _grow_rows(self) -> None:
        self.rows = np.concatenate([self.rows, np.zeros_like(self.rows)], axis=1)

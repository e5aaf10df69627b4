"""The nodes of all windows in arrays: which stamps they have, in which order, and where the values of each are kept.

Each track has a row of places in the order of the stamps, and what is known of the node at a place is kept under its
number; a node keeps its number as long as it lives, so that an insertion moves no values. The first `first` places hold
nodes that have left the window and are kept for detections that are older (see `ring`); those from there up to `count`
are the window.
"""

from collections.abc import Sequence

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.banded import node_kernels
from fgtrack.estimation.histories import Histories, grown
from fgtrack.estimation.terms import MeasurementTerm

_FEW_NODES, _FEW_COMPONENTS = 16, 4


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
        *("step", "P", "far"),
    )

    def __init__(self, n: int) -> None:
        super().__init__(_FEW_NODES)
        self.dim, size = n, self.size
        self.first: IntArray = np.zeros_like(self.count)
        """Place of the oldest node of the window."""
        self.known: IntArray = np.zeros_like(self.count)
        """From this place on `P` is known."""
        self.any_far: BoolArray = np.zeros(len(self.count), dtype=bool)
        """True if a node of the track is marked as `far`."""
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
        self.step, self.P = np.zeros((size, n)), np.zeros((size, n, n))
        """Mean relative to x0, and covariance, given everything."""
        self.far = np.zeros(size, dtype=bool)
        """True if `step` is longer than it may be."""
        self.terms: dict[int, list[MeasurementTerm]] = {}
        """What is measured at each node."""

    def place_before(self, tracks: IntArray, stamps_ns: IntArray) -> IntArray:
        """See `Histories.place_before`."""
        places = np.empty(len(tracks), dtype=np.int64)
        node_kernels.place_before(tracks, stamps_ns, self.stamps_ns, self.count, places)
        return places

    def last_before(self, tracks: IntArray, places: IntArray, stamps_ns: IntArray) -> IntArray:
        """`place_before`, or `places` where these are later."""
        last = np.empty(len(tracks), dtype=np.int64)
        node_kernels.last_before(tracks, places, stamps_ns, self.stamps_ns, self.count, last)
        return last

    def insert(self, tracks: IntArray, places: IntArray, stamp_ns: int) -> IntArray:
        """See `Histories.insert`."""
        numbers = np.empty(len(tracks), dtype=np.int64)
        node_kernels.insert(tracks, places, stamp_ns, self.stamps_ns, self.numbers, self.count, numbers)
        return numbers

    def begin_window(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """The first node of a new track."""
        number = self.begin(track, stamp_ns)
        self.first[track] = self.known[track] = 0
        self.any_far[track] = False
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
        order = self.first, self.numbers
        node_kernels.shift(tracks, numbers, steps, *order, self.origin, self.step, self.predicted, self.back, self.rows)

    def drop(self, tracks: IntArray, many: IntArray) -> None:
        """See `Histories.drop`: nodes behind the windows."""
        super().drop(tracks, many)
        self.first[tracks] -= many
        self.known[tracks] -= many

    def measure(self, numbers: IntArray, rows: FloatArray) -> None:
        """Measurements [G | y] (m, k, n + 1) at m nodes, beside those that are there."""
        used, k = self.num_rows[numbers], rows.shape[-2]
        self._fit_rows(int(used.max(initial=0)) + k)
        self.rows[numbers[:, None], used[:, None] + np.arange(k)] = rows
        self.num_rows[numbers] = used + k

    def observe(self, numbers: IntArray, y: FloatArray, H: FloatArray, R: FloatArray, offsets: FloatArray) -> None:
        """`measure` y = H (x - guess) + N(0, R), shapes (m, k), (m, k, n), (m, k, k); guess - x0 is `offsets`, (m, n).

        Raises `numpy.linalg.LinAlgError` for an R that is not positive definite.
        """
        self._fit_rows(int(self.num_rows[numbers].max(initial=0)) + y.shape[1])
        if not node_kernels.observe(numbers, y, H.copy(), R, offsets, self.rows, self.num_rows):
            raise np.linalg.LinAlgError("a covariance is not positive definite")

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
        size = len(self.count)
        self.first, self.known = grown(self.first, size), grown(self.known, size)
        self.any_far = grown(self.any_far, size)
        self._fit()

    def _grow_places(self) -> None:
        super()._grow_places()
        self._fit()

    def _fit(self) -> None:
        """As many values as there are numbers."""
        for name in self._VALUES:
            setattr(self, name, self.fitted(getattr(self, name)))

    def _fit_rows(self, most: int) -> None:
        while most > self.rows.shape[1]:
            self.rows = np.concatenate([self.rows, np.zeros_like(self.rows)], axis=1)

"""The nodes of all windows in arrays, and their linearisation.

Each track has a row of nodes in the order of their stamps; the values of a node are kept under its number, which stays
the same as long as the node exists, so that an insertion moves no values. The first `first` nodes of a row have left
the window and are kept for detections that are older; those from there up to `count` are the window.
"""

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.smoothing import node_kernels
from fgtrack.estimation.smoothing.terms import NEAR_NS, Term, whitened
from fgtrack.models.motion import MotionModel

_FEW_TRACKS, _FEW_NODES, _FEW_COMPONENTS = 4, 16, 4
#: Later than any stamp and index.
NEVER = int(np.iinfo(np.int64).max)


def _numbered(first: int, tracks: int, nodes: int) -> IntArray:
    """Return numbers from `first` on, shape (tracks, nodes); the first nodes of all tracks are neighbours in memory."""
    return np.ascontiguousarray(first + np.arange(tracks * nodes).reshape(nodes, tracks).T)


class Nodes:
    """Arrays of shape (tracks, nodes) with the order of the nodes, and (numbers, ...) with the values of each.
    Vectors stand as a last column beside the matrix that moves with them: [F | Q | f(x0)], [P | x], [A | b].
    """

    ORDER = ("stamps_ns", "numbers", "first", "count")
    _OF_TRACKS = ("count", "first", "known", "begin_ns", "is_nonlinear")
    _VALUES = (
        *("origin", "reference", "segment", "rows", "num_rows", "predicted", "filtered", "back", "C"),
        *("step", "P", "changed"),
    )

    def __init__(self, motion: MotionModel) -> None:
        shape = _FEW_TRACKS, _FEW_NODES
        self._motion, n, size = motion, motion.dim, _FEW_TRACKS * _FEW_NODES
        self.stamps_ns: IntArray = np.full(shape, NEVER)
        """Shape (tracks, nodes); `NEVER` from `count` on."""
        self.numbers: IntArray = _numbered(0, *shape)
        """Shape (tracks, nodes); those from `count` on are free."""
        self.count: IntArray = np.zeros(_FEW_TRACKS, dtype=np.int64)
        """Number of nodes of each track."""
        self.first: IntArray = np.zeros_like(self.count)
        """Index of the oldest node of the window."""
        self.known: IntArray = np.zeros_like(self.count)
        """From this index on `P` is known."""
        self.begin_ns: IntArray = np.zeros_like(self.count)
        """Stamp of the first state of each track."""
        self.is_nonlinear: BoolArray = np.zeros(_FEW_TRACKS, dtype=bool)
        """True if a track has a measurement that is not linear."""
        self.origin, self.reference = np.zeros((2, size, n))
        """Linearisation points x0, and the first of them, which the variables of a factor graph are relative to."""
        self.segment = np.zeros((size, n, 2 * n + 1))
        """Motion to the next node: F, the derivative of f at x0, the noise Q, and f(x0)."""
        self.rows = np.zeros((size, _FEW_COMPONENTS, n + 1))
        """Measurements: G and y of y = G (x - x0) + N(0, I); unused rows are 0."""
        self.num_rows: IntArray = np.zeros(size, dtype=np.int64)
        """Number of `rows` in use."""
        self.predicted, self.filtered = (np.zeros((size, n, n + 1)) for _ in range(2))
        """Covariances and means relative to x0, before and after the node's own measurements."""
        self.back, self.C = np.zeros((size, n, n + 1)), np.zeros((size, n, n))
        """The node given the next one: x - x0 = A (next - its x0) + b + N(0, C); A and b."""
        self.step, self.P = np.zeros((size, n)), np.zeros((size, n, n))
        """Mean relative to x0, and covariance, given everything."""
        self.changed: BoolArray = np.zeros(size, dtype=bool)
        """True if the motion to the next node, or a measurement, was linearised since a factor graph read them."""
        self.terms: dict[int, list[Term]] = {}
        """Measurements of each node."""
        self.order = self.first, self.count, self.numbers
        """Arguments of all loops over the windows."""

    def nearest(self, tracks: IntArray, stamp_ns: int) -> tuple[IntArray, IntArray]:
        """Return the indices of the newest nodes at most `NEAR_NS` after `stamp_ns`, and the stamps to fuse it at.
        These are those of nodes that are at most `NEAR_NS` from it, else `stamp_ns` itself.
        """
        all_ns = self.stamps_ns[tracks]
        indices = (all_ns <= stamp_ns + NEAR_NS).sum(axis=1) - 1
        at_ns = all_ns[np.arange(len(tracks)), indices]
        return indices, np.where(at_ns < stamp_ns - NEAR_NS, stamp_ns, at_ns)

    def last_before(self, tracks: IntArray, stamps_ns: IntArray) -> IntArray:
        """Return the indices of the newest nodes at or before `stamps_ns`; -1 without such a node."""
        return np.asarray((self.stamps_ns[tracks] <= stamps_ns[:, None]).sum(axis=1) - 1)

    def window(self, track: int) -> IntArray:
        """Return the numbers of all nodes of a window."""
        return self.numbers[track, self.first[track] : self.count[track]].copy()

    def window_stamps_ns(self, track: int) -> IntArray:
        """Return the stamps of all nodes of a window."""
        return self.stamps_ns[track, self.first[track] : self.count[track]].copy()

    def begin_window(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """Make the first node of a new track."""
        while track >= len(self.count):
            self._grow(axis=0)
        self.stamps_ns[track] = NEVER
        self.stamps_ns[track, 0] = self.begin_ns[track] = stamp_ns
        self.count[track], self.first[track], self.known[track], self.is_nonlinear[track] = 1, 0, 0, False
        number = self.numbers[track, :1]
        self._empty(number)
        self.origin[number], self.step[number], self.P[number] = mean, 0.0, covariance
        self.predicted[number] = self.filtered[number] = np.column_stack([covariance, np.zeros(len(mean))])

    def insert_at(self, tracks: IntArray, indices: IntArray, stamp_ns: int, origins: FloatArray) -> None:
        """Insert nodes at `indices`, one for each of `tracks` that were `saved`, linearised at `origins` (m, n)."""
        numbers = np.empty(len(tracks), dtype=np.int64)
        node_kernels.insert(tracks, indices, stamp_ns, self.stamps_ns, self.numbers, self.count, numbers)
        self._empty(numbers)
        self.origin[numbers] = origins

    def move(self, tracks: IntArray, numbers: IntArray, steps: FloatArray) -> None:
        """Move the linearisation points of nodes of `tracks`, one each, by `steps` (m, n), and linearise their
        measurements there.
        """
        order = self.first, self.numbers
        node_kernels.shift(tracks, numbers, steps, *order, self.origin, self.step, self.predicted, self.back, self.rows)
        for number in numbers.tolist():
            if any(term.is_nonlinear for term, _ in self.terms[number]):
                self.linearise_terms(number)

    def drop(self, tracks: IntArray, many: IntArray) -> None:
        """Forget so `many` of the oldest nodes of each of `tracks`, which lie behind the windows."""
        columns = np.arange(self.stamps_ns.shape[1])
        source = (columns + many[:, None]) % len(columns)
        is_left = columns < (self.count[tracks] - many)[:, None]
        stamps_ns = np.take_along_axis(self.stamps_ns[tracks], source, axis=1)
        self.stamps_ns[tracks] = np.where(is_left, stamps_ns, NEVER)
        self.numbers[tracks] = np.take_along_axis(self.numbers[tracks], source, axis=1)
        self.count[tracks] -= many
        self.first[tracks] -= many
        self.known[tracks] -= many

    def linearise_terms(self, number: int) -> None:
        """Linearise all measurements of a node at its linearisation point."""
        rows = [whitened(term, self.origin[number], self._motion) for term in self.terms[number]]
        used = sum(map(len, rows))
        self._fit_rows(used)
        self.rows[number], self.num_rows[number], self.changed[number] = 0.0, used, True
        if used:
            self.rows[number, :used] = np.concatenate(rows)

    def linearise_motion(self, tracks: IntArray, indices: IntArray) -> None:
        """Linearise the motion from the nodes at `indices` to the next ones, where there are any."""
        inner = indices < self.count[tracks] - 1
        tracks, indices = tracks[inner], indices[inner]
        if tracks.size:
            dt_s = (self.stamps_ns[tracks, indices + 1] - self.stamps_ns[tracks, indices]) / NS_PER_S
            numbers = self.numbers[tracks, indices]
            ahead, F, Q = self._motion.transition(self.origin[numbers], dt_s)
            self.segment[numbers] = np.concatenate([F, Q, ahead[..., None]], axis=-1)
            self.changed[numbers] = True

    def observe(self, numbers: IntArray, y: FloatArray, H: FloatArray, R: FloatArray, offsets: FloatArray) -> None:
        """Add measurements y = H (x - guess) + N(0, R); guess - x0 is `offsets`, (m, n).
        Raises `numpy.linalg.LinAlgError` for an R that is not positive definite.
        """
        self._fit_rows(int(self.num_rows[numbers].max()) + y.shape[1])
        if not node_kernels.observe(numbers, y, H, R, offsets, self.rows, self.num_rows):
            raise np.linalg.LinAlgError("a covariance is not positive definite")
        self.changed[numbers] = True

    def saved(self, tracks: IntArray) -> list[IntArray]:
        """Return the `ORDER` of `tracks` before an insertion of a node into each, for which room is made."""
        if self.count[tracks].max() >= self.stamps_ns.shape[1]:
            self._grow(axis=1)
        return [getattr(self, name)[tracks] for name in self.ORDER]

    def _empty(self, numbers: IntArray) -> None:
        self.num_rows[numbers] = 0
        self.rows[numbers] = 0.0
        for number in numbers.tolist():
            self.terms[number] = []

    def _grow(self, axis: int) -> None:
        """Double the tracks, or the nodes of each; a node keeps its number and, if it is of a track, its values."""
        shape, first = self.numbers.shape, self.numbers.size
        used = self.numbers[np.arange(shape[1]) < self.count[:, None]]
        self.stamps_ns = np.concatenate([self.stamps_ns, np.full(shape, NEVER)], axis=axis)
        self.numbers = np.concatenate([self.numbers, _numbered(first, *shape)], axis=axis)
        for name in self._VALUES:
            values = getattr(self, name)
            larger = np.zeros((self.numbers.size, *values.shape[1:]), values.dtype)  # only pages of used ones are made
            larger[used] = values[used]
            setattr(self, name, larger)
        for name in self._OF_TRACKS if axis == 0 else ():
            values = getattr(self, name)
            setattr(self, name, np.concatenate([values, np.zeros_like(values)]))
        self.order = self.first, self.count, self.numbers

    def _fit_rows(self, most: int) -> None:
        while most > self.rows.shape[1]:
            self.rows = np.concatenate([self.rows, np.zeros_like(self.rows)], axis=1)

"""The nodes of all windows in arrays.

Each track has a row of nodes in the order of their stamps; the values of a node are kept under its number, which stays
the same as long as the node exists, so that an insertion moves no values. The first `first` nodes of a row have left
the window and are kept for detections that are older (see `ring`); those from there up to `count` are the window.
"""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.smoothing import node_kernels
from fgtrack.estimation.smoothing.terms import NEAR_NS, Innovations, MeasurementTerm, is_nonlinear, whitened

_FEW_TRACKS, _FEW_NODES, _FEW_COMPONENTS = 4, 16, 4
_NEVER_NS = int(np.iinfo(np.int64).max)

_Scalar = TypeVar("_Scalar", bound=np.generic)


def grown(values: npt.NDArray[_Scalar], size: int) -> npt.NDArray[_Scalar]:
    """Return `values` with zeros behind them, `size` rows in all."""
    return np.concatenate([values, np.zeros((size - len(values), *values.shape[1:]), values.dtype)])


def _numbered(first: int, tracks: int, nodes: int) -> IntArray:
    """Return numbers from `first` on, shape (tracks, nodes); the first nodes of all tracks are neighbours in memory."""
    return np.ascontiguousarray(first + np.arange(tracks * nodes).reshape(nodes, tracks).T)


class Nodes:
    """Arrays of shape (tracks, nodes) with the order of the nodes, and (numbers, ...) with the values of each.

    Vectors stand as a last column beside the matrix that moves with them: [F | Q | f(x0)], [P | x], [A | b].

    Parameters
    ----------
    n
        Length of a state.
    """

    _ORDER = ("stamps_ns", "numbers", "first", "count")
    _VALUES = (
        *("origin", "segment", "rows", "num_rows", "predicted", "filtered", "back", "C"),
        *("step", "P", "changed"),
    )

    def __init__(self, n: int) -> None:
        shape = _FEW_TRACKS, _FEW_NODES
        self.dim, size = n, _FEW_TRACKS * _FEW_NODES
        self.stamps_ns: IntArray = np.full(shape, _NEVER_NS)
        """Shape (tracks, nodes); `_NEVER_NS` from `count` on."""
        self.numbers: IntArray = _numbered(0, *shape)
        """Shape (tracks, nodes); those from `count` on are free."""
        self.count: IntArray = np.zeros(_FEW_TRACKS, dtype=np.int64)
        """Number of nodes of each track."""
        self.first: IntArray = np.zeros_like(self.count)
        """Index of the oldest node of the window."""
        self.known: IntArray = np.zeros_like(self.count)
        """From this index on `P` is known."""
        self.origin = np.zeros((size, n))
        """Linearisation points x0."""
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
        self.terms: dict[int, list[MeasurementTerm]] = {}
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
            for name in ("count", "first", "known"):
                setattr(self, name, grown(getattr(self, name), len(self.numbers)))
            self.order = self.first, self.count, self.numbers
        self.stamps_ns[track] = _NEVER_NS
        self.stamps_ns[track, 0] = stamp_ns
        self.count[track] = 1
        number = int(self.numbers[track, 0])
        self.first[track] = self.known[track] = 0
        self._empty(np.array([number]))
        self.origin[number] = mean
        for values in (self.predicted, self.filtered):
            values[number, :, :-1], values[number, :, -1] = covariance, 0.0
        self.P[number], self.step[number] = covariance, 0.0

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
            if any(map(is_nonlinear, self.terms[number])):
                self.linearise_terms(number)

    def drop(self, tracks: IntArray, many: IntArray) -> None:
        """Forget so `many` of the oldest nodes of each of `tracks`, which lie behind the windows."""
        columns = np.arange(self.stamps_ns.shape[1])
        source = (columns + many[:, None]) % len(columns)
        is_left = columns < (self.count[tracks] - many)[:, None]
        stamps_ns = np.take_along_axis(self.stamps_ns[tracks], source, axis=1)
        self.stamps_ns[tracks] = np.where(is_left, stamps_ns, _NEVER_NS)
        self.numbers[tracks] = np.take_along_axis(self.numbers[tracks], source, axis=1)
        self.count[tracks] -= many
        self.first[tracks] -= many
        self.known[tracks] -= many

    def linearise_terms(self, number: int) -> None:
        """Linearise all measurements of a node at its linearisation point."""
        rows = [whitened(term, self.origin[number]) for term in self.terms[number]]
        stacked = np.concatenate([np.zeros((0, self.dim + 1)), *rows])
        self.rows[number], self.num_rows[number] = 0.0, 0
        self.append_rows(np.array([number]), stacked[None])

    def append_rows(self, numbers: IntArray, rows: FloatArray) -> None:
        """Add measurements [G | y] (m, k, n + 1) of m nodes to those that they have."""
        used, k = self.num_rows[numbers], rows.shape[-2]
        self._fit_rows(int(used.max(initial=0)) + k)
        self.rows[numbers[:, None], used[:, None] + np.arange(k)] = rows
        self.num_rows[numbers] = used + k
        self.changed[numbers] = True

    def observe(self, numbers: IntArray, measured: Innovations, offsets: FloatArray) -> None:
        """Add measurements y = H (x - guess) + N(0, R); guess - x0 is `offsets`, (m, n).

        Raises `numpy.linalg.LinAlgError` for an R that is not positive definite.
        """
        self._fit_rows(int(self.num_rows[numbers].max(initial=0)) + measured.y.shape[1])
        given = measured.y, measured.H, measured.R
        if not node_kernels.observe(numbers, *given, offsets, self.rows, self.num_rows):
            raise np.linalg.LinAlgError("a covariance is not positive definite")
        self.changed[numbers] = True

    def _empty(self, numbers: IntArray) -> None:
        self.num_rows[numbers] = 0
        self.rows[numbers] = 0.0
        self.predicted[numbers, :, -1] = 0.0
        for number in numbers.tolist():
            self.terms[number] = []

    def saved(self, tracks: IntArray, anchors: IntArray, is_old: BoolArray) -> list[tuple[str, IntArray, FloatArray]]:
        """Return the values of `tracks` before an update that may fail, which inserts a node into each at most.

        These are names of arrays, rows and values. What is relinearised is not among them; the nodes that have left
        the windows are, where a measurement `is_old`.
        """
        if self.count[tracks].max(initial=0) >= self.stamps_ns.shape[1]:  # before values are saved, which would move
            self._grow(axis=1)
        numbers, first = self.numbers[tracks], self.first[tracks]
        columns, oldest = np.arange(numbers.shape[1]), np.where(is_old, 0, first - 1)
        behind = numbers[(columns >= oldest[:, None]) & (columns < anchors[:, None])]
        rows = {"predicted": numbers[np.arange(len(tracks)), first], "back": behind, "C": behind, "origin": numbers}
        rows |= dict.fromkeys(self._ORDER, tracks)
        return [(name, at, getattr(self, name)[at]) for name, at in rows.items()]

    def _grow(self, axis: int) -> None:
        """Double the tracks, or the nodes of each; a node keeps its number and, if it is of a track, its values."""
        shape, first = self.numbers.shape, self.numbers.size
        used = self.numbers[np.arange(shape[1]) < self.count[:, None]]
        self.stamps_ns = np.concatenate([self.stamps_ns, np.full(shape, _NEVER_NS)], axis=axis)
        self.numbers = np.concatenate([self.numbers, _numbered(first, *shape)], axis=axis)
        for name in self._VALUES:
            values = getattr(self, name)
            larger = np.zeros((self.numbers.size, *values.shape[1:]), values.dtype)  # only pages of used ones are made
            larger[used] = values[used]
            setattr(self, name, larger)
        self.order = self.first, self.count, self.numbers

    def _fit_rows(self, most: int) -> None:
        while most > self.rows.shape[1]:
            self.rows = np.concatenate([self.rows, np.zeros_like(self.rows)], axis=1)

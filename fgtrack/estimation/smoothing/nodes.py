"""The nodes of all windows in arrays, and their linearisation.

A track has a row of nodes in the order of their stamps. The values of a node stand under its number, which stays the
same as long as the node exists. So an insertion moves no values. The first nodes of a row have left the window. They
are kept for older detections. A row takes a number when it needs one, and keeps it. So memory grows with the number of
nodes, and not with the longest window times the number of tracks.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from fgtrack.core.state import Snapshot, Stateful, copied_attributes, put_back
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Measurement, Measurements
from fgtrack.estimation.smoothing import insertion_kernels, linearisation_kernels
from fgtrack.estimation.smoothing.node_arrays import (
    AHEAD_S,
    COUNT,
    FILTERED,
    FIRST,
    KNOWN,
    NEVER,
    NONE,
    NONLINEAR,
    NUM_PLUGINS,
    NUM_ROWS,
    NUM_VALUES,
    PLUGIN,
    POSE,
    PREDICTED,
    ROOT,
    ROWS_STALE,
    STALE,
    C,
    F,
    P,
    Q,
    Z,
)
from fgtrack.estimation.smoothing.terms import NEAR_NS, MeasurementFactor, whitened
from fgtrack.models.motion import MotionModel, WhiteNoise
from fgtrack.models.robust import compiled_form
from fgtrack.models.transitions import transitions

_FEW_TRACKS, _FEW_NODES, _FEW_VALUES, _FEW_COMPONENTS = 4, 64, 256, 4

#: Arrays whose first dimension is the number of a node.
_BY_NUMBER = ("labels", "backs", "points", "blocks", "rows", "marks", "values")


class Nodes(Stateful):
    """Arrays by track (tracks, ...), with the order of the nodes, and arrays by number (size, ...), with their
    values.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "tracks",
        "stamps_ns",
        "numbers",
        "_num_numbers",
        "labels",
        "backs",
        "points",
        "blocks",
        "rows",
        "marks",
        "values",
        "has_plugins",
        "_factors",
    )

    def __init__(self, motion: MotionModel) -> None:
        self._motion, n, size = motion, motion.dim, _FEW_VALUES
        self.compiled = (
            motion if isinstance(motion, WhiteNoise) and motion.is_compiled else None
        )
        self.tracks: IntArray = np.zeros((_FEW_TRACKS, 5), dtype=np.int64)
        """Columns: number of nodes; index of the oldest node of the window; index from which on `P` is known;
        stamp of the first state; level 0 for a linear track, 1 after a nonlinear measurement, 2 after a robust
        loss.
        """
        self.stamps_ns: IntArray = np.full((_FEW_TRACKS, _FEW_NODES), NEVER)
        """Shape (tracks, nodes); `NEVER` beyond the number of nodes."""
        self.numbers: IntArray = np.full((_FEW_TRACKS, _FEW_NODES), NONE)
        """Shape (tracks, nodes). Numbers beyond the number of nodes are free; `NONE` if the row has not taken a
        number there.
        """
        self._num_numbers = 0  # numbers that rows have taken
        self.labels: IntArray = np.zeros((size, 5), dtype=np.int64)
        """Columns: number of `rows` in use; 1 if the `INFORMATION` is up to date; 1 if the motion to the next
        node must be linearised; 1 if the measurements must be linearised; number of measurements that a plug-in
        models.
        """
        self.backs = np.zeros((size, n + 1, n + 1))
        """[A | b], the node given the next node: x - x0 = A (next - its x0) + b + N(0, C). The last row is the
        step: the smoothed mean minus the linearisation point x0.
        """
        self.points, self.blocks = np.zeros((size, n)), np.zeros((size, 7, n, n + 1))
        """See `node_arrays` and `_share`. A vector stands as the last column beside a matrix."""
        self.rows = np.zeros((size, _FEW_COMPONENTS, n + 1))
        """Measurements: G and y of y = G (x - x0) + N(0, I)."""
        self.marks = np.zeros((size, 3, _FEW_COMPONENTS), dtype=np.int64)
        self.values = np.zeros((size, NUM_VALUES, _FEW_COMPONENTS))
        """Measurements as compiled loops linearise them, see `node_arrays`."""
        self.has_plugins = self.compiled is None
        """True if plug-ins model the motion, or have modelled a measurement. These parts are linearised outside
        the compiled loops.
        """
        self._factors: dict[int, list[tuple[Measurements, int, float]]] = {}
        self._share()

    def checkpoint(self) -> Snapshot:
        """See `Stateful.checkpoint`. Arrays by number are copied as far as their numbers are in use."""
        used, others = self._num_numbers, set(self.STATE).difference(_BY_NUMBER)
        by_number = {
            name: (len(getattr(self, name)), getattr(self, name)[:used].copy())
            for name in _BY_NUMBER
        }
        factors = {number: own.copy() for number, own in self._factors.items()}
        others.remove("_factors")
        return {**copied_attributes(self, others), **by_number, "_factors": factors}

    def restore(self, snapshot: Snapshot) -> None:
        """See `Stateful.restore`."""
        put_back(self, set(self.STATE).difference(_BY_NUMBER), snapshot)
        for name in _BY_NUMBER:
            size, used = snapshot[name]
            values = np.zeros((size, *used.shape[1:]), used.dtype)
            values[: len(used)] = used
            setattr(self, name, values)
        self._share()

    def __setstate__(self, state: dict[str, Any]) -> None:  # Any: of each attribute
        self.__dict__.update(state)
        self._share()

    def _share(self) -> None:
        """Assign the tuples of arrays that compiled loops take, and names for parts of the arrays."""
        n = self._motion.dim
        kept = (self.tracks, self.stamps_ns, self.numbers, self.labels, self.backs)
        self.arrays = (*kept, self.points, self.blocks, self.rows)
        """Arguments of all compiled loops."""
        self.seen = self.marks, self.values
        """Arguments of the compiled loops that write or linearise measurements."""
        self.count, self.first, self.step = (
            self.tracks[:, COUNT],
            self.tracks[:, FIRST],
            self.backs[:, n, :n],
        )
        self.origin = self.points[:]
        """Linearisation points x0."""
        self.filtered, self.predicted = (
            self.blocks[:, FILTERED],
            self.blocks[:, PREDICTED],
        )
        self.ahead = self.blocks[:, F, :, n]
        """`filtered` and `predicted` are covariances and means relative to x0, after and before the
        measurements of the node. `ahead` is f(x0), the prediction of x0 to the next node.
        """
        self.C, self.P, self.F, self.Q = (
            self.blocks[:, k, :, :n] for k in (C, P, F, Q)
        )
        """Covariance C given the next node; smoothed covariance; derivative of f at x0; process noise to the
        next node.
        """

    def window(self, track: int) -> IntArray:
        """Return the numbers of all nodes of a window."""
        return self.numbers[track, self.first[track] : self.count[track]].copy()

    def window_stamps_ns(self, track: int) -> IntArray:
        """Return the stamps of all nodes of a window."""
        return self.stamps_ns[track, self.first[track] : self.count[track]].copy()

    def factors(self, number: int) -> list[MeasurementFactor]:
        """Return the measurements of a node."""
        return [(stack[row], ahead_s) for stack, row, ahead_s in self._factors[number]]

    def begin_window(
        self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray
    ) -> None:
        """Make the first node of a new track, with the prior (n,) and (n, n)."""
        while track >= len(self.tracks):
            self._grow(axis=0)
        if self.numbers[track, 0] == NONE:
            self._take_numbers(np.array([track]), np.array([0]))
        self.stamps_ns[track] = NEVER
        self.stamps_ns[track, 0] = stamp_ns
        self.tracks[track] = 1, 0, 0, stamp_ns, 0
        number = int(self.numbers[track, 0])
        self._factors[number], self.labels[number] = [], 0
        self.origin[number], self.step[number], self.P[number] = mean, 0.0, covariance
        self.predicted[number] = self.filtered[number] = np.column_stack(
            [covariance, np.zeros(len(mean))]
        )

    def load_window(
        self,
        track: int,
        stamps_ns: Sequence[int],
        means: FloatArray,
        prior_mean: FloatArray,
        prior_covariance: FloatArray,
        factors: Sequence[Sequence[MeasurementFactor]],
    ) -> None:
        """Make the window of a new track, with a node for each stamp. Its nodes must still be linearised and
        solved.

        `means` (m, n) become the linearisation points. The prior, (n,) and (n, n), belongs to the oldest node.
        """
        self.begin_window(track, stamps_ns[0], prior_mean, prior_covariance)
        while len(stamps_ns) >= self.stamps_ns.shape[1]:
            self._grow(axis=1)
        for index in range(1, len(stamps_ns)):
            if self.numbers[track, index] == NONE:
                self._take_numbers(np.array([track]), np.array([index]))
        self.stamps_ns[track, : len(stamps_ns)] = stamps_ns
        self.count[track] = len(stamps_ns)
        numbers = self.window(track)
        self.predicted[numbers[0], :, -1] = prior_mean - means[0]
        self.origin[numbers], self.step[numbers] = means, 0.0
        self.labels[numbers] = 0
        for number, own in zip(numbers.tolist(), factors, strict=True):
            self._factors[number] = [
                (Measurements(replace(one, z=one.z[None], R=one.R[None])), 0, ahead_s)
                for one, ahead_s in own
            ]
            self._note_again(number)

    def note(
        self,
        stack: Measurements,
        numbers: IntArray,
        is_new: IntArray,
        ahead_s: FloatArray,
    ) -> None:
        """Keep a stack of measurements, one for each node in `numbers`. An exception changes nothing."""
        kept = dict[int, list[tuple[Measurements, int, float]]]()
        rows = zip(
            numbers.tolist(),
            is_new.tolist(),
            range(len(numbers)),
            ahead_s.tolist(),
            strict=True,
        )
        for number, new, *factor in rows:
            kept[number] = [*([] if new else self._factors[number]), (stack, *factor)]
        self._factors.update(kept)

    def withdraw(self, track: int, index: int, *, is_new: bool, is_noted: bool) -> None:
        """Remove the last measurement of a node if it `is_noted`, and the node itself if it `is_new`."""
        number, last = int(self.numbers[track, index]), self.count[track] - 1
        if is_noted:
            self._factors[number].pop()
        if is_new:
            for each, free in (
                (self.stamps_ns[track], NEVER),
                (self.numbers[track], number),
            ):
                each[index:last] = each[index + 1 : last + 1]
                each[last] = free
            self.count[track] = last
        else:
            self._note_again(number)
        self.tracks[track, KNOWN] = self.count[track]

    def noted_as(self, measurement: Measurement) -> tuple[IntArray, FloatArray, int]:
        """Return a measurement as compiled loops take it: codes (k,), pose with the width of the loss (6,), and
        kind of the loss.

        The kind is `PLUGIN` if a plug-in models the measurement or the motion.
        """
        codes = measurement.model.codes
        loss, width = compiled_form(measurement.loss, len(codes))
        view = np.array([*measurement.pose, width], dtype=np.float64)
        if self.compiled is None or not measurement.model.is_compiled:
            self.has_plugins = True
            loss = PLUGIN
        return codes, view, loss

    def widen(self, num_rows: int) -> None:
        """Make room for `num_rows` further rows of measurements in each node."""
        self._resize(len(self.labels), self.rows.shape[1] + num_rows)

    def _note_again(self, number: int) -> None:
        """Write the measurements in `factors` of a node into the arrays again. Its rows must then be linearised."""
        factors, row = self.factors(number), 0
        used = sum(len(measurement.z) for measurement, _ in factors)
        if used > self.rows.shape[1]:
            self._resize(len(self.labels), used)
        self.labels[number, NUM_PLUGINS] = 0
        for measurement, ahead_s in factors:
            codes, view, loss = self.noted_as(measurement)
            k, values = len(codes), self.values[number]
            of = slice(row, row + k)
            self.marks[number, :, of] = codes, np.full(k, k), np.full(k, loss)
            values[Z, of] = measurement.z
            values[POSE:AHEAD_S, of] = view[:, None]
            values[AHEAD_S, of] = ahead_s
            root = np.linalg.cholesky(measurement.R)
            values[ROOT : ROOT + k, of] = root.T
            self.labels[number, NUM_PLUGINS] += loss == PLUGIN
            row += k
        self.labels[number, NUM_ROWS], self.labels[number, ROWS_STALE] = used, 1

    def index_of(self, track: int, measurement: Measurement) -> int | None:
        """Return the index of the node with this measurement; None if no node has it."""
        stamps_ns = self.stamps_ns[track, : self.count[track]]
        near = np.abs(stamps_ns - measurement.stamp_ns) <= NEAR_NS
        for index in near.nonzero()[0].tolist():
            own = self.factors(int(self.numbers[track, index]))
            if any(each.order == measurement.order for each, _ in own):
                return index
        return None

    def take_out(self, track: int, index: int, measurement: Measurement) -> None:
        """Remove a measurement from the node at `index`, and the node itself if nothing else needs it.

        The neighbours must be linearised and solved afterwards. The oldest node of the window stays, because it
        has the prior. The oldest node of all stays, too.
        """
        number = int(self.numbers[track, index])
        orders = [each.order for each, _ in self.factors(number)]
        del self._factors[number][orders.index(measurement.order)]
        self.labels[number, STALE] = 1
        self._note_again(number)
        if self._factors[number] or index in (0, self.first[track]):
            return
        self.labels[self.numbers[track, index - 1], STALE] = 1
        self.withdraw(track, index, is_new=True, is_noted=False)
        self.first[track] -= index < self.first[track]

    def windows(self, tracks: IntArray, *limits_ns: int) -> IntArray:
        """Return `insertion_kernels.windows` of `tracks`, shape (4, m), and make room for another node in each."""
        out = np.empty((4, len(tracks)), dtype=np.int64)
        if (
            insertion_kernels.windows(tracks, *limits_ns, self.arrays, out)
            >= self.stamps_ns.shape[1]
        ):
            self._grow(axis=1)
        counts = self.count[tracks]
        lacking = self.numbers[tracks, counts] == NONE
        if lacking.any():
            self._take_numbers(tracks[lacking], counts[lacking])
        return out

    def linearise_factors(self, number: int) -> None:
        """Linearise all measurements of a node at its linearisation point, with the models of plug-ins."""
        rows = [
            whitened(factor, self.origin[number], self._motion)
            for factor in self.factors(number)
        ]
        if rows:
            self.rows[number, : self.labels[number, NUM_ROWS]] = np.concatenate(rows)
        self.labels[number, ROWS_STALE] = 0

    def linearise(self, tracks: IntArray, starts: IntArray) -> None:
        """Linearise measurements and motion of the stale nodes of `tracks`, from the node before `starts` on."""
        compiled = self.compiled
        if self.has_plugins:
            is_node = np.arange(self.numbers.shape[1]) < self.count[tracks, None]
            labels = self.labels[self.numbers[tracks]]
            is_nonlinear = self.tracks[tracks, NONLINEAR, None] > 0
            is_outdated = (labels[..., ROWS_STALE] > 0) | (
                (labels[..., STALE] > 0) & is_nonlinear
            )
            outside = is_node & is_outdated & (labels[..., NUM_PLUGINS] > 0)
            rows, indices = np.nonzero(outside)
            for number in self.numbers[tracks[rows], indices].tolist():
                self.linearise_factors(number)
        if compiled is not None:
            linearisation_kernels.linearise(
                compiled.kind, compiled.noise, tracks, starts, self.arrays, self.seen
            )
            return
        rows, indices = np.nonzero(is_node & (labels[..., STALE] > 0))
        rows = tracks[rows]
        stale = self.numbers[rows, indices]
        self.labels[stale, STALE] = 0
        inner = indices < self.count[rows] - 1
        rows, indices, stale = rows[inner], indices[inner], stale[inner]
        dt_s = (
            self.stamps_ns[rows, indices + 1] - self.stamps_ns[rows, indices]
        ) / NS_PER_S
        self.ahead[stale], self.F[stale], self.Q[stale] = self.transition(
            self.origin[stale], dt_s
        )

    def transition(
        self, x: FloatArray, dt_s: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `MotionModel.transition` of states (m, n) after times (m,)."""
        if self.compiled is None:
            return self._motion.transition(x, dt_s)
        m, n = x.shape
        result = np.empty((m, n)), np.empty((m, n, n)), np.empty((m, n, n))
        transitions(self.compiled.kind, x, dt_s, self.compiled.noise, *result)
        return result

    def _grow(self, axis: int) -> None:
        """Double the number of tracks (`axis` 0) or of nodes (`axis` 1). Memory is allocated before anything
        changes.
        """
        shape = [*self.stamps_ns.shape]
        shape[axis] *= 2
        stamps_ns, numbers = np.full(shape, NEVER), np.full(shape, NONE)
        tracks = np.zeros((shape[0], self.tracks.shape[1]), dtype=np.int64)
        rows, columns = self.stamps_ns.shape
        stamps_ns[:rows, :columns], numbers[:rows, :columns], tracks[:rows] = (
            self.stamps_ns,
            self.numbers,
            self.tracks,
        )
        self.stamps_ns, self.numbers, self.tracks = stamps_ns, numbers, tracks
        self._share()

    def _take_numbers(self, tracks: IntArray, indices: IntArray) -> None:
        """Give each of `tracks` (m,) a number for a further node, at its index in `indices` (m,), where it has no
        number.
        """
        first, end = self._num_numbers, self._num_numbers + len(tracks)
        if end > len(self.labels):
            self._resize(max(end, 2 * len(self.labels)), self.rows.shape[1])
        self.numbers[tracks, indices], self._num_numbers = np.arange(first, end), end

    def _resize(self, size: int, num_rows: int) -> None:
        """Make room for the values of `size` numbers, with at least `num_rows` rows of measurements each."""
        used, width = self._num_numbers, self.rows.shape[1]
        while width < num_rows:
            width *= 2
        larger = []
        for name in _BY_NUMBER:
            values: Any = getattr(self, name)  # Any: of integers or numbers
            shape = [size, *values.shape[1:]]
            if name in ("rows", "marks", "values"):
                shape[1 if name == "rows" else 2] = width
            larger.append(
                np.zeros(shape, values.dtype)
            )  # memory is used by these numbers only
            part = tuple(slice(length) for length in (used, *values.shape[1:]))
            larger[-1][part] = values[:used]
        for name, values in zip(_BY_NUMBER, larger, strict=True):
            setattr(self, name, values)
        self._share()

"""Looking up, inserting and moving nodes, compiled by numba; see `compiled`."""

import numpy as np
from numba import njit

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes

_TRACKS, _ORDER, _STATES, _TABLES = "int64[::1]", "int64[:, ::1]", "float64[:, ::1]", "float64[:, :, ::1]"


class CompiledNodes(Nodes):
    """The same arrays."""

    def place_before(self, tracks: IntArray, stamps_ns: IntArray) -> IntArray:
        """See `Nodes.place_before`."""
        places = np.empty(len(tracks), dtype=np.int64)
        _place_before(tracks, stamps_ns, self.stamps_ns, self.count, places)
        return places

    def last_before(self, tracks: IntArray, places: IntArray, stamps_ns: IntArray) -> IntArray:
        """See `Nodes.last_before`."""
        last = np.empty(len(tracks), dtype=np.int64)
        _last_before(tracks, places, stamps_ns, self.stamps_ns, self.count, last)
        return last

    def shift(self, tracks: IntArray, numbers: IntArray, steps: FloatArray) -> None:
        """See `Nodes.shift`."""
        order = self.first, self.numbers
        _shift(tracks, numbers, steps, *order, self.origin, self.step, self.predicted, self.back, self.rows)

    def observe(self, numbers: IntArray, y: FloatArray, H: FloatArray, R: FloatArray, offsets: FloatArray) -> None:
        """See `Nodes.observe`."""
        while int(self.num_rows[numbers].max(initial=0)) + y.shape[1] > self.rows.shape[1]:
            self._grow_rows()
        if not _observe(numbers, y, H.copy(), R, offsets, self.rows, self.num_rows):
            raise np.linalg.LinAlgError("a covariance is not positive definite")

    def insert(self, tracks: IntArray, places: IntArray, stamp_ns: int) -> IntArray:
        """See `Histories.insert`."""
        numbers = np.empty(len(tracks), dtype=np.int64)
        _place(tracks, places, stamp_ns, self.stamps_ns, self.numbers, self.count, numbers)
        return numbers


@njit(f"void(int64[:], int64[:], {_ORDER}, {_TRACKS}, {_TRACKS})", cache=True)
def _place_before(tracks: IntArray, stamps_ns: IntArray, all_ns: IntArray, count: IntArray, places: IntArray) -> None:
    for t in range(len(tracks)):
        track = tracks[t]
        places[t] = np.searchsorted(all_ns[track, : count[track]], stamps_ns[t], side="right") - 1


@njit(f"void(int64[:], int64[:], int64[:], {_ORDER}, {_TRACKS}, {_TRACKS})", cache=True)
def _last_before(
    tracks: IntArray, places: IntArray, stamps_ns: IntArray, all_ns: IntArray, count: IntArray, last: IntArray
) -> None:
    for t in range(len(tracks)):
        track, place = tracks[t], places[t]
        while place + 1 < count[track] and all_ns[track, place + 1] <= stamps_ns[t]:
            place += 1
        last[t] = place


@njit(f"void(int64[:], int64[:], int64, {_ORDER}, {_ORDER}, {_TRACKS}, {_TRACKS})", cache=True)
def _place(
    tracks: IntArray,
    places: IntArray,
    stamp_ns: int,
    all_ns: IntArray,
    numbers: IntArray,
    count: IntArray,
    placed: IntArray,
) -> None:
    for t in range(len(tracks)):
        track = tracks[t]
        placed[t] = numbers[track, count[track]]
        for place in range(count[track], places[t], -1):
            all_ns[track, place], numbers[track, place] = all_ns[track, place - 1], numbers[track, place - 1]
        all_ns[track, places[t]], numbers[track, places[t]] = stamp_ns, placed[t]
        count[track] += 1


@njit(
    f"void(int64[:], int64[:], float64[:, :], {_TRACKS}, {_ORDER}, {_STATES}, {_STATES}, {', '.join([_TABLES] * 3)})",
    cache=True,
)
def _shift(
    tracks: IntArray,
    shifted: IntArray,
    steps: FloatArray,
    first: IntArray,
    numbers: IntArray,
    origin: FloatArray,
    step: FloatArray,
    predicted: FloatArray,
    back: FloatArray,
    rows: FloatArray,
) -> None:
    n = origin.shape[1]
    for t in range(len(tracks)):
        at, oldest = shifted[t], first[tracks[t]]
        for i in range(n):
            origin[at, i] += steps[t, i]
            step[at, i] -= steps[t, i]
            predicted[at, i, n] -= steps[t, i]
        for k in range(rows.shape[1]):
            for j in range(n):
                rows[at, k, n] -= rows[at, k, j] * steps[t, j]
        if oldest > 0 and numbers[tracks[t], oldest] == at:
            behind = numbers[tracks[t], oldest - 1]
            for i in range(n):
                for j in range(n):
                    back[behind, i, n] += back[behind, i, j] * steps[t, j]


@njit(
    f"b1(int64[:], float64[:, :], {_TABLES}, float64[:, :, :], float64[:, :], {_TABLES}, {_TRACKS})",
    cache=True,
    error_model="numpy",
)
def _observe(
    numbers: IntArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    offsets: FloatArray,
    rows: FloatArray,
    num_rows: IntArray,
) -> bool:
    """Whether all covariances are positive definite."""
    k, n = H.shape[1:]
    L = np.empty((k, k))
    for t in range(len(numbers)):
        at = numbers[t]
        used = num_rows[at]
        for i in range(k):
            for j in range(i + 1):
                value = R[t, i, j]
                for m in range(j):
                    value -= L[i, m] * L[j, m]
                if i > j:
                    L[i, j] = value / L[j, j]
                elif value > 0.0:
                    L[i, i] = np.sqrt(value)
                else:
                    return False
            measured = y[t, i]
            for j in range(n):
                measured += H[t, i, j] * offsets[t, j]
            for j in range(n + 1):
                value = measured if j == n else H[t, i, j]
                for m in range(i):
                    value -= L[i, m] * rows[at, used + m, j]
                rows[at, used + i, j] = value / L[i, i]
        num_rows[at] += k
    return True

"""Compiled loops that look up, insert and move nodes; arguments are those arrays of `Nodes` that have their names."""

import numpy as np

from fgtrack.core.compiled import njit
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.kernels import MATRICES, ORDER, TRACKS, VECTORS


@njit(f"void(int64[:], int64[:], {ORDER}, {TRACKS}, {TRACKS})")
def place_before(tracks: IntArray, stamps_ns: IntArray, all_ns: IntArray, count: IntArray, places: IntArray) -> None:
    """Write the places of the newest nodes at or before `stamps_ns`; -1 if there is none."""
    for t in range(len(tracks)):
        track = tracks[t]
        places[t] = np.searchsorted(all_ns[track, : count[track]], stamps_ns[t], side="right") - 1


@njit(f"void(int64[:], int64[:], int64[:], {ORDER}, {TRACKS}, {TRACKS})")
def last_before(
    tracks: IntArray, places: IntArray, stamps_ns: IntArray, all_ns: IntArray, count: IntArray, last: IntArray
) -> None:
    """Write the same, or `places` where these are later; searches step by step from there."""
    for t in range(len(tracks)):
        track, place = tracks[t], places[t]
        while place + 1 < count[track] and all_ns[track, place + 1] <= stamps_ns[t]:
            place += 1
        last[t] = place


@njit(f"void(int64[:], int64[:], int64, {ORDER}, {ORDER}, {TRACKS}, {TRACKS})")
def insert(
    tracks: IntArray,
    places: IntArray,
    stamp_ns: int,
    all_ns: IntArray,
    numbers: IntArray,
    count: IntArray,
    placed: IntArray,
) -> None:
    """Insert nodes at `places`, whose numbers are written to `placed`; later nodes move up."""
    for t in range(len(tracks)):
        track = tracks[t]
        placed[t] = numbers[track, count[track]]
        for place in range(count[track], places[t], -1):
            all_ns[track, place], numbers[track, place] = all_ns[track, place - 1], numbers[track, place - 1]
        all_ns[track, places[t]], numbers[track, places[t]] = stamp_ns, placed[t]
        count[track] += 1


@njit(f"void(int64[:], int64[:], float64[:, :], {TRACKS}, {ORDER}, {VECTORS}, {VECTORS}, {', '.join([MATRICES] * 3)})")
def shift(
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
    """Move the linearisation points of the nodes `shifted` by `steps`, and all that is relative to them."""
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


@njit(f"b1(int64[:], float64[:, :], {MATRICES}, float64[:, :, :], float64[:, :], {MATRICES}, {TRACKS})")
def observe(
    numbers: IntArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    offsets: FloatArray,
    rows: FloatArray,
    num_rows: IntArray,
) -> bool:
    """Append whitened rows of measurements to the nodes `numbers`; False if an R is not positive definite."""
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

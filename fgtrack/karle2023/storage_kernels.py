"""Compiled storage of the states of many tracks on a time grid.

The storage keeps anchors; other states are predicted from them. All arrays have the
shape (tracks, slots, ...), and n is the dimension of the state:

- `anchors`: the grid index of the state, and the first grid index at which look-ups use
  it.
- `states`: the mean (first row) and the covariance, n + 1 rows of n.
- `windows` (one row per track, without slots): the number of anchors, the grid index of
  the birth, and the newest fused stamp.

The anchors of a track are in ascending order.
"""

import numpy as np

from fgtrack.core.compiled import check, check_rows, copy, inlined, merged, njit
from fgtrack.core.types import BoolArray, FloatArray, IntArray

FAILED, IN_SEQUENCE, OUT_OF_SEQUENCE = range(3)
_STORAGE = "int64[:, :, ::1], float64[:, :, :, ::1], int64[:, ::1]"


@inlined
def _check(
    rows: IntArray, anchors: IntArray, states: FloatArray, windows: IntArray, n: int
) -> None:
    """Raise `IndexError` for invalid rows, numbers of anchors or shapes."""
    size, slots = anchors.shape[0], anchors.shape[1]
    check_rows(rows, 0, size)
    check(
        states.shape[0] == size
        and windows.shape[0] == size
        and states.shape[1] == slots
    )
    check(
        states.shape[2] == n + 1
        and states.shape[3] == n
        and anchors.shape[2] >= 2
        and windows.shape[1] >= 3
    )
    for i in range(len(rows)):
        check_rows(windows[rows[i], :1], 1, slots + 1)


@njit(
    f"void(int64, b1, int64[:], {_STORAGE}, float64[:, ::1], float64[:, :, ::1], int64[::1])"
)
def look_up(
    grid: int,
    is_present: bool,
    rows: IntArray,
    anchors: IntArray,
    states: FloatArray,
    windows: IntArray,
    means: FloatArray,
    covariances: FloatArray,
    steps: IntArray,
) -> None:
    """Write the anchors from which the states of `rows` (m,) at index `grid` are predicted.

    Writes the means (m, n), the covariances (m, n, n), and the number of steps (m,)
    from the anchor to `grid`. For the present the newest anchor is used, even if
    look-ups do not use it yet.
    """
    _check(rows, anchors, states, windows, means.shape[1])
    check(
        len(means) >= len(rows)
        and len(covariances) >= len(rows)
        and len(steps) >= len(rows)
    )
    for i in range(len(rows)):
        row = rows[i]
        j = windows[row, 0] - 1
        while j > 0 and not is_present and anchors[row, j, 1] > grid:
            j -= 1
        steps[i] = grid - anchors[row, j, 0]
        for a in range(means.shape[1]):
            means[i, a] = states[row, j, 0, a]
        copy(states[row, j, 1:], covariances[i])


@merged
def _forget(
    oldest: int, anchors: IntArray, states: FloatArray, window: IntArray
) -> None:
    """Drop the anchors that no look-up from `oldest` on can use; move the others to the front."""
    gone = 0
    while gone + 1 < window[0] and anchors[gone + 1, 1] <= max(oldest, window[1]):
        gone += 1
    window[0] -= gone
    for j in range(window[0]):
        anchors[j, 0], anchors[j, 1] = anchors[j + gone, 0], anchors[j + gone, 1]
        copy(states[j + gone], states[j])


@njit(
    f"(int64, int64, int64, int64, int64[::1], b1[::1], float64[:, ::1], float64[:, :, ::1], {_STORAGE})"
)
def store(
    oldest: int,
    grid: int,
    visible_from: int,
    stamp_ns: int,
    rows: IntArray,
    fused: BoolArray,
    means: FloatArray,
    covariances: FloatArray,
    anchors: IntArray,
    states: FloatArray,
    windows: IntArray,
) -> IntArray:
    """Store an anchor of the measurement at `stamp_ns` for each of `rows` (m,) that `fused` it.

    Returns the status codes (m,). The new anchor replaces all anchors at and after it.
    If no slot is free, unused anchors before `oldest` are dropped first.
    """
    _check(rows, anchors, states, windows, means.shape[1])
    check(
        len(means) >= len(rows)
        and len(covariances) >= len(rows)
        and len(fused) >= len(rows)
    )
    status = np.full(len(rows), FAILED)
    for i in range(len(rows)):
        if fused[i]:
            row, window = rows[i], windows[rows[i]]
            if window[0] == anchors.shape[1]:
                _forget(oldest, anchors[row], states[row], window)
            j = window[0]
            while j > 0 and anchors[row, j - 1, 1] >= visible_from:
                j -= 1
            if j == anchors.shape[1]:  # no slot is free
                continue
            anchors[row, j, 0], anchors[row, j, 1] = grid, visible_from
            for a in range(means.shape[1]):
                states[row, j, 0, a] = means[i, a]
            copy(covariances[i], states[row, j, 1:])
            status[i] = IN_SEQUENCE if stamp_ns >= window[2] else OUT_OF_SEQUENCE
            window[0], window[2] = j + 1, max(window[2], stamp_ns)
    return status

"""The arrays of the replaying filters of many tracks, and the order of the steps of a track.

A step is a measurement with the states before and after the measurement. The steps of a track stand in slots, which a
step keeps until it leaves the window. A bank is a tuple of six arrays, each with a row for each track:

- `order` (tracks, slots): the slots of the steps, oldest first, and then the free slots.
- `labels` (tracks, slots, 3 + k): stamp, number of components, kind of the robust loss, codes of the components. The
  first step of a track is the prior, with 0 components.
- `steps` (tracks, slots, 3 n + 2, n): for the dimension n of the state, the mean and the covariance after the
  measurement (n + 1 rows), the predicted mean and covariance (n + 1 rows), and the cross-covariance of the prediction
  with the step before.
- `windows` (tracks, 3): number of steps, oldest stamp and newest stamp of the window.
- `measured` (tracks, slots, k + 1, k): z in the first row, then the covariance R.
- `views` (tracks, slots, 6): sensor pose (5 numbers) and width of the robust loss.
"""

from fgtrack.core.compiled import check, check_rows, inlined, merged
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.models.measurement_kernels import POSE_SIZE, Stack

#: Outcomes of a measurement.
FAILED, TOO_OLD, IN_SEQUENCE, OUT_OF_SEQUENCE, NO_ROOM = range(5)
#: Columns of `labels`; the codes of the components begin at the last column.
STAMP_NS, SIZE, LOSS, CODES = range(4)
#: Columns of `windows`.
COUNT, OLDEST_NS, NEWEST_NS = range(3)
#: Column of `views` behind the pose.
WIDTH = POSE_SIZE

BANK = (
    "Tuple((int64[:, ::1], int64[:, :, ::1], float64[:, :, :, ::1], int64[:, ::1], "
    "float64[:, :, :, ::1], float64[:, :, ::1]))"
)
Bank = tuple[IntArray, IntArray, FloatArray, IntArray, FloatArray, FloatArray]
"""The arrays `order`, `labels`, `steps`, `windows`, `measured` and `views`."""
Track = Bank
"""The rows of one track in the arrays of a bank."""
TIMES_NS = "UniTuple(int64, 3)"
Times = tuple[int, int, int]
"""Length of the windows, oldest stamp that the clock allows, and stamp of the measurements, in nanoseconds."""


@merged
def track_of(bank: Bank, row: int) -> Track:
    """Return the rows of one track in the arrays of a bank."""
    order, labels, steps, windows, measured, views = bank
    return (
        order[row],
        labels[row],
        steps[row],
        windows[row],
        measured[row],
        views[row],
    )


@inlined
def check_bank(tracks: IntArray, least: int, bank: Bank, n: int) -> None:
    """Raise `IndexError` unless the arrays of a bank are consistent for states of dimension n, and have all `tracks`.

    Row numbers of tracks are at least `least`.
    """
    order, labels, steps, windows, measured, views = bank
    size, slots = order.shape
    check_rows(tracks, least, size)
    check(
        labels.shape[0] == size and steps.shape[0] == size and windows.shape[0] == size
    )
    check(
        labels.shape[1] == slots and steps.shape[1] == slots and windows.shape[1] >= 3
    )
    check(steps.shape[2] == 3 * n + 2 and steps.shape[3] == n)
    check(measured.shape[0] == size and measured.shape[1] == slots)
    check(views.shape[0] == size and views.shape[1] == slots)
    for i in range(len(tracks)):
        if tracks[i] >= 0:
            check_rows(windows[tracks[i], :1], 1, slots + 1)
            check_rows(order[tracks[i]], 0, slots)


@inlined
def check_room(bank: Bank, k: int) -> None:
    """Raise `IndexError` unless the arrays of a bank have room for measurements of k components."""
    _, labels, _, _, measured, views = bank
    check(measured.shape[2] > k and measured.shape[3] >= k)
    check(labels.shape[2] >= k + CODES and views.shape[2] > WIDTH)


@merged
def _comes_after(track: Track, slot: int, new: int) -> bool:
    """True if the step in `slot` comes after the step in `new`: by stamp, and at equal stamps by content.

    The order of arrival therefore does not matter.
    """
    _, labels, _, _, measured, views = track
    label, new_label = labels[slot], labels[new]
    k = label[SIZE]
    if label[STAMP_NS] != new_label[STAMP_NS] or k == 0:
        return bool(label[STAMP_NS] > new_label[STAMP_NS])
    if k != new_label[SIZE]:
        return bool(k > new_label[SIZE])
    for a in range(CODES, CODES + k):
        if label[a] != new_label[a]:
            return bool(label[a] > new_label[a])
    for a in range(k + 1):
        for b in range(k):
            if measured[slot, a, b] != measured[new, a, b]:
                return bool(measured[slot, a, b] > measured[new, a, b])
    for a in range(POSE_SIZE):
        if views[slot, a] != views[new, a]:
            return bool(views[slot, a] > views[new, a])
    if label[LOSS] != new_label[LOSS]:
        return bool(label[LOSS] > new_label[LOSS])
    return bool(views[slot, WIDTH] > views[new, WIDTH])


@merged
def _forget(track: Track, oldest_ns: int) -> None:
    """Free the slots of the steps before the newest step that is older than `oldest_ns`."""
    slots, labels, _, window, _, _ = track
    num_old = 0
    while (
        num_old + 1 < window[COUNT] and labels[slots[num_old + 1], STAMP_NS] < oldest_ns
    ):
        num_old += 1
    window[COUNT] -= num_old
    for j in range(window[COUNT] if num_old else 0):
        slots[j], slots[j + num_old] = slots[j + num_old], slots[j]


@merged
def _write(track: Track, slot: int, stamp_ns: int, stack: Stack, row: int) -> None:
    """Write the measurement in a row of `stack` into a slot."""
    _, labels, _, _, measured, views = track
    components, view, loss, z, R = stack
    k = len(components)
    label, own = labels[slot], measured[slot]
    label[STAMP_NS], label[SIZE], label[LOSS] = stamp_ns, k, loss
    for a in range(WIDTH + 1):
        views[slot, a] = view[a]
    for a in range(k):
        label[CODES + a], own[0, a] = components[a], z[row, a]
        for b in range(k):
            own[1 + a, b] = R[row, a, b]


@inlined
def is_same(track: Track, slot: int, stamp_ns: int, stack: Stack, row: int) -> bool:
    """True if the step in a slot has the measurement in a row of `stack`."""
    _, labels, _, _, measured, views = track
    components, view, loss, z, R = stack
    k, label, own = len(components), labels[slot], measured[slot]
    if label[STAMP_NS] != stamp_ns or label[SIZE] != k or label[LOSS] != loss:
        return False
    for a in range(WIDTH + 1):
        if views[slot, a] != view[a]:
            return False
    for a in range(k):
        if label[CODES + a] != components[a] or own[0, a] != z[row, a]:
            return False
        for b in range(k):
            if own[1 + a, b] != R[row, a, b]:
                return False
    return True


@merged
def insert_step(track: Track, times_ns: Times, stack: Stack, row: int) -> int:
    """Insert the measurement in a row of `stack` into the steps of a track. Return the index of the step.

    Return minus the outcome, and change nothing, if the measurement is too old or all slots are in use. The number of
    steps in `windows` stays as it is.
    """
    slots, _, _, window, _, _ = track
    _, oldest_ns, stamp_ns = times_ns
    start_ns = max(window[OLDEST_NS], oldest_ns)
    if stamp_ns < start_ns:
        return -TOO_OLD
    if window[COUNT] + 1 >= len(slots):
        _forget(track, start_ns)
    if window[COUNT] == len(slots):
        return -NO_ROOM
    index = window[COUNT]
    own = slots[index]
    _write(track, own, stamp_ns, stack, row)
    while index > 1 and _comes_after(track, slots[index - 1], own):
        slots[index] = slots[index - 1]
        index -= 1
    slots[index] = own
    return int(index)

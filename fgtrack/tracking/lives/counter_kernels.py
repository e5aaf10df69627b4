"""Compiled loops over the counters of tracks; `fgtrack.tracking.lives.counters` has the arrays."""

import numpy as np

from fgtrack.core.compiled import check, check_rows, inlined, njit
from fgtrack.core.types import BoolArray, IntArray
from fgtrack.tracking.lives.counters import (
    COASTING,
    CONFIRMED,
    COUNTER,
    ENDS,
    JUDGED,
    LAST_SEEN,
    MANY_CHANGES,
    MISSES,
    NUM_CHANGES,
    NUM_COLUMNS,
    NUM_PLACED,
    SETTLED,
    TENTATIVE,
)
from fgtrack.tracking.lives.latency import FOREVER
from fgtrack.tracking.lives.latency_kernels import decided_ns

_STAMP, _DECREMENT = 0, 1


@inlined
def _check(
    rows: IntArray,
    counters: IntArray,
    changes: IntArray,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> None:
    """Raise `IndexError` for rows, or numbers of changes, beyond the ends of the arrays."""
    check_rows(rows, 0, len(counters))
    check(counters.shape[1] == NUM_COLUMNS and changes.shape[2] == 2)
    check(len(changes) == len(counters))
    check(len(could_show) == len(counters) and len(expected_ns) == len(counters))
    check(could_show.shape[1] == expected_ns.shape[1])
    for i in range(len(rows)):
        own = rows[i]
        check_rows(
            counters[own, NUM_CHANGES : NUM_CHANGES + 1], 0, changes.shape[1] + 1
        )


@inlined
def _have_room(rows: IntArray, counters: IntArray, changes: IntArray) -> bool:
    """True if each track has room for one more change."""
    has_room = True
    for i in range(len(rows)):
        has_room = has_room and counters[rows[i], NUM_CHANGES] < changes.shape[1]
    return has_room


@inlined
def _counted(counter: int, decrement: int, most: int) -> int:
    """Return the counter after a change. A counter above `most` may only decrease."""
    if decrement > 0:
        return counter - decrement
    return min(counter - decrement, most)


@inlined
def _change(
    own: int,
    stamp_ns: int,
    decrement: int,
    most: int,
    awaits: bool,
    counters: IntArray,
    changes: IntArray,
) -> None:
    """Insert a change by its stamp, and recount from the changes that no late list can precede.

    At the same stamp matches precede misses. Unless a track `awaits` late lists, changes count in order of arrival.
    """
    if not awaits:
        counters[own, COUNTER] = _counted(counters[own, COUNTER], decrement, most)
        return
    count = counters[own, NUM_CHANGES]
    at = count
    while at > 0 and (
        changes[own, at - 1, _STAMP] > stamp_ns
        or (
            changes[own, at - 1, _STAMP] == stamp_ns
            and changes[own, at - 1, _DECREMENT] > decrement
        )
    ):
        changes[own, at, _STAMP] = changes[own, at - 1, _STAMP]
        changes[own, at, _DECREMENT] = changes[own, at - 1, _DECREMENT]
        at -= 1
    changes[own, at, _STAMP] = stamp_ns
    changes[own, at, _DECREMENT] = decrement
    counters[own, NUM_CHANGES] = count + 1
    first = count
    if at < count:
        first = 0
        counters[own, COUNTER] = counters[own, SETTLED]
        counters[own, ENDS] = FOREVER
    for k in range(first, count + 1):
        if counters[own, ENDS] != FOREVER:
            return
        counters[own, COUNTER] = _counted(
            counters[own, COUNTER], changes[own, k, _DECREMENT], most
        )
        if counters[own, COUNTER] <= 0:
            counters[own, ENDS] = changes[own, k, _STAMP]


@inlined
def _settle(
    own: int, decided: int, most: int, counters: IntArray, changes: IntArray
) -> None:
    """Count the changes up to the stamp `decided`, which no late list can precede, and forget them."""
    count, num_settled = counters[own, NUM_CHANGES], 0
    while num_settled < count and changes[own, num_settled, _STAMP] <= decided:
        counters[own, SETTLED] = _counted(
            counters[own, SETTLED], changes[own, num_settled, _DECREMENT], most
        )
        num_settled += 1
    for k in range(num_settled, count):
        changes[own, k - num_settled, _STAMP] = changes[own, k, _STAMP]
        changes[own, k - num_settled, _DECREMENT] = changes[own, k, _DECREMENT]
    counters[own, NUM_CHANGES] = count - num_settled


@njit(
    "boolean(int64[::1], int64, int64, int64, int64, boolean, int64[:, ::1], int64[:, :, ::1], boolean[:, ::1],"
    " int64[:, ::1])"
)
def match(
    rows: IntArray,
    sensor: int,
    stamp_ns: int,
    increment: int,
    most: int,
    awaits: bool,
    counters: IntArray,
    changes: IntArray,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> bool:
    """Count that a list of `sensor` shows the tracks in `rows`.

    Returns False, and changes nothing, if the arrays have no room for the changes.
    """
    _check(rows, counters, changes, could_show, expected_ns)
    check(0 <= sensor < could_show.shape[1])
    if not _have_room(rows, counters, changes):
        return False
    for i in range(len(rows)):
        own = rows[i]
        _change(own, stamp_ns, -increment, most, awaits, counters, changes)
        counters[own, MISSES] = 0
        counters[own, LAST_SEEN] = max(counters[own, LAST_SEEN], stamp_ns)
        could_show[own, sensor] = True
        expected_ns[own, sensor] = max(expected_ns[own, sensor], stamp_ns)
    return True


@njit(
    "boolean(int64[::1], boolean[::1], boolean[:, ::1], int64, int64, boolean, int64[:, ::1], int64[:, :, ::1],"
    " boolean[:, ::1], int64[:, ::1])"
)
def miss(
    rows: IntArray,
    ages: BoolArray,
    views: BoolArray,
    stamp_ns: int,
    most: int,
    awaits: bool,
    counters: IntArray,
    changes: IntArray,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> bool:
    """Note the `views` (m, sensors) of tracks that a list misses, and count the misses of the tracks that it `ages`
    (m,).

    Returns False, and changes nothing, if the arrays have no room for the changes.
    """
    _check(rows, counters, changes, could_show, expected_ns)
    check(len(ages) == len(rows) and len(views) == len(rows))
    check(views.shape[1] == could_show.shape[1])
    if not _have_room(rows, counters, changes):
        return False
    for i in range(len(rows)):
        own = rows[i]
        is_newest = stamp_ns >= counters[own, JUDGED]
        if is_newest:
            counters[own, JUDGED] = stamp_ns
        for k in range(views.shape[1]):
            if views[i, k]:
                expected_ns[own, k] = max(expected_ns[own, k], stamp_ns)
            if is_newest:
                could_show[own, k] = views[i, k]
        if ages[i]:
            counters[own, MISSES] += 1
            _change(own, stamp_ns, 1, most, awaits, counters, changes)
    return True


@njit("void(int64[::1], int64[:, ::1])")
def place(rows: IntArray, counters: IntArray) -> None:
    """Count a measurement that has changed the position of each track in `rows`."""
    check_rows(rows, 0, len(counters))
    check(counters.shape[1] == NUM_COLUMNS)
    for i in range(len(rows)):
        counters[rows[i], NUM_PLACED] += 1


@njit("int64[::1](int64[::1], int64, int64[:, ::1])")
def report(rows: IntArray, confirm_count: int, counters: IntArray) -> IntArray:
    """Return the statuses of the tracks in `rows`: `TENTATIVE`, `CONFIRMED` or `COASTING`, shape (m,)."""
    check_rows(rows, 0, len(counters))
    check(counters.shape[1] == NUM_COLUMNS)
    statuses = np.empty(len(rows), dtype=np.int64)
    for i in range(len(rows)):
        own = rows[i]
        statuses[i] = COASTING if counters[own, MISSES] else CONFIRMED
        if counters[own, NUM_PLACED] < confirm_count:
            statuses[i] = TENTATIVE
    return statuses


@njit(
    "boolean[::1](int64[::1], int64[::1], int64, int64[:, ::1], int64[:, :, ::1], boolean[:, ::1], int64[:, ::1])"
)
def ended(
    rows: IntArray,
    watermarks_ns: IntArray,
    processed_ns: int,
    counters: IntArray,
    changes: IntArray,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> BoolArray:
    """Return True for each track in `rows` whose counter has reached 0 at a stamp that no late list can precede,
    (m,).
    """
    _check(rows, counters, changes, could_show, expected_ns)
    check(len(watermarks_ns) == could_show.shape[1])
    result = np.empty(len(rows), dtype=np.bool_)
    for i in range(len(rows)):
        own = rows[i]
        result[i] = counters[own, ENDS] != FOREVER and counters[
            own, ENDS
        ] <= decided_ns(own, watermarks_ns, processed_ns, could_show, expected_ns)
    return result


@njit(
    "int64(int64[::1], int64, int64, int64[::1], int64, int64, int64[:, ::1], int64[:, :, ::1], boolean[:, ::1],"
    " int64[:, ::1], boolean[::1])"
)
def expire(
    rows: IntArray,
    present_ns: int,
    forget_ns: int,
    watermarks_ns: IntArray,
    processed_ns: int,
    most: int,
    counters: IntArray,
    changes: IntArray,
    could_show: BoolArray,
    expected_ns: IntArray,
    result: BoolArray,
) -> int:
    """Write True to `result` (m,) for each track in `rows` that ends by now, and return the number of these tracks.

    If another track has many changes, the changes that no late list can precede are settled.
    """
    _check(rows, counters, changes, could_show, expected_ns)
    check(len(watermarks_ns) == could_show.shape[1] and len(result) == len(rows))
    number = 0
    for i in range(len(rows)):
        own = rows[i]
        result[i] = False
        last_seen_ns = counters[own, LAST_SEEN]
        if (
            last_seen_ns >= present_ns - forget_ns
            and counters[own, ENDS] == FOREVER
            and counters[own, NUM_CHANGES] < MANY_CHANGES
        ):
            continue
        decided = min(
            decided_ns(own, watermarks_ns, processed_ns, could_show, expected_ns),
            present_ns,
        )
        if counters[own, ENDS] <= decided or decided - last_seen_ns > forget_ns:
            result[i] = True
            number += 1
        else:
            _settle(own, decided, most, counters, changes)
    return number

"""Compiled loops over the lives of tracks; `fgtrack.tracking.lives.existence` has the arrays."""

import math

import numpy as np

from fgtrack.core.compiled import check, check_rows, inlined, njit
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.tracking.lives.counters import COASTING, CONFIRMED, TENTATIVE
from fgtrack.tracking.lives.existence import (
    ENDS,
    IN_VIEW,
    IS_CONFIRMED,
    IS_TRAVELLED,
    JUDGED,
    MISSES,
    NUM_FLAGS,
    NUM_LIFE,
    STAYS,
    SUSPENDED,
    VISIBLE,
)
from fgtrack.tracking.lives.latency import NEVER
from fgtrack.tracking.lives.latency_kernels import decided_ns
from fgtrack.tracking.lives.visibility_kernels import check_histories, existing_at


@inlined
def _check(
    rows: IntArray,
    lives: IntArray,
    flags: BoolArray,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> None:
    """Raise `IndexError` for rows beyond the ends of the arrays."""
    check_rows(rows, 0, len(lives))
    check(lives.shape[1] == NUM_LIFE and flags.shape[1] == NUM_FLAGS)
    check(len(flags) == len(lives) and len(could_show) == len(lives))
    check(len(expected_ns) == len(lives))
    check(could_show.shape[1] == expected_ns.shape[1])


@njit(
    "void(int64[::1], int64[::1], float64[:, ::1], float64, float64[:, ::1], int64[:, ::1], boolean[:, ::1],"
    " boolean[:, ::1], int64[:, ::1])"
)
def match(
    rows: IntArray,
    sensors: IntArray,
    means_m: FloatArray,
    min_travel_m: float,
    first_m: FloatArray,
    lives: IntArray,
    flags: BoolArray,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> None:
    """Note that `sensors` (m,) show the tracks in `rows` (m,), whose states have the positions `means_m` (m, 2)."""
    _check(rows, lives, flags, could_show, expected_ns)
    check_rows(sensors, 0, could_show.shape[1])
    check(len(sensors) == len(rows) and len(means_m) == len(rows))
    check(len(first_m) == len(lives))
    for i in range(len(rows)):
        own = rows[i]
        lives[own, MISSES] = 0
        could_show[own, sensors[i]] = True
        travelled_m = math.hypot(
            means_m[i, 0] - first_m[own, 0], means_m[i, 1] - first_m[own, 1]
        )
        if travelled_m >= min_travel_m:
            flags[own, IS_TRAVELLED] = True


@njit(
    "float64[::1](int64[::1], boolean[:, ::1], int64, int64, float64, int64[:, ::1], boolean[:, ::1],"
    " boolean[:, ::1], int64[:, ::1])"
)
def miss(
    rows: IntArray,
    views: BoolArray,
    sensor: int,
    stamp_ns: int,
    ratio: float,
    lives: IntArray,
    flags: BoolArray,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> FloatArray:
    """Record that a list of `sensor` misses the tracks in `rows` (m,), and return likelihood ratios, shape (m,).

    `views` (m, sensors) is True for the sensors that could see a track. The ratio of existence
    given the miss is `ratio`, or NaN for a track out of the view of the sensor.
    """
    _check(rows, lives, flags, could_show, expected_ns)
    check(len(views) == len(rows) and views.shape[1] == could_show.shape[1])
    check(0 <= sensor < could_show.shape[1])
    ratios = np.empty(len(rows))
    for i in range(len(rows)):
        own = rows[i]
        is_newest = stamp_ns >= lives[own, JUDGED]
        if is_newest:
            lives[own, JUDGED] = stamp_ns
        for k in range(views.shape[1]):
            if is_newest:
                could_show[own, k] = views[i, k]
            if views[i, k]:
                expected_ns[own, k] = max(expected_ns[own, k], stamp_ns)
        ratios[i] = ratio if views[i, sensor] else np.nan
        lives[own, MISSES] += views[i, sensor]
    return ratios


@njit(
    "void(int64[::1], int64[::1], int64[::1], float64[::1], float64[::1], float64[::1], float64, int64[:, ::1],"
    " boolean[:, ::1], boolean[:, ::1], int64[:, ::1])"
)
def note(
    rows: IntArray,
    stamps_ns: IntArray,
    sensors: IntArray,
    ratios: FloatArray,
    visible: FloatArray,
    exists: FloatArray,
    confirm_probability: float,
    lives: IntArray,
    flags: BoolArray,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> None:
    """Note the stamps at which tracks were in view and probably visible. Confirm tracks.

    The evidence (m,) is already in the histories. `ratios` are NaN for tracks out of view. `visible` and `exists` are
    the probabilities that `Histories.learn` returns. A track that has travelled is confirmed from `confirm_probability`
    on.
    """
    _check(rows, lives, flags, could_show, expected_ns)
    check_rows(sensors, 0, could_show.shape[1])
    check(len(stamps_ns) == len(rows) and len(sensors) == len(rows))
    check(len(ratios) == len(rows) and len(visible) == len(rows))
    check(len(exists) == len(rows))
    for i in range(len(rows)):
        own, stamp_ns = rows[i], stamps_ns[i]
        if not math.isnan(ratios[i]):
            lives[own, IN_VIEW] = max(lives[own, IN_VIEW], stamp_ns)
            expected_ns[own, sensors[i]] = max(expected_ns[own, sensors[i]], stamp_ns)
        if visible[i] >= 0.5:
            lives[own, VISIBLE] = max(lives[own, VISIBLE], stamp_ns)
        if exists[i] >= confirm_probability and flags[own, IS_TRAVELLED]:
            flags[own, IS_CONFIRMED] = True


@njit(
    "int64(int64[::1], int64[::1], int64, int64, int64[::1], int64, int64, float64, int64[:, ::1], boolean[:, ::1],"
    " boolean[:, ::1], int64[:, ::1], float64[:, :, ::1], int64[:, :, ::1], int64[::1], float64, int64[::1])"
)
def judge(
    rows: IntArray,
    watermarks_ns: IntArray,
    processed_ns: int,
    present_ns: int,
    scans_ns: IntArray,
    out_of_view_ns: int,
    hidden_ns: int,
    delete_probability: float,
    lives: IntArray,
    flags: BoolArray,
    could_show: BoolArray,
    expected_ns: IntArray,
    numbers: FloatArray,
    entries: IntArray,
    counts: IntArray,
    lifetime_s: float,
    verdicts: IntArray,
) -> int:
    """Return the number of tracks in `rows` that do not stay; `verdicts` (m,) are `STAYS`, `ENDS` or `SUSPENDED`.

    A track ends if it was out of view or hidden for too long, or if its object is improbable. It is suspended if its
    object is improbable unless a list that is still due shows it. `scans_ns` are the ascending stamps of the lists.
    """
    _check(rows, lives, flags, could_show, expected_ns)
    check_histories(rows, numbers, entries, counts)
    check(len(watermarks_ns) == could_show.shape[1] and len(verdicts) == len(rows))
    number = 0
    for i in range(len(rows)):
        own = rows[i]
        decided = decided_ns(own, watermarks_ns, processed_ns, could_show, expected_ns)
        newest = len(scans_ns) - 1
        while newest >= 0 and scans_ns[newest] > decided:
            newest -= 1
        newest_ns = scans_ns[newest] if newest >= 0 else NEVER
        known_ns = min(decided, present_ns)
        verdicts[i] = STAYS
        if (
            newest_ns - lives[own, IN_VIEW] > out_of_view_ns
            or newest_ns - lives[own, VISIBLE] > hidden_ns
        ):
            verdicts[i] = ENDS
        elif (
            existing_at(own, known_ns, False, numbers, entries, counts, lifetime_s)
            < delete_probability
        ):
            known = existing_at(
                own, known_ns, True, numbers, entries, counts, lifetime_s
            )
            verdicts[i] = SUSPENDED if known >= delete_probability else ENDS
        number += verdicts[i] != STAYS
    return number


@njit(
    "void(int64[::1], int64[::1], int64, int64, float64, int64[:, ::1], boolean[:, ::1], boolean[:, ::1],"
    " int64[:, ::1], float64[:, :, ::1], int64[:, :, ::1], int64[::1], float64, int64[::1], float64[::1])"
)
def report(
    rows: IntArray,
    watermarks_ns: IntArray,
    processed_ns: int,
    present_ns: int,
    doubt_probability: float,
    lives: IntArray,
    flags: BoolArray,
    could_show: BoolArray,
    expected_ns: IntArray,
    numbers: FloatArray,
    entries: IntArray,
    counts: IntArray,
    lifetime_s: float,
    statuses: IntArray,
    exists: FloatArray,
) -> None:
    """Write the statuses `TENTATIVE`, `CONFIRMED` or `COASTING`, and the probabilities at present, both shape (m,).

    The status depends on the probability at the stamp up to which all lists have come. So a late sensor does not make
    its tracks tentative.
    """
    _check(rows, lives, flags, could_show, expected_ns)
    check_histories(rows, numbers, entries, counts)
    check(len(watermarks_ns) == could_show.shape[1])
    check(len(statuses) == len(rows) and len(exists) == len(rows))
    for i in range(len(rows)):
        own = rows[i]
        exists[i] = existing_at(
            own, present_ns, False, numbers, entries, counts, lifetime_s
        )
        decided = decided_ns(own, watermarks_ns, processed_ns, could_show, expected_ns)
        known = existing_at(
            own,
            min(decided, present_ns),
            False,
            numbers,
            entries,
            counts,
            lifetime_s,
        )
        statuses[i] = TENTATIVE
        if flags[own, IS_CONFIRMED] and known >= doubt_probability:
            statuses[i] = COASTING if lives[own, MISSES] else CONFIRMED

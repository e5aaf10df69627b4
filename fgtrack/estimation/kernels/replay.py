"""The extended Kalman filter with replay, of many tracks: insert a measurement, and re-filter the later ones.

Banks, tracks and slots are those of `fgtrack.estimation.kernels.replay_arrays`.
"""

import math

from fgtrack.core.compiled import (
    MATRIX,
    add_congruence,
    check,
    check_rows,
    copy,
    inlined,
    merged,
    njit,
    scratch,
    wrapped,
)
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.kernels.kalman import correction_space, marginal_nis
from fgtrack.estimation.kernels.replay_arrays import (
    BANK,
    COUNT,
    FAILED,
    IN_SEQUENCE,
    NEWEST_NS,
    NO_ROOM,
    OLDEST_NS,
    OUT_OF_SEQUENCE,
    SIZE,
    STAMP_NS,
    TIMES_NS,
    Bank,
    Times,
    Track,
    check_bank,
    check_room,
    insert_step,
    is_same,
    track_of,
)
from fgtrack.estimation.kernels.replay_steps import (
    YAW,
    Space,
    correct_slot,
    innovate,
    predict_at,
    predict_state,
    replay_space,
    smooth_back,
    smoothing_space,
)
from fgtrack.models.measurement_kernels import STACK, Stack, check_stack
from fgtrack.models.short_bends import ARC
from fgtrack.models.transitions import check_noise

OUTCOMES = "Tuple((float64[:, ::1], float64[:, :, ::1], float64[::1], int64[::1]))"
Outcomes = tuple[FloatArray, FloatArray, FloatArray, IntArray]
"""Arrays that `fuse` writes: innovations y (m, k), their covariances S (m, k, k), NIS (m,) and outcomes (m,)."""


@merged
def _expect(
    kind: int,
    noise: FloatArray,
    track: Track,
    index: int,
    rows: IntArray,
    R: FloatArray,
    y: FloatArray,
    S: FloatArray,
    space: Space,
) -> float:
    """Write the innovation y (k,) of the new step at `index`, given all other steps, and its covariance S (k, k).

    Return the NIS of the `rows` of y; NaN if a covariance is not positive definite.
    """
    slots, labels, steps, window, _, _ = track
    _, H, now, smoothing, correction = space
    k, n, count = len(y), steps.shape[2], window[COUNT]
    white, K, root = space[0], correction[2], correction[4]
    copy(steps[slots[count], n + 1 if index == count else 0 :], now)
    is_regular = smooth_back(
        kind, noise, slots[index : count + 1], labels, steps, smoothing, now
    )
    innovate(kind, now[0], track, slots[index], y, H[:k])
    for a in range(k):
        for b in range(k):
            S[a, b] = R[a, b]
    add_congruence(H[:k], now[1:], K[:k], S)
    nis = marginal_nis(S, y, rows, root, white)
    return nis if is_regular else math.nan


@merged
def _fuse(
    kind: int,
    noise: FloatArray,
    track: Track,
    times_ns: Times,
    stack: Stack,
    row: int,
    rows: IntArray,
    outcomes: Outcomes,
    space: Space,
) -> int:
    """Fuse the measurement in a row of `stack` into a track, and write its innovation. Return the outcome."""
    lag_ns, _, stamp_ns = times_ns
    slots, _, steps, window, _, _ = track
    y, S, nis, _ = outcomes
    innovation, H, _, smoothing, correction = space
    index = insert_step(track, times_ns, stack, row)
    if index < 0:
        return -index
    count, own = window[COUNT], slots[index]
    j, last, is_fused = index, count, True
    while j <= last:
        slot = slots[j]
        predict_at(kind, noise, track, j, smoothing[0])
        innovate(kind, steps[slot, 0], track, slot, innovation, H)
        is_corrected = correct_slot(kind, track, slot, innovation, H, correction)
        if is_corrected and slot == own:
            nis[row] = _expect(
                kind, noise, track, index, rows, stack[4][row], y[row], S[row], space
            )
            is_corrected = not math.isnan(nis[row])
        j += 1
        if not is_corrected and is_fused:
            # Take the measurement out, and re-filter the later measurements without it.
            for later in range(index, count):
                slots[later] = slots[later + 1]
            slots[count] = own
            j, last, is_fused = index, count - 1, False
    if not is_fused:
        return FAILED
    outcome = IN_SEQUENCE if stamp_ns >= window[NEWEST_NS] else OUT_OF_SEQUENCE
    window[COUNT] = count + 1
    window[NEWEST_NS] = max(window[NEWEST_NS], stamp_ns)
    window[OLDEST_NS] = max(window[OLDEST_NS], window[NEWEST_NS] - lag_ns)
    return outcome


@njit(
    f"int64(int64, float64[::1], {BANK}, int64[::1], {TIMES_NS}, {STACK}, int64[::1], {OUTCOMES})"
)
def fuse(
    kind: int,
    noise: FloatArray,
    bank: Bank,
    tracks: IntArray,
    times_ns: Times,
    stack: Stack,
    rows: IntArray,
    outcomes: Outcomes,
) -> int:
    """Fuse a stack of measurements, one of each of `tracks` (m,), and re-filter the later measurements.

    Innovations are given everything that was fused. Their NIS is the NIS of the measured components, `rows`. A failed
    measurement changes nothing, and neither does a measurement that is older than the window of its track. Returns the
    number of tracks whose slots are all in use: nothing changes there.
    """
    y, S, nis, outcome = outcomes
    m, k, n, num_without_room = len(tracks), y.shape[1], bank[2].shape[3], 0
    check_noise(kind, noise, n)
    check_bank(tracks, 0, bank, n)
    check_room(bank, k)
    check_stack(stack, m, k, n)
    check(len(y) == m and len(S) == m and len(nis) == m and len(outcome) == m)
    check(S.shape[1] == k and S.shape[2] == k)
    check_rows(rows, 0, k)
    space = replay_space(n, bank[4].shape[3])
    for i in range(m):
        outcome[i] = _fuse(
            kind,
            noise,
            track_of(bank, tracks[i]),
            times_ns,
            stack,
            i,
            rows,
            outcomes,
            space,
        )
        num_without_room += outcome[i] == NO_ROOM
    return num_without_room


@inlined
def _index_of(track: Track, stamp_ns: int, stack: Stack, row: int) -> int:
    """Return the index of the step with the measurement in a row of `stack`; -1 without one."""
    found = -1
    for index in range(1, track[3][COUNT]):
        if is_same(track, track[0][index], stamp_ns, stack, row):
            found = index
            break
    return found


@njit(f"void(int64, float64[::1], {BANK}, int64[::1], int64, {STACK}, int64[::1])")
def withdraw(
    kind: int,
    noise: FloatArray,
    bank: Bank,
    tracks: IntArray,
    stamp_ns: int,
    stack: Stack,
    outcomes: IntArray,
) -> None:
    """Take the measurements of `stack` out of the steps of `tracks` (m,), and re-filter the later measurements.

    Written is 1 for a track that had the measurement, 0 for a track without it or without a row, and -1 if a later
    measurement can no longer be fused. The states from this later measurement on are then invalid.
    """
    n, k = bank[2].shape[3], len(stack[0])
    check_noise(kind, noise, n)
    check_bank(tracks, -1, bank, n)
    check_stack(stack, len(tracks), k, n)
    check_room(bank, k)
    check(len(outcomes) >= len(tracks))
    space = replay_space(n, bank[4].shape[3])
    innovation, H, _, smoothing, correction = space
    for i in range(len(tracks)):
        outcomes[i] = 0
        if tracks[i] < 0:
            continue
        track = track_of(bank, tracks[i])
        slots, labels, steps, window, _, _ = track
        index = _index_of(track, stamp_ns, stack, i)
        if index < 0:
            continue
        outcomes[i], count, own = 1, window[COUNT], slots[index]
        for later in range(index, count - 1):
            slots[later] = slots[later + 1]
        slots[count - 1] = own
        window[COUNT] = count - 1
        window[NEWEST_NS] = labels[slots[count - 2], STAMP_NS]
        for j in range(index, count - 1):
            slot = slots[j]
            predict_at(kind, noise, track, j, smoothing[0])
            innovate(kind, steps[slot, 0], track, slot, innovation, H)
            if not correct_slot(kind, track, slot, innovation, H, correction):
                outcomes[i] = -1
                break


@njit(f"int64({BANK}, int64[::1], int64, {STACK})")
def find(bank: Bank, tracks: IntArray, stamp_ns: int, stack: Stack) -> int:
    """Return the index of the step of the first of `tracks` with the first measurement of `stack`; -1 without one."""
    check(len(tracks) > 0 and len(stack[0]) > 0)
    n, k = bank[2].shape[3], len(stack[0])
    check_bank(tracks, 0, bank, n)
    check_stack(stack, 1, k, n)
    check_room(bank, k)
    return int(_index_of(track_of(bank, tracks[0]), stamp_ns, stack, 0))


@njit(f"int64({BANK}, int64[::1], {TIMES_NS}, {STACK})")
def insert(bank: Bank, tracks: IntArray, times_ns: Times, stack: Stack) -> int:
    """Insert the first measurement of `stack` into the steps of the first of `tracks`. See `insert_step`.

    Together with `predict_step`, `correct_step` and `retrodict` this function does for one track what `fuse` does for
    many. Between these calls a plug-in linearises its measurement, or an initiation replaces a state.
    """
    n, k = bank[2].shape[3], len(stack[0])
    check_bank(tracks, 0, bank, n)
    check_room(bank, k)
    check_stack(stack, 1, k, n)
    check(len(tracks) > 0)
    return insert_step(track_of(bank, tracks[0]), times_ns, stack, 0)


@njit(f"void(int64, float64[::1], {BANK}, int64[::1], int64)")
def predict_step(
    kind: int, noise: FloatArray, bank: Bank, tracks: IntArray, index: int
) -> None:
    """Predict the step at `index` of the first of `tracks` from the step before."""
    n = bank[2].shape[3]
    check_noise(kind, noise, n)
    check_bank(tracks, 0, bank, n)
    check(len(tracks) > 0 and 0 < index < bank[0].shape[1])
    predict_at(kind, noise, track_of(bank, tracks[0]), index, scratch(n, n))


@njit(f"b1(int64, {BANK}, int64[::1], int64, b1, float64[::1], {MATRIX})")
def correct_step(
    kind: int,
    bank: Bank,
    tracks: IntArray,
    index: int,
    is_linearised: bool,
    y: FloatArray,
    H: FloatArray,
) -> bool:
    """Fuse the measurement of the predicted step at `index` of the first of `tracks`; False if it cannot be fused.

    If `is_linearised`, the innovation y (k,) and the Jacobian H (k, n) are given. Else this function writes them.
    """
    n = bank[2].shape[3]
    check_bank(tracks, 0, bank, n)
    check(len(tracks) > 0 and 0 < index < bank[0].shape[1])
    track = track_of(bank, tracks[0])
    slots, labels, steps, _, _, _ = track
    slot = slots[index]
    k = labels[slot, SIZE]
    check_room(bank, k)
    check(k > 0 and len(y) == k and H.shape == (k, n))
    space = correction_space(n, bank[4].shape[3])
    if not is_linearised:
        innovate(kind, steps[slot, 0], track, slot, y, H)
    return correct_slot(kind, track, slot, y, H, space)


@njit(f"b1(int64, float64[::1], {BANK}, int64[::1], int64, int64, {MATRIX})")
def retrodict(
    kind: int,
    noise: FloatArray,
    bank: Bank,
    tracks: IntArray,
    index: int,
    last: int,
    now: FloatArray,
) -> bool:
    """Write the state (n + 1, n) at the new step at `index`, without its measurement, given all steps up to `last`."""
    n = bank[2].shape[3]
    check_noise(kind, noise, n)
    check_bank(tracks, 0, bank, n)
    check(len(tracks) > 0 and 0 < index <= last < bank[0].shape[1])
    check(now.shape == (n + 1, n))
    slots, labels, steps, _, _, _ = track_of(bank, tracks[0])
    copy(steps[slots[last], n + 1 if index == last else 0 :], now)
    return smooth_back(
        kind, noise, slots[index : last + 1], labels, steps, smoothing_space(n), now
    )


@njit(
    f"int64(int64, float64[::1], {BANK}, int64[::1], int64, int64, b1, float64[:, ::1], float64[:, :, ::1], b1[::1])"
)
def ahead(
    kind: int,
    noise: FloatArray,
    bank: Bank,
    tracks: IntArray,
    oldest_ns: int,
    stamp_ns: int,
    is_present: bool,
    means: FloatArray,
    covariances: FloatArray,
    known: BoolArray,
) -> int:
    """Write the states (m, n) and (m, n, n) of `tracks` at a stamp, predicted from the last step before the stamp.

    `known` (m,) becomes True for tracks whose windows have begun at the stamp. If `is_present`, a track that begins
    later has its first state and is known, too. Rows below 0 are skipped. Returns the number of known tracks.
    """
    n, num_known = bank[2].shape[3], 0
    check_noise(kind, noise, n)
    check_bank(tracks, -1, bank, n)
    check(
        len(means) == len(tracks)
        and len(covariances) == len(tracks)
        and len(known) == len(tracks)
    )
    F, FP = scratch(n, n), scratch(n, n)
    for i in range(len(tracks)):
        if tracks[i] < 0:
            continue
        slots, labels, steps, window, _, _ = track_of(bank, tracks[i])
        start_ns = max(window[OLDEST_NS], oldest_ns)
        at_ns = max(stamp_ns, start_ns) if is_present else stamp_ns
        known[i] = start_ns <= at_ns
        if not known[i]:
            continue
        num_known += 1
        j = window[COUNT] - 1
        while j > 0 and labels[slots[j], STAMP_NS] > at_ns:
            j -= 1
        predict_state(
            kind,
            noise,
            steps[slots[j], : n + 1],
            at_ns - labels[slots[j], STAMP_NS],
            F,
            means[i],
            covariances[i],
            FP,
        )
        if kind == ARC:
            means[i, YAW] = wrapped(means[i, YAW])
    return num_known

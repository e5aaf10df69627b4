"""Compiled parts of a step: the table of a list, the tracks after the list, and their hypotheses."""

import math

import numpy as np

from fgtrack.core.compiled import check, check_rows, njit
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.tracking.decisions.columns import (
    ALIVE,
    BELIEVED,
    COASTS,
    COUNT,
    EXISTED,
    FIRST_X_M,
    FIRST_Y_M,
    HAS_TRAVELLED,
    HAZARD_HZ,
    HITS,
    IS_CONFIRMED,
    MISSES,
    NUM_NUMBERS,
    NUM_PROBABILITIES,
    OWN,
    SENSOR,
)

_LARGEST_LOG_RATIO = 500.0


@njit(
    "(int64[:], int64[:], float64[:], b1[:], float64[:], float64[:], float64[:], b1[:], b1, int64, float64)"
)
def tabulate(
    tracks: IntArray,
    candidates: IntArray,
    log_ratios: FloatArray,
    jumps: BoolArray,
    log_free: FloatArray,
    exists: FloatArray,
    detectable: FloatArray,
    in_view: BoolArray,
    shows_misses: bool,
    num_candidates: int,
    least_gain: float,
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, BoolArray, FloatArray]:
    """Return the table of a list by track, of the pairs (p,) whose gain is above `least_gain`.

    These are the first pair of each track (n + 1,), candidates, gains against a missed track, likelihood ratios against
    a candidate without a track, and jumps, all (q,), and the log-likelihood of each track without a candidate (n,).

    Pairs have log-densities `log_ratios`; `log_free` (m,) is the log-density of a candidate without a track. Tracks
    exist with the probabilities `exists`, and are detected then with the probabilities `detectable`, shapes (n,). A
    list that `shows_misses` shows each track `in_view` (n,), or its absence. The pairs of a candidate are in the order
    of the tracks.
    """
    n, p = len(exists), len(tracks)
    check(len(candidates) == p and len(log_ratios) == p and len(jumps) == p)
    check(len(detectable) == n and len(in_view) == n)
    check(len(log_free) == num_candidates)
    check_rows(tracks, 0, n)
    check_rows(candidates, 0, num_candidates)
    log_missed, log_hit = np.zeros(n), np.empty(n)
    for i in range(n):
        detected = exists[i] * detectable[i]
        if shows_misses and in_view[i]:
            log_missed[i] = math.log(1.0 - detected)
        log_hit[i] = math.log(max(detected, 1e-300)) - log_missed[i]
    first = np.zeros(n + 1, np.int64)
    for k in range(p):
        own = log_hit[tracks[k]] + log_ratios[k] - log_free[candidates[k]]
        if own > least_gain:
            first[tracks[k] + 1] += 1
    for i in range(n):
        first[i + 1] += first[i]
    count = first[n]
    of, gains = np.empty(count, np.int64), np.empty(count)
    ratios, is_jump = np.empty(count), np.empty(count, np.bool_)
    at = first.copy()
    for k in range(p):
        i = tracks[k]
        log_ratio = log_ratios[k] - log_free[candidates[k]]
        if log_hit[i] + log_ratios[k] - log_free[candidates[k]] > least_gain:
            to = at[i]
            of[to], gains[to], is_jump[to] = (
                candidates[k],
                log_hit[i] + log_ratio,
                jumps[k],
            )
            ratios[to] = math.exp(min(log_ratio, _LARGEST_LOG_RATIO))
            at[i] += 1
    return first, of, gains, ratios, is_jump, log_missed


@njit("(int64[::1], int64[::1], int64[:, ::1], b1[:])")
def distinct(
    first: IntArray, candidates: IntArray, pairs: IntArray, is_born: BoolArray
) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Return the distinct tracks of several assignments.

    These are the row (k,) and the pair (k,) of each track that is no birth, and the candidate of each track, -1 for a
    missed one, of which the b births come first, shape (b + k,). Then follow the tracks of all assignments, one
    assignment after the other, and the ends of the assignments (r + 1,).

    `pairs` (r, n) has the pair of each row, -1 for a missed one, -2 for a row that the assignment does not have. Row i
    has the pairs `first[i]` to `first[i + 1]` with `candidates` (p,). The candidates in `is_born` (m,) without a track
    start tracks.
    """
    (r, n), m = pairs.shape, len(is_born)
    check(len(first) == n + 1 and first[0] == 0 and first[n] == len(candidates))
    check_rows(candidates, 0, m)
    for i in range(n):
        check(first[i] <= first[i + 1])
        for a in range(r):
            check(pairs[a, i] < 0 or first[i] <= pairs[a, i] < first[i + 1])
    taken = np.zeros((r, m), np.bool_)
    # Row i has the codes from m + first[i] + i on: missed, then its pairs.
    is_used = np.zeros(m + n + first[n], np.bool_)
    total = 0
    for a in range(r):
        for i in range(n):
            if pairs[a, i] >= -1:
                total += 1
                code = m + first[i] + i
                if pairs[a, i] >= 0:
                    taken[a, candidates[pairs[a, i]]] = True
                    code += pairs[a, i] - first[i] + 1
                is_used[code] = True
        for c in range(m):
            if is_born[c] and not taken[a, c]:
                total += 1
                is_used[c] = True
    numbers, num_births, count = np.empty(len(is_used), np.int64), 0, 0
    for code in range(len(is_used)):
        numbers[code] = count
        if is_used[code]:
            count += 1
            num_births += 1 if code < m else 0
    own_candidates = np.full(count, -1)
    rows, own_pairs = np.empty((2, count - num_births), np.int64)
    for c in range(m):
        if is_used[c]:
            own_candidates[numbers[c]] = c
    for i in range(n):
        code = m + first[i] + i
        for choice in range(first[i + 1] - first[i] + 1):
            if is_used[code + choice]:
                k = numbers[code + choice] - num_births
                rows[k] = i
                own_pairs[k] = -1
                if choice > 0:
                    own_pairs[k] = first[i] + choice - 1
                    own_candidates[numbers[code + choice]] = candidates[own_pairs[k]]
    members, ends, at = np.empty(total, np.int64), np.zeros(r + 1, np.int64), 0
    for a in range(r):
        for c in range(m):
            if is_born[c] and not taken[a, c]:
                members[at] = numbers[c]
                at += 1
        for i in range(n):
            if pairs[a, i] >= -1:
                code = m + first[i] + i
                if pairs[a, i] >= 0:
                    code += pairs[a, i] - first[i] + 1
                members[at] = numbers[code]
                at += 1
        ends[a + 1] = at
    return rows, own_pairs, own_candidates, members, ends


@njit(
    "void(float64[:, ::1], int64[:, ::1], float64[:, ::1], float64[:, ::1], int64[::1], b1[::1], float64[::1], "
    "float64[::1], b1[::1], int64, float64, float64, float64)"
)
def update(
    probabilities: FloatArray,
    numbers: IntArray,
    visible: FloatArray,
    means: FloatArray,
    pairs: IntArray,
    is_placed: BoolArray,
    ratios: FloatArray,
    detectable: FloatArray,
    in_view: BoolArray,
    sensor: int,
    detection_probability: float,
    visible_share: float,
    min_travel_m: float,
) -> None:
    """Update the tracks of a list of `sensor`, after their detections or misses.

    `pairs` (k,) are the pairs of the tracks, below 0 for a missed track. A detection `is_placed` (k,) if it has a
    position, and has the likelihood ratio `ratios` (k,) to a candidate without a track. Tracks are detected with the
    probability `detectable` (k,) if they exist. The list would show each track `in_view` (k,).
    """
    k = len(probabilities)
    check(len(numbers) >= k and len(visible) >= k and len(means) >= k)
    check(len(pairs) >= k and len(is_placed) >= k and len(ratios) >= k)
    check(len(detectable) >= k and len(in_view) >= k)
    check(probabilities.shape[1] == NUM_PROBABILITIES and means.shape[1] >= 2)
    check(numbers.shape[1] == NUM_NUMBERS and 0 <= sensor < visible.shape[1])
    for i in range(k):
        own, counts, seen = probabilities[i], numbers[i], visible[i, sensor]
        is_hit = pairs[i] >= 0
        missable = detectable[i] if in_view[i] else 0.0
        existed, believed, alive = own[EXISTED], own[BELIEVED], own[ALIVE]
        unseen_alive = 1.0 - alive * missable
        if is_placed[i]:
            own[EXISTED] = own[ALIVE] = 1.0
        elif not is_hit:
            own[EXISTED] = existed * unseen_alive / (1.0 - existed * alive * missable)
            own[ALIVE] = alive * (1.0 - missable) / unseen_alive
        if is_placed[i] or not is_hit:
            # The few hypotheses that are kept do not show each detection as clutter. So a track with a detection is
            # compared with the same track that was missed.
            exists = believed * alive
            missed = 1.0 - exists * missable
            odds = exists * detectable[i] * ratios[i] / missed if is_placed[i] else 0.0
            own[BELIEVED] = (odds + believed * unseen_alive / missed) / (odds + 1.0)
        if is_hit:
            visible[i, sensor] = 1.0
            dx, dy = means[i, 0] - own[FIRST_X_M], means[i, 1] - own[FIRST_Y_M]
            if math.hypot(dx, dy) >= min_travel_m:
                counts[HAS_TRAVELLED] = 1
            counts[HITS] += 1
            counts[COASTS] = 0
        elif in_view[i]:
            left = max(1.0 - seen * detection_probability, 1e-12)
            visible[i, sensor] = seen * (1.0 - detection_probability) / left
            counts[COASTS] = 1
        else:
            visible[i, sensor] = visible_share
        if counts[SENSOR] == sensor:
            if is_hit:
                counts[COUNT] += 1
            elif in_view[i]:
                counts[MISSES] += 1


@njit(
    "(float64[:, ::1], int64[::1], int64[::1], int64[::1], float64[::1], int64[::1], int64, float64)"
)
def merge(
    probabilities: FloatArray,
    candidates: IntArray,
    members: IntArray,
    ends: IntArray,
    log_weights: FloatArray,
    parents: IntArray,
    num_candidates: int,
    least_existence: float,
) -> tuple[
    IntArray, FloatArray, IntArray, IntArray, IntArray, IntArray, IntArray, IntArray
]:
    """Return the hypotheses after a list, the likeliest first. Hypotheses with the same tracks become one hypothesis.

    These are the tracks that may still exist (u,), and of the hypotheses the log-weights (h,), parents (h,), and tracks
    as rows of the former, one hypothesis after the other, with their ends (h + 1,), the track of each candidate (h, m),
    -1 for none, and the tracks that end, with their ends (h + 1,).

    Assignment a has the tracks `members[ends[a]:ends[a + 1]]`. The tracks took `candidates`, below 0 for none.
    """
    k, r, m = len(probabilities), len(log_weights), num_candidates
    check(probabilities.shape[1] == NUM_PROBABILITIES and len(candidates) == k)
    check(len(ends) == r + 1 and ends[0] == 0 and ends[r] == len(members))
    check(len(parents) == r)
    check_rows(members, 0, k)
    check_rows(candidates, -1, m)
    is_alive, is_used = np.empty(k, np.bool_), np.zeros(k, np.bool_)
    for i in range(k):
        own = probabilities[i]
        is_alive[i] = own[EXISTED] * own[ALIVE] >= least_existence
    # The tracks of each assignment that may still exist:
    living, living_ends, at = (
        np.empty(len(members), np.int64),
        np.zeros(r + 1, np.int64),
        0,
    )
    for a in range(r):
        check(ends[a] <= ends[a + 1])
        for b in range(ends[a], ends[a + 1]):
            if is_alive[members[b]]:
                living[at], is_used[members[b]] = members[b], True
                at += 1
        living_ends[a + 1] = at
    in_use, new_rows, count = np.empty(k, np.int64), np.empty(k, np.int64), 0
    for i in range(k):
        if is_used[i]:
            in_use[count], new_rows[i] = i, count
            count += 1
    kept, weights, num_kept = np.empty(r, np.int64), np.empty(r), 0
    for a in range(r):
        same = -1
        size = living_ends[a + 1] - living_ends[a]
        for h in range(num_kept):
            b = kept[h]
            if living_ends[b + 1] - living_ends[b] != size:
                continue
            is_same = True
            for c in range(size):
                if living[living_ends[a] + c] != living[living_ends[b] + c]:
                    is_same = False
                    break
            if is_same:
                same = h
                break
        if same < 0:
            kept[num_kept], weights[num_kept] = a, log_weights[a]
            num_kept += 1
        else:
            larger = max(weights[same], log_weights[a])
            smaller = min(weights[same], log_weights[a])
            weights[same] = larger + math.log1p(math.exp(smaller - larger))
    for h in range(1, num_kept):  # sort, the likeliest first
        g = h
        while g > 0 and weights[g - 1] < weights[g]:
            weights[g - 1], weights[g] = weights[g], weights[g - 1]
            kept[g - 1], kept[g] = kept[g], kept[g - 1]
            g -= 1
    rows, row_ends = np.empty(len(living), np.int64), np.zeros(num_kept + 1, np.int64)
    gone, gone_ends = np.empty(len(members), np.int64), np.zeros(num_kept + 1, np.int64)
    taken = np.full((num_kept, m), -1)
    own_parents, at, gone_at = np.empty(num_kept, np.int64), 0, 0
    for h in range(num_kept):
        a = kept[h]
        own_parents[h] = parents[a]
        for b in range(ends[a], ends[a + 1]):
            i = members[b]
            if candidates[i] >= 0:
                taken[h, candidates[i]] = i
            if is_alive[i]:
                rows[at] = new_rows[i]
                at += 1
            else:
                gone[gone_at] = i
                gone_at += 1
        row_ends[h + 1], gone_ends[h + 1] = at, gone_at
    return (
        in_use[:count],
        weights[:num_kept],
        own_parents,
        rows[:at],
        row_ends,
        taken,
        gone[:gone_at],
        gone_ends,
    )


@njit(
    "void(float64[:, ::1], int64[:, ::1], float64[:, ::1], b1[:, ::1], float64[::1], float64, float64, float64, "
    "float64)"
)
def judge(
    probabilities: FloatArray,
    numbers: IntArray,
    visible: FloatArray,
    views: BoolArray,
    own: FloatArray,
    confirm_probability: float,
    lifetime_s: float,
    hidden_s: float,
    out_of_view_s: float,
) -> None:
    """Write the confirmation of tracks, and the rate at which their existence decays from now on.

    `views` (n, sensors) is True for each sensor that could show the track. Tracks are no second returns with the
    probabilities `own` (n,).
    """
    n = len(probabilities)
    check(len(numbers) >= n and len(visible) >= n and len(views) >= n and len(own) >= n)
    check(probabilities.shape[1] == NUM_PROBABILITIES)
    check(numbers.shape[1] == NUM_NUMBERS and views.shape[1] == visible.shape[1])
    for i in range(n):
        probabilities[i, OWN] = own[i]
        exists = probabilities[i, BELIEVED] * probabilities[i, ALIVE] * own[i]
        if numbers[i, HAS_TRAVELLED] == 1 and exists >= confirm_probability:
            numbers[i, IS_CONFIRMED] = 1
        is_in_view, seen = False, 0.0
        for k in range(views.shape[1]):
            if views[i, k]:
                is_in_view, seen = True, max(seen, visible[i, k])
        slow_s, share = (hidden_s, 1.0 - seen) if is_in_view else (out_of_view_s, 1.0)
        probabilities[i, HAZARD_HZ] = 1.0 / lifetime_s + share / slow_s


@njit("void(float64[:, ::1], float64[:, ::1], float64, float64, float64)")
def fade(
    probabilities: FloatArray,
    visible: FloatArray,
    dt_s: float,
    visible_share: float,
    visible_s: float,
) -> None:
    """Let existence and visibility of tracks decay for `dt_s`."""
    check(len(visible) >= len(probabilities))
    check(probabilities.shape[1] == NUM_PROBABILITIES)
    forgotten = math.exp(-dt_s / visible_s)
    for i in range(len(probabilities)):
        probabilities[i, ALIVE] *= math.exp(-probabilities[i, HAZARD_HZ] * dt_s)
        for k in range(visible.shape[1]):
            visible[i, k] = visible_share + (visible[i, k] - visible_share) * forgotten

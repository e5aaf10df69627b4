"""Compiled loops over the evidence of existence and visibility; `fgtrack.tracking.lives.visibility` has the arrays."""

import math

import numpy as np

from fgtrack.core.compiled import check, check_rows, inlined, merged, njit
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.tracking.lives.visibility import (
    LARGEST_LOG_ODDS,
    LOG_ODDS,
    NEVER,
    RATIO,
    SENSOR,
    STAMP,
    VIEWED,
    VISIBLE,
)


@inlined
def _survived(log_odds: float, dt_ns: int, lifetime_s: float) -> float:
    """Return the log-odds after `dt_ns`: odds r / (1 - r) become r s / (1 - r s) with s = exp(-dt / lifetime)."""
    dt = dt_ns / (NS_PER_S * lifetime_s)
    if dt <= 0.0:
        return log_odds
    return max(-math.log(math.exp(-log_odds) - math.expm1(-dt)) - dt, -LARGEST_LOG_ODDS)


@merged
def _conclude(
    numbers: FloatArray,
    entries: IntArray,
    k: int,
    lifetime_s: float,
    visible_share: float,
    visible_s: float,
) -> None:
    """Write the probabilities after entry k of one track.

    Prediction v = share + (v - share) exp(-dt / visible_s), likelihood 1 - v + v ratio, update v ratio / likelihood.
    """
    for j in range(VISIBLE, numbers.shape[1]):
        numbers[k, j], entries[k, j - VISIBLE + VIEWED] = (
            numbers[k - 1, j],
            entries[k - 1, j - VISIBLE + VIEWED],
        )
    own, viewed, stamp_ns = (
        VISIBLE + entries[k, SENSOR],
        VIEWED + entries[k, SENSOR],
        entries[k, STAMP],
    )
    v, ratio = visible_share, numbers[k, RATIO]
    numbers[k, LOG_ODDS] = _survived(
        numbers[k - 1, LOG_ODDS], stamp_ns - entries[k - 1, STAMP], lifetime_s
    )
    if math.isnan(
        ratio
    ):  # out of view: what it sees when it is back is not correlated with what it saw
        numbers[k, own], entries[k, viewed] = 0.0, NEVER
        return
    if entries[k, viewed] != NEVER:
        v += (numbers[k, own] - v) * math.exp(
            (entries[k, viewed] - stamp_ns) / (NS_PER_S * visible_s)
        )
    likelihood = 1.0 - v + v * ratio
    numbers[k, own], entries[k, viewed] = v * ratio / likelihood, stamp_ns
    changed = numbers[k, LOG_ODDS] + math.log(likelihood)
    numbers[k, LOG_ODDS] = min(max(changed, -LARGEST_LOG_ODDS), LARGEST_LOG_ODDS)


@inlined
def _existing(
    own: int,
    k: int,
    stamp_ns: int,
    numbers: FloatArray,
    entries: IntArray,
    lifetime_s: float,
) -> float:
    """Return the probability at `stamp_ns`, or at entry k if that is newer, from the evidence up to entry k."""
    log_odds = _survived(
        numbers[own, k, LOG_ODDS], stamp_ns - entries[own, k, STAMP], lifetime_s
    )
    return 1.0 / (1.0 + math.exp(-log_odds))


@inlined
def existing_at(
    own: int,
    stamp_ns: int,
    is_known: bool,
    numbers: FloatArray,
    entries: IntArray,
    counts: IntArray,
    lifetime_s: float,
) -> float:
    """Return the probability that the object of track `own` exists at `stamp_ns`.

    All evidence counts, or only the evidence up to the stamp if `is_known`. A newer list that could not show the object
    is no evidence.
    """
    k = counts[own] - 1
    while (
        k > 0
        and entries[own, k, STAMP] > stamp_ns
        and (is_known or math.isnan(numbers[own, k, RATIO]))
    ):
        k -= 1
    return _existing(own, k, stamp_ns, numbers, entries, lifetime_s)


@inlined
def check_histories(
    rows: IntArray, numbers: FloatArray, entries: IntArray, counts: IntArray
) -> None:
    """Raise `IndexError` for rows, or numbers of entries, beyond the ends of the arrays."""
    check_rows(rows, 0, len(counts))
    check(
        len(numbers) >= len(counts)
        and len(entries) >= len(counts)
        and numbers.shape[1] == entries.shape[1]
    )
    check(numbers.shape[2] - VISIBLE == entries.shape[2] - VIEWED)
    for i in range(len(rows)):
        check_rows(counts[rows[i] : rows[i] + 1], 1, entries.shape[1] + 1)


@njit(
    "(int64[::1], int64[::1], int64[::1], float64[::1], float64[:, :, ::1], int64[:, :, ::1], int64[::1],"
    " float64, float64, float64)"
)
def learn(
    rows: IntArray,
    stamps_ns: IntArray,
    sensors: IntArray,
    ratios: FloatArray,
    numbers: FloatArray,
    entries: IntArray,
    counts: IntArray,
    lifetime_s: float,
    visible_share: float,
    visible_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Insert entries into the tracks `rows`, each by its stamp, and recompute the later entries.

    Returns two probabilities after each insertion, shape (m,): that the object is visible to the sensor, and that it
    exists. The second is the largest probability at the stamps from the entry on.
    """
    check_histories(rows, numbers, entries, counts)
    num_entries, num_sensors = entries.shape[1], entries.shape[2] - VIEWED
    check_rows(sensors, 0, num_sensors)
    check(
        len(stamps_ns) >= len(rows)
        and len(sensors) >= len(rows)
        and len(ratios) >= len(rows)
    )
    visible, exists = np.empty(len(rows)), np.empty(len(rows))
    for m in range(len(rows)):
        own, at, stamp_ns = rows[m], counts[rows[m]], stamps_ns[m]
        check(at < num_entries)
        while at > 1 and entries[own, at - 1, STAMP] > stamp_ns:
            numbers[own, at, RATIO] = numbers[own, at - 1, RATIO]
            for j in range(VIEWED):
                entries[own, at, j] = entries[own, at - 1, j]
            at -= 1
        counts[own] += 1
        numbers[own, at, RATIO], entries[own, at, SENSOR] = ratios[m], sensors[m]
        entries[own, at, STAMP] = max(stamp_ns, entries[own, 0, STAMP])
        exists[m] = 0.0
        for k in range(at, counts[own]):
            _conclude(
                numbers[own], entries[own], k, lifetime_s, visible_share, visible_s
            )
            exists[m] = max(
                exists[m], _existing(own, k, NEVER, numbers, entries, lifetime_s)
            )
        visible[m] = numbers[own, counts[own] - 1, VISIBLE + sensors[m]]
    return visible, exists


@njit(
    "float64[::1](int64[::1], int64[::1], boolean, float64[:, :, ::1], int64[:, :, ::1], int64[::1], float64)"
)
def existing(
    rows: IntArray,
    stamps_ns: IntArray,
    is_known: bool,
    numbers: FloatArray,
    entries: IntArray,
    counts: IntArray,
    lifetime_s: float,
) -> FloatArray:
    """Return the probabilities of existence at `stamps_ns` (m,), shape (m,); see `existing_at`."""
    check_histories(rows, numbers, entries, counts)
    check(len(stamps_ns) >= len(rows))
    result = np.empty(len(rows))
    for m in range(len(rows)):
        result[m] = existing_at(
            rows[m], stamps_ns[m], is_known, numbers, entries, counts, lifetime_s
        )
    return result


@njit("void(int64, float64[:, :, ::1], int64[:, :, ::1], int64[::1])")
def forget(
    oldest_ns: int, numbers: FloatArray, entries: IntArray, counts: IntArray
) -> None:
    """Drop the entries up to `oldest_ns` but the last, which becomes entry 0."""
    check(len(numbers) >= len(counts) and len(entries) >= len(counts))
    check_rows(counts, 0, entries.shape[1] + 1)
    for own in range(len(counts)):
        last = 0
        while last + 1 < counts[own] and entries[own, last + 1, STAMP] <= oldest_ns:
            last += 1
        for k in range(last, counts[own] if last else 0):
            for j in range(numbers.shape[2]):
                numbers[own, k - last, j], entries[own, k - last, j] = (
                    numbers[own, k, j],
                    entries[own, k, j],
                )
        counts[own] -= last

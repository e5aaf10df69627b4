"""Diagnostics of what a run received: angles in degrees, silent sensors, repeated recordings."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fgtrack.core.diagnostic import EGO, Diagnostic, in_degrees
from fgtrack.core.finding import percent
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import IntArray
from fgtrack.evaluation.diagnostics.outcomes import section
from fgtrack.evaluation.scores.innovations import by_sensor
from fgtrack.models.measurement import ANGULAR
from fgtrack.runs import Run

# A silence counts from this length on, in seconds and in mean periods of the sensor. It is longer than the sensor's
# other gaps by this factor, because a sensor without an object may send nothing.
_SILENCE_S = 5.0
_SILENCE_PERIODS = 20.0
_SILENCE_FACTOR = 3.0
# A stamp is repeated if it was received at least this time before. A smaller share of repeated stamps may be copies.
_LOOP_NS = NS_PER_S
_LOOP_SHARE = 0.1
# Largest share of repeated stamps in a loop that are followed by a new stamp. Late reports come between new ones.
_NEW_SHARE = 0.1


def received_nothing(run: Run) -> str | None:
    """Line on a run that received no detection; None if a detection was received."""
    if run.tables["updates"].num_rows:
        return None
    lists = dict(run.meta.get("lists") or {})
    counted = ", ".join(
        f"{name}: {one['count']} empty lists" for name, one in sorted(lists.items())
    )
    return (
        f"no detection was received ({counted or 'no detection list'}): check the topics or tables of the sensors "
        "(`fgtrack info`)"
    )


def mapped_nothing(run: Run) -> Iterator[Diagnostic]:
    """Yield the configured topics and tables of sensors from which no list was read."""
    lists = run.meta.get("lists")
    if lists is None:  # a run of an older version
        return
    source = section(run, "input")
    ignored = set(run.config.get("ignore_sensors") or ())
    mapped = {
        **dict(source.get("detections") or {}),
        **dict((source.get("csv") or {}).get("detections") or {}),
    }
    for name, item in mapped.items():
        if name not in lists and name not in ignored:
            where = (item or {}).get("topic") or (item or {}).get("file") or "its input"
            yield Diagnostic(
                name,
                f"no list was read from {where}: it is missing in the recording, or empty",
            )


def silences(run: Run) -> Iterator[Diagnostic]:
    """Yield the sensors that fall silent: an unusually long time without a list."""
    first_ns = run.meta.get("first_receipt_ns")
    last_ns = run.meta.get("last_receipt_ns")
    if first_ns is None or last_ns is None:
        return
    for name, one in dict(run.meta.get("lists") or {}).items():
        if text := _silence(one, int(first_ns), int(last_ns)):
            yield Diagnostic(name, text)


def _silence(one: Mapping[str, Any], first_ns: int, last_ns: int) -> str | None:
    """Text on the longest silence of a source; None if the silence is usual.

    `one` is the record of the source in meta.json. The recording lasts from `first_ns`
    to `last_ns`.
    """
    gaps = [
        *map(tuple, one["longest_gaps_ns"]),
        (first_ns, one["first_receipt_ns"]),
        (one["last_receipt_ns"], last_ns),
    ]
    gaps.sort(key=lambda gap: gap[0] - gap[1])
    lengths_s = [(end_ns - start_ns) / NS_PER_S for start_ns, end_ns in gaps]
    count = one["count"]
    times_ns = one["first_receipt_ns"], one["last_receipt_ns"]
    known_s = (times_ns[1] - times_ns[0]) / NS_PER_S
    is_within = gaps[0][0] >= times_ns[0] and gaps[0][1] <= times_ns[1]
    usual_steps = count - 1 - is_within
    period_s = (known_s - is_within * lengths_s[0]) / max(usual_steps, 1)
    usual_s = max(
        _SILENCE_S, _SILENCE_PERIODS * period_s, _SILENCE_FACTOR * lengths_s[1]
    )
    if count < 2 or lengths_s[0] <= usual_s:
        return None
    start_s, end_s = ((each - first_ns) / NS_PER_S for each in gaps[0])
    until = "the end" if gaps[0][1] == last_ns else f"{end_s:.1f} s"
    return (
        f"no list from {start_s:.1f} s to {until} ({lengths_s[0]:.1f} s; its mean period is {period_s:.2g} s): the "
        "sensor stopped, or it had nothing to report"
    )


def repeated(run: Run) -> Diagnostic | None:
    """Return a diagnostic if stamps that were received before are received again, as in looped playback; else None."""
    shares = {}
    for name, table in [(EGO, run.tables["ego"]), *by_sensor(run.tables["detections"])]:
        share, period_s = _repeated_share(table["stamp_ns"], table["receipt_ns"])
        if share > _LOOP_SHARE:
            shares[name] = f"{percent(share)} of {name} after {period_s:.3g} s"
    if not shares:
        return None
    text = (
        f"stamps return that were received before ({', '.join(shares.values())}), as in looped playback: only the "
        "first pass is tracked; record again without the loop, or cut the recording"
    )
    return Diagnostic("recording", text)


def _repeated_share(stamps_ns: IntArray, receipts_ns: IntArray) -> tuple[float, float]:
    """Share of messages whose stamp was received before, and the median time in between [s].

    The share is 0 if new stamps are received between the repeated ones, as with late
    reports whose stamps are whole seconds.
    """
    messages = np.unique(np.stack([stamps_ns, receipts_ns], axis=-1), axis=0)
    if not len(messages):
        return 0.0, 0.0
    stamps, first = np.unique(messages[:, 0], return_index=True)
    since_ns = (
        messages[:, 1] - messages[first[np.searchsorted(stamps, messages[:, 0])], 1]
    )
    again = (since_ns > _LOOP_NS) & (messages[:, 0] != 0)
    order = np.lexsort((messages[:, 0], messages[:, 1]))
    newest_ns = np.maximum.accumulate(messages[order, 0])
    is_new = np.diff(newest_ns, append=newest_ns[-1]) > 0
    if not again.any() or is_new[again[order]].mean() > _NEW_SHARE:
        return 0.0, 0.0
    return float(again.mean()), float(np.median(since_ns[again])) / NS_PER_S


def angles(run: Run) -> Iterator[Diagnostic]:
    """Yield angles that are degrees in the recording but were read as radians."""
    for about, table in [
        (EGO, run.tables["ego"]),
        *by_sensor(run.tables["detections"]),
    ]:
        for name in ANGULAR:
            finite = [
                value
                for value in table.get(name, np.empty(0)).tolist()
                if math.isfinite(value)
            ]
            if wrong := in_degrees(
                about, name, min(finite, default=0.0), max(finite, default=0.0)
            ):
                yield wrong

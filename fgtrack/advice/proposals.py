"""Proposed settings are replayed: are more detections used, and predicted better?"""

import math
from collections.abc import Iterator

import numpy as np

from fgtrack.advice.run_quality import RunQuality
from fgtrack.core.finding import percent
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.comparison import comparisons
from fgtrack.evaluation.diagnostics import USED, lifetimes_and_breaks
from fgtrack.evaluation.intervals import Estimate, sums_by_stamp, within_run
from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.evaluation.scores.innovations import num_measured
from fgtrack.runs import Run

__all__ = ["benefit", "effect", "prediction_change"]

# Significant difference of two counts, in standard deviations.
_CHANCE = 2.0
# A smaller increase of a share does not matter.
_LEAST_SHARE = 0.005
_KEY = ("sensor", "receipt_ns", "index")


def benefit(before: RunQuality | None, after: RunQuality | None) -> str | None:
    """Return a clause with numbers on the result that improves between two runs of the same messages.

    None if no result improves beyond its interval.
    """
    if after is None:
        return None
    if before is None:
        return "without it, nothing can be tracked"
    return next(_benefits(before, after), None)


def _benefits(before: RunQuality, after: RunQuality) -> Iterator[str]:
    """Yield the results that improve: used detections, tracked share, RMSE, predictions, tracks."""
    for name, share in after.used.items():
        count = sum(dict(after.run.meta["counts"])[name].values())
        was = before.used.get(name, 0.0)
        if _is_gain(share - was, count):
            yield f"used detections of {name} rise from {percent(was)} to {percent(share)}"
    old = before.truth
    new = after.truth
    if old is not None and new is not None:
        gain = new.tracked_share_in_view - old.tracked_share_in_view
        if gain > _LEAST_SHARE:
            yield (
                f"the tracked share of time rises from {percent(old.tracked_share_in_view)} to "
                f"{percent(new.tracked_share_in_view)}"
            )
    if old is not None and (text := _against_truth(before.run, after.run)):
        yield text
    change = prediction_change(before.run, after.run)
    if change.is_known and change.high < 0.0:
        yield f"prediction errors change by {_percents(change)}"
    was_dead = before.births - before.confirmed
    dead = after.births - after.confirmed
    if was_dead - dead > _CHANCE * math.sqrt(max(was_dead + dead, 1)):
        yield f"unconfirmed births fall from {was_dead} to {dead}"
    was_breaks, breaks = (lifetimes_and_breaks(one.run)[1] for one in (before, after))
    if was_breaks - breaks > _CHANCE * math.sqrt(max(was_breaks + breaks, 1)):
        yield f"breaks fall from {was_breaks} to {breaks}"


def _is_gain(gain: float, count: int) -> bool:
    """True if a share of `count` detections rises significantly (sign test of the detections that differ)."""
    return gain > _LEAST_SHARE and gain * count > _CHANCE * math.sqrt(gain * count)


def effect(before: RunQuality | None, after: RunQuality | None) -> str:
    """Return a clause with numbers on two runs between which no result improves."""
    if before is None or after is None:
        return "nothing can be tracked with it"
    shares = ", ".join(
        f"{name} {percent(before.used.get(name, 0.0))} and {percent(share)}"
        for name, share in after.used.items()
    )
    change = prediction_change(before.run, after.run)
    errors = f", prediction errors {_percents(change)}" if change.is_known else ""
    return f"used detections without and with it: {shares}{errors}"


def prediction_change(before: Run, after: Run) -> Estimate:
    """Return the relative change of the predicted innovations from `before` to `after`, with its 95 % interval.

    An innovation tests a prediction, because the detection was not yet fused. Its
    components are divided by the standard deviations of the sensor in `before`. The
    result is the change of their root mean square over the detections that both runs
    have fused.
    """
    first, second = _shared_rows(before, after)
    squares = np.stack(
        [
            _squares(run, rows, before)
            for run, rows in ((before, first), (after, second))
        ],
        axis=-1,
    )
    squares[~(squares > 0.0).any(axis=1)] = np.nan
    log = within_run(
        sums_by_stamp(after.tables["updates"]["receipt_ns"][second], squares)[:, :2],
        lambda S: 0.5 * np.log(S[1] / S[0]),
    )
    with np.errstate(over="ignore"):
        mean, low, high = np.expm1([log.mean, log.low, log.high]).tolist()
    return Estimate(mean, low, high, log.count)


def _shared_rows(before: Run, after: Run) -> tuple[IntArray, IntArray]:
    """Rows of `updates` of the detections that both runs have fused, shape (n,) each."""
    import pandas as pd

    keys = []
    rows = []
    for run in (before, after):
        updates = run.tables["updates"]
        fused = np.flatnonzero(
            np.isin(updates["disposition"], USED) & (num_measured(updates) > 0)
        )
        frame = pd.DataFrame({name: updates[name][fused] for name in _KEY})
        nth = frame.groupby(list(_KEY)).cumcount()
        keys.append(pd.MultiIndex.from_frame(frame.assign(nth=nth)))
        rows.append(fused)
    at = keys[0].get_indexer(keys[1])
    return rows[0][at[at >= 0]], rows[1][at >= 0]


def _squares(run: Run, rows: IntArray, scale: Run) -> FloatArray:
    """Mean square of the components of each innovation, in standard deviations of the sensor in `scale`, (n,)."""
    updates = run.tables["updates"]
    result = np.full(len(rows), np.nan)
    sensors = updates["sensor"][rows]
    for sensor in np.unique(sensors).tolist():
        std = (scale.config.get("sensors") or {}).get(sensor, {}).get("std") or {}
        mine = sensors == sensor
        components = [
            updates[f"res_{name}"][rows[mine]] / float(value)
            for name, value in std.items()
        ]
        if components:
            known = np.isfinite(components)
            sums = np.where(known, np.square(components), 0.0).sum(axis=0)
            result[mine] = sums / np.maximum(known.sum(axis=0), 1)
    return result


def _against_truth(before: Run, after: Run) -> str | None:
    """Clause on the position RMSE, if the run `after` is significantly better."""
    runs = [EvaluatedRun("before", before), EvaluatedRun("after", after)]
    for one in comparisons(runs):
        for name, entries in one.quantities.items():
            result = {entry.name: entry for entry in entries}
            if name == "position_rmse_m" and result["before"].standing == "worse":
                was, now = result["before"].value, result["after"].value
                return f"the position RMSE falls from {was:.3g} to {now:.3g} m"
    return None


def _percents(change: Estimate) -> str:
    return f"{100.0 * change.mean:+.1f} % ({100.0 * change.low:+.1f} to {100.0 * change.high:+.1f})"

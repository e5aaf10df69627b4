"""Outcomes of the detections of a run: unused, failed and excluded detections, with cause and remedy."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fgtrack.core.diagnostic import Diagnostic, reasons, too_late
from fgtrack.core.finding import percent
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray
from fgtrack.evaluation.scores.innovations import by_sensor
from fgtrack.runs import Columns, Run
from fgtrack.tracking.ego.trajectory import MAX_EXTRAPOLATION_NS

USED = ("birth", "in_sequence", "out_of_sequence", "beyond_window", "merged")
"""Dispositions of detections that were used."""
FAILED_SHARE = 0.05
"""Share of failed detections of a sensor above which the failures are reported."""
# Estimator that leaves out late measurements by design.
_DROPS = "drop"
# A stamp further after its receipt is invalid (`tracking.inbox`).
_AHEAD_S = 1.0
# Fewer failed detections may be the border of a recording.
_FEWEST_FAILED = 3
#: Cause and remedy by disposition, for a sensor with most detections in this disposition.
_REMEDIES = {
    "gated": "no track was near and no track was started: check the gate of `association`, the clock, and "
    "ego.detection_origin_x_m",
    "out_of_bounds": "{reasons}: check these settings, the map (--map), and the frame of the detections",
    "duplicate": "the same list is repeated: check the recording, a sensor or a bridge may send lists twice",
    "superseded": "another list of the sensor arrived in the same tick, and the inbox keeps one: raise clock.node_hz",
    "invalid": "no position, a value that is not finite, an invalid covariance, or a stamp after the receipt: compare "
    "the keys of sensors.{sensor}.std with the fields in `fgtrack info`",
}


def unused(run: Run) -> str | None:
    """Line on the dispositions of a run that used no detection.

    None if a detection was used, or none was received.
    """
    counts = Counter(run.tables["updates"]["disposition"].tolist())
    if not counts or counts.keys() & set(USED):
        return None
    names = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
    return f"none of the {counts.total()} detections was used ({names})"


def excluded_lines(meta: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each sensor on the detections that settings excluded; `meta` is the run's meta.json."""
    for sensor, counts in sorted(dict(meta.get("out_of_bounds") or {}).items()):
        total = sum(meta["counts"][sensor].values())
        yield f"{sensor}: {sum(counts.values())} of {total} detections out of bounds ({reasons(counts)})"
    for sensor, counts in sorted(dict(meta.get("left_out") or {}).items()):
        yield f"{sensor}: {sum(counts.values())} left out by the reader ({reasons(counts)})"


def failed_shares(run: Run) -> dict[str, float]:
    """Return the share of failed detections of each sensor, where the share exceeds `FAILED_SHARE`."""
    shares = {}
    for sensor, mine in by_sensor(run.tables["updates"]):
        failed = int(np.count_nonzero(mine["disposition"] == "failed"))
        if (
            failed >= min(_FEWEST_FAILED, mine.num_rows)
            and failed > FAILED_SHARE * mine.num_rows
        ):
            shares[sensor] = failed / mine.num_rows
    return shares


def failed_diagnostics(run: Run) -> Iterator[Diagnostic]:
    """Yield the sensors with many failed detections, and the cause.

    Without any ego state the ego is reported instead, see `ego_diagnostics`.
    """
    updates = run.tables["updates"]
    for sensor, share in failed_shares(run).items():
        failed = updates.where(
            (updates["sensor"] == sensor) & (updates["disposition"] == "failed")
        )
        unposed = int(np.count_nonzero(_without_pose(run, failed)))
        if unposed and not run.tables["ego"].num_rows:
            continue
        first = run.meta.get("first_failure")
        cause = f"the first failure: {first}"
        if 2 * unposed > failed.num_rows or not first:
            cause = (
                f"no ego pose was known at the stamps of {unposed or failed.num_rows}: check the clock of the ego, the "
                "clock of the sensor, and gaps in the ego's states"
            )
        text = f"{failed.num_rows} detections failed ({percent(share)}): {cause}"
        yield Diagnostic(sensor, text)


def _without_pose(run: Run, updates: Columns) -> BoolArray:
    """Mask of `updates` of one sensor in a moving frame that lack a near ego state, shape (rows,)."""
    detections = run.tables["detections"]
    moving = (detections["frame"] != "map") & np.isin(
        detections["sensor"], updates["sensor"]
    )
    in_moving = np.isin(updates["stamp_ns"], detections["stamp_ns"][moving])
    egos_ns = np.sort(run.tables["ego"]["stamp_ns"])
    if not len(egos_ns):
        return in_moving
    after = np.searchsorted(egos_ns, updates["stamp_ns"])
    off_ns = np.minimum(
        np.abs(updates["stamp_ns"] - egos_ns[np.minimum(after, len(egos_ns) - 1)]),
        np.abs(updates["stamp_ns"] - egos_ns[np.maximum(after - 1, 0)]),
    )
    return np.asarray(in_moving & (off_ns > MAX_EXTRAPOLATION_NS))


def _mostly_unused(run: Run) -> Iterator[tuple[str, Columns, str, int]]:
    """Yield sensors with more than half of their updates unused for one disposition.

    Yields the sensor, its updates, the disposition, and its count.
    """
    for sensor, mine in by_sensor(run.tables["updates"]):
        name, count = Counter(mine["disposition"].tolist()).most_common(1)[0]
        if name not in USED and 2 * count > mine.num_rows:
            yield sensor, mine, name, count


def unused_diagnostics(run: Run) -> Iterator[Diagnostic]:
    """Yield sensors without stamps, and the disposition of most detections if no other diagnostic explains it."""
    unset = [
        name
        for name, mine in by_sensor(run.tables["updates"])
        if not mine["stamp_ns"].any()
    ]
    for sensor in unset:
        text = "all stamps are 0: its driver does not set them; `stamp_from: receipt` uses the receipt as the stamp"
        yield Diagnostic(sensor, text, {f"sensors.{sensor}.stamp_from": "receipt"})
    for sensor, mine, name, count in _mostly_unused(run):
        if name == "invalid" and delay_s(mine) < -_AHEAD_S:
            text = (
                f"{count} of {mine.num_rows} invalid: its stamps lie {-delay_s(mine):.3g} s after their receipts, so "
                f"its clock is ahead; correct it, or set sensors.{sensor}.clock_offset_s"
            )
            yield Diagnostic(sensor, text)
            continue
        is_design = name == "too_old" and run.meta.get("estimator") == _DROPS
        if name == "failed" or is_design or (name == "too_old" and sensor in unset):
            continue  # `failed_diagnostics` reports failed detections
        if name == "duplicate" and (section(run, "sensors").get(sensor) or {}).get(
            "copies_s"
        ):
            continue  # copies from several receivers are expected
        by = reasons((run.meta.get("out_of_bounds") or {}).get(sensor, {}))
        remedy = (
            _too_old(run, sensor, mine)
            if name == "too_old"
            else _REMEDIES[name].format(sensor=sensor, reasons=by)
        )
        yield Diagnostic(sensor, f"{count} of {mine.num_rows} {name}: {remedy}")


def late_diagnostics(run: Run) -> Iterator[Diagnostic]:
    """Yield delays beyond the limits of the estimator or the inbox, unless most detections already have a reason."""
    if run.meta.get("estimator") == _DROPS:
        return
    explained = {sensor for sensor, _, _, _ in _mostly_unused(run)}
    for sensor, mine in by_sensor(run.tables["updates"]):
        if sensor not in explained and mine["stamp_ns"].any():
            delays_s = (mine["receipt_ns"] - mine["stamp_ns"]) / NS_PER_S
            refused = mine["disposition"] == "too_old"
            if late := too_late(
                sensor, delays_s, _limits(run, sensor, "reach_s"), refused
            ):
                yield late


def _limits(run: Run, sensor: str, window_s: str) -> list[tuple[str, float | None]]:
    """Return the configuration keys and values of a sensor's largest delay and of the window.

    `window_s` is the name of the time in the window's record.
    """
    window = run.meta.get("effective") or {}
    own = section(run, "sensors").get(sensor) or {}
    return [
        (f"sensors.{sensor}.max_delay_s", own.get("max_delay_s")),
        (str(window.get("lag_key")), window.get(window_s, window.get("lag_s"))),
    ]


def _too_old(run: Run, sensor: str, updates: Columns) -> str:
    median_s = delay_s(updates)
    for key, limit_s in _limits(run, sensor, "lag_s"):
        if limit_s is not None and median_s > limit_s:
            return f"median delay {median_s:.3g} s, allowed {limit_s:g} s: raise {key}, or correct the clock"
    return f"median delay {median_s:.3g} s, but no track is as old as these detections: check births, gate and clock"


def delay_s(table: Columns) -> float:
    """Median delay [s] from stamp to receipt of the rows of a table."""
    return float(np.median(table["receipt_ns"] - table["stamp_ns"])) / NS_PER_S


def section(run: Run, name: str) -> Mapping[str, Any]:
    """Return a section of the configuration of `run`; empty if the configuration lacks it."""
    return run.config.get(name) or {}

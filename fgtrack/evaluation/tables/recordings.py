"""Tables of runs of several recordings: the worst recording first, and means over the recordings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from fgtrack.core.files import open_text
from fgtrack.core.types import Disposition
from fgtrack.evaluation.diagnostics.outcomes import USED
from fgtrack.evaluation.runs import EvaluatedRun, by_recording
from fgtrack.evaluation.scalars import scalars_of
from fgtrack.evaluation.tables import PERCENT, Column, Record, Table
from fgtrack.evaluation.tables.seeds import (
    SweepTable,
    difference_table,
    seed_comparisons,
    summary_table,
)

RECORDING = "recording"
"""Column with the name of the recording."""
_GOSPA = "multi_object.gospa"
_COST = f"{_GOSPA}.in_view_rms_m"
_RMSE = "truth.overall.errors.position_m.rmse"
_TRACKED = "truth.overall.tracked_share_in_view"
_FALSE = "truth.false_tracks"
_SWITCHES = "truth.overall.id_switches"


def recording_tables(
    sweep: SweepTable, errors: Mapping[str, str] | None = None
) -> dict[str, Table]:
    """Return the tables `recordings`, `over_recordings` and `differences_over_recordings` of a sweep by recording.

    `errors` are the reasons of recordings without a result, by name. Intervals are t
    intervals over recordings: times within a recording are no independent samples.
    """
    tables = {"recordings": _recordings(sweep, errors or {})}
    if sweep.rows.empty:
        return tables
    rows = sweep.rows.drop(columns="seed").rename(columns={RECORDING: "seed"})
    # Metrics of single objects are not comparable between recordings.
    metrics = tuple(
        name for name in sweep.metrics if not name.startswith("truth.objects.")
    )
    over = replace(sweep, axes=(), rows=rows, metrics=metrics, repeated="recordings")
    compared = difference_table(seed_comparisons(over), (), over.repeated)
    tables["over_recordings"] = replace(
        summary_table(over), title="Means over the recordings"
    )
    if compared.records:
        title = f"Differences over the recordings: {compared.title}"
        tables["differences_over_recordings"] = replace(compared, title=title)
    return tables


def sweep_of_runs(runs: Sequence[EvaluatedRun]) -> SweepTable | None:
    """Return the metrics of `runs` as a sweep by recording; None for a single recording.

    The name of a recording is the name of its file, with a number where names are equal.
    """
    groups = by_recording(runs)
    if len(groups) < 2:
        return None
    records: list[dict[str, object]] = []
    names: set[str] = set()
    for group in groups:
        source = (group[0].run.meta.get("input") or {}).get("path") or group[0].label
        stem = Path(str(source)).name
        name = stem if stem not in names else f"{stem} #{len(names) + 1}"
        names.add(name)
        for one in group:
            values = {
                key: value
                for key, value in scalars_of(one.metrics)
                if isinstance(value, int | float | None)
            }
            keys = {RECORDING: name, "seed": "0", "estimator": one.metrics.estimator}
            records.append({**values, **keys})
    rows = pd.DataFrame(records)
    keys_of = [RECORDING, "seed", "estimator"]
    numbers = rows.drop(columns=keys_of).astype(float)
    metrics = tuple(numbers.replace([np.inf, -np.inf], np.nan))
    return SweepTable(
        (RECORDING,), metrics, pd.concat([rows[keys_of], numbers], axis=1)
    )


def read_errors(path: Path) -> dict[str, str]:
    """Return the reasons in the table of failed cells `path` by recording."""
    with open_text(path) as file:
        table = pd.read_csv(file, dtype=str, keep_default_na=False)
    return dict(zip(table[RECORDING], table["error"], strict=True))


def _recordings(sweep: SweepTable, errors: Mapping[str, str]) -> Table:
    """Return a row for each recording and estimator, the worst recording first; a row with the reason for an error."""
    found = [
        _record({str(name): value for name, value in row.items()})
        for row in sweep.rows.to_dict("records")
    ]
    first = found[0]["estimator"] if found else ""
    costs = {
        str(record[RECORDING]): _cost(record)
        for record in found
        if record["estimator"] == first
    }
    found.sort(key=lambda record: -costs.get(str(record[RECORDING]), math.inf))
    failed = [
        {RECORDING: name, "reason": f"error: {text}"} for name, text in errors.items()
    ]
    has_truth = any(math.isfinite(_number(record, _COST)) for record in found)
    columns = [
        Column("recording", RECORDING, left=True),
        Column("estimator", left=True, is_extra=True),
        Column("GOSPA\n[m]", _COST, is_extra=not has_truth),
        Column("position\nRMSE [m]", _RMSE, is_extra=not has_truth),
        Column("tracked\n[%]", _TRACKED, scale=PERCENT, is_extra=not has_truth),
        Column("false\ntracks", _FALSE, is_extra=not has_truth),
        Column("switches", _SWITCHES, is_extra=not has_truth),
        Column("unused\n[%]", "unused_share", scale=PERCENT, is_extra=has_truth),
        Column("tracks", "num_confirmed", is_extra=has_truth),
        Column("reason", left=True),
    ]
    notes = ["reason: the largest part of the error, or of the unused detections"]
    if found:
        by = "the GOSPA in view" if has_truth else "the share of unused detections"
        notes.append(
            f"worst first, by {by} of {first}; recordings with an error come before"
        )
    return Table(
        "Recordings",
        [*failed, *found],
        columns,
        (RECORDING, "estimator"),
        notes,
        is_main=lambda row: row.get("estimator", first) == first,
    )


def _cost(record: Record) -> float:
    """Return the number by which recordings are ordered, the worst largest; unused shares follow GOSPA."""
    gospa_m = float(record[_COST])
    return gospa_m if math.isfinite(gospa_m) else float(record["unused_share"]) - 1.0


def _record(row: Mapping[str, object]) -> dict[str, object]:
    """Return the shown numbers of a row, and the reason of its error."""
    counts = dict.fromkeys(Disposition, 0.0)
    for name in row:
        if ".dispositions." in name and math.isfinite(_number(row, name)):
            counts[Disposition(name.rpartition(".")[2])] += _number(row, name)
    total = sum(counts.values())
    unused = {
        fate: count for fate, count in counts.items() if fate not in USED and count
    }
    share = sum(unused.values()) / total if total else 0.0
    shown = (_COST, _RMSE, _TRACKED, _FALSE, _SWITCHES, "num_confirmed")
    return {
        RECORDING: row[RECORDING],
        "estimator": row["estimator"],
        **{name: _number(row, name) for name in shown},
        "unused_share": share,
        "reason": _reason(row) or _most_unused(unused, total),
    }


def _reason(row: Mapping[str, object]) -> str:
    """Return the largest part of the GOSPA in view with its share; empty without an error or truth."""
    unseen = _number(row, f"{_GOSPA}.out_of_view_m2")
    parts = {
        "missed objects": _number(row, f"{_GOSPA}.missed_m2") - unseen,
        "false tracks": _number(row, f"{_GOSPA}.false_m2"),
        "position errors": _number(row, f"{_GOSPA}.localisation_m2"),
    }
    total = sum(parts.values())
    if not total > 0.0:
        return ""
    name = max(parts, key=parts.__getitem__)
    return f"{PERCENT * parts[name] / total:.0f} % {name}"


def _most_unused(unused: Mapping[Disposition, float], total: float) -> str:
    if not unused:
        return "no detections" if not total else "all detections used"
    fate = max(unused, key=unused.__getitem__)
    return f"{PERCENT * unused[fate] / total:.0f} % of the detections {fate.value}"


def _number(row: Mapping[str, object], name: str) -> float:
    value = row.get(name)
    return float(value) if isinstance(value, int | float) else math.nan

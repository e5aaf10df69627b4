"""Comparison of runs: tables, and the sentences that summarise them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fgtrack.core.errors import CallError
from fgtrack.core.types import FUSED, LATE, Disposition
from fgtrack.evaluation.comparison import (
    POSITION_NEES,
    STANDING_NOTE,
    Comparison,
    comparisons,
    entry_columns,
    entry_record,
)
from fgtrack.evaluation.diagnostics.outcomes import USED
from fgtrack.evaluation.intervals import UNKNOWN
from fgtrack.evaluation.metrics import FALSE_TRACK_SHARE, Metrics
from fgtrack.evaluation.runs import OneRun, evaluated
from fgtrack.evaluation.scores.innovations import FEWEST, RESIDUAL_NAMES
from fgtrack.evaluation.scores.lagged import WINDOW
from fgtrack.evaluation.tables import MS, PERCENT, RUN, Column, Table, Tables, named
from fgtrack.evaluation.tables.decisions import decisions_table, revisions_table
from fgtrack.evaluation.tables.recordings import recording_tables, sweep_of_runs
from fgtrack.evaluation.tables.streaming import streaming_tables
from fgtrack.evaluation.tables.verdict import verdict

_GOSPA = "gospa_in_view_rms_m"
_ERRORS = {
    "position_m": "pos.\n[m]",
    "along_m": "along\n[m]",
    "across_m": "across\n[m]",
    "yaw_rad": "yaw\n[rad]",
    "speed_mps": "speed\n[m/s]",
}
_QUANTITIES = {
    "position_rmse_m": "pos. [m]",
    "speed_rmse_mps": "speed [m/s]",
    "yaw_rmse_rad": "yaw [rad]",
    POSITION_NEES: "NEES pos.",
    _GOSPA: "GOSPA [m]",
}
_CONTINUITY = ("tracked_share", "tracked_share_in_view", "breaks", "id_switches")
_UNITS = {"m": "m", "rad": "rad", "mps": "m/s"}
# If the runs have less than this share of their samples in common, a note gives the numbers.
_COMMON_SHARE = 0.9


def compare(
    *runs: OneRun | Iterable[OneRun] | Mapping[str, OneRun], streaming: bool = False
) -> Tables:
    """Compare the metrics of `runs`: the `verdict`, and tables by name.

    The tables are `differences`, `tracking`, `multi_object`, `lag`, `consistency`,
    `dispositions`, `revisions`, `decisions`, and `residuals_SENSOR` of every sensor. Runs
    of the same recording are compared sample by sample. A path is a run folder, or a folder of run folders.
    The keys of a mapping are labels. `streaming` also evaluates published states at the
    time when they were ready.

    Raises `CallError` without runs, for a run that is given twice, or if a path is not
    a run folder. Raises `DataError` for a damaged run.
    """
    every = evaluated(runs)
    if not every:
        raise CallError("compare: no run is given, give at least one")
    metrics = {item.label: item.metrics for item in every}
    compared = comparisons(every)
    tables = {
        "differences": _differences(compared),
        "tracking": _tracking(metrics),
        "multi_object": _multi_object(metrics),
        "lag": _lag(metrics),
        "consistency": _consistency(metrics),
        **{
            f"residuals_{name}": _residuals(name, metrics)
            for item in metrics.values()
            for name in item.sensors
        },
        "dispositions": _dispositions(metrics),
        "revisions": revisions_table(metrics),
        "decisions": decisions_table(metrics),
    }
    if (sweep := sweep_of_runs(every)) is not None:
        tables |= recording_tables(sweep)
    more, sentences = streaming_tables(every) if streaming else ({}, [])
    details = {"runs": {label: item.as_dict() for label, item in metrics.items()}}
    return Tables(tables | more, details, (*verdict(metrics, compared), *sentences))


def _differences(compared: Sequence[Comparison]) -> Table:
    """Return a row for each recording, quantity and run: its value, and the difference to the best run."""
    records = [
        {
            "quantity": name,
            **entry_record(entry),
            "blocks": (entry.worse_by or UNKNOWN).count,
        }
        for one in compared
        for name, entries in one.quantities.items()
        for entry in entries
    ]
    quantity = Column("quantity", text=lambda name: _QUANTITIES[str(name)], left=True)
    notes = [
        "RMSE where all runs track the object; NEES: worse is farther from 2",
        STANDING_NOTE,
    ]
    notes += [
        f"{', '.join(one.runs)}: {one.samples} samples in common, of up to {one.most_samples}"
        for one in compared
        if one.samples < _COMMON_SHARE * one.most_samples
    ]
    title = "Differences of runs of the same recording"
    columns = [quantity, RUN, *entry_columns("value")]
    main = ("position_rmse_m", _GOSPA)
    return Table(
        title,
        records,
        columns,
        ("run", "quantity"),
        notes,
        is_main=lambda row: row["quantity"] in main,
    )


def _tracking(metrics: Mapping[str, Metrics]) -> Table:
    """Return a row for each run: errors against truth, continuity, number of tracks, time."""
    records = []
    for label, item in metrics.items():
        record: dict[str, Any] = {"run": label, "estimator": item.estimator}
        if item.truth is not None:
            overall = item.truth.overall
            record |= {
                named(name, "rmse"): overall.errors[name].rmse for name in _ERRORS
            }
            record |= {"position_nees": item.consistency.position_nees.mean}
            record |= {name: getattr(overall, name) for name in _CONTINUITY}
            record |= {
                "false_tracks": item.truth.false_tracks,
                "precision": item.precision,
            }
        time_s = item.time_per_tick_s
        record |= {"num_tracks": item.num_tracks, "num_confirmed": item.num_confirmed}
        records.append(
            record
            | {"time_per_tick_p50_s": time_s.p50, "time_per_tick_p99_s": time_s.p99}
        )
    columns = [
        RUN,
        *(
            Column(heading, named(name, "rmse"), is_extra=name != "position_m")
            for name, heading in _ERRORS.items()
        ),
        Column("NEES\npos.", "position_nees"),
        Column("tracked\n[%]", "tracked_share_in_view", scale=PERCENT),
        Column("breaks/\nswitches", "breaks id_switches", "{}/{}"),
        Column("false\ntracks", "false_tracks"),
        Column("preci-\nsion", "precision", is_extra=True),
        Column("tracks all/\nconfirmed", "num_tracks num_confirmed", "{}/{}"),
        Column(
            "ms/tick\np50/p99", "time_per_tick_p50_s time_per_tick_p99_s", "{}/{}", MS
        ),
    ]
    notes = [
        "errors: RMSE against truth; NEES: mean position NEES, 2 if consistent; tracked: share of the ticks in view",
        "breaks: tracking resumed after a loss or with another track; switches: only with another track",
        f"false: tracks with a true object in less than {FALSE_TRACK_SHARE:.0%} of their rows",
    ]
    return Table(
        "Tracking",
        records,
        columns,
        notes=notes if any(item.truth for item in metrics.values()) else (),
    )


def _multi_object(metrics: Mapping[str, Metrics]) -> Table:
    """Return a row for each run with truth: GOSPA and its parts, CLEAR, IDF1, HOTA, switches, time to confirm."""
    records = []
    for label, item in metrics.items():
        if item.multi_object is not None and item.truth is not None:
            of = item.multi_object
            m2 = item.multi_object.gospa
            overall = item.truth.overall
            parts = {
                part: m2[f"{part}_m2"]
                for part in ("localisation", "false", "out_of_view", "missed")
            }
            parts["missed_in_view"] = max(parts["missed"] - parts["out_of_view"], 0.0)
            record = {
                "run": label,
                _GOSPA: m2["in_view_rms_m"],
                "gospa_rms_m": m2["rms_m"],
            }
            record |= {
                f"gospa_{part}_m": math.sqrt(square) for part, square in parts.items()
            }
            record |= {"mota": of.clear["mota"], "idf1": of.identity["idf1"], **of.hota}
            for name, values in of.others.items():
                record |= {f"{name}_{key}": value for key, value in values.items()}
            switches = overall.id_switches
            confirm_s = overall.time_to_confirm_s.mean
            records.append(
                record | {"id_switches": switches, "time_to_confirm_s": confirm_s}
            )
    others = {
        f"{name}_{key}": f"{name}\n{key}"
        for item in metrics.values()
        if item.multi_object is not None
        for name, values in item.multi_object.others.items()
        for key in values
    }
    columns = [
        RUN,
        Column("GOSPA\n[m]", _GOSPA),
        Column("local.\n[m]", "gospa_localisation_m"),
        Column("missed\n[m]", "gospa_missed_in_view_m"),
        Column("false\n[m]", "gospa_false_m"),
        Column("unseen\n[m]", "gospa_out_of_view_m"),
        Column("with\nunseen", "gospa_rms_m"),
        *(
            Column(f"{name}\n[%]", name.lower(), scale=PERCENT)
            for name in ("MOTA", "IDF1", "HOTA", "DetA", "AssA")
        ),
        Column("switches", "id_switches"),
        Column("confirm\n[s]", "time_to_confirm_s"),
        *(Column(text, key, is_extra=True) for key, text in others.items()),
    ]
    notes = [
        "GOSPA: root mean square over ticks; its square is the sum of the squares of its parts; scores: 100 is perfect",
        "unseen: missed objects that no sensor could detect; the scores in % count them too, so MOTA may be far below "
        "the tracked share of the time in view",
        "confirm: from an object's first detection to its first confirmed track",
    ]
    return Table("Multi-object metrics", records, columns, notes=notes, is_detail=True)


def _lag(metrics: Mapping[str, Metrics]) -> Table:
    """Return a row for each run and lag: errors, and their reduction by waiting.

    Empty if no run has lagged or final states.
    """
    records = []
    for label, item in (
        metrics.items()
        if any(len(item.lagged) > 1 for item in metrics.values())
        else ()
    ):
        for lag in item.lagged:
            at_s = lag.lag_s if isinstance(lag.lag_s, float) else None
            record: dict[str, Any] = {
                "run": label,
                "lag": WINDOW if at_s is None else f"{at_s:g}",
                "lag_s": at_s,
            }
            record |= {"num_states": lag.errors["position_m"].count}
            for name in ("position_m", "speed_mps", "yaw_rad"):
                gain = lag.gain(name) if lag.lag_s else math.nan
                record |= {
                    named(name, "rmse"): lag.errors[name].rmse,
                    f"{name.rpartition('_')[0]}_reduction": gain,
                }
            of = lag.position_reduction
            record |= {
                "position_reduction_low": of.low,
                "position_reduction_high": of.high,
            }
            records.append(record | {"position_nees": lag.position_nees.mean})
    columns = [
        RUN,
        Column("lag\n[s]", "lag"),
        Column("states", "num_states", is_extra=True),
        Column(_ERRORS["position_m"], "position_rmse_m"),
        Column("below\n[%]", "position_reduction", scale=PERCENT),
        Column(
            "95 %\ninterval",
            "position_reduction_low position_reduction_high",
            "{} to {}",
            PERCENT,
        ),
        Column(_ERRORS["speed_mps"], "speed_rmse_mps", is_extra=True),
        Column("below\n[%]", "speed_reduction", scale=PERCENT, is_extra=True),
        Column(_ERRORS["yaw_rad"], "yaw_rmse_rad", is_extra=True),
        Column("below\n[%]", "yaw_reduction", scale=PERCENT, is_extra=True),
        Column("NEES\npos.", "position_nees"),
    ]
    notes = [
        "lag 0: present states; window: final states, when they leave the window; NEES: 2 if consistent",
        "below: reduction compared with the present states of the same tracks and stamps",
    ]
    return Table(
        "Error against lag (RMSE against truth)",
        records,
        columns,
        ("run", "lag"),
        notes,
    )


def _consistency(metrics: Mapping[str, Metrics]) -> Table:
    """Return a row for each run and normalised square: NEES of the present states, NIS and whiteness by sensor."""
    records = []
    for label, item in metrics.items():
        of = item.consistency
        squares = {"NEES position": of.position_nees} | {
            f"NIS {sensor}": nis for sensor, nis in of.nis.items()
        }
        for name, square in squares.items():
            record: dict[str, Any] = {
                "run": label,
                "of": name,
                "num_samples": square.count,
                "mean": square.mean,
            }
            record |= {
                "expected": square.dof,
                "band_low": square.band_low,
                "band_high": square.band_high,
            }
            white = of.autocorrelation.get(name.removeprefix("NIS "))
            record |= (
                {}
                if white is None
                else {"lag1_correlation": white.lag1, "lag1_band": white.lag1_band}
            )
            records += [record] if square.count else []
    columns = [
        *(
            RUN,
            Column("of", left=True),
            Column("samples", "num_samples"),
            Column("mean"),
            Column("expected"),
        ),
        Column("95 % band", "band_low band_high", "{} to {}"),
        Column("correlation\nat lag 1", "lag1_correlation lag1_band", "{} ± {}"),
    ]
    notes = [
        "band: for the mean of independent samples; errors along a run are correlated, so a single NEES may leave it",
        f"correlation: of the innovations of tracks with at least {FEWEST}; ± 95 % band for white innovations",
    ]
    title = "Consistency (mean NEES and NIS, and their expected values)"
    return Table(title, records, columns, ("run", "of"), notes, is_detail=True)


def _residuals(sensor: str, metrics: Mapping[str, Metrics]) -> Table:
    """Return a row for each run with the sensor: mean and standard deviation of the innovations, NIS, delay."""
    records = []
    for label, item in metrics.items():
        if sensor in item.sensors:
            mine = item.sensors[sensor]
            nis = item.consistency.nis[sensor]
            record: dict[str, Any] = {"run": label}
            for name, moments in mine.residuals.items():
                record |= {
                    named(name, "mean"): moments.mean,
                    named(name, "std"): moments.std,
                }
            record |= {"nis_mean": nis.mean, "nis_expected": nis.dof}
            records.append(
                record
                | {"delay_mean_s": mine.delay_s.mean, "delay_p90_s": mine.delay_s.p90}
            )
    columns = [RUN]
    for name in (name for name in RESIDUAL_NAMES if name not in ("x_m", "y_m")):
        quantity, _, unit = name.rpartition("_")
        heading = f"{quantity.replace('_', ' ')}\n[{_UNITS[unit]}]"
        columns.append(
            Column(heading, f"{named(name, 'mean')} {named(name, 'std')}", "{} ± {}")
        )
    columns += [
        Column("NIS", "nis_mean"),
        Column("NIS\nexpected", "nis_expected"),
        Column("delay [ms]\nmean/p90", "delay_mean_s delay_p90_s", "{}/{}", MS),
    ]
    title = (
        f"Residuals of {sensor} (measured minus predicted: mean ± standard deviation)"
    )
    return Table(title, records, columns, is_detail=True)


def _dispositions(metrics: Mapping[str, Metrics]) -> Table:
    """Return a row for each run and sensor: number of detections by disposition, and their sum."""
    records = []
    for label, item in metrics.items():
        for name, sensor in item.sensors.items():
            counts = sensor.dispositions
            refused = sum(count for kind, count in counts.items() if kind not in USED)
            groups = {
                "fused": sum(counts[k] for k in FUSED),
                "late": sum(counts[k] for k in LATE),
                "refused": refused,
            }
            late = {"overtaken": sensor.overtaken, "detections": sensor.detections}
            records.append({"run": label, "sensor": name, **counts, **late, **groups})
    occur = [
        kind.value for kind in Disposition if any(record[kind] for record in records)
    ]
    kinds = [
        Column(kind.replace("_", "\n"), kind, is_extra=kind != Disposition.MERGED)
        for kind in occur
    ]
    columns = [
        *(
            RUN,
            Column("sensor", left=True),
            Column("fused"),
            Column("late"),
            Column("overtaken"),
            Column("refused"),
            *kinds,
        ),
        Column("sum", "detections"),
    ]
    notes = [
        "fused: includes detections that started a track",
        "late: fused detections that are older than the newest detection of their track",
        "overtaken: received after a newer detection of the sensor, of any track",
    ]
    notes += dict.fromkeys(line for item in metrics.values() for line in item.left_out)
    title = "Dispositions (the outcome of every detection)"
    return Table(title, records, columns, ("run", "sensor"), notes)

"""Runs in comparison: their tables and the sentences that summarise them."""

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
from fgtrack.evaluation.diagnostics import USED
from fgtrack.evaluation.intervals import UNKNOWN
from fgtrack.evaluation.metrics import FALSE_TRACK_SHARE, Metrics, ObjectMetrics, TruthMetrics
from fgtrack.evaluation.runs import OneRun, evaluated
from fgtrack.evaluation.scores.innovations import FEWEST, RESIDUAL_NAMES
from fgtrack.evaluation.scores.lagged import WINDOW
from fgtrack.evaluation.scores.multi_object import MultiObjectMetrics
from fgtrack.evaluation.tables import MS, PERCENT, RUN, Column, Table, Tables, named
from fgtrack.evaluation.tables.streaming import streaming_tables
from fgtrack.evaluation.tables.verdict import verdict

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
    "gospa_in_sight_rms_m": "GOSPA [m]",
}
_MAIN_QUANTITIES = ("position_rmse_m", "gospa_in_sight_rms_m")
_GOSPA = "gospa_in_sight_rms_m"
_UNITS = {"m": "m", "rad": "rad", "mps": "m/s"}
_COMMON_SHARE = 0.9  # of the samples that all runs have in common; below it a note counts them


def compare(*runs: OneRun | Iterable[OneRun] | Mapping[str, OneRun], streaming: bool = False) -> Tables:
    """Return the metrics of `runs` in comparison: the `verdict`, and tables `differences`, `tracking`, `multi_object`,
    `lag`, `consistency`, `dispositions`, `failures`, and `residuals_SENSOR` of every sensor.

    Runs of the same recording are compared sample by sample. A path is a run folder, or a folder that holds run
    folders; a mapping gives runs labels. With `streaming` a table of that name evaluates what was published when it was
    ready, and the verdict names the best run then.

    Raises
    ------
    CallError
        No run is given, one is given twice, or a path is not a run folder.
    DataError
        A run folder is damaged.
    """
    every = evaluated(runs)
    if not every:
        raise CallError("compare: no run is given, name at least one")
    metrics, compared = {one.label: one.metrics for one in every}, comparisons(every)
    tables = {
        "differences": _differences(compared),
        "tracking": _tracking(metrics),
        "multi_object": _multi_object(metrics),
        "lag": _lag(metrics),
        "consistency": _consistency(metrics),
        **{f"residuals_{name}": _residuals(name, metrics) for one in metrics.values() for name in one.sensors},
        "dispositions": _dispositions(metrics),
        "failures": _failures(metrics),
    }
    sentences = verdict(metrics, compared)
    if streaming:
        more, added = streaming_tables(every)
        tables, sentences = tables | more, (*sentences, *added)
    details = {"runs": {label: one.as_dict() for label, one in metrics.items()}}
    return Tables(tables, details, sentences)


def _differences(compared: Sequence[Comparison]) -> Table:
    """A row for each recording, quantity and run: its value, and how much worse than the best it is."""
    records = [
        {"quantity": name, **entry_record(entry), "blocks": (entry.worse_by or UNKNOWN).count}
        for one in compared
        for name, entries in one.quantities.items()
        for entry in entries
    ]
    quantity = Column("quantity", text=lambda name: _QUANTITIES[str(name)], left=True)
    notes = ["RMSE where all runs track the object; NEES: worse is farther from 2", STANDING_NOTE]
    notes += [
        f"{', '.join(one.runs)}: {one.samples} samples in common, of up to {one.most_samples}"
        for one in compared
        if one.samples < _COMMON_SHARE * one.most_samples
    ]
    return Table(
        "Differences of runs of the same recording",
        records,
        [quantity, RUN, *entry_columns("value")],
        ("run", "quantity"),
        notes,
        is_main=lambda record: record["quantity"] in _MAIN_QUANTITIES,
    )


def _tracking(metrics: Mapping[str, Metrics]) -> Table:
    """A row for each run: errors against truth, continuity, number of tracks, time."""
    with_truth = any(one.truth for one in metrics.values())
    records = [
        {"run": label, "estimator": one.estimator}
        | ({} if one.truth is None else _truth_numbers(one, one.truth))
        | {"num_tracks": one.num_tracks, "num_confirmed": one.num_confirmed}
        | {"time_per_tick_p50_s": one.time_per_tick_s.p50, "time_per_tick_p99_s": one.time_per_tick_s.p99}
        for label, one in metrics.items()
    ]
    truth = [Column(heading, named(name, "rmse"), is_extra=name != "position_m") for name, heading in _ERRORS.items()]
    nees, tracked = "NEES: mean of the position's; 2 if consistent", "tracked: share of the ticks in sight of a sensor"
    breaks = "breaks: resumed after a loss or with another track; switches: the latter"
    false = f"false: paired with a true object in less than {FALSE_TRACK_SHARE:.0%} of its life"
    precision = "precision: true objects tracked / tracks that were confirmed"
    truth += [
        Column("NEES\npos.", "position_nees", note=nees),
        Column("tracked\n[%]", "tracked_share_in_sight", scale=PERCENT, note=tracked),
        Column("breaks/\nswitches", "breaks id_switches", "{}/{}", note=breaks),
        Column("false\ntracks", "false_tracks", note=false),
        Column("preci-\nsion", "precision", is_extra=True, note=precision),
    ]
    confirmed = "confirmed: published as more than tentative at some tick"
    columns = [
        RUN,
        *(truth if with_truth else ()),
        Column("tracks all/\nconfirmed", "num_tracks num_confirmed", "{}/{}", is_extra=with_truth, note=confirmed),
        Column("ms/tick\np50/p99", "time_per_tick_p50_s time_per_tick_p99_s", "{}/{}", MS),
    ]
    title = "Tracking" + (" (errors: RMSE against truth)" if with_truth else "")
    return Table(title, records, columns)


def _truth_numbers(one: Metrics, truth: TruthMetrics) -> dict[str, float]:
    overall = truth.overall
    return {
        **{named(name, "rmse"): overall.errors[name].rmse for name in _ERRORS},
        "position_nees": one.consistency.position_nees.mean,
        "tracked_share": overall.tracked_share,
        "tracked_share_in_sight": overall.tracked_share_in_sight,
        "breaks": overall.breaks,
        "id_switches": overall.id_switches,
        "false_tracks": truth.false_tracks,
        "precision": one.precision,
    }


def _multi_object(metrics: Mapping[str, Metrics]) -> Table:
    """A row for each run with truth: GOSPA and its parts, CLEAR, IDF1, HOTA, switches, time to confirm."""
    records = [
        {"run": label}
        | ({} if one.multi_object is None or one.truth is None else _scores(one.multi_object, one.truth.overall))
        for label, one in metrics.items()
    ]
    columns = [
        RUN,
        Column("GOSPA\n[m]", _GOSPA),
        Column("local.\n[m]", "gospa_localisation_m"),
        Column("missed\n[m]", "gospa_missed_in_sight_m"),
        Column("false\n[m]", "gospa_false_m"),
        Column("unseen\n[m]", "gospa_out_of_sight_m"),
        Column("with\nunseen", "gospa_rms_m"),
        *(Column(f"{name}\n[%]", name.lower(), scale=PERCENT) for name in ("MOTA", "IDF1", "HOTA", "DetA", "AssA")),
        Column("switches", "id_switches"),
        Column("confirm\n[s]", "time_to_confirm_s"),
    ]
    notes = [
        "GOSPA: root mean square over ticks; the squares of its parts add up to its own",
        "unseen: missed where no sensor could see; the scores in % count it too",
        "scores: 100 is perfect; defined in docs/metrics.md",
        "confirm: from an object's first detection to its first confirmed track",
    ]
    records = records if any(len(record) > 1 for record in records) else []
    return Table("Multi-object metrics", records, columns, notes=notes, is_detail=True)


def _scores(of: MultiObjectMetrics, overall: ObjectMetrics) -> dict[str, float]:
    m2 = of.gospa
    return {
        _GOSPA: of.gospa["in_sight_rms_m"],
        "gospa_localisation_m": math.sqrt(m2["localisation_m2"]),
        "gospa_missed_in_sight_m": math.sqrt(max(m2["missed_m2"] - m2["out_of_sight_m2"], 0.0)),
        "gospa_false_m": math.sqrt(m2["false_m2"]),
        "gospa_out_of_sight_m": math.sqrt(m2["out_of_sight_m2"]),
        "gospa_rms_m": of.gospa["rms_m"],
        "gospa_missed_m": math.sqrt(m2["missed_m2"]),
        "mota": of.clear["mota"],
        "idf1": of.identity["idf1"],
        **of.hota,
        "id_switches": overall.id_switches,
        "time_to_confirm_s": overall.time_to_confirm_s.mean,
    }


def _lag(metrics: Mapping[str, Metrics]) -> Table:
    """A row for each run and lag, where any run has lagged or final states: errors, and how waiting lowers them."""
    records = []
    for label, one in metrics.items():
        for lag in one.lagged:
            is_window = lag.lag_s == WINDOW
            numbers: dict[str, Any] = {"lag": lag.lag_s if is_window else f"{lag.lag_s:g}"}
            numbers |= {"lag_s": None if is_window else lag.lag_s, "num_states": lag.errors["position_m"].count}
            for name in ("position_m", "speed_mps", "yaw_rad"):
                gain = math.nan if lag.lag_s == 0.0 else lag.gain(name)
                numbers |= {named(name, "rmse"): lag.errors[name].rmse, f"{name.rpartition('_')[0]}_reduction": gain}
            ends = {"low": lag.position_reduction.low, "high": lag.position_reduction.high}
            numbers |= {f"position_reduction_{end}": value for end, value in ends.items()}
            records.append({"run": label, **numbers, "position_nees": lag.position_nees.mean})
    interval = "position_reduction_low position_reduction_high"
    columns = [
        RUN,
        Column("lag\n[s]", "lag"),
        Column("states", "num_states", is_extra=True),
        Column(_ERRORS["position_m"], "position_rmse_m"),
        Column("below\n[%]", "position_reduction", scale=PERCENT),
        Column("95 %\ninterval", interval, "{} to {}", PERCENT),
        Column(_ERRORS["speed_mps"], "speed_rmse_mps", is_extra=True),
        Column("below\n[%]", "speed_reduction", scale=PERCENT, is_extra=True),
        Column(_ERRORS["yaw_rad"], "yaw_rmse_rad", is_extra=True),
        Column("below\n[%]", "yaw_reduction", scale=PERCENT, is_extra=True),
        Column("NEES\npos.", "position_nees"),
    ]
    notes = [
        "lag 0: states as published; window: final states, as they leave the window",
        "below: reduction against the present states of the same tracks and stamps",
        "NEES: of the position; 2 if consistent",
    ]
    records = records if any(len(one.lagged) > 1 for one in metrics.values()) else []
    return Table("Error against lag (RMSE against truth)", records, columns, ("run", "lag"), notes)


def _consistency(metrics: Mapping[str, Metrics]) -> Table:
    """A row for each run and normalised square: NEES of the present states, NIS and whiteness of every sensor."""
    records = []
    for label, one in metrics.items():
        of = one.consistency
        squares = {"NEES position": of.position_nees} | {f"NIS {sensor}": nis for sensor, nis in of.nis.items()}
        for name, square in squares.items():
            record: dict[str, Any] = {"run": label, "of": name, "num_samples": square.count, "mean": square.mean}
            record |= {"expected": square.dof, "band_low": square.band[0], "band_high": square.band[1]}
            white = of.autocorrelation.get(name.removeprefix("NIS "))
            record |= {} if white is None else {"lag1_correlation": white.lag1, "lag1_band": white.lag1_band}
            records += [record] if square.count else []
    columns = [
        RUN,
        Column("of", left=True),
        Column("samples", "num_samples"),
        Column("mean"),
        Column("expected"),
        Column("95 % band", "band_low band_high", "{} to {}"),
        Column("correlation\nat lag 1", "lag1_correlation lag1_band", "{} ± {}"),
    ]
    notes = [
        "band: of the mean of independent samples; errors along one run are correlated,",
        "so the NEES of a single run may leave it (average over several runs)",
        f"correlation: of innovations, tracks with {FEWEST}+ of them; ± 95 % band if white",
    ]
    title = "Consistency (mean NEES and NIS, and their expected values)"
    return Table(title, records, columns, ("run", "of"), notes, is_detail=True)


def _residuals(sensor: str, metrics: Mapping[str, Metrics]) -> Table:
    """A row for each run with the sensor: mean and standard deviation of the innovations, NIS, delay."""
    sensors = {label: one.sensors[sensor] for label, one in metrics.items() if sensor in one.sensors}
    names = [name for name in RESIDUAL_NAMES if any(name in one.residuals for one in sensors.values())]
    records = []
    for label, one in sensors.items():
        record: dict[str, Any] = {"run": label}
        for name in names:
            if name in one.residuals:
                record |= {named(name, "mean"): one.residuals[name].mean, named(name, "std"): one.residuals[name].std}
        record |= {"nis_mean": one.nis.mean, "nis_expected": one.nis_dof.mean}
        records.append(record | {"delay_mean_s": one.delay_s.mean, "delay_p90_s": one.delay_s.p90})
    shown = [name for name in names if "along_m" not in names or name not in ("x_m", "y_m")]
    columns = [
        RUN,
        *(
            Column(
                f"{quantity.replace('_', ' ')}\n[{_UNITS[unit]}]",
                f"{named(name, 'mean')} {named(name, 'std')}",
                "{} ± {}",
            )
            for name in shown
            for quantity, _, unit in [name.rpartition("_")]
        ),
        Column("NIS", "nis_mean"),
        Column("NIS\nexpected", "nis_expected"),
        Column("delay [ms]\nmean/p90", "delay_mean_s delay_p90_s", "{}/{}", MS),
    ]
    title = f"Residuals of {sensor} (measured minus predicted: mean ± standard deviation)"
    return Table(title, records, columns, is_detail=True)


def _dispositions(metrics: Mapping[str, Metrics]) -> Table:
    """A row for each run and sensor: dispositions of the detections, and their sum."""
    records = []
    for label, one in metrics.items():
        for name, sensor in one.sensors.items():
            counts = sensor.dispositions
            refused = sum(count for kind, count in counts.items() if kind not in USED)
            groups = {"fused": sum(counts[k] for k in FUSED), "late": sum(counts[k] for k in LATE), "refused": refused}
            records.append({"run": label, "sensor": name, **counts, "detections": sensor.detections, **groups})
    absent = [kind for kind in Disposition if not any(record[kind.value] for record in records)]
    columns = [
        RUN,
        Column("sensor", left=True),
        Column("fused", note="fused: also those that started a track"),
        Column("late", note="late: of the fused ones, those out of sequence"),
        Column("refused"),
        *(
            Column(kind.value.replace("_", "\n"), kind.value, is_extra=kind != Disposition.MERGED)
            for kind in Disposition
            if kind not in absent
        ),
        Column("sum", "detections"),
    ]
    notes = [f"no detection was {' or '.join(kind.value.replace('_', ' ') for kind in absent)}"] if absent else []
    notes += dict.fromkeys(line for one in metrics.values() for line in one.left_out)
    title = "Dispositions (the outcome of every detection)"
    return Table(title, records, columns, ("run", "sensor"), notes)


def _failures(metrics: Mapping[str, Metrics]) -> Table:
    """A row for each run that counted its failures; without any failure it is a detail."""
    records: list[dict[str, Any]] = [
        {"run": label, **{kind.replace(" ", "_"): count for kind, count in one.failures.items()}}
        | {"failures": sum(one.failures.values())}
        for label, one in metrics.items()
        if one.failures
    ]
    kinds = dict.fromkeys(kind for one in metrics.values() for kind in one.failures)
    columns = [RUN, *(Column(kind.replace(" ", "\n"), kind.replace(" ", "_")) for kind in kinds)]
    is_detail = not any(record["failures"] for record in records)
    return Table("Failures inside the estimator", records, [*columns, Column("sum", "failures")], is_detail=is_detail)

"""Tables that compare several runs; made for a terminal of 120 columns."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from fgtrack.core.types import Disposition
from fgtrack.evaluation.consistency import Consistency
from fgtrack.evaluation.innovations import FEWEST, LAGS, RESIDUAL_NAMES
from fgtrack.evaluation.lagged import WINDOW, LagMetrics
from fgtrack.evaluation.matching import CONFIRMED_MEASUREMENTS
from fgtrack.evaluation.metrics import FALSE_TRACK_SHARE, Metrics, ObjectMetrics
from fgtrack.evaluation.statistics import ChiSquareMean, Distribution, Moments

BACKWARD_FORWARD = "ekf-backward-forward"
BACKWARD_FORWARD_NOTE = "backward-forward forgets what was fused after the stamp of a late detection"

_NONE = "-"
_UNITS = {"m": "m", "rad": "rad", "mps": "m/s"}
_ERROR_HEADINGS = {
    "position_m": "pos.\n[m]",
    "along_m": "along\n[m]",
    "across_m": "across\n[m]",
    "yaw_rad": "yaw\n[rad]",
    "speed_mps": "speed\n[m/s]",
}
_LAG_ERRORS = ("position_m", "speed_mps", "yaw_rad")
_MOST_LAGS = 8
_CONTINUITY_HEADINGS = ("tracked\n[%]", "breaks/\nswitches", "false\ntracks", "preci-\nsion")
_MULTI_OBJECT_HEADINGS = (
    *("GOSPA\n[m]", "local.\n[m]", "missed\n[m]", "false\n[m]"),
    *("MOTA\n[%]", "IDF1\n[%]", "HOTA\n[%]", "DetA\n[%]", "AssA\n[%]"),
    *("switches/\nlate", "confirm\n[s]"),
)
_NOTE_WIDTH = 86  # so that no note is broken
_MS = 1e3


def comparison_tables(metrics: Mapping[str, Metrics]) -> list[Table]:
    """All tables of `metrics`, by label, that have a row; the main one first."""
    tables = [main_table(metrics), multi_object_table(metrics), lag_table(metrics), consistency_table(metrics)]
    tables += [*residual_tables(metrics), disposition_table(metrics)]
    return [table for table in tables if table.row_count]


def comparison_dict(metrics: Mapping[str, Metrics]) -> dict[str, Any]:
    """What the tables show and more, as JSON values."""
    return {"runs": {label: one.as_dict() for label, one in metrics.items()}, "notes": _notes(metrics)}


def main_table(metrics: Mapping[str, Metrics]) -> Table:
    """A row per run: errors against truth, continuity, number of tracks, time."""
    with_truth = any(one.truth for one in metrics.values())
    table = _table("Tracking" + (" (errors: RMSE against truth)" if with_truth else ""))
    _name(table, "run")
    if with_truth:
        for heading in _ERROR_HEADINGS.values():
            _number(table, heading)
        for heading in _CONTINUITY_HEADINGS:
            _number(table, heading)
    _number(table, f"tracks\nall/{CONFIRMED_MEASUREMENTS}+")
    _number(table, "ms/tick\np50/p99")
    for label, one in metrics.items():
        time = one.time_per_tick_s
        ms = f"{_short(time.p50 * _MS)}/{_short(time.p99 * _MS)}" if time.count else _NONE
        counts = f"{one.num_tracks}/{one.num_confirmed}"
        table.add_row(Text(label), *(_truth_cells(one) if with_truth else ()), counts, ms)
    notes = [f"{CONFIRMED_MEASUREMENTS}+: tracks with at least {CONFIRMED_MEASUREMENTS} measurements"]
    if with_truth:
        notes += [
            f"false: paired to a true object in less than {FALSE_TRACK_SHARE:.0%} of its life",
            "breaks: tracked again after a loss, or by another track; switches: by another track",
            f"precision: true objects tracked / tracks with {CONFIRMED_MEASUREMENTS}+ measurements",
        ]
    table.caption = Text("\n".join([*notes, *_notes(metrics)]))
    return table


def multi_object_table(metrics: Mapping[str, Metrics]) -> Table:
    """A row per run with truth: GOSPA and its parts, CLEAR, IDF1, HOTA, identity switches, time to confirm."""
    table = _table("Multi-object metrics")
    _name(table, "run")
    for heading in _MULTI_OBJECT_HEADINGS:
        _number(table, heading)
    if not any(one.multi_object for one in metrics.values()):
        return table
    for label, one in metrics.items():
        table.add_row(Text(label), *_multi_object_cells(one))
    notes = [
        "GOSPA: root mean square over the ticks; the squares of its parts add up to its own",
        "scores: 100 is perfect; docs/metrics.md tells what each of them counts",
        "late: switches soon after an out-of-sequence update of one of the two tracks",
        "confirm: from an object's first detection to its first confirmed track",
    ]
    table.caption = Text("\n".join([*notes, *_notes(metrics)]))
    return table


def consistency_table(metrics: Mapping[str, Metrics]) -> Table:
    """A row per run and normalised square: NEES of the present states, NIS and whiteness of every sensor."""
    table = _table("Consistency (means of normalised squares, and what they must be)")
    _name(table, "run")
    _name(table, "of")
    for heading in ("samples", "mean", "expected", "95 % band", "correlation\nat lag 1", "outside\n[%]"):
        _number(table, heading)
    for label, one in metrics.items():
        for k, cells in enumerate(_consistency_rows(one.consistency)):
            table.add_row(Text(label if k == 0 else ""), *cells)
    notes = [
        "band: of the mean of independent samples; errors along one run are not independent,",
        "so NEES of a single run may leave it (several runs tell)",
        f"correlation: of the innovations (position first), of tracks with {FEWEST}+; ± 95 % band if white",
        f"outside: tracks and lags 1 to {LAGS} outside their own bands; 5 if white",
    ]
    table.caption = Text("\n".join([*notes, *_notes(metrics)]))
    return table


def lag_table(metrics: Mapping[str, Metrics]) -> Table:
    """A row per run and lag, where any run has lagged or final states: errors, and by how much waiting lowers them."""
    table = _table("Error against lag (RMSE against truth)")
    _name(table, "run")
    for heading in ("lag\n[s]", "states"):
        _number(table, heading)
    for name in _LAG_ERRORS:
        _number(table, _ERROR_HEADINGS[name])
        _number(table, "below\n[%]")
    _number(table, "NEES\npos.")
    if not any(len(one.lagged) > 1 for one in metrics.values()):
        return table
    for label, one in metrics.items():
        for k, entry in enumerate(_shown_lags(one.lagged)):
            table.add_row(Text(label if k == 0 else ""), *_lag_cells(entry))
    notes = [
        "lag 0: present states, as published; window: final states, which leave the window",
        "below: by how much, than the present states of the same tracks at the same stamps",
        "NEES: of the position; 2 if consistent",
    ]
    if any(len(_shown_lags(one.lagged)) < len(one.lagged) for one in metrics.values()):
        notes.append(f"{_MOST_LAGS} lags of a run are shown at most, metrics.json has all")
    table.caption = Text("\n".join([*notes, *_notes(metrics)]))
    return table


def residual_tables(metrics: Mapping[str, Metrics]) -> list[Table]:
    """A table per sensor, a row per run: mean and deviation of the innovations, NIS, delay."""
    return [
        _residual_table(sensor, {label: one for label, one in metrics.items() if sensor in one.sensors})
        for sensor in _sensors(metrics)
    ]


def disposition_table(metrics: Mapping[str, Metrics]) -> Table:
    """A row per run and sensor: what became of the detections, and their sum."""
    occurring = [
        name
        for name in Disposition
        if any(sensor.dispositions[name] for one in metrics.values() for sensor in one.sensors.values())
    ]
    table = _table("Dispositions (what became of every detection)")
    _name(table, "run")
    _name(table, "sensor")
    for name in occurring:
        _number(table, name.replace("_", "\n"))
    _number(table, "sum")
    for label, one in metrics.items():
        for k, (sensor_name, sensor) in enumerate(one.sensors.items()):
            counts = [str(sensor.dispositions[disposition]) for disposition in occurring]
            table.add_row(Text(label if k == 0 else ""), Text(sensor_name), *counts, str(sensor.detections))
    absent = [name.replace("_", " ") for name in Disposition if name not in occurring]
    notes = [f"none: {', '.join(absent)}"] if absent else []
    table.caption = Text("\n".join([*notes, *_notes(metrics)]))
    return table


def _shown_lags(lagged: Sequence[LagMetrics]) -> list[LagMetrics]:
    """The present and the final states, and of the lags between them at most so many that are evenly spread."""
    lags = [entry for entry in lagged if entry.lag_s not in (0.0, WINDOW)]
    if len(lags) > _MOST_LAGS:
        lags = [lags[round(k * (len(lags) - 1) / (_MOST_LAGS - 1))] for k in range(_MOST_LAGS)]
    return [entry for entry in lagged if entry.lag_s in (0.0, WINDOW) or entry in lags]


def _lag_cells(entry: LagMetrics) -> list[str]:
    lag = entry.lag_s if isinstance(entry.lag_s, str) else f"{entry.lag_s:g}"
    cells = [lag, str(entry.errors["position_m"].count)]
    for name in _LAG_ERRORS:
        below = math.nan if entry.lag_s == 0.0 else 100.0 * entry.gain(name)
        cells += [_short(entry.errors[name].rmse), _short(below)]
    return [*cells, _short(entry.position_nees.mean)]


def _residual_table(sensor: str, metrics: Mapping[str, Metrics]) -> Table:
    of_sensor = {label: one.sensors[sensor] for label, one in metrics.items()}
    shown = [name for name in RESIDUAL_NAMES if any(name in one.residuals for one in of_sensor.values())]
    if "along_m" in shown:
        shown = [name for name in shown if name not in ("x_m", "y_m")]
    table = _table(f"Residuals of {sensor} (measured minus predicted: mean ± standard deviation)")
    _name(table, "run")
    for name in shown:
        quantity, _, unit = name.rpartition("_")
        _number(table, f"{quantity.replace('_', ' ')}\n[{_UNITS[unit]}]")
    for heading in ("NIS", "NIS\nexpected", "delay [ms]\nmean/p90"):
        _number(table, heading)
    for label, one in of_sensor.items():
        cells = [_mean_std(one.residuals.get(name, Moments())) for name in shown]
        nis = (_short(one.nis.mean), _short(one.nis_dof.mean))
        table.add_row(Text(label), *cells, *nis, _delay(one.delay_s))
    table.caption = Text("\n".join(_notes(metrics)))
    return table


def _sensors(metrics: Mapping[str, Metrics]) -> list[str]:
    return list(dict.fromkeys(sensor for one in metrics.values() for sensor in one.sensors))


def _truth_cells(one: Metrics) -> list[str]:
    if one.truth is None:
        return [_NONE] * (len(_ERROR_HEADINGS) + len(_CONTINUITY_HEADINGS))
    overall: ObjectMetrics = one.truth.overall
    return [
        *(_short(overall.errors[name].rmse) for name in _ERROR_HEADINGS),
        _short(100.0 * overall.tracked_share),
        f"{overall.breaks}/{overall.id_switches}",
        str(one.truth.false_tracks),
        _NONE if math.isnan(one.precision) else f"{one.precision:.2f}",
    ]


def _multi_object_cells(one: Metrics) -> list[str]:
    if one.multi_object is None or one.truth is None:
        return [_NONE] * len(_MULTI_OBJECT_HEADINGS)
    gospa, overall = one.multi_object.gospa, one.truth.overall
    parts_m = (math.sqrt(part) for part in (gospa.localisation_m2, gospa.missed_m2, gospa.false_m2))
    clear, identity, hota = one.multi_object.clear, one.multi_object.identity, one.multi_object.hota
    return [
        *(_short(value) for value in (gospa.rms_m, *parts_m)),
        *(_short(100.0 * score) for score in (clear.mota, identity.idf1, hota.hota, hota.deta, hota.assa)),
        f"{overall.id_switches}/{overall.late_id_switches}",
        _short(overall.time_to_confirm_s.mean),
    ]


def _consistency_rows(found: Consistency) -> list[list[str]]:
    """Cells of every row behind the name of the run."""
    rows = []
    for name, nees in (("NEES position", found.position_nees), ("NEES state", found.state_nees)):
        if nees.count:
            rows.append([name, *_chi_square_cells(nees), _NONE, _NONE])
    for sensor, nis in found.nis.items():
        if nis.count:
            first = next(iter(found.autocorrelation[sensor].values()), None)
            correlation = f"{_short(first.lag1)} ± {_short(first.lag1_band)}" if first else _NONE
            outside = _short(100.0 * first.share_outside) if first else _NONE
            rows.append([f"NIS {sensor}", *_chi_square_cells(nis), correlation, outside])
    return rows


def _chi_square_cells(one: ChiSquareMean) -> list[str]:
    low, high = one.band
    return [str(one.count), _short(one.mean), _short(one.dof), f"{_short(low)} to {_short(high)}"]


def _notes(metrics: Mapping[str, Metrics]) -> list[str]:
    known = any(one.estimator == BACKWARD_FORWARD for one in metrics.values())
    return [BACKWARD_FORWARD_NOTE] if known else []


def _table(title: str) -> Table:
    return Table(
        title=Text(f"\n{title}"),
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 0, 0, 1),
        min_width=_NOTE_WIDTH,
        title_justify="left",
        caption_justify="left",
    )


def _name(table: Table, heading: str) -> None:
    table.add_column(heading, overflow="fold")


def _number(table: Table, heading: str) -> None:
    table.add_column(Text(heading), justify="right", no_wrap=True)


def _short(value: float) -> str:
    """`value` with three significant digits, integers in full; a dash for NaN."""
    if not math.isfinite(value):
        return _NONE
    if abs(value) >= 100.0:
        return f"{value:.0f}"
    decimals = 1 if abs(value) >= 10.0 else 2 if abs(value) >= 1.0 else 3
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # no negative zero


def _mean_std(moments: Moments) -> str:
    return f"{_short(moments.mean)} ± {_short(moments.std)}" if moments.count else _NONE


def _delay(delay_s: Distribution) -> str:
    return f"{_short(delay_s.mean * _MS)}/{_short(delay_s.p90 * _MS)}" if delay_s.count else _NONE

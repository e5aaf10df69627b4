"""Runs compared: what each table of a comparison shows."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

from fgtrack.core.errors import CallError
from fgtrack.evaluation.contest import BEST_NOTE, POSITION_NEES, Contest, contests, differences, is_best
from fgtrack.evaluation.failures_table import failures_table
from fgtrack.evaluation.lagged import WINDOW, LagMetrics
from fgtrack.evaluation.metrics import FALSE_TRACK_SHARE, Metrics, ObjectMetrics, TruthMetrics
from fgtrack.evaluation.multi_object import MultiObjectMetrics
from fgtrack.evaluation.paper_tables import with_paper_tables
from fgtrack.evaluation.runs import OneRun, judged
from fgtrack.evaluation.sensor_tables import consistency_table, dispositions_table, residuals_table
from fgtrack.evaluation.streaming import with_streaming
from fgtrack.evaluation.table_rows import ERRORS, MS, PERCENT, Row, Values, named, run_column
from fgtrack.evaluation.tables import NO_VALUE, Column, Table, Tables, Value
from fgtrack.evaluation.verdict import verdict

BACKWARD_FORWARD = "ekf-backward-forward"
BACKWARD_FORWARD_NOTE = "backward-forward forgets what was fused after the stamp of a late detection"

_MAIN_ERRORS = ("position_m",)
_RANKED = ("position_rmse_m", "speed_rmse_mps", "yaw_rmse_rad", POSITION_NEES)
_LAG_ERRORS = ("position_m", "speed_mps", "yaw_rad")
_MOST_LAGS = 8
_FEW_LAGS = 3


def compare(*runs: OneRun | Iterable[OneRun], streaming: bool = False) -> Tables:
    """Metrics of `runs` in comparison: the `verdict`, and tables `differences`, `tracking`, `multi_object`, `lag`,
    `consistency`, `dispositions`, `failures`, `residuals_SENSOR` of every sensor, and those of `with_paper_tables`.

    Runs of the same recording are compared sample by sample. A path is a run folder, or a folder that holds run
    folders. With `streaming` a table of that name judges what was published when it was ready, and the verdict says who
    is best then.

    Raises
    ------
    CallError
        No run is given, one is given twice, or a path is no run folder.
    DataError
        A run folder is damaged.
    """
    every = judged(runs)
    if not every:
        raise CallError("compare: no run is given, name at least one")
    tables = comparison({one.label: one.metrics for one in every}, contests(every))
    tables = with_paper_tables(tables, every)
    return with_streaming(tables, every) if streaming else tables


def comparison(metrics: Mapping[str, Metrics], found: Sequence[Contest] = ()) -> Tables:
    """The tables of `metrics`, by label, and what the contests among these runs `found`."""
    notes = [BACKWARD_FORWARD_NOTE] if any(one.estimator == BACKWARD_FORWARD for one in metrics.values()) else []
    rows = [Row(label, one) for label, one in metrics.items()]
    of_sensors = [Row(row.run, sensor, name) for row in rows for name, sensor in row.of.sensors.items()]
    tables = {
        "differences": differences(found),
        "tracking": _tracking(rows, found, notes),
        "multi_object": _multi_object(rows, found),
        "lag": _lag(rows),
        "consistency": consistency_table(rows),
    }
    for sensor in dict.fromkeys(row.part for row in of_sensors):
        tables[f"residuals_{sensor}"] = residuals_table(sensor, [row for row in of_sensors if row.part == sensor])
    tables["dispositions"] = dispositions_table(
        of_sensors, dict.fromkeys(line for row in rows for line in row.of.left_out)
    )
    tables["failures"] = failures_table(rows)
    details = {"runs": {label: one.as_dict() for label, one in metrics.items()}, "notes": notes}
    return Tables(tables, details, verdict(metrics, found))


def _tracking(rows: Sequence[Row[Metrics]], found: Sequence[Contest], notes: Sequence[str]) -> Table:
    """A row for each run: errors against truth, continuity, number of tracks, time."""

    def of_truth(get: Callable[[TruthMetrics], Values]) -> Callable[[Row[Metrics]], Values | None]:
        return lambda row: None if row.of.truth is None else get(row.of.truth)

    def rmse(name: str) -> Column[Row[Metrics]]:
        data = named(name, "rmse")
        return Column(
            ERRORS[name],
            (data,),
            of_truth(lambda truth: (truth.overall.errors[name].rmse,)),
            bold=lambda row: is_best(found, data, row.run),
            when="always" if name in _MAIN_ERRORS else "full",
        )

    with_truth = any(row.of.truth for row in rows)
    truth: list[Column[Row[Metrics]]] = [
        *map(rmse, ERRORS),
        Column(
            "NEES\npos.",
            (),
            lambda row: (row.of.consistency.position_nees.mean,) if row.of.truth else None,
            bold=lambda row: is_best(found, POSITION_NEES, row.run),
            when="few",
            note="NEES: mean of the position's; 2 if the covariances fit",
        ),
        Column("", ("tracked_share",), of_truth(lambda of: (of.overall.tracked_share,))),
        Column(
            "tracked\n[%]",
            ("tracked_share_in_sight",),
            of_truth(lambda of: (of.overall.tracked_share_in_sight,)),
            scale=PERCENT,
            note="tracked: share of the ticks at which some sensor could see the object",
        ),
        Column(
            "breaks/\nswitches",
            ("breaks", "id_switches"),
            of_truth(lambda of: (of.overall.breaks, of.overall.id_switches)),
            "{}/{}",
            note="breaks: resumed after a loss or with another track; switches: the latter",
        ),
        Column(
            "false\ntracks",
            ("false_tracks",),
            of_truth(lambda of: (of.false_tracks,)),
            note=f"false: paired with a true object in less than {FALSE_TRACK_SHARE:.0%} of its life",
        ),
        Column(
            "preci-\nsion",
            ("precision",),
            lambda row: (row.of.precision,),
            text=_two_decimals,
            when="full",
            note="precision: true objects tracked / tracks that were confirmed",
        ),
    ]
    columns = [
        run_column(rows),
        Column("", ("estimator",), lambda row: (row.of.estimator,)),
        *(truth if with_truth else [replace(column, heading="") for column in truth]),
        Column(
            "tracks all/\nconfirmed",
            ("num_tracks", "num_confirmed"),
            lambda row: (row.of.num_tracks, row.of.num_confirmed),
            "{}/{}",
            when="full" if with_truth else "always",
            note="confirmed: published as more than tentative at some tick",
        ),
        Column(
            "ms/tick\np50/p99",
            ("time_per_tick_p50_s", "time_per_tick_p99_s"),
            lambda row: (row.of.time_per_tick_s.p50, row.of.time_per_tick_s.p99),
            "{}/{}",
            MS,
        ),
    ]
    own = [BEST_NOTE] if any(is_best(found, name, row.run) for row in rows for name in _RANKED) else []
    known = [row for row in rows if row.of.deadlines.are_known]
    if known:
        late = [
            f"{row.run} {row.of.deadlines.misses}/{row.of.deadlines.ticks}" for row in known if row.of.deadlines.misses
        ]
        if late:
            own.append(f"slower than real time, on a machine that may have been busy (ticks late): {', '.join(late)}")
    title = "Tracking" + (" (errors: RMSE against truth)" if with_truth else "")
    return Table(title, columns, rows, notes=[*own, *notes])


def _multi_object(rows: Sequence[Row[Metrics]], found: Sequence[Contest]) -> Table:
    """A row for each run where any has truth: GOSPA and its parts, CLEAR, IDF1, HOTA, switches, time to confirm."""

    def score(get: Callable[[MultiObjectMetrics], float]) -> Callable[[Row[Metrics]], Values | None]:
        return lambda row: None if row.of.multi_object is None else (get(row.of.multi_object),)

    def of_objects(get: Callable[[ObjectMetrics], Values]) -> Callable[[Row[Metrics]], Values | None]:
        return lambda row: get(row.of.truth.overall) if row.of.multi_object and row.of.truth else None

    scores: dict[str, Callable[[MultiObjectMetrics], float]] = {
        "MOTA": lambda of: of.clear.mota,
        "IDF1": lambda of: of.identity.idf1,
        "HOTA": lambda of: of.hota.hota,
        "DetA": lambda of: of.hota.deta,
        "AssA": lambda of: of.hota.assa,
    }
    gospa = "gospa_in_sight_rms_m"
    columns: list[Column[Row[Metrics]]] = [
        run_column(rows),
        Column(
            "GOSPA\n[m]",
            (gospa,),
            score(lambda of: of.gospa.in_sight_rms_m),
            bold=lambda row: is_best(found, gospa, row.run),
        ),
        Column("local.\n[m]", ("gospa_localisation_m",), score(lambda of: math.sqrt(of.gospa.localisation_m2))),
        Column("missed\n[m]", ("gospa_missed_in_sight_m",), score(_missed_in_sight_m)),
        Column("false\n[m]", ("gospa_false_m",), score(lambda of: math.sqrt(of.gospa.false_m2))),
        Column("unseen\n[m]", ("gospa_out_of_sight_m",), score(lambda of: math.sqrt(of.gospa.out_of_sight_m2))),
        Column("with\nunseen", ("gospa_rms_m",), score(lambda of: of.gospa.rms_m)),
        Column("", ("gospa_missed_m",), score(lambda of: math.sqrt(of.gospa.missed_m2))),
        *(Column(f"{k}\n[%]", (k.lower(),), score(get), scale=PERCENT) for k, get in scores.items()),
        Column(
            "switches/\nlate",
            ("id_switches", "late_id_switches"),
            of_objects(lambda of: (of.id_switches, of.late_id_switches)),
            "{}/{}",
        ),
        Column("confirm\n[s]", ("time_to_confirm_s",), of_objects(lambda of: (of.time_to_confirm_s.mean,))),
    ]
    notes = [
        "GOSPA: root mean square over ticks; the squares of its parts add up to its own",
        "unseen: missed where no sensor could see; the scores in % count it too",
        "scores: 100 is perfect; defined in docs/metrics.md",
        "late: switches soon after an out-of-sequence update of one of the two tracks",
        "confirm: from an object's first detection to its first confirmed track",
        *([BEST_NOTE] if any(is_best(found, gospa, row.run) for row in rows) else []),
    ]
    rows = rows if any(row.of.multi_object for row in rows) else []
    return Table("Multi-object metrics", columns, rows, notes=notes, detail=True)


def _missed_in_sight_m(of: MultiObjectMetrics) -> float:
    return math.sqrt(max(of.gospa.missed_m2 - of.gospa.out_of_sight_m2, 0.0))


def _lag(rows: Sequence[Row[Metrics]]) -> Table:
    """A row for each run and lag, where any run has lagged or final states: errors, and how waiting lowers them."""

    def rmse(name: str) -> Callable[[Row[LagMetrics]], Values]:
        return lambda row: (row.of.errors[name].rmse,)

    def reduction(name: str) -> Callable[[Row[LagMetrics]], Values]:
        return lambda row: (math.nan if row.of.lag_s == 0.0 else row.of.gain(name),)

    def interval(row: Row[LagMetrics]) -> Values:
        return row.of.position_reduction.low, row.of.position_reduction.high

    errors: list[Column[Row[LagMetrics]]] = []
    for name in _LAG_ERRORS:
        when: Literal["always", "full"] = "always" if name in _MAIN_ERRORS else "full"
        quantity = f"{name.rpartition('_')[0]}_reduction"
        errors.append(Column(ERRORS[name], (named(name, "rmse"),), rmse(name), when=when))
        errors.append(Column("below\n[%]", (quantity,), reduction(name), scale=PERCENT, when=when))
        if name == "position_m":
            errors.append(
                Column(
                    "95 %\ninterval",
                    ("position_reduction_low", "position_reduction_high"),
                    interval,
                    "{} to {}",
                    PERCENT,
                )
            )
    entries = [Row(row.run, one) for row in rows for one in _shown_lags(row.of.lagged, _MOST_LAGS)]
    few = [id(one) for row in rows for one in _shown_lags(row.of.lagged, _FEW_LAGS)]
    columns: list[Column[Row[LagMetrics]]] = [
        run_column(entries),
        Column("lag\n[s]", ("lag",), lambda row: (row.of.lag_s if row.of.lag_s == WINDOW else f"{row.of.lag_s:g}",)),
        Column("", ("lag_s",), lambda row: None if row.of.lag_s == WINDOW else (row.of.lag_s,)),
        Column("states", ("num_states",), lambda row: (row.of.errors["position_m"].count,), when="full"),
        *errors,
        Column("NEES\npos.", ("position_nees",), lambda row: (row.of.position_nees.mean,)),
    ]
    own = [
        "lag 0: states as published; window: final states, as they leave the window",
        "below: reduction against the present states of the same tracks and stamps",
        "NEES: of the position; 2 if consistent",
    ]
    if any(len(_shown_lags(row.of.lagged, _MOST_LAGS)) < len(row.of.lagged) for row in rows):
        own.append(f"{_MOST_LAGS} lags of a run are shown at most, metrics.json has all")
    entries = entries if any(len(row.of.lagged) > 1 for row in rows) else []
    title = "Error against lag (RMSE against truth)"
    return Table(
        title, columns, entries, row_keys=("run", "lag"), notes=own, detail_rows=lambda row: id(row.of) not in few
    )


def _shown_lags(lagged: Sequence[LagMetrics], most: int) -> list[LagMetrics]:
    """The present and the final states, and of the lags between them at most so many that are evenly spread."""
    lags = [entry for entry in lagged if entry.lag_s not in (0.0, WINDOW)]
    if len(lags) > most:
        lags = [lags[round(k * (len(lags) - 1) / (most - 1))] for k in range(most)]
    return [entry for entry in lagged if entry.lag_s in (0.0, WINDOW) or entry in lags]


def _two_decimals(value: Value) -> str:
    return f"{value:.2f}" if math.isfinite(float(value)) else NO_VALUE

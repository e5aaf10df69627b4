"""Runs compared: what each table of a comparison shows."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from fgtrack.core.errors import CallError
from fgtrack.core.types import Disposition
from fgtrack.evaluation.consistency import Consistency
from fgtrack.evaluation.contest import Contest, contests, differences
from fgtrack.evaluation.innovations import FEWEST, LAGS, RESIDUAL_NAMES, Autocorrelation
from fgtrack.evaluation.lagged import WINDOW, LagMetrics
from fgtrack.evaluation.matching import CONFIRMED_MEASUREMENTS
from fgtrack.evaluation.metrics import FALSE_TRACK_SHARE, Metrics, ObjectMetrics, SensorMetrics, TruthMetrics
from fgtrack.evaluation.multi_object import MultiObjectMetrics
from fgtrack.evaluation.runs import OneRun, judged
from fgtrack.evaluation.statistics import ChiSquareMean
from fgtrack.evaluation.streaming import with_streaming
from fgtrack.evaluation.tables import NO_VALUE, Column, Table, Tables, Value
from fgtrack.evaluation.verdict import verdict

BACKWARD_FORWARD = "ekf-backward-forward"
BACKWARD_FORWARD_NOTE = "backward-forward forgets what was fused after the stamp of a late detection"

_UNITS = {"m": "m", "rad": "rad", "mps": "m/s"}
_ERRORS = {
    "position_m": "pos.\n[m]",
    "along_m": "along\n[m]",
    "across_m": "across\n[m]",
    "yaw_rad": "yaw\n[rad]",
    "speed_mps": "speed\n[m/s]",
}
_LAG_ERRORS = ("position_m", "speed_mps", "yaw_rad")
_MOST_LAGS = 8
_PERCENT = 100.0
_MS = 1e3

T = TypeVar("T")
_Values = tuple[Value, ...]
_Square = tuple[ChiSquareMean, Autocorrelation | None]


@dataclass(frozen=True)
class _Row(Generic[T]):
    """What a row is made of."""

    run: str
    of: T
    part: str = ""
    """What distinguishes it from the other rows of the run."""


def compare(*runs: OneRun | Iterable[OneRun], streaming: bool = False) -> Tables:
    """Metrics of `runs` in comparison: the `verdict`, and tables `differences`, `tracking`, `multi_object`, `lag`,
    `consistency`, `dispositions` and `residuals_SENSOR` of every sensor.

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
    return with_streaming(tables, every) if streaming else tables


def comparison(metrics: Mapping[str, Metrics], found: Sequence[Contest] = ()) -> Tables:
    """The tables of `metrics`, by label, and what the contests among these runs `found`."""
    notes = [BACKWARD_FORWARD_NOTE] if any(one.estimator == BACKWARD_FORWARD for one in metrics.values()) else []
    rows = [_Row(label, one) for label, one in metrics.items()]
    of_sensors = [_Row(row.run, sensor, name) for row in rows for name, sensor in row.of.sensors.items()]
    tables = {
        "differences": differences(found),
        "tracking": _tracking(rows, notes),
        "multi_object": _multi_object(rows, notes),
        "lag": _lag(rows, notes),
        "consistency": _consistency(rows, notes),
    }
    for sensor in dict.fromkeys(row.part for row in of_sensors):
        tables[f"residuals_{sensor}"] = _residuals(sensor, [row for row in of_sensors if row.part == sensor], notes)
    tables["dispositions"] = _dispositions(of_sensors, notes)
    details = {"runs": {label: one.as_dict() for label, one in metrics.items()}, "notes": notes}
    return Tables(tables, details, verdict(metrics, found))


def _tracking(rows: Sequence[_Row[Metrics]], notes: Sequence[str]) -> Table:
    """A row for each run: errors against truth, continuity, number of tracks, time."""

    def of_truth(get: Callable[[TruthMetrics], _Values]) -> Callable[[_Row[Metrics]], _Values | None]:
        return lambda row: None if row.of.truth is None else get(row.of.truth)

    def rmse(name: str) -> Callable[[TruthMetrics], _Values]:
        return lambda truth: (truth.overall.errors[name].rmse,)

    with_truth = any(row.of.truth for row in rows)
    truth: list[Column[_Row[Metrics]]] = [
        *(Column(heading, (_named(name, "rmse"),), of_truth(rmse(name))) for name, heading in _ERRORS.items()),
        Column("", ("tracked_share",), of_truth(lambda of: (of.overall.tracked_share,))),
        Column(
            "tracked\n[%]",
            ("tracked_share_in_sight",),
            of_truth(lambda of: (of.overall.tracked_share_in_sight,)),
            scale=_PERCENT,
        ),
        Column(
            "breaks/\nswitches",
            ("breaks", "id_switches"),
            of_truth(lambda of: (of.overall.breaks, of.overall.id_switches)),
            "{}/{}",
        ),
        Column("false\ntracks", ("false_tracks",), of_truth(lambda of: (of.false_tracks,))),
        Column("preci-\nsion", ("precision",), lambda row: (row.of.precision,), text=_two_decimals),
    ]
    columns = [
        _run_column(rows),
        Column("", ("estimator",), lambda row: (row.of.estimator,)),
        *(truth if with_truth else [replace(column, heading="") for column in truth]),
        Column(
            f"tracks\nall/{CONFIRMED_MEASUREMENTS}+",
            ("num_tracks", "num_confirmed"),
            lambda row: (row.of.num_tracks, row.of.num_confirmed),
            "{}/{}",
        ),
        Column(
            "ms/tick\np50/p99",
            ("time_per_tick_p50_s", "time_per_tick_p99_s"),
            lambda row: (row.of.time_per_tick_s.p50, row.of.time_per_tick_s.p99),
            "{}/{}",
            _MS,
        ),
    ]
    own = [f"{CONFIRMED_MEASUREMENTS}+: tracks with at least {CONFIRMED_MEASUREMENTS} measurements"]
    known = [row for row in rows if row.of.deadlines.are_known]
    if known:
        late = [
            f"{row.run} {row.of.deadlines.misses}/{row.of.deadlines.ticks}" for row in known if row.of.deadlines.misses
        ]
        own.append(f"deadlines missed (ticks not done when the next one was due): {', '.join(late) or 'none'}")
    if with_truth:
        own += [
            "tracked: share of the ticks at which some sensor could see the object",
            f"false: paired with a true object in less than {FALSE_TRACK_SHARE:.0%} of its life",
            "breaks: resumed after a loss or with another track; switches: the latter",
            f"precision: true objects tracked / tracks with {CONFIRMED_MEASUREMENTS}+ measurements",
        ]
    title = "Tracking" + (" (errors: RMSE against truth)" if with_truth else "")
    return Table(title, columns, rows, notes=[*own, *notes])


def _multi_object(rows: Sequence[_Row[Metrics]], notes: Sequence[str]) -> Table:
    """A row for each run where any has truth: GOSPA and its parts, CLEAR, IDF1, HOTA, switches, time to confirm."""

    def score(get: Callable[[MultiObjectMetrics], float]) -> Callable[[_Row[Metrics]], _Values | None]:
        return lambda row: None if row.of.multi_object is None else (get(row.of.multi_object),)

    def of_objects(get: Callable[[ObjectMetrics], _Values]) -> Callable[[_Row[Metrics]], _Values | None]:
        return lambda row: get(row.of.truth.overall) if row.of.multi_object and row.of.truth else None

    scores: dict[str, Callable[[MultiObjectMetrics], float]] = {
        "MOTA": lambda of: of.clear.mota,
        "IDF1": lambda of: of.identity.idf1,
        "HOTA": lambda of: of.hota.hota,
        "DetA": lambda of: of.hota.deta,
        "AssA": lambda of: of.hota.assa,
    }
    columns: list[Column[_Row[Metrics]]] = [
        _run_column(rows),
        Column("GOSPA\n[m]", ("gospa_in_sight_rms_m",), score(lambda of: of.gospa.in_sight_rms_m)),
        Column("local.\n[m]", ("gospa_localisation_m",), score(lambda of: math.sqrt(of.gospa.localisation_m2))),
        Column("missed\n[m]", ("gospa_missed_in_sight_m",), score(_missed_in_sight_m)),
        Column("false\n[m]", ("gospa_false_m",), score(lambda of: math.sqrt(of.gospa.false_m2))),
        Column("unseen\n[m]", ("gospa_out_of_sight_m",), score(lambda of: math.sqrt(of.gospa.out_of_sight_m2))),
        Column("with\nunseen", ("gospa_rms_m",), score(lambda of: of.gospa.rms_m)),
        Column("", ("gospa_missed_m",), score(lambda of: math.sqrt(of.gospa.missed_m2))),
        *(Column(f"{k}\n[%]", (k.lower(),), score(get), scale=_PERCENT) for k, get in scores.items()),
        Column(
            "switches/\nlate",
            ("id_switches", "late_id_switches"),
            of_objects(lambda of: (of.id_switches, of.late_id_switches)),
            "{}/{}",
        ),
        Column("confirm\n[s]", ("time_to_confirm_s",), of_objects(lambda of: (of.time_to_confirm_s.mean,))),
    ]
    own = [
        "GOSPA: root mean square over ticks; the squares of its parts add up to its own",
        "unseen: missed where no sensor could see; the scores in % count it too",
        "scores: 100 is perfect; defined in docs/metrics.md",
        "late: switches soon after an out-of-sequence update of one of the two tracks",
        "confirm: from an object's first detection to its first confirmed track",
    ]
    rows = rows if any(row.of.multi_object for row in rows) else []
    return Table("Multi-object metrics", columns, rows, notes=[*own, *notes])


def _missed_in_sight_m(of: MultiObjectMetrics) -> float:
    return math.sqrt(max(of.gospa.missed_m2 - of.gospa.out_of_sight_m2, 0.0))


def _lag(rows: Sequence[_Row[Metrics]], notes: Sequence[str]) -> Table:
    """A row for each run and lag, where any run has lagged or final states: errors, and how waiting lowers them."""

    def rmse(name: str) -> Callable[[_Row[LagMetrics]], _Values]:
        return lambda row: (row.of.errors[name].rmse,)

    def reduction(name: str) -> Callable[[_Row[LagMetrics]], _Values]:
        return lambda row: (math.nan if row.of.lag_s == 0.0 else row.of.gain(name),)

    def interval(row: _Row[LagMetrics]) -> _Values:
        return row.of.position_reduction.low, row.of.position_reduction.high

    errors: list[Column[_Row[LagMetrics]]] = []
    for name in _LAG_ERRORS:
        errors.append(Column(_ERRORS[name], (_named(name, "rmse"),), rmse(name)))
        errors.append(Column("below\n[%]", (f"{name.rpartition('_')[0]}_reduction",), reduction(name), scale=_PERCENT))
        if name == "position_m":
            errors.append(
                Column(
                    "95 %\ninterval",
                    ("position_reduction_low", "position_reduction_high"),
                    interval,
                    "{} to {}",
                    _PERCENT,
                )
            )
    entries = [_Row(row.run, one) for row in rows for one in _shown_lags(row.of.lagged)]
    columns: list[Column[_Row[LagMetrics]]] = [
        _run_column(entries),
        Column("lag\n[s]", ("lag",), lambda row: (row.of.lag_s if row.of.lag_s == WINDOW else f"{row.of.lag_s:g}",)),
        Column("", ("lag_s",), lambda row: None if row.of.lag_s == WINDOW else (row.of.lag_s,)),
        Column("states", ("num_states",), lambda row: (row.of.errors["position_m"].count,)),
        *errors,
        Column("NEES\npos.", ("position_nees",), lambda row: (row.of.position_nees.mean,)),
    ]
    own = [
        "lag 0: states as published; window: final states, as they leave the window",
        "below: reduction against the present states of the same tracks and stamps",
        "NEES: of the position; 2 if consistent",
    ]
    if any(len(_shown_lags(row.of.lagged)) < len(row.of.lagged) for row in rows):
        own.append(f"{_MOST_LAGS} lags of a run are shown at most, metrics.json has all")
    entries = entries if any(len(row.of.lagged) > 1 for row in rows) else []
    title = "Error against lag (RMSE against truth)"
    return Table(title, columns, entries, row_keys=("run", "lag"), notes=[*own, *notes])


def _shown_lags(lagged: Sequence[LagMetrics]) -> list[LagMetrics]:
    """The present and the final states, and of the lags between them at most so many that are evenly spread."""
    lags = [entry for entry in lagged if entry.lag_s not in (0.0, WINDOW)]
    if len(lags) > _MOST_LAGS:
        lags = [lags[round(k * (len(lags) - 1) / (_MOST_LAGS - 1))] for k in range(_MOST_LAGS)]
    return [entry for entry in lagged if entry.lag_s in (0.0, WINDOW) or entry in lags]


def _consistency(rows: Sequence[_Row[Metrics]], notes: Sequence[str]) -> Table:
    """A row for each run and normalised square: NEES of the present states, NIS and whiteness of every sensor."""
    entries = [_Row(row.run, values, name) for row in rows for name, values in _squares(row.of.consistency)]
    columns: list[Column[_Row[_Square]]] = [
        _run_column(entries),
        Column("of", ("of",), lambda row: (row.part,), left=True),
        Column("samples", ("num_samples",), lambda row: (row.of[0].count,)),
        Column("mean", ("mean",), lambda row: (row.of[0].mean,)),
        Column("expected", ("expected",), lambda row: (row.of[0].dof,)),
        Column("95 % band", ("band_low", "band_high"), lambda row: row.of[0].band, "{} to {}"),
        Column(
            "correlation\nat lag 1",
            ("lag1_correlation", "lag1_band"),
            lambda row: (row.of[1].lag1, row.of[1].lag1_band) if row.of[1] else None,
            "{} ± {}",
        ),
        Column(
            "outside\n[%]",
            ("share_outside",),
            lambda row: (row.of[1].share_outside,) if row.of[1] else None,
            scale=_PERCENT,
        ),
    ]
    own = [
        "band: of the mean of independent samples; errors along one run are correlated,",
        "so the NEES of a single run may leave it (average over several runs)",
        f"correlation: of innovations, tracks with {FEWEST}+ of them; ± 95 % band if white",
        f"outside: share of tracks and lags 1 to {LAGS} outside their bands; 5 if white",
    ]
    title = "Consistency (mean NEES and NIS, and their expected values)"
    return Table(title, columns, entries, row_keys=("run", "of"), notes=[*own, *notes])


def _squares(found: Consistency) -> Iterator[tuple[str, _Square]]:
    for name, nees in (("NEES position", found.position_nees), ("NEES state", found.state_nees)):
        if nees.count:
            yield name, (nees, None)
    for sensor, nis in found.nis.items():
        if nis.count:
            yield f"NIS {sensor}", (nis, next(iter(found.autocorrelation[sensor].values()), None))


def _residuals(sensor: str, rows: Sequence[_Row[SensorMetrics]], notes: Sequence[str]) -> Table:
    """A row for each run with the sensor: mean and standard deviation of the innovations, NIS, delay."""

    def mean_std(name: str) -> Callable[[_Row[SensorMetrics]], _Values | None]:
        return lambda row: (
            (row.of.residuals[name].mean, row.of.residuals[name].std) if name in row.of.residuals else None
        )

    occurring = [name for name in RESIDUAL_NAMES if any(name in row.of.residuals for row in rows)]
    columns: list[Column[_Row[SensorMetrics]]] = [_run_column(rows)]
    for name in occurring:
        quantity, _, unit = name.rpartition("_")
        heading = f"{quantity.replace('_', ' ')}\n[{_UNITS[unit]}]"
        if "along_m" in occurring and name in ("x_m", "y_m"):
            heading = ""
        columns.append(Column(heading, (_named(name, "mean"), _named(name, "std")), mean_std(name), "{} ± {}"))
    columns += [
        Column("NIS", ("nis_mean",), lambda row: (row.of.nis.mean,)),
        Column("NIS\nexpected", ("nis_expected",), lambda row: (row.of.nis_dof.mean,)),
        Column(
            "delay [ms]\nmean/p90",
            ("delay_mean_s", "delay_p90_s"),
            lambda row: (row.of.delay_s.mean, row.of.delay_s.p90),
            "{}/{}",
            _MS,
        ),
    ]
    title = f"Residuals of {sensor} (measured minus predicted: mean ± standard deviation)"
    return Table(title, columns, rows, notes=notes)


def _dispositions(rows: Sequence[_Row[SensorMetrics]], notes: Sequence[str]) -> Table:
    """A row for each run and sensor: what became of the detections, and their sum."""

    def count(name: Disposition) -> Callable[[_Row[SensorMetrics]], _Values]:
        return lambda row: (row.of.dispositions[name],)

    absent = [name for name in Disposition if not any(row.of.dispositions[name] for row in rows)]
    columns: list[Column[_Row[SensorMetrics]]] = [
        _run_column(rows),
        Column("sensor", ("sensor",), lambda row: (row.part,), left=True),
        *(Column("" if k in absent else k.replace("_", "\n"), (k.value,), count(k)) for k in Disposition),
        Column("sum", ("detections",), lambda row: (row.of.detections,)),
    ]
    own = [f"none: {', '.join(name.replace('_', ' ') for name in absent)}"] if absent else []
    title = "Dispositions (what became of every detection)"
    return Table(title, columns, rows, row_keys=("run", "sensor"), notes=[*own, *notes])


def _run_column(rows: Sequence[_Row[T]]) -> Column[_Row[T]]:
    """The column with the run of each of `rows`."""
    return Column("run", ("run",), lambda row: (row.run,), left=True)


def _named(name: str, moment: str) -> str:
    """`name` of a quantity with the `moment` before its unit: position_rmse_m."""
    quantity, _, unit = name.rpartition("_")
    return f"{quantity}_{moment}_{unit}"


def _two_decimals(value: Value) -> str:
    return f"{value:.2f}" if math.isfinite(float(value)) else NO_VALUE

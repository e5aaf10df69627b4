"""The evaluation of Karle et al. 2023 as tables: residuals and precision, by time, speed and place, delays, latency."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.evaluation.metrics import Metrics
from fgtrack.evaluation.prediction import HORIZONS_S, PredictionErrors
from fgtrack.evaluation.residual_samples import LOCAL_NAMES, ResidualSamples
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.evaluation.sensed import Sensed, sensed
from fgtrack.evaluation.statistics import Distribution, Moments
from fgtrack.evaluation.table_rows import MS, Row, Values, named, run_column
from fgtrack.evaluation.tables import Column, Table, Tables

_HEADINGS = {"along_m": "along\n[m]", "across_m": "across\n[m]", "yaw_rad": "yaw\n[deg]", "speed_mps": "speed\n[m/s]"}
_DEGREES = math.degrees(1.0)

#: Bounds between the groups, in the quantity's unit (the published evaluation's).
_OBSERVED_S = (1.0, 2.0, 3.0)
_SPEEDS_MPS = (40.0, 50.0)
_AHEAD_M = (0.0, 50.0)

R = TypeVar("R")
_Moments = Mapping[str, Moments]
_Predicted = tuple[str, str, Mapping[str, PredictionErrors]]


def with_paper_tables(tables: Tables, runs: Sequence[JudgedRun]) -> Tables:
    """`tables` and, behind them, `residuals`, `residuals_by`, `sensed`, `latency` and `predictions` of `runs`.

    Raises `DataError` where the map that a run names is no map.
    """
    by_sensor = [Row(one.label, of, sensor) for one in runs for sensor, of in sensed(one).items()]
    more = {
        "residuals": _residuals([Row(one.label, one.metrics) for one in runs]),
        "residuals_by": _residuals_by(runs),
        "sensed": _sensed(by_sensor),
        "latency": _latency([Row(one.label, one.metrics) for one in runs]),
        "predictions": _predictions(runs),
    }
    return replace(tables, tables={**tables.tables, **more})


def _residuals(rows: Sequence[Row[Metrics]]) -> Table:
    """A row for each run: residuals of all sensors together, and the precision (table I)."""
    columns: list[Column[Row[Metrics]]] = [
        run_column(rows),
        *(_moments_column(name, lambda row: row.of.residuals) for name in LOCAL_NAMES),
        Column("preci-\nsion", ("precision",), lambda row: (row.of.precision,)),
        Column("con-\nfirmed", ("num_confirmed",), lambda row: (row.of.num_confirmed,)),
    ]
    notes = [
        "measured minus predicted, of confirmed tracks: mean ± standard deviation",
        "yaw: where no sensor measures it the heading of the map stands in for it, as in the paper",
        "precision: visits of true objects that were tracked / confirmed tracks",
    ]
    title = "Residuals of all sensors, and precision (table I of Karle et al. 2023)"
    return Table(title, columns, rows, notes=notes, detail=True)


def _residuals_by(runs: Sequence[JudgedRun]) -> Table:
    """A row for each run, group of samples and sensor."""
    rows: list[Row[_Moments]] = []
    for one in runs:
        samples = one.samples
        sensors = np.unique(samples.sensors).tolist()
        for group, inside in _groups(samples):
            for sensor in sensors:
                chosen = inside & (samples.sensors == sensor)
                if chosen.any():
                    rows.append(Row(one.label, samples.moments(chosen), f"{group}, {sensor}"))
    columns: list[Column[Row[_Moments]]] = [
        run_column(rows),
        Column("of", ("of",), lambda row: (row.part,), left=True),
        Column("samples", ("num_samples",), lambda row: (row.of["along_m"].count,)),
        *(_moments_column(name, lambda row: row.of) for name in LOCAL_NAMES),
    ]
    notes = [
        "observed: time since the first detection of the track (its transient)",
        "speed: of the track; ahead: of the ego",
    ]
    title = "Residuals by time, speed and place (mean ± standard deviation)"
    return Table(title, columns, rows, row_keys=("run", "of"), notes=notes, detail=True)


def _groups(samples: ResidualSamples) -> Iterator[tuple[str, BoolArray]]:
    quantities: tuple[tuple[str, FloatArray, tuple[float, ...], str], ...] = (
        ("observed", samples.observed_s, _OBSERVED_S, "s"),
        ("speed", samples.object_speed_mps, _SPEEDS_MPS, "m/s"),
        ("ahead", samples.ahead_m, _AHEAD_M, "m"),
    )
    for name, values, bounds, unit in quantities:
        numbers = np.digitize(values, bounds)  # NaN comes last
        for k in range(len(bounds) + 1):
            if k == 0:
                text = f"below {bounds[0]:g}"
            elif k == len(bounds):
                text = f"{bounds[-1]:g} and more"
            else:
                text = f"{bounds[k - 1]:g} to {bounds[k]:g}"
            yield f"{name} {text} {unit}", np.isfinite(values) & (numbers == k)


def _sensed(rows: Sequence[Row[Sensed]]) -> Table:
    """A row for each run and sensor: delays, way of the ego in them, and the detections that were fused."""

    def delay(row: Row[Sensed]) -> Values:
        of = Distribution.of(row.of.delay_s)
        return of.mean, of.p90, of.max

    def moved(row: Row[Sensed]) -> Values:
        of = Distribution.of(row.of.moved_m[np.isfinite(row.of.moved_m)])
        return of.mean, of.max

    def spread(get: Callable[[Sensed], FloatArray]) -> Callable[[Row[Sensed]], Values | None]:
        def of(row: Row[Sensed]) -> Values | None:
            values = get(row.of)[np.isfinite(get(row.of))]
            return tuple(np.quantile(values, (0.0, 0.5, 1.0)).tolist()) if len(values) else None

        return of

    spreads: dict[str, tuple[str, str, Callable[[Sensed], FloatArray]]] = {
        "object_speed": ("mps", "speed\n[m/s]", lambda of: of.object_speed_mps),
        "relative_speed": ("mps", "relative\n[m/s]", lambda of: of.relative_speed_mps),
        "distance": ("m", "distance\n[m]", lambda of: of.distance_m),
        "ahead": ("m", "ahead\n[m]", lambda of: of.ahead_m),
    }
    columns: list[Column[Row[Sensed]]] = [
        run_column(rows),
        Column("sensor", ("sensor",), lambda row: (row.part,), left=True),
        Column("delay [ms]\nmean/p90/max", ("delay_mean_s", "delay_p90_s", "delay_max_s"), delay, "{}/{}/{}", MS),
        Column("moved [m]\nmean/max", ("moved_mean_m", "moved_max_m"), moved, "{}/{}"),
        Column("fused", ("num_fused",), lambda row: (len(row.of.object_speed_mps),)),
        Column("ob-\njects", ("num_objects",), lambda row: (len(row.of.detections),)),
    ]
    for name, (unit, heading, get) in spreads.items():
        names = tuple(f"{name}_{moment}_{unit}" for moment in ("min", "median", "max"))
        columns.append(Column(heading, names, spread(get), "{}/{}/{}"))
    names = tuple(f"detections_{moment}" for moment in ("min", "median", "max"))
    columns.append(Column("detections\nper object", names, spread(lambda of: of.detections), "{}/{}/{}"))
    notes = [
        "moved: way of the ego while a message was under way; fused: detections of confirmed tracks (objects)",
        "speed to detections: smallest/median/largest; relative: to the ego",
    ]
    title = "What the sensors saw (figures 5 and 6 of Karle et al. 2023)"
    return Table(title, columns, rows, row_keys=("run", "sensor"), notes=notes, detail=True)


def _latency(rows: Sequence[Row[Metrics]]) -> Table:
    """A row for each run: computing time of the ticks with detections."""

    def times(row: Row[Metrics]) -> Values:
        of = row.of.time_per_tick_s
        return of.mean, of.p90, of.p99, of.max

    names = tuple(f"time_per_tick_{moment}_s" for moment in ("mean", "p90", "p99", "max"))
    columns: list[Column[Row[Metrics]]] = [
        run_column(rows),
        Column("ticks", ("num_ticks",), lambda row: (row.of.time_per_tick_s.count,)),
        Column("ms/tick\nmean/p90/p99/max", names, times, "{}/{}/{}/{}", MS),
        Column("ms/\ndetection", ("time_per_detection_s",), lambda row: (row.of.time_per_detection_s,), scale=MS),
    ]
    notes = ["of ticks with a detection, on the machine that replayed; without prediction and logging"]
    return Table("Latency", columns, rows, notes=notes, detail=True)


def _moments_column(name: str, get: Callable[[R], Mapping[str, Moments]]) -> Column[R]:
    def of(row: R) -> Values | None:
        moments = get(row)[name]
        return (moments.mean, moments.std) if moments.count else None

    scale = _DEGREES if name == "yaw_rad" else 1.0
    return Column(_HEADINGS[name], (named(name, "mean"), named(name, "std")), of, "{} ± {}", scale)


def _predictions(runs: Sequence[JudgedRun]) -> Table:
    """A row for each run and predictor: FDE and ADE at every horizon."""
    rows = [(one.label, name, of) for one in runs for name, of in one.metrics.predictions.items()]

    def displacement(horizon: str) -> Callable[[_Predicted], tuple[float, float]]:
        return lambda row: (row[2][horizon].final_m.mean, row[2][horizon].average_m.mean)

    columns: list[Column[_Predicted]] = [
        Column("run", ("run",), lambda row: (row[0],), left=True),
        Column("along", ("predictor",), lambda row: (row[1],), left=True),
        Column("predic-\ntions", ("count",), lambda row: (next(iter(row[2].values())).final_m.count,)),
    ]
    for horizon_s in HORIZONS_S:
        horizon = f"{horizon_s:g}s"
        names = (f"fde_{horizon}_m", f"ade_{horizon}_m")
        columns.append(Column(f"{horizon_s:g} s [m]\nFDE/ADE", names, displacement(horizon), "{}/{}"))
    notes = [
        "FDE: mean distance from the truth at that time ahead; ADE: the same, averaged up to it",
        "arc: constant turn rate and speed; rail: the same for 0.2 s, then along the track",
    ]
    return Table(
        "Predictions from the published states", columns, rows, row_keys=("run", "predictor"), notes=notes, detail=True
    )

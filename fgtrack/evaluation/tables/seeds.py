"""The table of a sweep over its seeds: means at every point of the grid, and paired differences of the estimators."""

import csv
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fgtrack.core.errors import CallError, DataError, did_you_mean
from fgtrack.core.files import open_text
from fgtrack.evaluation.comparison import Entry, entry_columns, entry_record, ranked
from fgtrack.evaluation.intervals import paired
from fgtrack.evaluation.tables import PERCENT, Column, Record, Table

SWEEP_FILE = "sweep.csv"

#: Metrics that have a better and a worse, in order of preference; the first is shown.
_BETTER: Mapping[str, Literal["less", "more", "nearer"]] = {
    "truth.overall.errors.*.rmse": "less",
    "multi_object.gospa.in_sight_rms_m": "less",
    "multi_object.gospa.rms_m": "less",
    "consistency.position_nees.mean": "nearer",
    "consistency.nis.*.mean": "nearer",
    "lagged.*.errors.*.rmse": "less",
    "truth.overall.tracked_share_in_sight": "more",
    "truth.overall.tracked_share": "more",
    "truth.overall.breaks": "less",
    "truth.overall.id_switches": "less",
    "truth.overall.time_to_confirm_s.mean": "less",
    "truth.false_tracks": "less",
    "multi_object.clear.mota": "more",
    "multi_object.identity.idf1": "more",
    "multi_object.hota.hota": "more",
    "predictions.*.mean": "less",
}
#: Metrics that a summary shows first, and their headings.
_MAIN: Mapping[str, str] = {
    "truth.overall.errors.position_m.rmse": "pos.\n[m]",
    "consistency.position_nees.mean": "NEES\npos.",
    "multi_object.gospa.in_sight_rms_m": "GOSPA\n[m]",
    "truth.overall.tracked_share_in_sight": "tracked\n[%]",
}
_SHARES = ("truth.overall.tracked_share_in_sight",)
_INTERVALS = "t intervals of paired differences over seeds; tie with the best: 0 is inside"


@dataclass(frozen=True)
class PointMean:
    """Mean and standard error over the seeds of a metric, of one estimator at one point of the grid."""

    point: tuple[str, ...]
    """Cells of the axes."""
    estimator: str
    mean: float
    standard_error: float
    """NaN of one seed."""
    seeds: int
    """Seeds with a value."""


@dataclass(frozen=True)
class SweepTable:
    """The rows of sweep.csv."""

    axes: tuple[str, ...]
    """Columns that make a point of the grid."""
    metrics: tuple[str, ...]
    rows: Sequence[Mapping[str, str]]
    """Cells by column."""

    @property
    def shown_axes(self) -> tuple[str, ...]:
        """Axes that vary and distinguish the points, without those of whole mappings where labels do it."""
        varying = [axis for axis in self.axes if len({row[axis] for row in self.rows}) > 1]
        points = [tuple(row[axis] for axis in varying) for row in self.rows]
        return tuple(varying[k] for k in distinguishing(points, len(varying)))

    def means(self, metric: str, axes: Sequence[str] | None = None) -> list[PointMean]:
        """Return the means of `metric` at every point and of every estimator, in the order of the table.

        `axes` are those that make a point, by default `shown_axes`. Cells that are empty or not finite are ignored.
        Raises `CallError` if there is no such metric.
        """
        if metric not in self.metrics:
            hint = did_you_mean(metric, self.metrics) or f", there are {', '.join(self.metrics[:5])} ..."
            raise CallError(f"{metric}: the sweep has no such metric{hint}")
        axes = self.shown_axes if axes is None else axes
        values: dict[tuple[tuple[str, ...], str], list[float]] = {}
        for row in self.rows:
            value = number(row[metric])
            if math.isfinite(value):
                values.setdefault((tuple(row[axis] for axis in axes), row["estimator"]), []).append(value)
        return [
            PointMean(*key, float(np.mean(of)), float(np.std(of, ddof=1)) / math.sqrt(n) if n > 1 else math.nan, n)
            for key, of in values.items()
            for n in [len(of)]
        ]


@dataclass(frozen=True)
class SeedComparison:
    """The estimators in one metric at one point of the grid."""

    point: tuple[str, ...]
    """Cells of the axes."""
    metric: str
    seeds: int
    """Seeds that all estimators have a value of."""
    entries: tuple[Entry, ...]
    """From the best estimator to the worst; the values are means over the seeds."""


def read_sweep(folder: Path | str) -> SweepTable:
    """Return the table of the sweep in `folder`.

    Raises `CallError` if there is no table, and `DataError` if it is not that of a sweep, or has no rows.
    """
    path = Path(folder) / SWEEP_FILE
    try:
        with open_text(path, newline="") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise CallError(f"{path}: cannot be read ({error.strerror}), make one with `fgtrack sweep`") from error
    except (csv.Error, UnicodeDecodeError) as error:
        raise DataError(f"{path}: is not a table ({error}), repeat the sweep") from error
    columns = list(rows[0]) if rows else []
    if "seed" not in columns or "estimator" not in columns or any(None in row.values() for row in rows):
        raise DataError(f"{path}: holds no rows of a sweep, repeat it")
    seed = columns.index("seed")
    return SweepTable(tuple(columns[:seed]), tuple(columns[seed + 2 :]), rows)


def is_sweep(folder: Path) -> bool:
    """True if `folder` holds the table of a sweep."""
    return (folder / SWEEP_FILE).is_file()


def distinguishing(points: Iterable[tuple[str, ...]], num_axes: int) -> list[int]:
    """Axes that distinguish `points`, without those of whole mappings where labels do it."""
    distinct = set(points)
    plain = [k for k in range(num_axes) if not any(point[k].startswith(("{", "[")) for point in distinct)]
    return plain if len({tuple(point[k] for k in plain) for point in distinct}) == len(distinct) else [*range(num_axes)]


def number(cell: str) -> float:
    """The number in a cell; NaN where there is none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def seed_comparisons(rows: Sequence[Mapping[str, str]], axes: Sequence[str]) -> list[SeedComparison]:
    """Return a comparison for every metric with a better and a worse, and every point with several estimators.

    `rows` are those of sweep.csv, by column; `axes` the columns that make a point.
    """
    points: dict[tuple[str, ...], list[Mapping[str, str]]] = {}
    for row in rows:
        points.setdefault(tuple(row[axis] for axis in axes), []).append(row)
    metrics = [name for pattern in _BETTER for name in (rows[0] if rows else ()) if fnmatchcase(name, pattern)]
    every = (_compared(point, metric, mine) for metric in metrics for point, mine in points.items())
    return [one for one in every if one is not None]


def difference_table(compared: Sequence[SeedComparison], axes: Sequence[str]) -> Table:
    """Return a row for every comparison and estimator; shown are those of the first metric over several seeds."""
    records = [
        {**dict(zip(axes, one.point, strict=True)), "metric": one.metric, "estimator": entry.name, "seeds": one.seeds}
        | {name: value for name, value in entry_record(entry, "mean").items() if name not in ("run", "standing")}
        | {"standing": entry.standing}
        for one in compared
        for entry in one.entries
    ]
    first, keys = compared[0].metric if compared else "", (*axes, "metric", "estimator")
    columns = [_point_column({one.point for one in compared}, axes), Column("estimator", left=True)]
    columns += [*entry_columns("mean", "mean"), Column("seeds")]
    notes = [_INTERVALS, "+: best; =: ties with the best"]
    return Table(first, records, columns, keys, notes, is_main=lambda row: row["metric"] == first and row["seeds"] > 1)


def summary_table(sweep: SweepTable, compared: Sequence[SeedComparison]) -> Table:
    """Return mean and standard error over the seeds of every metric, a row for each point and estimator.

    The best value at a point is bold where `compared`, those of the sweep, have no tie.
    """
    means = {metric: of for metric in sweep.metrics if (of := sweep.means(metric, sweep.axes))}
    values = {(one.point, one.estimator, metric): one for metric, of in means.items() for one in of}
    best = {
        (one.point, entry.name, one.metric) for one in compared for entry in one.entries if entry.standing == "best"
    }
    rows = list(dict.fromkeys((tuple(row[axis] for axis in sweep.axes), row["estimator"]) for row in sweep.rows))
    main = [name for name in _MAIN if name in means] or list(means)[: len(_MAIN)]
    metrics = [*main, *(name for name in means if name not in main)]
    records = []
    for point, estimator in rows:
        record: dict[str, Any] = {**dict(zip(sweep.axes, point, strict=True)), "estimator": estimator}
        for metric in metrics:
            one = values.get((point, estimator, metric))
            record[metric], record[f"{metric}.standard_error"] = (one.mean, one.standard_error) if one else (None, None)
        seeds = [values[key].seeds for metric in metrics if (key := (point, estimator, metric)) in values]
        records.append(record | {"seeds": max(seeds, default=0)})

    def is_best(metric: str) -> Callable[[Record], bool]:
        return lambda record: (tuple(record[axis] for axis in sweep.axes), record["estimator"], metric) in best

    columns = [_point_column({point for point, _ in rows}, sweep.axes), Column("estimator", left=True)]
    for name in metrics:
        heading = _MAIN.get(name) or re.sub(r"\.(?!\d)", "\n", name)
        both, scale = (name, f"{name}.standard_error"), PERCENT if name in _SHARES else 1.0
        columns.append(Column(heading, both, "{} ± {}", scale, bold=is_best(name), is_extra=name not in main))
    notes = ["± standard error of the mean over the seeds"]
    if any((*row, metric) in best for row in rows for metric in main):
        notes.append("bold: the best estimator of its point in this, with 95 % confidence")
    return Table("Summary", records, [*columns, Column("seeds")], (*sweep.axes, "estimator"), notes)


def _point_column(points: Iterable[tuple[str, ...]], axes: Sequence[str]) -> Column:
    """The axes that distinguish `points`, under the last parts of their names."""
    shown = [axes[k] for k in distinguishing(points, len(axes))]
    heading = ",\n".join(axis.rpartition(".")[2] for axis in shown) or "point"
    return Column(heading, shown, ", ".join(["{}"] * len(shown)) or "{}", left=True)


def _compared(point: tuple[str, ...], metric: str, rows: Sequence[Mapping[str, str]]) -> SeedComparison | None:
    """The estimators over the seeds that all of them have; None of fewer than two, or without such a seed."""
    cost_of = _cost_of(metric)
    values: dict[str, dict[str, tuple[float, float]]] = {}
    for row in rows:
        value, cost = number(row[metric]), cost_of(row)
        if math.isfinite(cost):
            values.setdefault(row["estimator"], {})[row["seed"]] = (value, cost)
    seeds = sorted(set.intersection(*map(set, values.values())), key=int) if len(values) > 1 else []
    if not seeds:
        return None
    table = np.array([[of[seed] for seed in seeds] for of in values.values()])
    means, costs = table[..., 0].mean(axis=1), table[..., 1]
    entries = ranked(list(values), means, costs.mean(axis=1), lambda one, best: paired(costs[one], costs[best]))
    return SeedComparison(point, metric, len(seeds), entries)


def _cost_of(metric: str) -> Callable[[Mapping[str, str]], float]:
    """The number that should be small in a row: the metric, its negative, or its distance from the expected value."""
    better = next(better for pattern, better in _BETTER.items() if fnmatchcase(metric, pattern))
    if better == "nearer":
        dof, default = metric.removesuffix("mean") + "dof", "2" if "position_nees" in metric else ""
        return lambda row: abs(number(row[metric]) - number(row.get(dof, default)))
    sign = 1.0 if better == "less" else -1.0
    return lambda row: sign * number(row[metric])

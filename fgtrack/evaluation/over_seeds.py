"""Estimators of a sweep against each other at every point of its grid: paired differences over the seeds."""

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal

import numpy as np

from fgtrack.evaluation.paired import Estimate, paired
from fgtrack.evaluation.ranking import Entry, Standing, ranked, worse_columns
from fgtrack.evaluation.sweep_table import SweepTable, number, telling
from fgtrack.evaluation.table_rows import PERCENT
from fgtrack.evaluation.tables import Column, Table, Value

#: Metrics that have a better and a worse, in the order in which they are asked for; the first is shown.
_BETTER: Mapping[str, Literal["less", "more", "nearer"]] = {
    "truth.overall.errors.*.rmse": "less",
    "multi_object.gospa.in_sight_rms_m": "less",
    "multi_object.gospa.rms_m": "less",
    "consistency.position_nees.mean": "nearer",
    "consistency.state_nees.mean": "nearer",
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
_MOST_ROWS = 40
_NAMES = ("metric", "estimator", "seeds", "mean", "worse_by", "low", "high", "standing")
_POSITION_DOF = 2.0


@dataclass(frozen=True)
class SeedContest:
    """The estimators in one metric at one point of the grid."""

    point: tuple[str, ...]
    """Cells of the axes."""
    metric: str
    seeds: int
    """Seeds that all estimators have a value of."""
    entries: tuple[Entry, ...]
    """From the best estimator to the worst; the values are means over the seeds."""


def seed_contests(rows: Sequence[Mapping[str, str]], axes: Sequence[str]) -> list[SeedContest]:
    """A contest for every metric with a better and a worse, and every point with several estimators.

    Parameters
    ----------
    rows
        Those of sweep.csv, by column.
    axes
        Columns that make a point.
    """
    points: dict[tuple[str, ...], list[Mapping[str, str]]] = {}
    for row in rows:
        points.setdefault(tuple(row[axis] for axis in axes), []).append(row)
    columns = list(rows[0]) if rows else []
    metrics = [name for pattern in _BETTER for name in columns if fnmatchcase(name, pattern)]
    found = []
    for metric in metrics:
        for point, mine in points.items():
            contest = _contest(point, metric, mine)
            if contest is not None:
                found.append(contest)
    return found


def to_csv(contests: Sequence[SeedContest], axes: Sequence[str]) -> str:
    """A row for every contest and estimator; floats with all digits, an empty cell where there is none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*axes, *_NAMES])
    for contest in contests:
        for entry in contest.entries:
            worse = entry.worse_by
            numbers = (entry.value, *((worse.mean, worse.low, worse.high) if worse else (math.nan,) * 3))
            cells = (contest.metric, entry.name, contest.seeds, *map(_cell, numbers), entry.standing)
            writer.writerow([*contest.point, *cells])
    return text.getvalue()


def shown_tables(contests: Sequence[SeedContest], axes: Sequence[str]) -> list[Table]:
    """The first metric of `contests` for people: every point where these are few, else how often who is best.

    Nothing where no point has several seeds.
    """
    mine = [one for one in contests if one.metric == contests[0].metric]
    if not any(one.seeds > 1 for one in mine):
        return []
    metric, points = mine[0].metric, _point_texts(mine, axes)
    rows = [_Row(text, one.seeds, entry) for text, one in zip(points, mine, strict=True) for entry in one.entries]
    if len(rows) <= _MOST_ROWS:
        return [_every_point(metric, rows, _axis_names(telling((one.point for one in mine), len(axes)), axes))]
    return [_counts(metric, len(mine), rows)]


def summary_table(sweep: SweepTable, contests: Sequence[SeedContest]) -> Table:
    """Mean and standard error over the seeds of every metric, a row for each point and estimator; few metrics first.

    The best value at a point is bold where `contests`, those of the sweep, know of no tie.
    """
    means = {metric: sweep.means(metric, sweep.axes) for metric in sweep.metrics}
    means = {metric: found for metric, found in means.items() if found}
    values = {(one.point, one.estimator, metric): one for metric, found in means.items() for one in found}
    best = {
        (one.point, entry.name, one.metric) for one in contests for entry in one.entries if entry.standing == "best"
    }
    rows = list(dict.fromkeys((tuple(row[axis] for axis in sweep.axes), row["estimator"]) for row in sweep.rows))
    points = list(dict.fromkeys(point for point, _ in rows))
    places = telling(points, len(sweep.axes))
    main = [name for name in _MAIN if name in means] or list(means)[: len(_MAIN)]

    def column(metric: str) -> Column[_Cell]:
        def of(row: _Cell) -> tuple[Value, ...] | None:
            found = values.get((*row, metric))
            return None if found is None else (found.mean, found.standard_error)

        return Column(
            _MAIN.get(metric) or re.sub(r"\.(?!\d)", "\n", metric),
            (metric, f"{metric}.standard_error"),
            of,
            "{} ± {}",
            PERCENT if metric in _SHARES else 1.0,
            bold=lambda row: (*row, metric) in best,
            when="always" if metric in main else "full",
        )

    def axis(place: int) -> Column[_Cell]:
        return Column("", (sweep.axes[place],), lambda row: (row[0][place],))

    def seeds(row: _Cell) -> tuple[Value, ...]:
        return (max((values[(*row, metric)].seeds for metric in means if (*row, metric) in values), default=0),)

    columns: list[Column[_Cell]] = [
        *map(axis, range(len(sweep.axes))),
        Column(_axis_names(places, sweep.axes), (), lambda row: (", ".join(row[0][k] for k in places),), left=True),
        Column("estimator", ("estimator",), lambda row: (row[1],), left=True),
        *map(column, [*main, *(name for name in means if name not in main)]),
        Column("seeds", ("seeds",), seeds),
    ]
    notes = ["± standard error of the mean over the seeds"]
    if any((point, name, metric) in best for point, name in rows for metric in main):
        notes.append("bold: the best estimator of its point in this, with 95 % confidence")
    return Table("Summary", columns, rows, row_keys=(*sweep.axes, "estimator"), notes=notes)


_Cell = tuple[tuple[str, ...], str]  # cells of the axes, and the estimator


@dataclass(frozen=True)
class _Row:
    point: str
    seeds: int
    entry: Entry


def _every_point(metric: str, rows: Sequence[_Row], heading: str) -> Table:
    columns: list[Column[_Row]] = [
        Column(heading, ("point",), lambda row: (row.point,), left=True),
        Column("estimator", ("estimator",), lambda row: (row.entry.name,), left=True),
        Column("mean", ("mean",), lambda row: (row.entry.value,), bold=lambda row: row.entry.standing == "best"),
        *worse_columns(lambda row: row.entry),
        Column("seeds", ("seeds",), lambda row: (row.seeds,)),
        Column("is", ("standing",), lambda row: (row.entry.standing,), left=True),
    ]
    return Table(metric, columns, rows, row_keys=("point", "estimator"), notes=[_INTERVALS])


def _counts(metric: str, num_points: int, rows: Sequence[_Row]) -> Table:
    estimators = list(dict.fromkeys(row.entry.name for row in rows))
    standings = Counter((row.entry.name, row.entry.standing) for row in rows)

    def count(standing: Standing) -> Callable[[str], tuple[Value, ...]]:
        return lambda name: (standings[name, standing],)

    columns: list[Column[str]] = [
        Column("estimator", ("estimator",), lambda name: (name,), left=True),
        Column("best", ("best",), count("best")),
        Column("tie", ("tie",), count("tie")),
        Column("worse", ("worse",), count("worse")),
    ]
    title = f"{metric}: how often which estimator is best, at {num_points} points"
    return Table(title, columns, estimators, row_keys=("estimator",), notes=[_INTERVALS])


def _point_texts(contests: Sequence[SeedContest], axes: Sequence[str]) -> list[str]:
    places = telling((one.point for one in contests), len(axes))
    return [", ".join(one.point[place] for place in places) for one in contests]


def _axis_names(places: Sequence[int], axes: Sequence[str]) -> str:
    """The last parts of the names of the axes shown."""
    return ",\n".join(axes[place].rpartition(".")[2] for place in places) or "point"


def _contest(point: tuple[str, ...], metric: str, rows: Sequence[Mapping[str, str]]) -> SeedContest | None:
    """The estimators over the seeds that all of them have; None of fewer than two, or without such a seed."""
    costs_of = _cost_of(metric)
    values: dict[str, dict[str, tuple[float, float]]] = {}
    for row in rows:
        value, cost = number(row[metric]), costs_of(row)
        if math.isfinite(cost):
            values.setdefault(row["estimator"], {})[row["seed"]] = (value, cost)
    if len(values) < 2:
        return None
    seeds = sorted(set.intersection(*map(set, values.values())), key=int)
    if not seeds:
        return None
    found = np.array([[of[seed] for seed in seeds] for of in values.values()])
    means, costs = found[..., 0].mean(axis=1), found[..., 1]

    def worse_by(one: int, best: int) -> Estimate:
        return paired(costs[one], costs[best])

    return SeedContest(point, metric, len(seeds), ranked(list(values), means, costs.mean(axis=1), worse_by))


def _cost_of(metric: str) -> Callable[[Mapping[str, str]], float]:
    """What is to be small in a row: the metric, its negative, or its distance from the expected value."""
    better = next(better for pattern, better in _BETTER.items() if fnmatchcase(metric, pattern))
    if better == "nearer":
        dof = metric.removesuffix("mean") + "dof"
        default = str(_POSITION_DOF) if "position_nees" in metric else ""
        return lambda row: abs(number(row[metric]) - number(row.get(dof, default)))
    sign = 1.0 if better == "less" else -1.0
    return lambda row: sign * number(row[metric])


def _cell(value: float) -> str:
    return repr(value) if math.isfinite(value) else ""

"""Tables of a sweep over its seeds: means at every grid point, and paired differences of the estimators."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from textwrap import wrap
from typing import Literal

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from fgtrack.core.errors import CallError, DataError, did_you_mean
from fgtrack.core.files import open_text
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.comparison import (
    STANDING_NOTE,
    Entry,
    entry_columns,
    entry_record,
    ranked,
)
from fgtrack.evaluation.intervals import paired
from fgtrack.evaluation.tables import PERCENT, Column, DataFrame, Table
from fgtrack.evaluation.tables.metric_names import metric_words, words

SWEEP_FILE = "sweep.csv"
# Width of a heading, and quantile of a two-sided 95 % interval.
_HEADING = 14
_UPPER = 0.975
#: Better direction of each metric, in order of preference; tables show the first metric.
_BETTER: Mapping[str, Literal["less", "more", "nearer"]] = {
    "truth.overall.errors.*.rmse": "less",
    "multi_object.gospa.in_view_rms_m": "less",
    "multi_object.gospa.rms_m": "less",
    "consistency.position_nees.mean": "nearer",
    "consistency.nis.*.mean": "nearer",
    "lagged.*.errors.*.rmse": "less",
    "truth.overall.tracked_share_in_view": "more",
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
#: Headings of the metrics that a summary shows first.
_MAIN: Mapping[str, str] = {
    "truth.overall.errors.position_m.rmse": "position\nRMSE [m]",
    "consistency.position_nees.mean": "position\nNEES",
    "multi_object.gospa.in_view_rms_m": "GOSPA\n[m]",
    "truth.overall.tracked_share_in_view": "tracked\n[%]",
}


@dataclass(frozen=True)
class SweepTable:
    """The rows of sweep.csv."""

    axes: tuple[str, ...]
    """Columns that define a grid point."""
    metrics: tuple[str, ...]
    rows: DataFrame
    """Axes, `seed` and `estimator` as text, and metrics as numbers; NaN for an empty or infinite cell."""
    repeated: str = "seeds"
    """Word for the values of the column `seed`, over which means and intervals are computed."""

    @property
    def shown_axes(self) -> list[str]:
        """Axes that vary and distinguish the points.

        Axes whose values are mappings or lists are included only if the other axes do not
        distinguish the points.
        """
        return distinguishing(
            self.rows[[axis for axis in self.axes if self.rows[axis].nunique() > 1]]
        )

    def means(self, metric: str) -> DataFrame:
        """Return the mean over the seeds at every grid point, for every estimator.

        Columns are `shown_axes`, `estimator`, `mean`, `standard_error` (NaN for a
        single seed), and `seeds`, the number of seeds with a value. Raises `CallError`
        for an unknown metric.
        """
        if metric not in self.metrics:
            hint = (
                did_you_mean(metric, self.metrics)
                or f", use {', '.join(self.metrics[:5])} ..."
            )
            raise CallError(f"{metric}: not a metric of the sweep{hint}")
        groups = self.rows.dropna(subset=[metric]).groupby(
            [*self.shown_axes, "estimator"], sort=False
        )[metric]
        return groups.agg(
            mean="mean", standard_error="sem", seeds="count"
        ).reset_index()


@dataclass(frozen=True)
class SeedComparison:
    """Comparison of the estimators in one metric at one grid point."""

    point: tuple[str, ...]
    """Cells of the axes."""
    metric: str
    seeds: int
    """Number of seeds with a value for all estimators."""
    entries: tuple[Entry, ...]
    """Estimators, best first; the values are means over the seeds."""


def read_sweep(folder: Path | str) -> SweepTable:
    """Return the table of the sweep in `folder`.

    Raises `CallError` if the folder has no table, and `DataError` for an invalid table.
    """
    path = Path(folder) / SWEEP_FILE
    try:
        with open_text(path) as file:
            rows = pd.read_csv(file, dtype=str, keep_default_na=False, index_col=False)
    except OSError as error:
        raise CallError(
            f"{path}: cannot be read ({error.strerror}), make one with `fgtrack sweep`"
        ) from error
    except ValueError as error:
        raise DataError(
            f"{path}: not a table ({' '.join(str(error).split())}), repeat the sweep"
        ) from error
    if (
        not {"seed", "estimator"} <= set(rows)
        or rows.empty
        or rows.isna().any(axis=None)
    ):
        raise DataError(f"{path}: no rows of a sweep, repeat the sweep")
    seed = rows.columns.get_loc("seed")
    cells = rows.iloc[:, : seed + 2]
    values = rows.iloc[:, seed + 2 :].apply(pd.to_numeric, errors="coerce")
    numbers = values.astype(float).replace([np.inf, -np.inf], np.nan)
    return SweepTable(
        tuple(rows.columns[:seed]), tuple(numbers), pd.concat([cells, numbers], axis=1)
    )


def distinguishing(points: DataFrame) -> list[str]:
    """Return the columns that distinguish `points`.

    Columns whose cells are mappings or lists are included only if the other columns do
    not distinguish the points.
    """
    distinct = points.drop_duplicates()
    plain = [
        axis for axis in points if not distinct[axis].str.startswith(("{", "[")).any()
    ]
    return plain if plain and not distinct.duplicated(plain).any() else list(points)


def seed_comparisons(sweep: SweepTable) -> list[SeedComparison]:
    """Return a comparison for every metric with a better direction, at every point with several estimators."""
    rows = sweep.rows
    result = []
    cells = [tuple(row) for row in rows[list(sweep.axes)].to_numpy()]
    points = {point: k for k, point in enumerate(dict.fromkeys(cells))}
    (estimator, names), (seed, seeds) = (
        pd.factorize(rows[name]) for name in ("estimator", "seed")
    )
    at = [points[cell] for cell in cells], estimator, seed
    for metric in [
        name
        for pattern in _BETTER
        for name in sweep.metrics
        if fnmatchcase(name, pattern)
    ]:
        values, costs = np.full((2, len(points), len(names), len(seeds)), np.nan)
        values[at] = rows[metric]
        costs[at] = _cost(rows, metric)
        for point, value, cost in zip(points, values, costs, strict=True):
            valued = np.isfinite(cost).any(axis=1)
            common = np.isfinite(cost[valued]).all(axis=0)
            if valued.sum() > 1 and common.any():
                entries = _ranked(
                    names[valued], value[valued][:, common], cost[valued][:, common]
                )
                result.append(SeedComparison(point, metric, int(common.sum()), entries))
    return result


def _ranked(
    names: Sequence[str], values: FloatArray, costs: FloatArray
) -> tuple[Entry, ...]:
    means = values.mean(axis=1).tolist()
    return ranked(
        names,
        means,
        costs.mean(axis=1),
        lambda item, best: paired(costs[item], costs[best]),
    )


def difference_table(
    compared: Sequence[SeedComparison], axes: Sequence[str], repeated: str = "seeds"
) -> Table:
    """Return a table with a row for each comparison and estimator; `repeated` as in `SweepTable`.

    Only the rows of the first metric over several seeds are shown.
    """
    records = [
        {
            **dict(zip(axes, item.point, strict=True)),
            "metric": item.metric,
            "estimator": entry.name,
            repeated: item.seeds,
        }
        | {
            name: value
            for name, value in entry_record(entry, "mean").items()
            if name not in ("run", "standing")
        }
        | {"standing": entry.standing}
        for item in compared
        for entry in item.entries
    ]
    # Consistency is no error, so it gives no best estimator.
    first = next(
        (one.metric for one in compared if _better(one.metric) != "nearer"), ""
    )
    keys = (*axes, "metric", "estimator")
    points = pd.DataFrame([item.point for item in compared], columns=list(axes))
    columns = [
        _point_column(points),
        Column("estimator", left=True),
        *entry_columns("mean", "mean"),
        Column(repeated),
    ]
    notes = [
        f"intervals: t intervals of paired differences over {repeated}",
        STANDING_NOTE,
    ]
    return Table(
        metric_words(first) if first else "",
        records,
        columns,
        keys,
        notes,
        is_main=lambda row: row["metric"] == first and row[repeated] > 1,
    )


def summary_table(sweep: SweepTable) -> Table:
    """Return the mean over the seeds of every metric, and half of its 95 % interval, for each point and estimator.

    The records contain the standard error, too.
    """
    metrics = [name for name in sweep.metrics if sweep.rows[name].notna().any()]
    main = [name for name in _MAIN if name in metrics] or metrics[: len(_MAIN)]
    metrics = list(dict.fromkeys((*main, *metrics)))
    groups = sweep.rows.groupby([*sweep.axes, "estimator"], sort=False)[metrics]
    errors = groups.sem().add_suffix(".standard_error")
    seeds = groups.count().max(axis=1).rename(sweep.repeated)
    names = [
        name
        for metric in metrics
        for name in (metric, f"{metric}.standard_error", f"{metric}.half")
    ]
    t = stdtrit(np.maximum(groups.count() - 1, 1), _UPPER)
    halves = (groups.sem() * t).add_suffix(".half")
    records = (
        pd.concat([groups.mean(), errors, halves], axis=1)[names]
        .join(seeds)
        .copy()  # many columns in pieces would be slow
        .reset_index()
        .to_dict("records")
    )
    columns = [
        _point_column(sweep.rows[list(sweep.axes)]),
        Column("estimator", left=True),
    ]
    for name in metrics:
        heading = _MAIN.get(name) or "\n".join(wrap(metric_words(name), _HEADING))
        both = (name, f"{name}.half")
        scale = PERCENT if name.endswith("share_in_view") else 1.0
        columns.append(
            Column(heading, both, "{} ± {}", scale, is_extra=name not in main)
        )
    few, most = int(seeds.min()), int(seeds.max())
    number = f"{few} to {most}" if few < most else str(most)
    notes = [
        f"mean over {number} {sweep.repeated}, ±: half of the 95 % interval of the mean (t)"
        if most > 1
        else f"one of the {sweep.repeated}, so there is no interval"
    ]
    return Table(
        "Summary",
        records,
        [*columns, Column(sweep.repeated)],
        (*sweep.axes, "estimator"),
        notes,
    )


def _point_column(points: DataFrame) -> Column:
    """Return a column with the axes that distinguish `points`; its heading has their names in words."""
    shown = distinguishing(points)
    heading = ",\n".join(map(words, shown)) or "point"
    return Column(heading, shown, ", ".join(["{}"] * len(shown)) or "{}", left=True)


def _better(metric: str) -> Literal["less", "more", "nearer"]:
    """Return the better direction of a metric of `_BETTER`."""
    return next(
        better for pattern, better in _BETTER.items() if fnmatchcase(metric, pattern)
    )


def _cost(rows: DataFrame, metric: str) -> DataFrame:
    """Return the number to minimise: the metric, its negative, or its distance from the expected value."""
    better = _better(metric)
    if better == "nearer":
        default = 2.0 if "position_nees" in metric else np.nan
        return (
            rows[metric] - rows.get(metric.removesuffix("mean") + "dof", default)
        ).abs()
    return rows[metric] if better == "less" else -rows[metric]

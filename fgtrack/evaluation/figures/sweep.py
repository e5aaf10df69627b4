"""Figures of a sweep: a metric over the grid, mean and standard error over the seeds."""

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.evaluation.figures.style import (
    StyledFigure,
    colour,
    line_style,
    log_axis,
    styled,
    title,
)
from fgtrack.evaluation.sweep_table import PointMean, SweepTable, number, read_sweep

#: Metrics with a name for people; the others are called by their column.
_NAMES: Mapping[str, str] = {
    "truth.overall.errors.position_m.rmse": "position RMSE [m]",
    "truth.overall.errors.speed_mps.rmse": "speed RMSE [m/s]",
    "truth.overall.errors.yaw_rad.rmse": "yaw RMSE [rad]",
    "consistency.position_nees.mean": "mean NEES of the position (dashed: expected)",
    "multi_object.gospa.in_sight_rms_m": "GOSPA of objects in sight [m]",
    "multi_object.gospa.rms_m": "GOSPA [m]",
    "truth.overall.tracked_share_in_sight": "share of the time in sight that is tracked",
    "truth.overall.tracked_share": "share of the time that is tracked",
    "truth.false_tracks": "false tracks",
    "truth.overall.id_switches": "identity switches",
    "multi_object.clear.mota": "MOTA",
    "multi_object.identity.idf1": "IDF1",
    "multi_object.hota.hota": "HOTA",
}
_EXPECTED: Mapping[str, float] = {"consistency.position_nees.mean": 2.0}
#: Those that are drawn where nothing else is asked for.
_FIRST = (*tuple(_NAMES)[:2], "consistency.position_nees.mean")
#: Of the rest, those with a better and a worse.
_REST = (
    *_NAMES,
    "truth.overall.errors.*.rmse",
    "consistency.nis.*.mean",
    "lagged.*.errors.position_m.rmse",
)
_WIDE = 3  # panels side by side
_LOG_FROM = 20.0  # largest over smallest value
_DODGE = 0.012  # of the axis, between the error bars of two estimators
_CAP = 3.0
_NAMED_STEPS = 8  # more values of the horizontal axis than these have no tick each


def sweep_metrics(table: SweepTable) -> tuple[list[str], list[str]]:
    """The metrics of `table` to draw: the first ones, and the rest."""
    known = [name for name in table.metrics if table.means(name)]
    ordered = [name for pattern in _REST for name in known if fnmatchcase(name, pattern)]
    ordered = list(dict.fromkeys(ordered)) or known
    first = [name for name in _FIRST if name in ordered] or ordered[:3]
    return first, [name for name in ordered if name not in first]


@styled
def sweep(table: SweepTable | Path | str, metric: str = "truth.overall.errors.position_m.rmse") -> Figure:
    """A metric of a sweep over its grid: mean over the seeds and its standard error, a line for each estimator.

    The axis with the most numbers is the horizontal one; of the others every combination has a panel.

    Parameters
    ----------
    table
        The sweep or its folder.
    metric
        Column of sweep.csv.

    Raises
    ------
    CallError
        There is no sweep, or no such metric.
    DataError
        The sweep has no value of the metric.
    """
    table = table if isinstance(table, SweepTable) else read_sweep(table)
    axes = table.shown_axes
    means = table.means(metric, axes)
    if not means:
        raise DataError(f"{metric}: no cell of the sweep has a value, so there is nothing to draw")
    across = _horizontal(table, axes)
    panels: dict[tuple[str, ...], list[PointMean]] = {}
    for one in means:
        panels.setdefault(_without(one.point, across), []).append(one)
    columns = min(_WIDE, len(panels))
    rows = math.ceil(len(panels) / columns)
    figure = StyledFigure(figsize=(max(7.0, 1.2 + 3.8 * columns), 1.5 + 3.0 * rows))
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    estimators = list(dict.fromkeys(one.estimator for one in means))
    values = [row[axes[across]] for row in table.rows] if axes else [""]
    steps = _Steps(values)
    for place, (rest, found) in enumerate(panels.items()):
        panel = grid[divmod(place, columns)]
        for k, estimator in enumerate(estimators):
            mine = [one for one in found if one.estimator == estimator]
            _draw(panel, steps, mine, across if axes else None, k, len(estimators), estimator)
        named = zip(_without(axes, across), rest, strict=True)
        panel.set_title("\n".join(f"{_short(axis)} {cell}" for axis, cell in named), loc="left")
    for place in range(len(panels), rows * columns):
        grid[divmod(place, columns)].set_visible(False)
    for panel in grid.flat[: len(panels)]:
        if metric in _EXPECTED:
            panel.axhline(_EXPECTED[metric], color="black", lw=0.9, ls="--")
    _scale(grid[0, 0], means, steps)
    for place in range(len(panels)):
        if place + columns >= len(panels):
            panel = grid[divmod(place, columns)]
            panel.set_xlabel(_short(axes[across]) if axes else "")
            panel.tick_params(labelbottom=True)
    figure.supylabel(_NAMES.get(metric, metric), fontsize=9)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    wide = max(1, int(14 * figure.get_figwidth()) // (6 + max(map(len, labels))))
    figure.legend(handles, labels, loc="outside lower center", ncols=wide, frameon=False)
    seeds = {one.seeds for one in means}
    of = f"{min(seeds)} to {max(seeds)}" if len(seeds) > 1 else str(seeds.pop())
    bars = f"mean over {of} seeds; bars: its standard error" if max(one.seeds for one in means) > 1 else "one seed"
    name = _NAMES.get(metric, metric)
    title(figure, f"{name.partition(' [')[0].partition(' (')[0]}: {bars}")
    return figure


class _Steps:
    """Where the values of the horizontal axis are: at themselves where they are numbers, else side by side."""

    def __init__(self, cells: Sequence[str]) -> None:
        self.names = list(dict.fromkeys(cells))
        self.are_numbers = all(math.isfinite(number(cell)) for cell in self.names)
        places = map(number, self.names) if self.are_numbers else range(len(self.names))
        self.at = dict(zip(self.names, places, strict=True))
        self.width = max(self.at.values()) - min(self.at.values()) or 1.0


def _draw(
    panel: Axes, steps: _Steps, means: Sequence[PointMean], across: int | None, index: int, count: int, label: str
) -> None:
    shift = _DODGE * steps.width * (index - (count - 1) / 2.0)  # so that bars do not hide each other
    at = np.array([steps.at["" if across is None else one.point[across]] + shift for one in means])
    order = np.argsort(at, kind="stable")
    mean, error = (np.array([getattr(one, name) for one in means]) for name in ("mean", "standard_error"))
    panel.errorbar(
        at[order],
        mean[order],
        np.nan_to_num(error[order]),
        color=colour(index),
        ls=line_style(index) if steps.are_numbers else "none",
        marker="os^vDP"[index % 6],
        ms=4,
        lw=1.2,
        capsize=_CAP,
        label=label,
    )


def _scale(panel: Axes, means: Sequence[PointMean], steps: _Steps) -> None:
    values = np.array([one.mean for one in means])
    if (values > 0.0).all() and values.max() > _LOG_FROM * values.min():
        panel.set_yscale("log")
        log_axis(panel.yaxis)
    elif (values >= 0.0).all():
        panel.set_ylim(0.0, None if values.any() else 1.0)
    if not steps.are_numbers or len(steps.names) <= _NAMED_STEPS:
        panel.set_xticks(list(steps.at.values()), steps.names)
    margin = 0.08 * steps.width
    panel.set_xlim(min(steps.at.values()) - margin, max(steps.at.values()) + margin)


def _horizontal(table: SweepTable, axes: Sequence[str]) -> int:
    """Place of the axis with the most different numbers, else with the most different texts."""

    def rank(place: int) -> tuple[bool, int]:
        cells = {row[axes[place]] for row in table.rows}
        return all(math.isfinite(number(cell)) for cell in cells), len(cells)

    return max(range(len(axes)), key=rank, default=0)


def _without(cells: Sequence[str], place: int) -> tuple[str, ...]:
    return (*cells[:place], *cells[place + 1 :])


def _short(axis: str) -> str:
    """The last part of the name of an axis."""
    return axis.rpartition(".")[2]

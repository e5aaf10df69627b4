"""Figures of a sweep: a metric over the grid with its 95 % interval over seeds, and error against delay."""

import math
from collections.abc import Mapping
from fnmatch import fnmatchcase
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullLocator
from scipy.special import stdtrit

from fgtrack.core.errors import DataError
from fgtrack.evaluation.tables.metric_names import METRIC_NAMES, metric_words, words
from fgtrack.evaluation.tables.seeds import SweepTable, read_sweep
from fgtrack.show.figures.paper import Paper, Sheet, is_column, styled
from fgtrack.show.figures.style import legend_above, legend_at_ends, log_axis, size_in
from fgtrack.show.palette import style_of, styles

_POSITION = "truth.overall.errors.position_m.rmse"
_LAGGED = "lagged.*.errors.position_m.rmse"
_EXPECTED: Mapping[str, float] = {"consistency.position_nees.mean": 2.0}
#: Metrics that are drawn by default.
_FIRST = (*tuple(METRIC_NAMES)[:2], "consistency.position_nees.mean")
#: Patterns of all metrics that can be drawn: for each it is clear which values are better.
_REST = (
    *METRIC_NAMES,
    "truth.overall.errors.*.rmse",
    "consistency.nis.*.mean",
    "lagged.*.errors.position_m.rmse",
)
# Largest number of panels side by side.
_WIDE = 3
# Ratio of the largest to the smallest value from which the axis is logarithmic.
_LOG_FROM = 20.0
# Shift between the error bars of two estimators, as a share of the axis.
_DODGE = 0.012
# Share of the time that a track must cover, so that its error needs no remark.
_TRACKED = 0.95
_SHARES = ("truth.overall.tracked_share_in_view", "truth.overall.tracked_share")
# Largest number of values of the horizontal axis that all have a tick.
_NAMED_STEPS = 8


def sweep_metrics(table: SweepTable) -> tuple[list[str], list[str]]:
    """Return the metrics of `table` that are drawn by default, and the others."""
    known = [name for name in table.metrics if not table.means(name).empty]
    ordered = [
        name for pattern in _REST for name in known if fnmatchcase(name, pattern)
    ]
    ordered = list(dict.fromkeys(ordered)) or known
    first = [name for name in _FIRST if name in ordered] or ordered[:3]
    return first, [name for name in ordered if name not in first]


@styled
def sweep(
    table: SweepTable | Path | str, metric: str = _POSITION, **paper: Unpack[Paper]
) -> Figure:
    """A metric of a sweep over its grid: mean over the seeds and 95 % interval, a line for each estimator.

    The axis with the most numeric values is horizontal. Each combination of the other
    axes has a panel. A number beside a mean error is the share of the time that is
    tracked, in per cent, where it is below 95 %. `table` is the sweep or its folder, and
    `metric` a column of sweep.csv. Raises `CallError` for an unknown sweep or metric, and `DataError` for a
    metric without values.
    """
    table = table if isinstance(table, SweepTable) else read_sweep(table)
    names = table.shown_axes or [""]
    means = _means(table, metric)
    if means.empty:
        raise DataError(
            f"{metric}: no cell of the sweep has a value, so there is nothing to draw"
        )
    are_numbers = {name: _are_numbers(means[name]) for name in names}
    across = max(names, key=lambda name: (are_numbers[name], means[name].nunique()))
    ticks = {
        cell: float(cell) if are_numbers[across] else k
        for k, cell in enumerate(means[across].unique())
    }
    means["at"] = [ticks[cell] for cell in means[across]]
    width = max(ticks.values()) - min(ticks.values()) or 1.0
    rest = [name for name in names if name != across]
    panels = list(means.groupby(rest, sort=False)) if rest else [((), means)]
    columns = min(_WIDE, len(panels))
    rows = math.ceil(len(panels) / columns)
    sheet = Sheet(max(7.0, 1.2 + 3.8 * columns), 1.5 + 3.0 * rows, paper)
    grid = sheet.plots(rows, columns, sharex=True, sharey=True)
    estimators = means["estimator"].unique().tolist()
    has_shares = False
    is_log = "x" in paper.get("log", "") and are_numbers[across]
    for axes, (point, panel) in zip(grid.flat, panels, strict=False):
        for k, (estimator, its) in enumerate(
            zip(estimators, styles(estimators), strict=True)
        ):
            mine = panel[panel["estimator"] == estimator].sort_values(
                "at", kind="stable"
            )
            at, mean, half = mine[["at", "mean", "half"]].to_numpy().T
            # Shift the error bars, so that they do not hide each other.
            shift = _DODGE * (k - (len(estimators) - 1) / 2.0)
            if is_log and at.min() > 0.0:
                at *= (max(ticks.values()) / min(ticks.values())) ** shift
            else:
                at += shift * width
            line = {
                "color": its.colour,
                "ls": its.line if are_numbers[across] else "none",
                "marker": its.marker,
            }
            label = "" if mine.empty else estimator
            axes.errorbar(
                at, mean, half, capsize=3.0, ms=4, lw=1.2, label=label, **line
            )
            has_shares |= _write_shares(axes, at, mean, mine["tracked"], its.colour)
        axes.set_title(
            "\n".join(
                f"{words(name)}: {c}" for name, c in zip(rest, point, strict=True)
            ),
            loc="left",
        )
        if metric in _EXPECTED:
            axes.axhline(
                _EXPECTED[metric], color="black", lw=0.9, ls="--", label="expected"
            )
    for k, axes in enumerate(grid.flat):
        axes.set_visible(k < len(panels))
        if len(panels) - columns <= k < len(panels):
            axes.set_xlabel(words(across))
            axes.tick_params(labelbottom=True)
    first: Axes = grid[0, 0]
    _set_scales(first, means, ticks, are_numbers[across], paper.get("log"))
    for axes in grid[:, 0]:
        axes.set_ylabel(metric_words(metric))
    if len(panels) == 1:
        _write_legend(first, paper)
    else:
        sheet.figure.legend(
            *first.get_legend_handles_labels(),
            loc="outside lower center",
            ncols=4,
            frameon=False,
        )
    sheet.title(
        f"{metric_words(metric).partition(' [')[0]}: {_over_seeds(means, 'bars')}"
        f"{_SHARES_NOTE if has_shares else ''}"
    )
    return sheet.figure


#: Caption of the numbers beside errors.
_SHARES_NOTE = "; numbers: share of the time tracked [%], where below 95 %"


def _over_seeds(means: Any, mark: str) -> str:
    """Return the caption of a mean over seeds, and of its interval, which is drawn as `mark`."""
    few = means["seeds"].min()
    most = means["seeds"].max()
    number = f"{few} to {most}" if few < most else str(most)
    return (
        f"mean over {number} seeds, {mark}: 95 % interval" if most > 1 else "one seed"
    )


def _set_scales(
    axes: Axes,
    means: Any,
    ticks: Mapping[str, float],
    is_numeric: bool,
    log: str | None,
) -> None:
    """Set scales, limits and ticks. `log` names the logarithmic axes; None chooses by the values."""
    low = means["mean"].min()
    high = means["mean"].max()
    wide = low > 0.0 and high > _LOG_FROM * low
    if wide if log is None else "y" in log:
        axes.set_yscale("log")
        log_axis(axes.yaxis)
    elif low >= 0.0:
        axes.set_ylim(0.0, None if high else 1.0)
    at = list(ticks.values())
    if log is not None and "x" in log and is_numeric and min(at) > 0.0:
        axes.set_xscale("log")
        margin = (max(at) / min(at)) ** 0.08
        axes.set_xlim(min(at) / margin, max(at) * margin)
        axes.xaxis.set_minor_locator(NullLocator())
    else:
        width = max(at) - min(at) or 1.0
        axes.set_xlim(min(at) - 0.08 * width, max(at) + 0.08 * width)
    if len(ticks) <= _NAMED_STEPS or not is_numeric:
        axes.set_xticks(at, list(ticks))


def _write_legend(axes: Axes, paper: Paper) -> None:
    """Write the legend above the plot, or at the ends of the lines."""
    if paper.get("legend") == "ends":
        legend_at_ends(axes, breaks=is_column(paper))
    else:
        legend_above(axes)


def _write_shares(
    axes: Axes, at: Any, means: Any, shares: Any, colour: str
) -> bool:  # Any: columns of a DataFrame
    """Write the share of the time that is tracked beside each error where it is low; return True if there is one."""
    low = [
        (x, y, share)
        for x, y, share in zip(at, means, shares, strict=True)
        if share < _TRACKED
    ]
    for x, y, share in low:
        axes.annotate(
            f"{100.0 * share:.0f} %",
            (x, y),
            (-3.0, 4.0),
            textcoords="offset points",
            ha="right",
            fontsize=0.85 * 72.0 * size_in("xtick.labelsize"),
            color=colour,
            path_effects=[withStroke(linewidth=1.5, foreground="white")],
            zorder=5.0,
        )
    return bool(low)


@styled
def error_against_delay(
    table: SweepTable | Path | str | None = None, **paper: Unpack[Paper]
) -> Figure:
    """Position error against the mean delay of a sensor, a line for each estimator, with 95 % intervals.

    `table` is a sweep, or its folder, over a single axis of delays in seconds. The
    default is the stored result of the shipped sweep `error_against_delay`: a car, a
    late LiDAR and a RADAR, ten seeds. Raises `CallError` for an unknown sweep, and
    `DataError` for a sweep without a single axis of delays.
    """
    if table is None:
        with as_file(files(__package__) / "error_against_delay") as folder:
            table = read_sweep(folder)
    table = table if isinstance(table, SweepTable) else read_sweep(table)
    waits = [name for name in table.metrics if _is_waited(name)][:1]
    curves = {metric: _means(table, metric) for metric in (_POSITION, *waits)}
    (delay, *others), points = table.shown_axes or [""], curves[_POSITION]
    if others or points.empty or not _are_numbers(points[delay]):
        raise DataError(
            "the sweep must have a single axis of delays, and position errors, for a figure against delay"
        )
    sheet = Sheet(7.0, 4.2, paper)
    axes: Axes = sheet.plots()[0, 0]
    has_shares = False
    for metric, means in curves.items():
        means["ms"] = 1e3 * means[delay].astype(float)
        for name, mine in means.sort_values("ms", kind="stable").groupby(
            "estimator", sort=False
        ):
            its = style_of(name)
            later = metric_words(metric).partition(", ")[2]
            later = later.removeprefix("output ")
            line, marker, label = (
                ("-." if its.line == ":" else ":", ".", f"{name}, {later}")
                if later
                else (its.line, its.marker, name)
            )
            low = mine["mean"] - mine["half"]
            high = mine["mean"] + mine["half"]
            axes.fill_between(mine["ms"], low, high, color=its.colour, alpha=0.18, lw=0)
            if metric == _POSITION:
                has_shares |= _write_shares(
                    axes, mine["ms"], mine["mean"], mine["tracked"], its.colour
                )
            axes.plot(
                mine["ms"],
                mine["mean"],
                ls=line,
                marker=marker,
                ms=4,
                lw=1.6,
                color=its.colour,
                label=label,
            )
    axes.set(
        xlabel=f"{words(delay).partition(' [')[0]}, mean [ms]",
        ylabel="position RMSE [m]",
    )
    log = paper.get("log", "")
    if "y" in log:
        axes.set_yscale("log")
        log_axis(axes.yaxis)
    else:
        axes.set_ylim(0.0, None)
    if "x" in log:  # a delay of 0 has no logarithm
        axes.set_xscale("symlog", linthresh=points["ms"][points["ms"] > 0.0].min())
        axes.set_xticks(sorted(points["ms"].unique()), minor=False)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
    axes.margins(x=0.02)
    _write_legend(axes, paper)
    sheet.title(
        f"Error against delay ({_over_seeds(points, 'shaded')}"
        f"{_SHARES_NOTE if has_shares else ''})"
    )
    return sheet.figure


def _is_waited(metric: str) -> bool:
    """True for the position error of states with a positive lag; the lag of a final state differs."""
    lag = metric.removeprefix("lagged.").partition(".errors.")[0]
    return fnmatchcase(metric, _LAGGED) and lag != "window" and float(lag) > 0.0


def has_delays(table: SweepTable) -> bool:
    """True if the sweep has a single axis of delays in seconds, and position errors, for `error_against_delay`."""
    if len(table.shown_axes) != 1 or _POSITION not in table.metrics:
        return False
    (axis,) = table.shown_axes
    name = axis.lower()
    is_delay = "delay" in name and name.endswith("_s")
    return is_delay and _are_numbers(table.rows[axis])


def _means(
    table: SweepTable, metric: str
) -> Any:  # Any: a DataFrame, whose columns have no types
    """Return the means of `table`, with the half-width `half` of the 95 % interval (t; 0 for a single seed).

    `tracked` is the share of the time that is tracked, 1 where it is unknown.
    """
    frame = table.means(metric)
    share = next((name for name in _SHARES if name in table.metrics), None)
    frame["tracked"] = 1.0
    if share is not None and ".errors." in metric:
        keys = [*table.shown_axes, "estimator"]
        shares = table.means(share)[[*keys, "mean"]]
        shares = shares.rename(columns={"mean": "share"})
        frame["tracked"] = frame.merge(shares, on=keys, how="left")["share"].fillna(1.0)
    frame["half"] = np.nan_to_num(
        stdtrit(np.maximum(frame["seeds"] - 1, 1), 0.975) * frame["standard_error"]
    )
    return frame if table.shown_axes else frame.assign(**{"": ""})


def _are_numbers(cells: Any) -> bool:
    return bool(np.isfinite(pd.to_numeric(cells, errors="coerce")).all())

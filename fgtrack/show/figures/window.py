"""Figure of a smoothing window: its factor graph over time, before and after a change."""

from itertools import pairwise
from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.smoothing.window import Window
from fgtrack.show.figures.paper import Paper, Sheet, styled
from fgtrack.show.figures.style import GREY, legend_above

_STATE, _CHANGED, _BLACK = "#2F93C6", "#B65CA8", "#000000"
# Heights of the panels.
_GRAPH_IN, _SPREAD_IN = 1.2, 1.7
# Heights in a graph: of states and motion factors, of measurements, and of the upper edge.
_STATES, _MEASUREMENTS, _TOP = 0.0, 1.0, 1.45


@styled
def window(
    after: Window, before: Window | None = None, **paper: Unpack[Paper]
) -> Figure:
    """Factor graph of a window over time, and the position standard deviation of its states.

    With the window `before`, both graphs are drawn. The second graph highlights what
    the change added. The first graph highlights the motion factor that the change
    split.
    """
    graphs = {"window": after}
    if before is not None:
        graphs = {"before": before, "after": after}
    heights = [*[_GRAPH_IN] * len(graphs), _SPREAD_IN]
    sheet = Sheet(8.0, sum(heights) + 0.9, paper)
    *rows, spread = sheet.plots(len(heights), heights=heights, sharex=True)[:, 0]
    first_ns = min(one.stamps_ns[0] for one in graphs.values())
    for axes, (name, one) in zip(rows, graphs.items(), strict=True):
        other = one if before is None else after if one is before else before
        _draw_graph(axes, one, other, first_ns)
        axes.set_ylabel(name)
        color = GREY if one is before else _STATE
        spread.plot(
            _times_s(one, first_ns),
            _position_deviations_m(one),
            "o-",
            ms=4.0,
            color=color,
            label=name,
        )
    spread.set(xlabel="time [s]", ylabel="position std [m]", ylim=(0.0, None))
    if before is not None:
        spread.legend(frameon=False)
    _legend(rows[0], has_changes=before is not None)
    sheet.title("Factor graph of a window")
    return sheet.figure


def _draw_graph(axes: Axes, one: Window, other: Window, first_ns: int) -> None:
    """Draw states, motion factors and measurements; elements that `other` lacks are highlighted."""
    times_s = _times_s(one, first_ns)
    links = list(pairwise(one.stamps_ns))
    kept_links = set(pairwise(other.stamps_ns))
    for link, (left_s, right_s) in zip(links, pairwise(times_s), strict=True):
        color = _BLACK if link in kept_links else _CHANGED
        axes.plot([left_s, right_s], [_STATES] * 2, "-", color=color, zorder=1)
        middle_s = 0.5 * (left_s + right_s)
        axes.plot([middle_s], [_STATES], "s", ms=5.0, color=color, zorder=2)
    prior_s = times_s[0] - 0.03 * max(times_s[-1] - times_s[0], 0.1)
    axes.plot([prior_s, times_s[0]], [_STATES] * 2, "-", color=_BLACK, zorder=1)
    axes.plot([prior_s], [_STATES], "D", ms=6.0, color=_BLACK, zorder=2)
    kept_orders = {each.order for each in other.measurements}
    for measurement, index in zip(one.measurements, one.indices, strict=True):
        color = _BLACK if measurement.order in kept_orders else _CHANGED
        ends_s = [times_s[index], seconds(measurement.stamp_ns - first_ns)]
        axes.plot(ends_s, [_STATES, _MEASUREMENTS], "-", lw=1.0, color=color, zorder=1)
        axes.plot(ends_s[1:], [_MEASUREMENTS], "s", ms=5.0, color=color, zorder=2)
    for stamp_ns, time_s in zip(one.stamps_ns, times_s, strict=True):
        color = _STATE if stamp_ns in other.stamps_ns else _CHANGED
        axes.plot([time_s], [_STATES], "o", ms=9.0, mec="white", color=color, zorder=3)
    axes.set(ylim=(-0.5, _TOP), yticks=[])
    axes.grid(visible=False)
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(axis="x", length=0.0)


def _legend(axes: Axes, has_changes: bool) -> None:
    """Draw the legend above the first graph."""
    entries = [
        ("o", _STATE, "state"),
        ("D", _BLACK, "marginalised prior"),
        ("s", _BLACK, "factor: motion between states, measurement above"),
    ]
    if has_changes:
        entries.append(("s", _CHANGED, "only in this window"))
    for marker, color, label in entries:
        axes.plot([], [], marker, ms=6.0, color=color, label=label)
    legend_above(axes)


def _times_s(one: Window, first_ns: int) -> list[float]:
    return [seconds(stamp_ns - first_ns) for stamp_ns in one.stamps_ns]


def _position_deviations_m(one: Window) -> FloatArray:
    """Position standard deviation of each state, shape (m,): the root of the mean variance of x and y."""
    return np.asarray(np.sqrt(one.covariances[:, [0, 1], [0, 1]].mean(axis=1)))

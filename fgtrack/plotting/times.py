"""The figure of processing times."""

from typing import Unpack

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.runs import Runs, evaluated
from fgtrack.evaluation.scores.statistics import Distribution
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.style import legend_above, log_axis, run_looks

_NS_PER_MS = NS_PER_S / 1e3


@styled
def timing(runs: Runs, **paper: Unpack[Paper]) -> Figure:
    """Share of the ticks with detections that are done within a wall time, a line for each run.

    Raises `DataError` if no run has a tick with detections.
    """
    every = evaluated(runs)
    sheet = Sheet(7.0, 3.8, paper)
    axes: Axes = sheet.plots()[0, 0]
    for one, its in zip(every, run_looks(every).values(), strict=True):
        ticks = one.run.tables["timing"]
        time_ms = ticks["process_ns"][ticks["num_detections"] > 0] / _NS_PER_MS
        if len(time_ms):
            spread = Distribution.of(time_ms)
            label = f"{one.label}: median {spread.p50:.3g} ms, 99 % within {spread.p99:.3g} ms"
            axes.ecdf(time_ms, lw=1.6, label=label, color=its.colour, ls=its.line)
    if not axes.lines:
        raise DataError("no run has detections, so there are no processing times to draw")
    axes.set(xscale="log", xlabel="time per tick with detections [ms]", ylabel="share of the ticks")
    axes.margins(x=0.02)
    log_axis(axes.xaxis)
    legend_above(axes)
    sheet.title("Processing time")
    return sheet.figure

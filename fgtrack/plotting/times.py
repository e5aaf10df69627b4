"""Figures of times: delays of messages, processing time."""

from typing import Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.runs import OneRun, Runs, evaluated, one_evaluated
from fgtrack.evaluation.scores.innovations import message_delays
from fgtrack.evaluation.scores.statistics import Distribution
from fgtrack.io.run import Run
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.style import legend_above, log_axis, run_looks, sensor_colour, titled

_MS = 1e3


@styled
def delays(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Share of the messages that has arrived against the delay from stamp to receipt, a line for each sensor.

    Raises `DataError` if the run has no detections.
    """
    one = one_evaluated(run)
    if not one.run.tables["updates"].num_rows:
        raise DataError(f"{one.label}: has no detections, so there are no delays to draw")
    sheet = Sheet(7.0, 3.8, paper)
    axes = sheet.plots()[0, 0]
    for k, (sensor, (_, delay_s)) in enumerate(sensor_delays(one.run).items()):
        spread = Distribution.of(_MS * delay_s)
        label = f"{sensor}: mean {spread.mean:.0f} ms, 90 % within {spread.p90:.0f} ms, all within {spread.max:.0f} ms"
        axes.ecdf(_MS * delay_s, color=sensor_colour(k), lw=1.6, label=label)
    axes.set(xlabel="delay from stamp to receipt [ms]", ylabel="share of the messages received")
    axes.margins(x=0.02)
    legend_above(axes)
    sheet.title(titled(one.label, "delay of the messages with detections"))
    return sheet.figure


def sensor_delays(run: Run) -> dict[str, tuple[IntArray, FloatArray]]:
    """Return receipt in ns and delay in s of the messages of every sensor, see `message_delays`."""
    sensors = run.tables["updates"]["sensor"]
    return {name: message_delays(run.tables["updates"].where(sensors == name)) for name in np.unique(sensors).tolist()}


@styled
def timing(runs: Runs, **paper: Unpack[Paper]) -> Figure:
    """Share of the ticks with detections that are done within a wall time, a line for each run.

    Raises `DataError` if no run has a tick with detections.
    """
    every = evaluated(runs)
    if not any((one.run.tables["timing"]["num_detections"] > 0).any() for one in every):
        raise DataError("no run has detections, so there are no processing times to draw")
    sheet = Sheet(7.0, 3.8, paper)
    axes = sheet.plots()[0, 0]
    looks = run_looks(every)
    for one in every:
        ticks = one.run.tables["timing"]
        time_ms = ticks["process_ns"][ticks["num_detections"] > 0] / NS_PER_S * _MS
        if len(time_ms):
            spread = Distribution.of(time_ms)
            text = f"{one.label}: median {spread.p50:.3g} ms, 99 % within {spread.p99:.3g} ms"
            axes.ecdf(time_ms, color=looks[one.label].colour, ls=looks[one.label].line, lw=1.6, label=text)
    axes.set(xscale="log", xlabel="time per tick with detections [ms]", ylabel="share of the ticks")
    log_axis(axes.xaxis)
    legend_above(axes)
    sheet.title("Processing time")
    return sheet.figure

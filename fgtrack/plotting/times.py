"""Figures of times: delays of messages, processing time."""

from collections.abc import Mapping, Sequence
from typing import Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.runs import OneRun, Runs, evaluated, one_evaluated
from fgtrack.evaluation.scores.innovations import message_delays
from fgtrack.evaluation.scores.statistics import Distribution
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.style import legend_above, log_axis, run_looks, sensor_colour

_MS = 1e3


@styled
def delays(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Share of the messages that has arrived against the delay from stamp to receipt, a line for each sensor.

    Raises `DataError` if the run has no detections.
    """
    one = one_evaluated(run)
    updates = one.run.tables["updates"]
    if not updates.num_rows:
        raise DataError(f"{one.label}: has no detections, so there are no delays to draw")
    curves = []
    for k, sensor in enumerate(np.unique(updates["sensor"]).tolist()):
        delay_ms = _MS * message_delays(updates.where(updates["sensor"] == sensor))[1]
        spread = Distribution.of(delay_ms)
        label = f"{sensor}: mean {spread.mean:.0f} ms, 90 % within {spread.p90:.0f} ms, all within {spread.max:.0f} ms"
        curves.append((delay_ms, label, {"color": sensor_colour(k)}))
    texts = {"xlabel": "delay from stamp to receipt [ms]", "ylabel": "share of the messages received"}
    return _distributions(curves, texts, f"{one.label}: delay of the messages with detections", paper)


@styled
def timing(runs: Runs, **paper: Unpack[Paper]) -> Figure:
    """Share of the ticks with detections that are done within a wall time, a line for each run.

    Raises `DataError` if no run has a tick with detections.
    """
    every = evaluated(runs)
    curves = []
    for one, its in zip(every, run_looks(every).values(), strict=True):
        ticks = one.run.tables["timing"]
        time_ms = ticks["process_ns"][ticks["num_detections"] > 0] / NS_PER_S * _MS
        if len(time_ms):
            spread = Distribution.of(time_ms)
            text = f"{one.label}: median {spread.p50:.3g} ms, 99 % within {spread.p99:.3g} ms"
            curves.append((time_ms, text, {"color": its.colour, "ls": its.line}))
    if not curves:
        raise DataError("no run has detections, so there are no processing times to draw")
    texts = {"xscale": "log", "xlabel": "time per tick with detections [ms]", "ylabel": "share of the ticks"}
    return _distributions(curves, texts, "Processing time", paper)


def _distributions(
    curves: Sequence[tuple[FloatArray, str, Mapping[str, str]]], texts: Mapping[str, str], title: str, paper: Paper
) -> Figure:
    """Cumulative distributions of samples, each with its label and look."""
    sheet = Sheet(7.0, 3.8, paper)
    axes = sheet.plots()[0, 0]
    for values, label, its in curves:
        axes.ecdf(values, lw=1.6, label=label, **its)
    axes.set(**texts)
    axes.margins(x=0.02)
    if "xscale" in texts:
        log_axis(axes.xaxis)
    legend_above(axes)
    sheet.title(title)
    return sheet.figure

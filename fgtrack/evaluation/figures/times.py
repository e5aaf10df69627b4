"""Figures of times: delays of messages, processing time."""

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.figures.seeds import grouped
from fgtrack.evaluation.figures.style import (
    StyledFigure,
    colour,
    legend_above,
    line_style,
    log_axis,
    styled,
    title,
    titled,
)
from fgtrack.evaluation.innovations import message_delays
from fgtrack.evaluation.runs import OneRun, Runs, judged, one_judged, starts_ns
from fgtrack.evaluation.statistics import Distribution
from fgtrack.io.run import Run

_MS = 1e3


@styled
def delays(run: OneRun) -> Figure:
    """Delay of the messages from stamp to receipt, per sensor: histogram and share that has arrived.

    Raises
    ------
    DataError
        The run has no detections.
    """
    one = one_judged(run)
    if not one.run.updates.num_rows:
        raise DataError(f"{one.label}: has no detections, so there are no delays to draw")
    figure = StyledFigure(figsize=(10.0, 4.0))
    histogram, arrived = figure.subplots(1, 2)
    delays_ms = {sensor: delay_s * _MS for sensor, (_, delay_s) in sensor_delays(one.run).items()}
    everything = np.concatenate(list(delays_ms.values()))
    low, high = min(0.0, float(everything.min())), max(float(everything.max()), 1.0)
    bins = np.linspace(low, high, 61)
    for k, (sensor, delay_ms) in enumerate(delays_ms.items()):
        spread = Distribution.of(delay_ms)
        share = np.histogram(delay_ms, bins)[0] / len(delay_ms)
        label = f"{sensor}: mean {spread.mean:.0f} ms, p90 {spread.p90:.0f} ms, max {spread.max:.0f} ms"
        histogram.stairs(share, bins, color=colour(k), lw=1.4, label=label)
        arrived.ecdf(delay_ms, color=colour(k), lw=1.4)
        for axes in (histogram, arrived):
            axes.axvline(spread.mean, color=colour(k), lw=1.0, ls="-", alpha=0.5)
            axes.axvline(spread.p90, color=colour(k), lw=1.0, ls="--", alpha=0.5)
    histogram.set_ylabel("share of the messages per bin")
    arrived.set_ylabel("share of the messages received")
    for axes in (histogram, arrived):
        axes.set_xlabel("delay [ms] (lines: mean; dashed: p90)")
        axes.set_xlim(low, high)
    legend_above(histogram, figure.get_figwidth() / 2.0)
    title(figure, titled(one.label, "delay of the messages with detections"))
    return figure


def sensor_delays(run: Run) -> dict[str, tuple[IntArray, FloatArray]]:
    """Receipt in ns and delay in s of the messages of every sensor, see `message_delays`."""
    sensors = run.updates["sensor"]
    return {name: message_delays(run.updates.where(sensors == name)) for name in np.unique(sensors).tolist()}


@styled
def timing(runs: Runs) -> Figure:
    """Wall time of the ticks with detections: over the run, and the share of ticks done by then.

    Runs that differ by their seed only are taken together.

    Raises
    ------
    DataError
        No run has a tick with detections.
    """
    every = judged(runs)
    if not any((one.run.timing["num_detections"] > 0).any() for one in every):
        raise DataError("no run has detections, so there are no processing times to draw")
    figure = StyledFigure(figsize=(10.0, 4.0))
    over_time, done = figure.subplots(1, 2)
    first_ns = starts_ns(every)
    for k, group in enumerate(grouped(every)):
        busy = [(one.label, one.run.timing.where(one.run.timing["num_detections"] > 0)) for one in group.runs]
        time_ms = np.concatenate([ticks["process_ns"] / NS_PER_S * _MS for _, ticks in busy])
        if not len(time_ms):
            continue
        spread = Distribution.of(time_ms)
        text = f"{group.label}: median {spread.p50:.3g} ms, p99 {spread.p99:.3g} ms"
        time_s = np.concatenate([(ticks["now_ns"] - first_ns[label]) / NS_PER_S for label, ticks in busy])
        over_time.plot(time_s, time_ms, ".", ms=3.0, alpha=0.5, mew=0, color=colour(k), label=text, rasterized=True)
        done.ecdf(time_ms, color=colour(k), ls=line_style(k), lw=1.4)
    over_time.set_yscale("log")
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel("time per tick with detections [ms]")
    done.set_xscale("log")
    done.set_xlabel("time per tick with detections [ms]")
    done.set_ylabel("share of the ticks")
    for axis in (over_time.yaxis, done.xaxis):
        log_axis(axis)
    legend_above(over_time, figure.get_figwidth() / 2.0)
    title(figure, "Processing time")
    return figure

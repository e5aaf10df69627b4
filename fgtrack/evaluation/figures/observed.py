"""Figures of the evaluation of Karle et al. 2023: the transient of the residuals, and what the sensors saw."""

from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.figures.style import WRONG, StyledFigure, colour, legend_above, styled, title, titled
from fgtrack.evaluation.residual_samples import LOCAL_NAMES
from fgtrack.evaluation.runs import OneRun, one_judged
from fgtrack.evaluation.sensed import Sensed
from fgtrack.evaluation.sensed import sensed as of_sensors

_UNTIL_S = 5.0
_BIN_S = 0.5
_FEWEST = 10  # samples of a point

_LABELS = {
    "along_m": "along track [m]",
    "across_m": "across track [m]",
    "yaw_rad": "yaw [deg]",
    "speed_mps": "speed [m/s]",
}

_SEEN: Mapping[str, Callable[[Sensed], FloatArray]] = {
    "delay [ms]": lambda of: 1e3 * of.delay_s,
    "way of the ego\nin the delay [m]": lambda of: of.moved_m,
    "speed of the\nobject [m/s]": lambda of: of.object_speed_mps,
    "speed relative to\nthe ego [m/s]": lambda of: of.relative_speed_mps,
    "distance [m]": lambda of: of.distance_m,
    "ahead of the\nego [m]": lambda of: of.ahead_m,
    "detections per\nobject": lambda of: of.detections,
}


@styled
def transient(run: OneRun) -> Figure:
    """Residuals against the time since the first detection of their track: of all sensors (black) and of each.

    Points are root mean squares over half a second, of confirmed tracks.

    Raises
    ------
    DataError
        The run has no innovations of confirmed tracks.
    """
    one = one_judged(run)
    samples = one.samples
    names = [name for name in LOCAL_NAMES if np.isfinite(samples.values[name]).any()]
    if not names:
        raise DataError(f"{one.label}: has no innovations of confirmed tracks, so there is no transient to draw")
    sensors = np.unique(samples.sensors).tolist()
    lines = [("all sensors", np.ones(len(samples.sensors), dtype=bool), WRONG, 3.0)]
    lines += [(sensor, samples.sensors == sensor, colour(k), 1.4) for k, sensor in enumerate(sensors)]
    figure = StyledFigure(figsize=(10.0, 0.9 + 1.7 * len(names)))
    rows = figure.subplots(len(names), 1, squeeze=False, sharex=True)[:, 0]
    numbers = (samples.observed_s // _BIN_S).astype(np.int64)
    middles_s = _BIN_S * (np.arange(round(_UNTIL_S / _BIN_S)) + 0.5)
    for axes, name in zip(rows, names, strict=True):
        values = np.degrees(samples.values[name]) if name == "yaw_rad" else samples.values[name]
        for label, mine, tint, width in lines:
            known = mine & np.isfinite(values) & (numbers < len(middles_s))
            counts = np.bincount(numbers[known], minlength=len(middles_s))
            squares = np.bincount(numbers[known], values[known] ** 2, minlength=len(middles_s))
            rms = np.where(counts >= _FEWEST, np.sqrt(squares / np.maximum(counts, 1)), np.nan)
            if np.isfinite(rms).any():
                axes.plot(middles_s, rms, "o-", ms=3.5, lw=width, color=tint, label=label)
        axes.set_ylabel(_LABELS[name])
        axes.set_ylim(bottom=0.0)
    rows[-1].set_xlabel("time since the first detection of the track [s]")
    rows[-1].set_xlim(0.0, _UNTIL_S)
    legend_above(rows[0], figure.get_figwidth())
    title(figure, titled(one.label, "transient of the residuals (root mean square)"))
    return figure


@styled
def sensed(run: OneRun) -> Figure:
    """What each sensor saw: delays, way of the ego in them, speeds and places of the objects, detections of each.

    Raises
    ------
    DataError
        The run has no detections.
    """
    one = one_judged(run)
    found = of_sensors(one)
    if not found:
        raise DataError(f"{one.label}: has no detections, so there is nothing to draw")
    figure = StyledFigure(figsize=(12.0, 4.2))
    for axes, (label, get) in zip(figure.subplots(1, len(_SEEN)), _SEEN.items(), strict=True):
        for k, of in enumerate(found.values()):
            values = get(of)
            _violin(axes, k, values[np.isfinite(values)])
        axes.set_xticks(range(len(found)), [""] * len(found))
        axes.set_xlim(-0.6, len(found) - 0.4)
        axes.set_title(label, fontsize=8)
    for k, sensor in enumerate(found):
        figure.axes[0].plot([], [], color=colour(k), lw=4.0, label=sensor)
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(found), frameon=False
    )
    title(figure, titled(one.label, "what the sensors saw (bars: median)"))
    return figure


def _violin(axes: Axes, place: int, values: FloatArray) -> None:
    """The distribution of `values`, shape (n,), at `place`, and a bar at its median."""
    if not len(values):
        return
    if np.ptp(values) > 0.0:
        parts = axes.violinplot(values, [place], widths=0.9, showextrema=False)
        for body in parts["bodies"]:  # type: ignore[attr-defined]  # the stubs know one collection only
            body.set(facecolor=colour(place), edgecolor=colour(place), alpha=0.6)
    axes.hlines(np.median(values), place - 0.35, place + 0.35, color=colour(place), lw=2.0)

"""Figures of errors against truth: over time, and against the lag."""

import math
from collections.abc import Mapping
from typing import Any, Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import Matching, track_errors
from fgtrack.evaluation.runs import (
    EvaluatedRun,
    Runs,
    by_recording,
    evaluated,
    start_ns,
)
from fgtrack.evaluation.scores.lagged import final_errors
from fgtrack.evaluation.scores.statistics import Moments
from fgtrack.show.figures.bands import thinned
from fgtrack.show.figures.paper import Paper, Sheet, styled
from fgtrack.show.figures.style import (
    broken_line,
    legend_above,
    run_styles,
    usual_step_ns,
)
from fgtrack.show.palette import CurveStyle

#: Name, unit, and factor to this unit of each quantity.
_QUANTITIES = {
    "position_m": ("position", "m", 1.0),
    "speed_mps": ("speed", "m/s", 1.0),
    "yaw_rad": ("yaw", "deg", 180.0 / math.pi),
}
# Number of windows of the moving mean in the displayed time, and the shortest window.
_WINDOWS = 60
_SHORTEST_S = 0.2


@styled
def errors(runs: Runs, object_id: int | None = None, **paper: Unpack[Paper]) -> Figure:
    """Moving RMS error in position, speed and yaw over time, a line for each run; the legend gives the total RMSE.

    Present states are solid or dashed lines, final states of a smoother are dotted.
    Each point is the root mean square over a sixtieth of the displayed time. Lines are
    interrupted where nothing was tracked. Quantities without truth are not drawn.
    Without `object_id` the figure shows the only object, or all objects together.

    Raises `DataError` if no run has truth, or none has truth of this object.
    """
    read = evaluated(runs)
    every = {item: item.matching for item in read if item.matching is not None}
    known = sorted({k for matching in every.values() for k in matching.object_ids})
    if not known:
        raise DataError("no run has truth, so there are no errors to draw")
    if object_id is not None and object_id not in known:
        raise DataError(
            f"object {object_id}: no run has truth of this object, use {', '.join(map(str, known))}"
        )
    wanted = known[0] if len(known) == 1 else object_id
    curves = _curves(every, wanted)
    names = [
        name
        for name in _QUANTITIES
        if any(np.isfinite(item[name]).any() for *_, item in curves)
    ]
    names = names or ["position_m"]
    longest_s = max(
        (
            float(np.ptp(times_ns)) / NS_PER_S
            for *_, times_ns, _ in curves
            if len(times_ns)
        ),
        default=0.0,
    )
    window_s = max(longest_s / _WINDOWS, _SHORTEST_S)
    sheet = Sheet(9.0, 1.5 + 2.0 * len(names), paper)
    rows = sheet.plots(len(names), sharex=True)[:, 0]
    for axes, name in zip(rows, names, strict=True):
        quantity, unit, factor = _QUANTITIES[name]
        for label, style, step_ns, times_ns, values in curves:
            moments = Moments.of(factor * values[name])
            text = (
                f"RMSE {moments.rmse:.3g} {unit}" if moments.count else "never tracked"
            )
            at_ns, rms = moving_rms(
                times_ns, factor * values[name], nanoseconds(window_s)
            )
            axes.plot(
                *broken_line(
                    at_ns, at_ns / NS_PER_S, rms, max(step_ns, usual_step_ns(at_ns))
                ),
                color=style.colour,
                ls=style.line,
                lw=1.4,
                label=f"{label}: {text}" if axes is rows[0] else text,
                # A dashed line is drawn above, so that the line below it is visible.
                zorder=2.0 if style.line == "-" else 2.5,
            )
        axes.set(ylabel=f"{quantity} error [{unit}]", ylim=(0.0, None))
        legend_above(axes)
    rows[-1].set_xlabel("time [s]")
    whose = "all objects" if wanted is None else f"object {wanted}"
    sheet.title(f"Errors of the tracks of {whose} (moving RMS over {window_s:.2g} s)")
    return sheet.figure


_Curve = tuple[str, CurveStyle, float, IntArray, Mapping[str, FloatArray]]
"""Label, style, usual step in ns, ascending times in ns since the start of the recording, and errors."""


def _curves(
    runs: Mapping[EvaluatedRun, Matching], object_id: int | None
) -> list[_Curve]:
    """Return the errors of the present states of every run, then the errors of final states."""
    styles = run_styles(list(runs))
    first_ns = {
        item: start_ns(group) for group in by_recording(list(runs)) for item in group
    }
    both = [(item, its, "", track_errors(its)) for item, its in runs.items()]
    both += [
        (item, its, ", final state", final_errors(item.run, its))
        for item, its in runs.items()
    ]
    curves = list[_Curve]()
    for item, its, more, result in both:
        if object_id is None:
            wanted = np.ones(len(result.stamps_ns), dtype=bool)
        elif object_id in its.object_ids:
            wanted = result.object_index == its.object_ids.index(object_id)
        else:
            continue
        rows = np.flatnonzero(wanted)
        rows = rows[np.argsort(result.stamps_ns[rows], kind="stable")]
        style = styles[item.label]._replace(line=":") if more else styles[item.label]
        if len(rows) or not more:
            values = {name: each[rows] for name, each in result.values.items()}
            times_ns = result.stamps_ns[rows] - first_ns[item]
            step_ns = usual_step_ns(its.tracks["now_ns"])
            curves.append((item.label + more, style, step_ns, times_ns, values))
    return curves


def moving_rms(
    stamps_ns: IntArray, values: FloatArray, window_ns: int
) -> tuple[IntArray, FloatArray]:
    """Return the distinct stamps with a value, and the root mean square within half a window around each."""
    known = np.isfinite(values)
    stamps_ns = stamps_ns[known]
    sums = np.concatenate([[0.0], np.cumsum(np.square(values[known]))])
    distinct_ns = np.unique(stamps_ns)
    distinct_ns = distinct_ns[thinned(len(distinct_ns))]
    first = np.searchsorted(stamps_ns, distinct_ns - window_ns // 2, side="left")
    last = np.searchsorted(stamps_ns, distinct_ns + window_ns // 2, side="right")
    return distinct_ns, np.sqrt(
        np.maximum(sums[last] - sums[first], 0.0) / (last - first)
    )


@styled
def lag(runs: Runs, **paper: Unpack[Paper]) -> Figure:
    """Position RMSE against the lag, a line for each run; a horizontal line for a run without lagged states.

    The thin dotted line shows the present states of these tracks at equal stamps.
    The distance between the two lines is the benefit of waiting. This comparison is
    needed because a track that ended has no lagged states for its last moments. Raises
    `DataError` if no run has tracks with truth.
    """
    every = evaluated(runs)
    if not any(
        entry.errors["position_m"].count
        for one in every
        for entry in one.metrics.lagged
    ):
        raise DataError("no run has tracks with truth, so there are no errors to draw")
    sheet = Sheet(7.0, 4.2, paper)
    axes: Axes = sheet.plots()[0, 0]
    for one, its in zip(every, run_styles(every).values(), strict=True):
        curve = [
            entry
            for entry in one.metrics.lagged
            if entry.lag_s == 0.0 or entry.is_lagged
        ]
        rmse_m = [entry.errors["position_m"].rmse for entry in curve]
        given: dict[str, Any] = {"color": its.colour, "ls": its.line, "lw": 1.6}
        if len(curve) > 1:
            lags_s = [float(entry.lag_s) for entry in curve]
            present_m = [entry.present_errors["position_m"].rmse for entry in curve]
            axes.plot(lags_s, rmse_m, marker=its.marker, ms=4, label=one.label, **given)
            axes.plot(lags_s, present_m, color=its.colour, ls=":", lw=0.8)
        elif curve:
            axes.axhline(rmse_m[0], label=f"{one.label} (no lag)", **given)
    if len(axes.lines) > len(every):
        axes.plot(
            [], [], color="black", ls=":", lw=0.8, label="present, at the same stamps"
        )
    axes.set(
        xlabel="lag of the output [s]",
        ylabel="position RMSE [m]",
        ylim=(0.0, 1.08 * axes.dataLim.y1 or 1.0),
    )
    legend_above(axes)
    sheet.title("Error against lag: the benefit of waiting")
    return sheet.figure

"""Figures of errors against truth: over time, and against the lag."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import track_errors
from fgtrack.evaluation.palette import Look
from fgtrack.evaluation.runs import EvaluatedRun, Runs, by_recording, evaluated, start_ns
from fgtrack.evaluation.scores.lagged import final_errors
from fgtrack.evaluation.scores.statistics import Moments
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.style import broken_line, legend_above, run_looks, usual_step_ns

#: What is drawn, with its name, its unit, and that unit over the one of the values.
_QUANTITIES = {
    "position_m": ("position", "m", 1.0),
    "speed_mps": ("speed", "m/s", 1.0),
    "yaw_rad": ("yaw", "deg", 180.0 / math.pi),
}
_WINDOWS = 60  # moving means in the time that is shown
_SHORTEST_S = 0.2  # of these


class _Curve(NamedTuple):
    """The errors of one run by rising stamp; its time axis starts at `first_ns`, ticks are `step_ns` apart."""

    label: str
    look: Look
    first_ns: int
    step_ns: float
    stamps_ns: IntArray
    values: Mapping[str, FloatArray]


@styled
def errors(runs: Runs, object_id: int | None = None, **paper: Unpack[Paper]) -> Figure:
    """Moving RMS error in position, speed and yaw over time, a line for each run; in the legend the RMSE of all.

    The present states are solid or dashed, the final states of a smoother dotted. Each point is the root mean square
    over a sixtieth of the time shown. Lines are broken where nothing was tracked; quantities that the truth does not
    hold are left out. Without `object_id` the figure is of the only object, or all together.

    Raises `DataError` if no run has truth, or none of this object.
    """
    every = [one for one in evaluated(runs) if one.matching is not None]
    known = sorted({k for one in every if one.matching for k in one.matching.object_ids})
    if not known:
        raise DataError("no run has truth, so there are no errors to draw")
    if object_id is not None and object_id not in known:
        raise DataError(f"object {object_id}: no run has truth of it, there are {', '.join(map(str, known))}")
    wanted = known[0] if len(known) == 1 else object_id
    curves = _curves(every, wanted)
    names = [name for name in _QUANTITIES if any(np.isfinite(one.values[name]).any() for one in curves)]
    names = names or ["position_m"]
    longest_ns = max((float(np.ptp(one.stamps_ns)) for one in curves if len(one.stamps_ns)), default=0.0)
    window_s = max(longest_ns / NS_PER_S / _WINDOWS, _SHORTEST_S)
    sheet = Sheet(9.0, 1.5 + 2.0 * len(names), paper)
    rows = sheet.plots(len(names), sharex=True)[:, 0]
    for axes, name in zip(rows, names, strict=True):
        what, unit, factor = _QUANTITIES[name]
        for one in curves:
            _draw_moving(axes, one, factor * one.values[name], unit, nanoseconds(window_s), has_label=axes is rows[0])
        axes.set_ylabel(f"{what} error [{unit}]")
        axes.set_ylim(0.0, None)
        legend_above(axes)
    rows[-1].set_xlabel("time [s]")
    whose = "all objects" if wanted is None else f"object {wanted}"
    sheet.title(f"Errors of the tracks of {whose} (moving RMS over {window_s:.2g} s)")
    return sheet.figure


def _curves(runs: Sequence[EvaluatedRun], object_id: int | None) -> list[_Curve]:
    """Errors of the present states of every run, then of the final ones of those that have them."""
    styles = run_looks(runs)
    first_ns = {one.label: start_ns(group) for group in by_recording(runs) for one in group}
    known = [(one, one.matching) for one in runs if one.matching is not None]
    if object_id is not None:
        known = [(one, matching) for one, matching in known if object_id in matching.object_ids]
    every = [(one, matching, track_errors(matching), "") for one, matching in known]
    every += [(one, matching, final_errors(one.run, matching), ", final state") for one, matching in known]
    curves = []
    for one, matching, its_errors, more in every:
        rows = np.argsort(its_errors.stamps_ns, kind="stable")
        if object_id is not None:
            rows = rows[its_errors.object_index[rows] == matching.object_ids.index(object_id)]
        look = styles[one.label]._replace(line=":") if more else styles[one.label]
        if len(rows) or not more:
            values = {name: each[rows] for name, each in its_errors.values.items()}
            step_ns, stamps_ns = usual_step_ns(matching.tracks["now_ns"]), its_errors.stamps_ns[rows]
            curves.append(_Curve(one.label + more, look, first_ns[one.label], step_ns, stamps_ns, values))
    return curves


def _draw_moving(axes: Axes, one: _Curve, values: FloatArray, unit: str, window_ns: int, has_label: bool) -> None:
    moments = Moments.of(values)
    rmse = f"RMSE {moments.rmse:.3g} {unit}" if moments.count else "never tracked"
    stamps_ns, rms = moving_rms(one.stamps_ns, values, window_ns)
    points = broken_line(stamps_ns, (stamps_ns - one.first_ns) / NS_PER_S, rms, one.step_ns)
    label = f"{one.label}: {rmse}" if has_label else rmse
    above = 2.0 if one.look.line == "-" else 2.5  # a dashed line shows what it lies on
    axes.plot(*points, color=one.look.colour, ls=one.look.line, lw=1.4, label=label, zorder=above)


def moving_rms(stamps_ns: IntArray, values: FloatArray, window_ns: int) -> tuple[IntArray, FloatArray]:
    """Distinct stamps with a value, and the root mean square of the values within half a window around each."""
    known = np.isfinite(values)
    stamps_ns, below = stamps_ns[known], np.concatenate([[0.0], np.cumsum(np.square(values[known]))])
    distinct_ns = np.unique(stamps_ns)
    first = np.searchsorted(stamps_ns, distinct_ns - window_ns // 2, side="left")
    last = np.searchsorted(stamps_ns, distinct_ns + window_ns // 2, side="right")
    return distinct_ns, np.sqrt(np.maximum(below[last] - below[first], 0.0) / (last - first))


@styled
def lag(runs: Runs, **paper: Unpack[Paper]) -> Figure:
    """Position RMSE against the lag, a line for each run; level where a run has no lagged states.

    Of a track that ended there are no lagged states of its last moments, so the thin dotted line shows the present
    states of the same tracks at the same stamps: the distance between the two is the gain of waiting. Raises
    `DataError` if no run has tracks with truth.
    """
    every = evaluated(runs)
    if not any(entry.errors["position_m"].count for one in every for entry in one.metrics.lagged):
        raise DataError("no run has tracks with truth, so there are no errors to draw")
    sheet = Sheet(7.0, 4.2, paper)
    axes: Axes = sheet.plots()[0, 0]
    for one, its in zip(every, run_looks(every).values(), strict=True):
        curve = [entry for entry in one.metrics.lagged if entry.lag_s == 0.0 or entry.is_lagged]
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
        axes.plot([], [], color="black", ls=":", lw=0.8, label="present, at the same stamps")
    axes.set(xlabel="lag of the output [s]", ylabel="position RMSE [m]")
    axes.set_ylim(0.0, 1.08 * axes.dataLim.y1 or 1.0)
    legend_above(axes)
    sheet.title("Error against lag: what it gains to wait")
    return sheet.figure

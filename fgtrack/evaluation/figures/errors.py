"""Figures of errors against truth: over time, and against the lag."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.figures.style import (
    StyledFigure,
    broken_line,
    colour,
    legend_above,
    line_style,
    styled,
    usual_step_ns,
)
from fgtrack.evaluation.lagged import LagMetrics
from fgtrack.evaluation.matching import Matching, track_errors
from fgtrack.evaluation.runs import Runs, judged, start_ns
from fgtrack.evaluation.statistics import Moments

_QUANTITIES = {"position_m": "position error [m]", "speed_mps": "speed error [m/s]", "yaw_rad": "yaw error [rad]"}
_LAG_PANELS = {"position_m": "position RMSE [m]", "speed_mps": "speed RMSE [m/s]"}


@styled
def errors(runs: Runs, object_id: int | None = None) -> Figure:
    """Error in position, speed and yaw over time, a line for each run, with the RMSE in the legend.

    Lines are broken where nothing was tracked; quantities that the truth does not hold are left out.

    Parameters
    ----------
    runs
        One run or several.
    object_id
        The true object; without it the only one, or of several the root mean square over those tracked at a stamp.

    Raises
    ------
    DataError
        No run has truth, or none of this object.
    """
    every = judged(runs)
    first_ns = start_ns(every)
    matchings = {one.label: one.matching for one in every if one.matching is not None}
    known = sorted({k for one in matchings.values() for k in one.object_ids})
    if not known:
        raise DataError("no run has truth, so there are no errors to draw")
    if object_id is not None and object_id not in known:
        raise DataError(f"object {object_id}: no run has truth of it, there are {', '.join(map(str, known))}")
    wanted = known[0] if len(known) == 1 else object_id
    lines = {
        label: _errors_of(matching, wanted)
        for label, matching in matchings.items()
        if wanted is None or wanted in matching.object_ids
    }
    names = [name for name in _QUANTITIES if any(np.isfinite(values[name]).any() for _, values in lines.values())]
    names = names or ["position_m"]
    figure = StyledFigure(figsize=(10.0, 1.4 + 2.0 * len(names)))
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(rows, names, strict=True):
        for k, (label, (stamps_ns, values)) in enumerate(lines.items()):
            moments = Moments.of(values[name])
            unit = _QUANTITIES[name].rpartition("[")[2][:-1]
            rmse = f"RMSE {moments.rmse:.3g} {unit}" if moments.count else "never tracked"
            step_ns = usual_step_ns(matchings[label].tracks["now_ns"])
            line_ns, line = (stamps_ns, values[name]) if wanted is not None else _over_objects(stamps_ns, values[name])
            points = broken_line(line_ns, (line_ns - first_ns) / NS_PER_S, line, step_ns)
            axes.plot(*points, color=colour(k), ls=line_style(k), lw=0.9, alpha=0.85, label=f"{label}: {rmse}")
        axes.set_ylabel(_QUANTITIES[name])
        legend_above(axes, width=140)
    rows[-1].set_xlabel("time [s]")
    whose = "all objects (root mean square)" if wanted is None else f"object {wanted}"
    figure.suptitle(f"Errors of the tracks of {whose}")
    return figure


def _errors_of(matching: Matching, object_id: int | None) -> tuple[IntArray, Mapping[str, FloatArray]]:
    """Stamps and errors by name of the tracks of one object, or of all."""
    found = track_errors(matching)
    if object_id is None:
        return found.stamps_ns, found.values
    mine = found.object_index == matching.object_ids.index(object_id)
    return found.stamps_ns[mine], {name: values[mine] for name, values in found.values.items()}


def _over_objects(stamps_ns: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Distinct stamps and the root mean square of the values there; those without a value are left out."""
    known = np.isfinite(values)
    distinct_ns, index, counts = np.unique(stamps_ns[known], return_inverse=True, return_counts=True)
    return distinct_ns, np.sqrt(np.bincount(index, values[known] ** 2, len(distinct_ns)) / counts)


@styled
def lag(runs: Runs) -> Figure:
    """RMSE of position and speed against the lag, a line for each run; level where a run has no lagged states.

    Of a track that ended there are no lagged states of its last moments, so the dotted line beside shows the present
    states of the same tracks at the same stamps: the distance between the two is what waiting brings.

    Raises
    ------
    DataError
        No run has truth.
    """
    lagged = {one.label: one.lagged for one in judged(runs)}
    names = [name for name in _LAG_PANELS if any(entry.errors[name].count for one in lagged.values() for entry in one)]
    if not names:
        raise DataError("no run has tracks with truth, so there are no errors to draw")
    figure = StyledFigure(figsize=(8.0, 1.4 + 2.6 * len(names)))
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        for k, (label, entries) in enumerate(lagged.items()):
            _draw_lags(axes, entries, name, label, k)
        axes.set_ylabel(_LAG_PANELS[name])
        axes.set_ylim(0.0, 1.08 * axes.dataLim.y1 or 1.0)
    legend_above(panels[0], width=120)
    panels[-1].set_xlabel("lag [s] (how long the output waits)")
    figure.suptitle("Error against lag")
    return figure


def _draw_lags(axes: Axes, lagged: Sequence[LagMetrics], name: str, label: str, index: int) -> None:
    color = colour(index)
    curve = [lagged[0], *(entry for entry in lagged if entry.is_lagged)] if lagged else []
    if len(curve) > 1:
        lags_s = [float(entry.lag_s) for entry in curve]
        rmse = [entry.errors[name].rmse for entry in curve]
        axes.plot(lags_s, rmse, ls=line_style(index), lw=1.4, color=color, label=label)
        axes.plot(lags_s, rmse, "o", ms=3.5, color=color)
        present = [entry.present_errors[name].rmse for entry in curve]
        axes.plot(lags_s, present, ls=":", lw=1.2, color=color, label=f"{label}: present states, same stamps")
    elif curve:
        axes.axhline(curve[0].errors[name].rmse, ls="--", lw=1.4, color=color, label=f"{label}: present, has no lag")

"""Figures of errors against truth: over time, and against the lag."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.figures.ranges import bulk
from fgtrack.evaluation.figures.seeds import grouped
from fgtrack.evaluation.figures.style import (
    StyledFigure,
    broken_line,
    colour,
    legend_above,
    line_style,
    styled,
    title,
    usual_step_ns,
)
from fgtrack.evaluation.lagged import LagMetrics
from fgtrack.evaluation.matching import Matching, track_errors
from fgtrack.evaluation.runs import Runs, judged, starts_ns
from fgtrack.evaluation.statistics import Moments

_QUANTITIES = {"position_m": "position error [m]", "speed_mps": "speed error [m/s]", "yaw_rad": "yaw error [rad]"}
_LAG_PANELS = {"position_m": "position RMSE [m]", "speed_mps": "speed RMSE [m/s]"}
_COINCIDE = 0.25  # median distance of two curves, as a share of the median error, below which one hides the other
_SAME = 1e-6  # largest distance, as such a share, below which there is nothing to tell apart


class _Curve(NamedTuple):
    """The error of one run over time."""

    stamps_ns: IntArray
    values: FloatArray
    step_ns: float
    """Usual step between its ticks."""


@styled
def errors(runs: Runs, object_id: int | None = None) -> Figure:
    """Error in position, speed and yaw over time, a line for each run, with the RMSE in the legend.

    Lines are broken where nothing was tracked; quantities that the truth does not hold are left out. Where two lines
    nearly coincide, a panel below shows by how much the one error is larger than the other, in absolute value.

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
    first_ns = starts_ns(every)
    matchings = {one.label: one.matching for one in every if one.matching is not None}
    known = sorted({k for one in matchings.values() for k in one.object_ids})
    if not known:
        raise DataError("no run has truth, so there are no errors to draw")
    if object_id is not None and object_id not in known:
        raise DataError(f"object {object_id}: no run has truth of it, there are {', '.join(map(str, known))}")
    wanted = known[0] if len(known) == 1 else object_id
    found = {
        label: _errors_of(matching, wanted)
        for label, matching in matchings.items()
        if wanted is None or wanted in matching.object_ids
    }
    names = [name for name in _QUANTITIES if any(np.isfinite(values[name]).any() for _, values in found.values())]
    curves = {
        name: {label: _curve(*of, name, wanted is None, matchings[label]) for label, of in found.items()}
        for name in names or ["position_m"]
    }
    panels: list[tuple[str, bool]] = []
    for name, lines in curves.items():
        differ = any(not same for _, same in _hidden(lines).values())
        panels += [(name, False), (name, True)] if differ else [(name, False)]
    figure = StyledFigure(figsize=(10.0, 1.4 + 1.9 * len(panels)))
    rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, is_difference) in zip(rows, panels, strict=True):
        if is_difference:
            _draw_differences(axes, curves[name], first_ns)
            axes.set_ylabel(_QUANTITIES[name].replace("error", "error,\nlarger by"))
        else:
            _draw_errors(
                axes, curves[name], first_ns, name, {label: values[name] for label, (_, values) in found.items()}
            )
        legend_above(axes, figure.get_figwidth())
    rows[-1].set_xlabel("time [s]")
    whose = "all objects (root mean square)" if wanted is None else f"object {wanted}"
    title(figure, f"Errors of the tracks of {whose}")
    return figure


def _draw_errors(
    axes: Axes, lines: Mapping[str, _Curve], first_ns: Mapping[str, int], name: str, samples: Mapping[str, FloatArray]
) -> None:
    unit = _QUANTITIES[name].rpartition("[")[2][:-1]
    hidden, labels = _hidden(lines), list(lines)
    for k, (label, curve) in enumerate(lines.items()):
        moments = Moments.of(samples[label])
        rmse = f"RMSE {moments.rmse:.3g} {unit}" if moments.count else "never tracked"
        other, is_same = hidden.get(k, (0, False))
        rmse += f", same as {labels[other]}" if is_same else ""
        points = broken_line(
            curve.stamps_ns, (curve.stamps_ns - first_ns[label]) / NS_PER_S, curve.values, curve.step_ns
        )
        axes.plot(*points, color=colour(k), ls=line_style(k), lw=0.9, alpha=0.85, label=f"{label}: {rmse}")
    axes.set_ylabel(_QUANTITIES[name])


def _draw_differences(axes: Axes, lines: Mapping[str, _Curve], first_ns: Mapping[str, int]) -> None:
    """How much larger the errors are than those of the curve that nearly coincides, at the stamps of both."""
    curves = list(lines.items())
    pairs = [(k, other) for k, (other, is_same) in _hidden(lines).items() if not is_same]
    common = [_common(curves[k][1], curves[other][1]) for k, other in pairs]
    differences = [np.abs(mine) - np.abs(its) for _, mine, its in common]
    low, high = bulk(differences)
    low, high = min(low, -0.1 * high), max(high, -0.1 * low)
    for (k, other), (stamps_ns, *_), more in zip(pairs, common, differences, strict=True):
        label, curve = curves[k]
        outside = int(((more < low) | (more > high)).sum())
        text = f"{label} minus {curves[other][0]}" + (f" ({outside} outside)" if outside else "")
        points = broken_line(stamps_ns, (stamps_ns - first_ns[label]) / NS_PER_S, more, curve.step_ns)
        axes.plot(*points, color=colour(k), ls=line_style(k), lw=0.9, label=text)
    axes.set_ylim(low, high)
    axes.yaxis.set_major_formatter("{x:g}")  # an offset would hide the legend


def _common(curve: _Curve, other: _Curve) -> tuple[IntArray, FloatArray, FloatArray]:
    """Common stamps of two curves, and the values of both there."""
    stamps_ns, mine, its = np.intersect1d(curve.stamps_ns, other.stamps_ns, return_indices=True)
    return stamps_ns, curve.values[mine], other.values[its]


def _hidden(lines: Mapping[str, _Curve]) -> dict[int, tuple[int, bool]]:
    """Places of the curves that nearly coincide with one before, each with the place of the nearest of those.

    And whether the two are the same.
    """
    found: dict[int, tuple[int, bool]] = {}
    curves = list(lines.values())
    for k, curve in enumerate(curves):
        apart = [_apart(curve, other) for other in curves[:k]]
        if min(apart, default=(np.inf, np.inf))[0] < _COINCIDE:
            nearest = min(range(k), key=lambda place: apart[place])
            found[k] = nearest, apart[nearest][1] < _SAME
    return found


def _apart(curve: _Curve, other: _Curve) -> tuple[float, float]:
    """Median and largest distance of two curves over the median size of the other; infinite without a common stamp."""
    _, mine, its = _common(curve, other)
    known = np.isfinite(mine) & np.isfinite(its)
    if not known.any():
        return np.inf, np.inf
    distances, size = np.abs(mine - its)[known], float(np.median(np.abs(its[known])))
    if size == 0.0:
        return (0.0, 0.0) if not distances.any() else (np.inf, np.inf)
    return float(np.median(distances)) / size, float(distances.max()) / size


def _curve(
    stamps_ns: IntArray, values: Mapping[str, FloatArray], name: str, is_mean: bool, matching: Matching
) -> _Curve:
    """The error `name`; its root mean square over all objects where `is_mean`."""
    line = _over_objects(stamps_ns, values[name]) if is_mean else (stamps_ns, values[name])
    return _Curve(*line, usual_step_ns(matching.tracks["now_ns"]))


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
    states of the same tracks at the same stamps: the distance between the two is what waiting brings. Runs that differ
    by their seed only have a common colour.

    Raises
    ------
    DataError
        No run has truth.
    """
    groups = grouped(judged(runs))
    every = [one for group in groups for one in group.runs]
    names = [name for name in _LAG_PANELS if any(entry.errors[name].count for one in every for entry in one.lagged)]
    if not names:
        raise DataError("no run has tracks with truth, so there are no errors to draw")
    figure = StyledFigure(figsize=(8.0, 1.4 + 2.6 * len(names)))
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        for k, group in enumerate(groups):
            for place, one in enumerate(group.runs):
                width = 1.4 if len(group.runs) == 1 else 0.8
                _draw_lags(axes, one.lagged, name, "" if place else group.label, k, width)
        axes.set_ylabel(_LAG_PANELS[name])
        axes.set_ylim(0.0, 1.08 * axes.dataLim.y1 or 1.0)
    legend_above(panels[0], figure.get_figwidth())
    panels[-1].set_xlabel("lag [s] (how long the output waits)")
    title(figure, "Error against lag")
    return figure


def _draw_lags(axes: Axes, lagged: Sequence[LagMetrics], name: str, label: str, index: int, width: float) -> None:
    color = colour(index)

    def named(what: str) -> str:
        return f"{label}{what}" if label else ""

    curve = [lagged[0], *(entry for entry in lagged if entry.is_lagged)] if lagged else []
    if len(curve) > 1:
        lags_s = [float(entry.lag_s) for entry in curve]
        rmse = [entry.errors[name].rmse for entry in curve]
        axes.plot(lags_s, rmse, ls=line_style(index), lw=width, color=color, label=label)
        axes.plot(lags_s, rmse, "o", ms=3.5, color=color)
        present = [entry.present_errors[name].rmse for entry in curve]
        axes.plot(lags_s, present, ls=":", lw=width, color=color, label=named(": present states, same stamps"))
    elif curve:
        axes.axhline(curve[0].errors[name].rmse, ls="--", lw=width, color=color, label=named(": present, has no lag"))

"""The figure of NEES and NIS over time, with their chi-square bands."""

from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.runs import JudgedRun, OneRun, one_judged, start_ns
from fgtrack.evaluation.scores.consistency import position_nees
from fgtrack.evaluation.scores.innovations import num_measured
from fgtrack.evaluation.scores.statistics import chi_square_band
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.style import (
    GREY,
    broken_line,
    legend_above,
    log_axis,
    run_looks,
    sensor_colour,
    titled,
    usual_step_ns,
)

_WINDOWS = 40  # of a run, so many values does each mean of NIS hold
_SHORTEST, _LONGEST = 5, 100
_LOWEST = 0.02  # of the axis, as a share of the expected value


@styled
def consistency(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """NEES of the position, averaged over the objects of a tick, and NIS by sensor, each in its 95 % band.

    A consistent estimator is inside of the band at 95 % of the ticks, and around the expected value; above it the
    covariance is too small, below it too large. A dot is the NIS of a detection, the line the mean of several in a row
    and the band that of this mean.

    Raises
    ------
    DataError
        The run has neither truth of its tracks nor innovations.
    """
    one = one_judged(run)
    panels = _panels(one)
    if not panels:
        raise DataError(f"{one.label}: has no errors and no innovations, so there is no consistency to draw")
    sheet = Sheet(10.0, 1.0 + 2.1 * len(panels), paper)
    rows = sheet.plots(len(panels), sharex=True)[:, 0]
    sensors = np.unique(one.run.tables["updates"]["sensor"]).tolist()
    first_ns = start_ns([one])
    for place, (axes, (name, (stamps_ns, values, dof))) in enumerate(zip(rows, panels.items(), strict=True)):
        time_s = (stamps_ns - first_ns) / NS_PER_S
        if name == _NEES:
            _draw_nees(axes, stamps_ns, time_s, values, dof, run_looks([one])[one.label].colour)
        else:
            color = sensor_colour(sensors.index(name.removeprefix("NIS of ")))
            _draw_nis(axes, time_s, values, dof, color, name)
        axes.set_ylabel(name.replace(" of ", " of\n").replace("_", " "))
        if not place:
            axes.fill_between([], [], color=GREY, alpha=0.25, lw=0, label="95 % band")
            axes.plot([], color="black", lw=0.9, ls="--", label="expected")
        legend_above(axes)
    rows[-1].set_xlabel("time [s]")
    sheet.title(titled(one.label, "consistency: normalised squares of errors and innovations, with their 95 % bands"))
    return sheet.figure


_NEES = "NEES of the position"
_Squares = tuple[IntArray, FloatArray, IntArray]  # stamps, values, degrees of freedom; of shape (n,) each


def _panels(one: JudgedRun) -> dict[str, _Squares]:
    """What there is to show, by name."""
    found: dict[str, _Squares] = {}
    if one.matching is not None:
        nees = position_nees(one.matching)
        known = np.isfinite(nees.values)
        if known.any():
            found[_NEES] = nees.stamps_ns[known], nees.values[known], nees.dof[known]
    updates = one.run.tables["updates"]
    measured = num_measured(updates)
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = (updates["sensor"] == sensor) & np.isfinite(updates["nis"]) & (measured > 0)
        if mine.any():
            found[f"NIS of {sensor}"] = updates["receipt_ns"][mine], updates["nis"][mine], measured[mine]
    return found


def has_squares(one: JudgedRun) -> bool:
    """Whether `consistency` has anything to show."""
    return bool(_panels(one))


def _draw_nees(
    axes: Axes, stamps_ns: IntArray, time_s: FloatArray, values: FloatArray, dof: IntArray, color: str
) -> None:
    """The mean over the objects of each stamp."""
    distinct_ns, first, index, count = np.unique(stamps_ns, return_index=True, return_inverse=True, return_counts=True)
    mean = np.bincount(index, values) / count
    total_dof = np.bincount(index, dof).astype(np.float64)
    low, high = chi_square_band(total_dof, count)
    text = _said("position", values, dof, float(((mean >= low) & (mean <= high)).mean()), "ticks")
    _draw(axes, distinct_ns, time_s[first], mean, (low, high), total_dof / count, color, text, 0.9)


def _draw_nis(axes: Axes, time_s: FloatArray, values: FloatArray, dof: IntArray, color: str, name: str) -> None:
    """Every value, and the mean of several in a row."""
    sensor = name.removeprefix("NIS of ")
    low, high = chi_square_band(dof.astype(np.float64), np.ones(len(dof), dtype=np.int64))
    inside = float(((values >= low) & (values <= high)).mean())
    length = min(max(_SHORTEST, min(_LONGEST, len(values) // _WINDOWS)), len(values))
    order = np.argsort(time_s, kind="stable")
    total, total_dof, late_s = (_sums(of[order].astype(np.float64), length) for of in (values, dof, time_s))
    middle_s, count = late_s / length, np.full(len(total), length)
    axes.plot(time_s, values, ".", ms=3.0, mew=0, color=color, alpha=0.5, rasterized=True)
    band = chi_square_band(total_dof, count)
    text = _said(sensor, values, dof, inside, "detections") + f"; line: mean of {length}"
    middle_ns = (NS_PER_S * middle_s).astype(np.int64)
    _draw(axes, middle_ns, middle_s, total / length, band, total_dof / length, color, text, 1.3)
    bottom, top = axes.get_ylim()
    shown = values[values > 0.0]  # the axis is logarithmic
    if len(shown):
        axes.set_ylim(min(bottom, float(np.quantile(shown, 0.05))), max(top, float(np.quantile(shown, 0.99))))


def _draw(
    axes: Axes,
    stamps_ns: IntArray,
    time_s: FloatArray,
    mean: FloatArray,
    band: tuple[FloatArray, FloatArray],
    expected: FloatArray,
    color: str,
    text: str,
    width: float,
) -> None:
    step_ns = usual_step_ns(stamps_ns)
    low, high = (broken_line(stamps_ns, time_s, edge, step_ns)[1] for edge in band)
    x_s, y = broken_line(stamps_ns, time_s, mean, step_ns)
    axes.fill_between(x_s, low, high, color=GREY, alpha=0.25, lw=0)
    axes.plot(x_s, y, color=color, lw=width, label=text)
    axes.plot(*broken_line(stamps_ns, time_s, expected, step_ns), color="black", lw=0.9, ls="--")
    axes.set_yscale("log")
    shown = np.concatenate([mean[mean > 0.0], *band])
    middle = float(np.median(expected))
    axes.set_ylim(max(_LOWEST * middle, 0.8 * float(shown.min())), 1.25 * float(shown.max()))
    log_axis(axes.yaxis)


def _sums(values: FloatArray, length: int) -> FloatArray:
    """Sums of `length` values in a row, shape (n - length + 1,)."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(total[length:] - total[:-length])


def _said(what: str, values: FloatArray, dof: IntArray, inside: float, of: str) -> str:
    return (
        f"{what}: mean {values.mean():.3g}, expected {dof.mean():.3g}; {100.0 * inside:.0f} % of the {of} in their band"
    )

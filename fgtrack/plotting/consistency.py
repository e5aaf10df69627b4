"""The figure of NEES and NIS over time, with their chi-square bands."""

from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.evaluation.palette import SENSORS
from fgtrack.evaluation.runs import EvaluatedRun, OneRun, one_evaluated, start_ns
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
    and the band that of this mean. Raises `DataError` if the run has neither truth of its tracks nor innovations.
    """
    one = one_evaluated(run)
    panels = _panels(one)
    if not panels:
        raise DataError(f"{one.label}: has no errors and no innovations, so there is no consistency to draw")
    sheet = Sheet(10.0, 1.0 + 2.1 * len(panels), paper)
    rows = sheet.plots(len(panels), sharex=True)[:, 0]
    sensors = np.unique(one.run.tables["updates"]["sensor"]).tolist()
    first_ns = start_ns([one])
    for axes, (name, (stamps_ns, values, dof)) in zip(rows, panels.items(), strict=True):
        since_ns = stamps_ns - first_ns
        if name == _NEES:
            at_ns, index, count = np.unique(since_ns, return_inverse=True, return_counts=True)
            mean, mean_dof = (np.bincount(index, each) / count for each in (values, dof))
            band = chi_square_band(mean_dof * count, count)
            colour = run_looks([one])[one.label].colour
            text = _summary("position", values, dof, (mean >= band[0]) & (mean <= band[1]), "ticks")
        else:
            sensor = name.removeprefix("NIS of ")
            colour = SENSORS[sensors.index(sensor) % len(SENSORS)]
            low, high = chi_square_band(dof.astype(np.float64), np.ones(len(dof), dtype=np.int64))
            length = min(max(_SHORTEST, min(_LONGEST, len(values) // _WINDOWS)), len(values))
            text = _summary(sensor, values, dof, (values >= low) & (values <= high), "detections")
            text += f"; line: mean of {length}"
            order = np.argsort(since_ns, kind="stable")
            middle_ns, mean, mean_dof = (_means(each[order], length) for each in (since_ns, values, dof))
            at_ns, band = middle_ns.astype(np.int64), chi_square_band(mean_dof * length, np.full(len(mean), length))
            axes.plot(since_ns / NS_PER_S, values, ".", ms=3.0, mew=0, color=colour, alpha=0.5, rasterized=True)
        _draw(axes, at_ns, mean, band, mean_dof, colour, text)
        shown = values[values > 0.0]  # the axis is logarithmic
        if name != _NEES and len(shown):
            bottom, top = axes.get_ylim()
            axes.set_ylim(min(bottom, np.quantile(shown, 0.05)), max(top, np.quantile(shown, 0.99)))
        axes.set_ylabel(name.replace(" of ", " of\n").replace("_", " "))
        if axes is rows[0]:
            axes.fill_between([], [], color=GREY, alpha=0.25, lw=0, label="95 % band")
            axes.plot([], color="black", lw=0.9, ls="--", label="expected")
        legend_above(axes)
    rows[-1].set_xlabel("time [s]")
    sheet.title(f"{one.label}: consistency: normalised squares of errors and innovations, with their 95 % bands")
    return sheet.figure


_NEES = "NEES of the position"
_Squares = tuple[IntArray, FloatArray, IntArray]  # stamps, values, degrees of freedom; of shape (n,) each


def _panels(one: EvaluatedRun) -> dict[str, _Squares]:
    """Stamps, normalised squares and degrees of freedom to show, by name of the panel."""
    result: dict[str, _Squares] = {}
    if one.matching is not None:
        values, stamps_ns = position_nees(one.matching), one.matching.tracks["stamp_ns"][one.matching.paired]
        known = np.isfinite(values)
        if known.any():
            result[_NEES] = stamps_ns[known], values[known], np.full(known.sum(), 2)
    updates = one.run.tables["updates"]
    measured = num_measured(updates)
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = (updates["sensor"] == sensor) & np.isfinite(updates["nis"]) & (measured > 0)
        if mine.any():
            result[f"NIS of {sensor}"] = updates["receipt_ns"][mine], updates["nis"][mine], measured[mine]
    return result


def has_squares(one: EvaluatedRun) -> bool:
    """True if `consistency` has anything to show."""
    return bool(_panels(one))


def _draw(
    axes: Axes,
    since_ns: IntArray,
    mean: FloatArray,
    band: tuple[FloatArray, FloatArray],
    expected: FloatArray,
    colour: str,
    text: str,
) -> None:
    step_ns, time_s = usual_step_ns(since_ns), since_ns / NS_PER_S
    x_s, y = broken_line(since_ns, time_s, mean, step_ns)
    low, high, middle = (broken_line(since_ns, time_s, each, step_ns)[1] for each in (*band, expected))
    axes.fill_between(x_s, low, high, color=GREY, alpha=0.25, lw=0)
    axes.plot(x_s, y, color=colour, lw=1.1, label=text)
    axes.plot(x_s, middle, color="black", lw=0.9, ls="--")
    axes.set_yscale("log")
    shown = np.concatenate([mean[mean > 0.0], *band])
    lowest = max(_LOWEST * float(np.median(expected)), 0.8 * float(shown.min()))
    axes.set_ylim(lowest, 1.25 * float(shown.max()))
    log_axis(axes.yaxis)


def _means(values: FloatArray | IntArray, length: int) -> FloatArray:
    """Means of `length` values in a row, shape (n - length + 1,)."""
    total = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    return np.asarray((total[length:] - total[:-length]) / length)


def _summary(name: str, values: FloatArray, dof: IntArray, inside: BoolArray, of: str) -> str:
    share = 100.0 * float(inside.mean())
    return f"{name}: mean {values.mean():.3g}, expected {dof.mean():.3g}; {share:.0f} % of the {of} in their band"

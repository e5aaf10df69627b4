"""Figure of NEES and NIS over time, with their chi-square bands."""

from typing import Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import position_nees
from fgtrack.evaluation.runs import EvaluatedRun, OneRun, one_evaluated, start_ns
from fgtrack.evaluation.scores.innovations import num_measured
from fgtrack.evaluation.scores.statistics import chi_square_band
from fgtrack.show.figures.bands import BAND_NOTE, MOST_DOTS, draw_values, thinned
from fgtrack.show.figures.paper import Paper, Sheet, styled
from fgtrack.show.figures.style import (
    GREY,
    broken_line,
    legend_above,
    log_axis,
    run_styles,
    usual_step_ns,
)
from fgtrack.show.palette import SENSORS

# Number of moving means in a run, and the least and largest number of NIS values in each.
_WINDOWS = 40
_SHORTEST = 5
_LONGEST = 100
# Lower end of the axis, as a share of the expected value: of the mean, and of single values, some of which are near 0.
_LOWEST = 0.02
_LOWEST_SINGLE = 1e-3
# The axis reaches at least this multiple of the expected value.
_HIGHEST = 4.0


@styled
def consistency(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Position NEES, averaged over the objects of a tick, and NIS by sensor, each with its 95 % band.

    A consistent estimator is inside the band at 95 % of the ticks, around the expected
    value. Above the band the covariance is too small, below it too large. A dot is the
    NIS of a detection. The line is the mean of several successive values, with the band
    of this mean. Raises `DataError` if the run has neither errors against truth nor
    innovations.
    """
    one = one_evaluated(run)
    panels = _panels(one)
    if not panels:
        raise DataError(
            f"{one.label}: no errors against truth and no innovations, so there is no consistency to draw"
        )
    sheet = Sheet(10.0, 1.0 + 2.1 * len(panels), paper)
    rows = sheet.plots(len(panels), sharex=True)[:, 0]
    sensors = np.unique(one.run.tables["updates"]["sensor"]).tolist()
    first_ns = start_ns([one])
    for axes, (name, (stamps_ns, values, dof)) in zip(
        rows, panels.items(), strict=True
    ):
        since_ns = stamps_ns - first_ns
        if name == _NEES:
            at_ns, index, count = np.unique(
                since_ns, return_inverse=True, return_counts=True
            )
            mean, expected = (
                np.bincount(index, each) / count for each in (values, dof)
            )
            band = chi_square_band(expected * count, count)
            colour = run_styles([one])[one.label].colour
            inside = (mean >= band[0]) & (mean <= band[1])
            subject = "position"
            unit = "ticks"
            line = ""
        else:
            sensor = name.removeprefix("NIS of ")
            colour = SENSORS[sensors.index(sensor) % len(SENSORS)]
            low, high = chi_square_band(
                dof.astype(np.float64), np.ones(len(dof), dtype=np.int64)
            )
            inside = (values >= low) & (values <= high)
            length = min(
                max(_SHORTEST, min(_LONGEST, len(values) // _WINDOWS)), len(values)
            )
            subject = sensor
            unit = "detections"
            line = f"; line: mean of {length}"
            order = np.argsort(since_ns, kind="stable")
            share = np.full(length, 1.0 / length)
            at_ns, mean, expected = (
                np.convolve(each[order], share, "valid")
                for each in (since_ns, values, dof)
            )
            at_ns = at_ns.astype(np.int64)
            band = chi_square_band(expected * length, np.full(len(mean), length))
            draw_values(axes, since_ns / NS_PER_S, values, colour)
        is_dense = name == _NEES and len(at_ns) > MOST_DOTS
        if is_dense:
            draw_values(axes, at_ns / NS_PER_S, mean, colour)
            line = f"; {BAND_NOTE}"
        few = thinned(len(at_ns))
        at_ns, band = at_ns[few], (band[0][few], band[1][few])
        mean, expected = mean[few], expected[few]
        step_ns = usual_step_ns(at_ns)
        time_s = at_ns / NS_PER_S
        x_s, y = broken_line(at_ns, time_s, mean, step_ns)
        low, high, middle = (
            broken_line(at_ns, time_s, each, step_ns)[1] for each in (*band, expected)
        )
        axes.fill_between(x_s, low, high, color=GREY, alpha=0.25, lw=0)
        share_inside = f"{100.0 * inside.mean():.0f} % of the {unit} in their band"
        label = f"{subject}: mean {values.mean():.3g}, expected {dof.mean():.3g}; {share_inside}{line}"
        axes.plot(
            *((x_s, y) if not is_dense else ([], [])), color=colour, lw=1.1, label=label
        )
        axes.plot(x_s, middle, color="black", lw=0.9, ls="--")
        # The axis is logarithmic, so only positive values count.
        positive = values[values > 0.0]
        shown = np.concatenate([mean[mean > 0.0], *band])
        limits = [
            max(_LOWEST * float(np.median(expected)), 0.8 * float(shown.min())),
            1.25 * float(shown.max()),
        ]
        if name != _NEES and len(positive):
            usual = float(np.median(expected))
            first, last = np.quantile(positive, (0.05, 0.99)).tolist()
            limits = [
                min(limits[0], max(first, _LOWEST_SINGLE * usual)),
                max(limits[1], last, _HIGHEST * usual),
            ]
        axes.set(
            yscale="log",
            ylim=limits,
            ylabel=name.replace(" of ", " of\n").replace("_", " "),
        )
        log_axis(axes.yaxis)
        if axes is rows[0]:
            axes.fill_between([], [], color=GREY, alpha=0.25, lw=0, label="95 % band")
            axes.plot([], color="black", lw=0.9, ls="--", label="expected")
        legend_above(axes)
    rows[-1].set_xlabel("time [s]")
    sheet.title(
        f"{one.label}: consistency of errors (NEES) and innovations (NIS), with 95 % bands"
    )
    return sheet.figure


_NEES = "NEES of the position"
#: Stamps, normalised squares and degrees of freedom, shape (n,) each.
_Squares = tuple[IntArray, FloatArray, IntArray]


def _panels(one: EvaluatedRun) -> dict[str, _Squares]:
    """Return stamps, normalised squares and degrees of freedom by name of the panel."""
    result: dict[str, _Squares] = {}
    if one.matching is not None:
        values = position_nees(one.matching)
        stamps_ns = one.matching.tracks["stamp_ns"][one.matching.paired]
        known = np.isfinite(values)
        if known.any():
            result[_NEES] = stamps_ns[known], values[known], np.full(known.sum(), 2)
    updates = one.run.tables["updates"]
    measured = num_measured(updates)
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = (
            (updates["sensor"] == sensor) & np.isfinite(updates["nis"]) & (measured > 0)
        )
        if mine.any():
            result[f"NIS of {sensor}"] = (
                updates["receipt_ns"][mine],
                updates["nis"][mine],
                measured[mine],
            )
    return result


def has_squares(one: EvaluatedRun) -> bool:
    """True if `consistency` can be drawn."""
    return bool(_panels(one))

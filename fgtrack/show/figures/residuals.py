"""Figure of the innovations."""

from itertools import cycle
from typing import Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.runs import OneRun, one_evaluated, start_ns
from fgtrack.evaluation.scores import innovations
from fgtrack.evaluation.scores.innovations import RESIDUAL_NAMES
from fgtrack.show.figures.bands import draw_values
from fgtrack.show.figures.paper import Paper, Sheet, styled
from fgtrack.show.figures.style import bulk, legend_above
from fgtrack.show.palette import SENSORS

_RESIDUALS = {
    "along_m": "along track [m]",
    "across_m": "across track [m]",
    "x_m": "x [m]",
    "y_m": "y [m]",
    "yaw_rad": "yaw [rad]",
    "speed_mps": "speed [m/s]",
    "range_m": "range [m]",
    "bearing_rad": "bearing [rad]",
    "range_rate_mps": "range rate [m/s]",
}
_DENSITIES = {"m": "1/m", "rad": "1/rad", "mps": "s/m"}


@styled
def residuals(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Innovations by sensor, a row for each component: over time, and their distribution.

    Axes and bins cover most of every sensor's innovations. The legend counts those
    outside. Raises `DataError` if the run has no innovations.
    """
    one = one_evaluated(run)
    values = innovations.residuals(one.run)
    updates = one.run.tables["updates"]
    time_s = (updates["stamp_ns"] - start_ns([one])) / NS_PER_S
    sensors = np.unique(updates["sensor"]).tolist()
    names = [name for name in RESIDUAL_NAMES if np.isfinite(values[name]).any()]
    if "along_m" in names:
        names = [name for name in names if name not in ("x_m", "y_m")]
    if not names:
        raise DataError(
            f"{one.label}: no innovations, so there are no residuals to draw"
        )
    sheet = Sheet(10.0, 0.8 + 2.4 * len(names), paper)
    rows = sheet.plots(len(names), 2, widths=(2, 1))
    for (over_time, histogram), name in zip(rows, names, strict=True):
        known = {
            sensor: np.isfinite(values[name]) & (updates["sensor"] == sensor)
            for sensor in sensors
        }
        low, high = bulk([values[name][mine] for mine in known.values()])
        bins = np.linspace(low, high, 41)
        for (sensor, mine), colour in zip(known.items(), cycle(SENSORS), strict=False):
            sample = values[name][mine]
            if not len(sample):
                continue
            moments = innovations.moments_of(name, sample)
            outside = int(((sample < low) | (sample > high)).sum())
            mean = round(moments.mean, 3) + 0.0  # no negative zero
            ending = f" ({outside} outside)" if outside else ""
            label = f"{sensor}: mean {mean:.3f}, std {moments.std:.3f}, n {moments.count}{ending}"
            draw_values(over_time, time_s[mine], sample, colour, label)
            density = np.histogram(sample, bins)[0] / (len(sample) * np.diff(bins))
            histogram.stairs(
                density, bins, orientation="horizontal", color=colour, lw=1.4
            )
        over_time.set(
            ylim=(low, high),
            ylabel=_RESIDUALS[name],
            xlabel="time [s]" if name == names[-1] else "",
        )
        histogram.set(
            ylim=(low, high), xlabel=f"density [{_DENSITIES[name.rpartition('_')[2]]}]"
        )
        histogram.tick_params(labelleft=False)
        over_time.sharex(rows[0][0])
        over_time.tick_params(labelbottom=name == names[-1])
        legend_above(over_time, 2.0 / 3.0, markerscale=3.0)
    sheet.title(f"{one.label}: innovations (measured minus predicted)")
    return sheet.figure

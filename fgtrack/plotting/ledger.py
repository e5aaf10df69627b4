"""The figure of the ledger: the error of the present, and what is left without each of its causes."""

import itertools
import math
from collections.abc import Sequence
from typing import Unpack

from matplotlib.figure import Figure

from fgtrack.evaluation.palette import SENSORS
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.style import GREY

_HEIGHT = 0.72


@styled
def waterfall(parts: Sequence[tuple[str, float]], title: str, **paper: Unpack[Paper]) -> Figure:
    """Bars from the error of the present down to what is left without its causes.
    `parts` are causes and the mean square, in m^2, that is left without each and all before it; the first is the error.
    """
    sheet = Sheet(9.0, 1.2 + 0.42 * (len(parts) + 1), paper)
    axes = sheet.plots(1)[0, 0]
    ends = [end for _, end in parts]
    names = ["error now", *(cause for cause, _ in parts[1:]), "nobody late"]
    steps = [(after, before - after, "") for before, after in itertools.pairwise(ends)]
    bars = [(0.0, ends[0], GREY), *steps, (0.0, ends[-1], GREY)]
    for row, (start, length, colour) in enumerate(bars):
        own = colour or (SENSORS[0] if length > 0.0 else SENSORS[1])
        axes.barh(row, length, left=start, height=_HEIGHT, color=own)
        rms = math.sqrt(start + length) if colour else math.sqrt(max(start, 0.0))
        label = f"{rms:.2f} m" if colour else f"{100.0 * length / ends[0] + 0.0:.0f} % of it; without: {rms:.2f} m"
        axes.text(max(start, start + length) + 0.01 * max(ends), row, label, va="center")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlim(0.0, 1.35 * max(ends))
    axes.set_xlabel("mean square error of the position [m²]")
    axes.set_title(title)
    return sheet.figure

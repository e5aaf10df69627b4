"""Figure of the ledger: the present error, and its rest without each of its causes."""

import itertools
import math
from collections.abc import Sequence
from typing import Unpack

from matplotlib.figure import Figure

from fgtrack.show.figures.paper import Paper, Sheet, styled
from fgtrack.show.figures.style import GREY
from fgtrack.show.palette import SENSORS

_HEIGHT = 0.72


@styled
def waterfall(
    parts: Sequence[tuple[str, float]], title: str, **paper: Unpack[Paper]
) -> Figure:
    """Bars from the present error down to the rest without its causes.

    `parts` are causes with the mean square [m^2] that remains without this cause and
    all causes before it. The first entry is the whole error.
    """
    sheet = Sheet(9.0, 1.2 + 0.42 * (len(parts) + 1), paper)
    axes = sheet.plots(1)[0, 0]
    ends = [end for _, end in parts]
    names = ["error now", *(cause for cause, _ in parts[1:]), "without delays"]
    steps = [*itertools.pairwise(ends), (ends[-1], 0.0)]
    for row, (before, after) in enumerate([(ends[0], 0.0), *steps]):
        is_end = row in (0, len(steps))
        root = f"{math.sqrt(before):.2f} m"
        colour = GREY if is_end else SENSORS[0] if before > after else SENSORS[1]
        axes.barh(row, before - after, left=after, height=_HEIGHT, color=colour)
        label = (
            root
            if is_end
            else f"{round(100.0 * (before - after) / ends[0])} %: {root} to {math.sqrt(after):.2f} m"
        )
        axes.text(max(before, after) + 0.01 * max(ends), row, label, va="center")
        if row:  # connect with the bar above
            axes.plot(
                [before, before],
                [row - 1.0 + _HEIGHT / 2, row - _HEIGHT / 2],
                color=GREY,
                linewidth=0.8,
            )
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlim(0.0, 1.45 * max(ends))
    axes.set_xlabel("mean square of the position error [m²] (in the labels: its root)")
    axes.set_title(title)
    return sheet.figure

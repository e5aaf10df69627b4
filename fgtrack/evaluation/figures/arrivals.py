"""The figure of arrivals: what was sensed when, received when, and what became of it."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import BoolArray, IntArray
from fgtrack.evaluation.figures.style import GREY, PALETTE, StyledFigure, legend_above, styled, titled
from fgtrack.evaluation.runs import OneRun, one_judged, start_ns
from fgtrack.io.run import Table
from fgtrack.io.run.reader import Column

_COLOURS = {
    "not used": GREY,
    "merged": PALETTE[4],
    "fused in sequence": PALETTE[2],
    "fused out of sequence": PALETTE[1],
    "fused beyond the window": PALETTE[3],
    "started a track": PALETTE[0],
}
#: What became of a detection, by disposition; every other one is `not used`.
_FATES: Mapping[str, str] = {
    "merged": "merged",
    "in_sequence": "fused in sequence",
    "out_of_sequence": "fused out of sequence",
    "beyond_window": "fused beyond the window",
    "birth": "started a track",
}
_SHOWN_S = 1.0  # of the run in the upper panel


@styled
def arrivals(run: OneRun) -> Figure:
    """Above a second of the run, a line for each detection from sensing to receipt; below the delays of all.

    A line that crosses another was overtaken: it is out of sequence. The second shown is the one in which the most
    detections were fused out of sequence. Colours say what became of a detection.

    Raises
    ------
    DataError
        The run has no detections.
    """
    one = one_judged(run)
    updates = one.run.updates
    if not updates.num_rows:
        raise DataError(f"{one.label}: has no detections, so there are no arrivals to draw")
    figure = StyledFigure(figsize=(10.0, 6.5))
    flow, delays = figure.subplots(2, 1, height_ratios=(3, 2))
    first_ns = start_ns([one])
    fates = _fates(updates)
    _draw_flow(flow, updates, fates, first_ns)
    delay_ms = (updates["receipt_ns"] - updates["stamp_ns"]) / (NS_PER_S / 1e3)
    received_s = (updates["receipt_ns"] - first_ns) / NS_PER_S
    for name, color in _COLOURS.items():
        mine = fates == name
        if mine.any():
            delays.plot(received_s[mine], delay_ms[mine], ".", ms=4.0, mew=0, alpha=0.8, color=color)
            flow.plot([], [], ".", color=color, label=f"{name}: {mine.sum()} of {len(mine)}")
    delays.set(xlabel="received at [s]", ylabel="delay [ms]")
    delays.set_ylim(min(0.0, float(delay_ms.min())), None)
    legend_above(flow, width=140)
    figure.suptitle(titled(one.label, "detections from sensing to receipt"))
    return figure


def _draw_flow(axes: Axes, updates: Table, fates: Column, first_ns: int) -> None:
    """A line for each detection of the busiest second, a pair of levels for each sensor."""
    start_ns = _busiest_ns(updates["receipt_ns"], fates == "fused out of sequence")
    inside = (updates["receipt_ns"] >= start_ns) & (updates["stamp_ns"] <= start_ns + nanoseconds(_SHOWN_S))
    sensors = np.unique(updates["sensor"][inside]).tolist()
    for name, color in _COLOURS.items():
        for level, sensor in enumerate(sensors):
            mine = inside & (fates == name) & (updates["sensor"] == sensor)
            sensed_s, received_s = ((updates[key][mine] - first_ns) / NS_PER_S for key in ("stamp_ns", "receipt_ns"))
            tops = np.stack([sensed_s, np.full(len(sensed_s), level + 0.9)], axis=-1)
            ends = np.stack([received_s, np.full(len(sensed_s), level + 0.1)], axis=-1)
            axes.add_collection(
                LineCollection(list(np.stack([tops, ends], axis=1)), colors=color, linewidths=1.3, zorder=3)
            )
            axes.plot(sensed_s, tops[:, 1], "o", ms=3.5, color=color, zorder=4)
            axes.plot(received_s, ends[:, 1], "v", ms=4.5, color=color, zorder=4)
    for level, sensor in enumerate(sensors):
        axes.annotate(
            sensor,
            (0.0, level + 0.5),
            (-38, 0),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            rotation=90,
            ha="center",
            va="center",
            fontsize=9,
        )
    axes.set_yticks([level + at for level in range(len(sensors)) for at in (0.1, 0.9)])
    axes.set_yticklabels(["received", "sensed"] * len(sensors))
    from_s = (start_ns - first_ns) / NS_PER_S
    axes.set(xlim=(from_s, from_s + _SHOWN_S), ylim=(0.0, len(sensors)), xlabel="time [s]")


def _busiest_ns(receipts_ns: IntArray, late: BoolArray) -> int:
    """When the second begins in which the most of the `late` were received, or of all where there are none."""
    receipts_ns = np.sort(receipts_ns[late] if late.any() else receipts_ns)
    counts = np.searchsorted(receipts_ns, receipts_ns + nanoseconds(_SHOWN_S), side="right") - np.arange(
        len(receipts_ns)
    )
    return int(receipts_ns[counts.argmax()])


def _fates(updates: Table) -> Column:
    """What became of each detection, as in the legend."""
    return np.array([_FATES.get(name, "not used") for name in updates["disposition"].tolist()])

"""Figure of arrivals: stamps, receipts and dispositions of detections."""

from collections.abc import Mapping
from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.runs import OneRun, one_evaluated, start_ns
from fgtrack.runs import Columns
from fgtrack.runs.schema import Column
from fgtrack.show.figures.bands import draw_values
from fgtrack.show.figures.paper import Paper, Sheet, styled
from fgtrack.show.figures.style import legend_above, usual_step_ns

#: Colours of the outcomes. They differ from the colours of the common estimators.
_COLOURS = {
    "fused in sequence": "#8A8F98",
    "fused out of sequence": "#B65CA8",
    "fused beyond the window": "#A0622D",
    "started a track": "#2F93C6",
    "merged": "#8C7A1F",
    "not used": "#000000",
}
#: Outcome by disposition; with any other disposition a detection is `not used`.
_FATES: Mapping[str, str] = {
    "merged": "merged",
    "in_sequence": "fused in sequence",
    "out_of_sequence": "fused out of sequence",
    "beyond_window": "fused beyond the window",
    "birth": "started a track",
}
# Height of a sensor in the upper panel, and of the panel of its delays.
_SENSOR_IN = 1.1
_DELAYS_IN = 1.2
# Number of lists of the fastest sensor in the upper panel.
_SHOWN_LISTS = 20


@styled
def arrivals(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Detections as lines from stamp to receipt, and below them the delays of each sensor.

    A line that crosses another line was overtaken: its detection is out of sequence.
    The upper panel shows the part with the most detections fused out of sequence. In
    this part the fastest sensor sends twenty lists. Colours are the outcomes of the
    detections. Raises `DataError` if the run has no detections.
    """
    one = one_evaluated(run)
    updates = one.run.tables["updates"]
    if not updates.num_rows:
        raise DataError(f"{one.label}: no detections, so there are no arrivals to draw")
    sensors = np.unique(updates["sensor"]).tolist()
    heights = [_SENSOR_IN * len(sensors), *[_DELAYS_IN] * len(sensors)]
    sheet = Sheet(9.0, sum(heights) + 1.5, paper)
    flow, *rows = sheet.plots(len(heights), heights=heights)[:, 0]
    first_ns = start_ns([one])
    fates = np.array(
        [_FATES.get(name, "not used") for name in updates["disposition"].tolist()]
    )
    _draw_flow(flow, updates, fates, first_ns)
    delay_ms = (updates["receipt_ns"] - updates["stamp_ns"]) / (NS_PER_S / 1e3)
    received_s = (updates["receipt_ns"] - first_ns) / NS_PER_S
    low_ms = min(0.0, float(delay_ms.min()))
    high_ms = max(1.0, float(delay_ms.max()))
    for name, color in _COLOURS.items():
        if count := int((fates == name).sum()):
            flow.plot(
                [],
                [],
                "o",
                ms=4.0,
                color=color,
                label=f"{name}: {count} of {len(fates)}",
            )
        for axes, sensor in zip(rows, sensors, strict=True):
            mine = (fates == name) & (updates["sensor"] == sensor)
            if mine.any():
                draw_values(axes, received_s[mine], delay_ms[mine], color, ms=4.0)
    for axes, sensor in zip(rows, sensors, strict=True):
        axes.set_ylim(low_ms, high_ms + 0.05 * (high_ms - low_ms))
        axes.set_title(sensor.replace("_", " "), loc="left", y=0.98, pad=1.0)
        axes.sharex(rows[0])
        axes.tick_params(labelbottom=axes is rows[-1])
    rows[len(rows) // 2].set_ylabel("delay [ms]")
    rows[-1].set_xlabel("time of receipt [s]")
    legend_above(flow)
    sheet.title(f"{one.label}: detections from stamp to receipt")
    return sheet.figure


def _draw_flow(axes: Axes, updates: Columns, fates: Column, first_ns: int) -> None:
    """Draw a line for each detection of the busiest part, with two levels for each sensor."""
    own = (
        updates["stamp_ns"][updates["sensor"] == name]
        for name in np.unique(updates["sensor"]).tolist()
    )
    shortest_ns = min(map(usual_step_ns, own))
    length_ns = (
        round(_SHOWN_LISTS * shortest_ns) if np.isfinite(shortest_ns) else NS_PER_S
    )
    late = fates == "fused out of sequence"
    receipts_ns = np.sort(
        updates["receipt_ns"][late] if late.any() else updates["receipt_ns"]
    )
    counts = np.searchsorted(
        receipts_ns, receipts_ns + length_ns, side="right"
    ) - np.arange(len(receipts_ns))
    # The part with the most receipts of late detections.
    start_ns = int(receipts_ns[counts.argmax()])
    inside = (updates["receipt_ns"] >= start_ns) & (
        updates["stamp_ns"] <= start_ns + length_ns
    )
    sensors = np.unique(updates["sensor"][inside]).tolist()
    for name, color in _COLOURS.items():
        for level, sensor in enumerate(sensors):
            mine = inside & (fates == name) & (updates["sensor"] == sensor)
            stamps_s = (updates["stamp_ns"][mine] - first_ns) / NS_PER_S
            received_s = (updates["receipt_ns"][mine] - first_ns) / NS_PER_S
            tops = np.stack([stamps_s, np.full(len(stamps_s), level + 0.9)], axis=-1)
            ends = np.stack([received_s, np.full(len(stamps_s), level + 0.1)], axis=-1)
            axes.add_collection(
                LineCollection(
                    list(np.stack([tops, ends], axis=1)),
                    colors=color,
                    linewidths=1.3,
                    zorder=3,
                )
            )
            axes.plot(stamps_s, tops[:, 1], "o", ms=3.5, color=color, zorder=4)
            axes.plot(received_s, ends[:, 1], "v", ms=4.5, color=color, zorder=4)
    axes.set_yticks([level + at for level in range(len(sensors)) for at in (0.1, 0.9)])
    axes.set_yticklabels(
        [
            text
            for sensor in sensors
            for text in ("received", f"{sensor.replace('_', ' ')}: stamp")
        ]
    )
    from_s = (start_ns - first_ns) / NS_PER_S
    axes.set(
        xlim=(from_s, from_s + length_ns / NS_PER_S),
        ylim=(0.0, len(sensors)),
        xlabel="time [s]",
    )

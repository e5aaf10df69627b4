"""The figure of arrivals: delays and outcomes of detections."""

from collections.abc import Mapping
from typing import Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.runs import OneRun, one_evaluated, start_ns
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.style import legend_above, titled

#: None is the colour of an estimator that is compared often.
_COLOURS = {
    "fused in sequence": "#8A8F98",
    "fused out of sequence": "#B65CA8",
    "fused beyond the window": "#A0622D",
    "started a track": "#2F93C6",
    "merged": "#8C7A1F",
    "not used": "#000000",
}
#: What became of a detection, by disposition; every other one is `not used`.
_FATES: Mapping[str, str] = {
    "merged": "merged",
    "in_sequence": "fused in sequence",
    "out_of_sequence": "fused out of sequence",
    "beyond_window": "fused beyond the window",
    "birth": "started a track",
}


@styled
def arrivals(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Delay of each detection against its time of receipt, sensor by sensor, in the colour of its outcome.

    Raises `DataError` if the run has no detections.
    """
    one = one_evaluated(run)
    updates = one.run.tables["updates"]
    if not updates.num_rows:
        raise DataError(f"{one.label}: has no detections, so there are no arrivals to draw")
    sensors = np.unique(updates["sensor"]).tolist()
    sheet = Sheet(9.0, 1.5 + 1.6 * len(sensors), paper)
    rows = sheet.plots(len(sensors), sharex=True)[:, 0]
    fates = np.array([_FATES.get(name, "not used") for name in updates["disposition"].tolist()])
    delay_ms = (updates["receipt_ns"] - updates["stamp_ns"]) / (NS_PER_S / 1e3)
    received_s = (updates["receipt_ns"] - start_ns([one])) / NS_PER_S
    low_ms, high_ms = min(0.0, float(delay_ms.min())), max(1.0, float(delay_ms.max()))
    for axes, sensor in zip(rows, sensors, strict=True):
        for name, color in _COLOURS.items():
            count, mine = int((fates == name).sum()), (fates == name) & (updates["sensor"] == sensor)
            label = f"{name}: {count} of {len(fates)}" if count else ""
            axes.plot(received_s[mine], delay_ms[mine], ".", ms=4.0, mew=0, color=color, label=label)
        axes.set(ylim=(low_ms, high_ms + 0.05 * (high_ms - low_ms)), ylabel=f"{sensor.replace('_', ' ')}\ndelay [ms]")
    rows[-1].set_xlabel("time of receipt [s]")
    legend_above(rows[0], markerscale=2.0)
    sheet.title(titled(one.label, "delays and outcomes of the detections"))
    return sheet.figure

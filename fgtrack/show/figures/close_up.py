"""Figure of one late detection: its effect on the errors of past and present estimates."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import rotation
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import YAW, FloatArray, IntArray
from fgtrack.evaluation.runs import Runs, evaluated
from fgtrack.evaluation.truth import TruePath, paths_around
from fgtrack.show.figures.paper import Paper, Sheet, is_column, styled
from fgtrack.show.figures.style import GREY, legend_above, run_styles
from fgtrack.show.palette import CurveStyle

STEP_S = 0.01
"""Time between estimates.

It equals the grid step of the backward-forward EKF, whose states are constant within a
step.
"""

_FORGET = ("ekf-backward-forward", "rewind-forget", "backward-forward")
_RINGS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_MS = NS_PER_S / 1e3


@dataclass(frozen=True)
class Arrival:
    """A detection, identified by its list and its index in the list."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    index: int


@dataclass(frozen=True)
class Estimates:
    """Estimates of one track at several stamps."""

    stamps_ns: IntArray
    """Ascending stamps, shape (m,); the last one is the present."""
    means: FloatArray
    """x, y, yaw, speed, yaw rate[, acceleration], shape (m, n)."""


@dataclass(frozen=True)
class CloseUp:
    """A late detection, and the estimates of its track before and after the fusion."""

    arrival: Arrival
    now_ns: int
    """Time of the tick that fused the detection."""
    track_id: int
    before: Estimates
    after: Estimates
    fused_ns: IntArray
    """Stamps of the track's other measurements, from 0.15 s before the detection, ascending, shape (k,)."""
    rule: str = ""
    """Sentence on the choice of the detection."""


@styled
def close_up(
    runs: Runs, close_ups: Sequence[CloseUp], **paper: Unpack[Paper]
) -> Figure:
    """A late detection, and its effect on the estimates of each run.

    The upper plots show the present position relative to the true position, for each
    run. The direction of travel points to the right. With truth, nearer to the centre
    is better.
    The lower plots show the error of the estimates over their stamps, before the
    detection arrived (grey) and after. A narrow figure has a single plot with all
    errors.

    Without truth the final estimate of the first run is the centre, and no run is
    judged. `close_ups` has
    an entry for each run, of the same detection: `fgtrack.close_ups`. Raises
    `CallError` if their number differs, or they belong to different detections.
    """
    every = evaluated(runs)
    if len(every) != len(close_ups) or len({item.arrival for item in close_ups}) != 1:
        raise CallError(
            f"{len(every)} runs need {len(every)} close-ups of one detection, use fgtrack.close_ups"
        )
    first = close_ups[0]
    now_ns = np.array([first.now_ns])
    at_m = first.after.means[-1, :2]
    paths = [
        path
        for path in paths_around(every[0].run, now_ns)
        if np.isfinite(path.at(now_ns)[0, 0])
    ]
    truth = min(
        paths,
        key=lambda path: float(np.hypot(*(path.at(now_ns)[0, :2] - at_m))),
        default=None,
    )
    both = [
        [_offsets(item, each, first, truth) for each in (item.before, item.after)]
        for item in close_ups
    ]
    ends_m = [[off_m[-1] for _, off_m in pair] for pair in both]
    texts = [
        "{:.2f} m before, {:.2f} m after".format(*np.linalg.norm(pair, axis=-1))
        for pair in ends_m
    ]
    highest_m = max(
        float(np.hypot(*off_m.T).max()) for pair in both for _, off_m in pair
    )
    styles = run_styles(every).values()
    late_ms = (first.now_ns - first.arrival.stamp_ns) / _MS
    stamp = "stamp relative to now [ms]"
    quantity = (
        "position error [m]"
        if truth is not None
        else f"distance to {every[0].label}\nafterwards [m]"
    )
    if is_column(paper):
        sheet = Sheet(7.0, 4.2, paper)
        axes: Axes = sheet.plots()[0, 0]
        for run, (before, after), text, style in zip(
            every, both, texts, styles, strict=True
        ):
            axes.plot(
                before[0], np.hypot(*before[1].T), color=style.colour, ls=":", lw=0.9
            )
            label = f"{run.label}: {text}"
            axes.plot(
                after[0],
                np.hypot(*after[1].T),
                color=style.colour,
                ls=style.line,
                lw=1.5,
                label=label,
            )
        axes.axvline(-late_ms, color="black", lw=0.8)
        axes.set(xlabel=stamp, ylabel=quantity, ylim=(0.0, 1.05 * highest_m))
        legend_above(axes)
        return sheet.figure
    reach_m = 1.25 * max(0.05, float(np.abs(ends_m).max()))
    sheet = Sheet(max(9.0, 3.0 * len(every)), 7.4, paper)
    rows = sheet.plots(2, len(every), heights=(1.35, 1.0))
    for k, (run, style) in enumerate(zip(every, styles, strict=True)):
        above, below = rows[:, k]
        above.set_title(f"{run.label}\n{texts[k]}", color=style.colour, loc="left")
        _draw_present(
            above,
            style,
            ends_m[k],
            reach_m,
            every[0].label if truth is None else "truth",
        )
        _draw_errors(
            below,
            style,
            close_ups[k],
            both[k],
            forgets=run.run.meta.get("estimator") in _FORGET,
        )
        below.set(xlabel=stamp, ylim=(0.0, 1.6 * highest_m))
        for axes in (above, below):
            axes.tick_params(labelleft=not k)
    rows[0, 0].set_ylabel("to the left [m]")
    rows[1, 0].set_ylabel(quantity)
    sensor = first.arrival.sensor.replace("_", " ")
    centre = (
        "nearer to the centre is better"
        if truth is not None
        else f"without truth the centre is {every[0].label} afterwards, so no run is judged"
    )
    sheet.title(f"A {sensor} detection arrives {late_ms:.0f} ms late: {centre}")
    if sheet.has_title:
        rule = "\n".join(
            textwrap.wrap(first.rule, int(17 * sheet.figure.get_figwidth()))
        )
        sheet.figure.supxlabel(rule, fontsize="small", ha="left", x=0.01)
    return sheet.figure


def _offsets(
    one: CloseUp, each: Estimates, first: CloseUp, truth: TruePath | None
) -> tuple[FloatArray, FloatArray]:
    """Return the grid stamps in ms from now (m,), and the offset ahead and to the left of the reference (m, 2)."""
    each_ns, known_ns = (
        stamps_ns - one.now_ns for stamps_ns in (each.stamps_ns, first.after.stamps_ns)
    )
    reference = [
        np.interp(each_ns, known_ns, first.after.means[:, k]) for k in range(2)
    ]
    at_m = (
        np.stack(reference, axis=-1)
        if truth is None
        else truth.at(each.stamps_ns)[:, :2]
    )
    off_m = (each.means[:, :2] - at_m) @ rotation(-float(first.after.means[-1, YAW])).T
    regular = each_ns % nanoseconds(STEP_S) == 0
    return each_ns[regular] / _MS, off_m[regular]


def _draw_present(
    axes: Axes, style: CurveStyle, ends_m: Sequence[Any], reach_m: float, centre: str
) -> None:
    """Draw the present position before and after the fusion, relative to the reference."""
    ring_m = max(
        [each for each in _RINGS_M if each < 0.8 * reach_m], default=0.5 * reach_m
    )
    for times in (1, 2, 3):
        axes.add_patch(
            Circle(
                (0.0, 0.0), times * ring_m, fill=False, ec="#d0d0d0", lw=0.8, zorder=1
            )
        )
    axes.plot(0.0, 0.0, "+", color="black", ms=12, mew=1.4, zorder=3)
    axes.annotate(
        centre, (0.0, 0.0), (5, -11), textcoords="offset points", fontsize="small"
    )
    axes.annotate(
        "",
        ends_m[1],
        ends_m[0],
        arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.2},
        zorder=4,
    )
    for end, word, colour, face in zip(
        ends_m,
        ("before", "after"),
        (GREY, style.colour),
        ("white", style.colour),
        strict=True,
    ):
        axes.plot([0.0, end[0]], [0.0, end[1]], color=colour, lw=1.0, ls=":", zorder=3)
        axes.plot(*end, "o", color=colour, ms=8.5, mfc=face, mew=1.8, zorder=5)
        axes.annotate(
            word,
            end,
            (0, 8),
            textcoords="offset points",
            ha="center",
            fontsize="small",
            zorder=7,
        )
    axes.set(
        xlim=(-reach_m, reach_m),
        ylim=(-reach_m, reach_m),
        xlabel="ahead [m]",
        aspect="equal",
    )
    axes.grid(visible=False)


def _draw_errors(
    axes: Axes,
    style: CurveStyle,
    one: CloseUp,
    pair: Sequence[tuple[FloatArray, FloatArray]],
    forgets: bool,
) -> None:
    """Draw the errors over the stamps up to now, and at the bottom the measurements since the detection."""
    before, (at_ms, error_m) = (
        (times_ms, np.hypot(*off_m.T)) for times_ms, off_m in pair
    )
    axes.plot(*before, color=GREY, ls="--", lw=1.4, label="before it arrives")
    axes.plot(at_ms, error_m, color=style.colour, lw=1.8, label="after")
    was_m = np.interp(at_ms, *before)
    axes.fill_between(
        at_ms,
        error_m,
        was_m,
        where=error_m <= was_m,
        color=style.colour,
        alpha=0.18,
        lw=0,
    )
    late_ms = (one.arrival.stamp_ns - one.now_ns) / _MS
    axes.axvline(late_ms, ymax=0.66, color="black", lw=0.9)
    marks: dict[str, Any] = {
        "color": "black",
        "clip_on": False,
        "zorder": 6,
        "ls": "none",
    }  # Any: keywords
    axes.plot(
        late_ms,
        0.0,
        marker="x",
        ms=8,
        mew=2.0,
        label="late detection: its stamp",
        **marks,
    )
    since_ms = (one.fused_ns[one.fused_ns > one.arrival.stamp_ns] - one.now_ns) / _MS
    if len(since_ms):
        label, face = ("now forgotten", "white") if forgets else ("kept", "black")
        marks |= {
            "marker": "^",
            "mfc": face,
            "ms": 7,
            "label": f"fused meanwhile, {label}",
        }
        axes.plot(since_ms, np.zeros(len(since_ms)), **marks)
    axes.legend(
        loc="upper left",
        frameon=False,
        handlelength=1.6,
        borderaxespad=0.1,
        labelspacing=0.2,
    )

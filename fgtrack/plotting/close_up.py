"""The figure of one late detection: where it comes in, and its effect on the errors of past and present."""

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
from fgtrack.evaluation.palette import Look
from fgtrack.evaluation.runs import EvaluatedRun, Runs, evaluated
from fgtrack.evaluation.truth import TruePath, true_paths
from fgtrack.plotting.paper import Paper, Sheet, is_column, styled
from fgtrack.plotting.style import GREY, legend_above, run_looks

STEP_S = 0.01
"""Between estimates; that of the grid of the backward-forward EKF, whose states are constant in between."""

_FORGET = ("ekf-backward-forward", "rewind-forget", "backward-forward")
_RING_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_MS = NS_PER_S / 1e3
_STAMP = "stamp relative to now [ms]"


@dataclass(frozen=True)
class Arrival:
    """A detection, by its list and its index there."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    index: int


@dataclass(frozen=True)
class Estimates:
    """Estimates of one track at several stamps."""

    stamps_ns: IntArray
    """Rising, shape (m,); the last one is the present."""
    means: FloatArray
    """x, y, yaw, speed, yaw rate[, acceleration], shape (m, n)."""


@dataclass(frozen=True)
class CloseUp:
    """A late detection, and a track before and after it was fused."""

    arrival: Arrival
    now_ns: int
    """Time of the tick at which it came in."""
    track_id: int
    before: Estimates
    after: Estimates
    fused_ns: IntArray
    """Rising stamps of the other measurements in the track from 0.15 s before the detection on, shape (k,)."""
    rule: str = ""
    """Rule by which the detection was chosen, a sentence."""


@styled
def close_up(runs: Runs, close_ups: Sequence[CloseUp], **paper: Unpack[Paper]) -> Figure:
    """A late detection and its effect on the estimates of each run.

    Above, for each run, the present relative to the true position, in the direction of travel to the right: nearer to
    the centre is better. Below the error of the estimates at the stamps up to now, before the detection arrived (grey)
    and after it. In a column of a paper all errors are in one plot. Without truth the estimate of the first run
    afterwards takes its role. `close_ups` are those of each run, of the same detection: `fgtrack.close_ups`. Raises
    `CallError` if they are not as many, or of different detections.
    """
    every = evaluated(runs)
    if len(every) != len(close_ups) or len({one.arrival for one in close_ups}) != 1:
        raise CallError(f"{len(every)} runs need as many close-ups of one detection")
    first = close_ups[0]
    truth = _true_path(every[0], first)
    quantity = "position error [m]" if truth is not None else f"distance to {every[0].label}\nafterwards [m]"
    looks = run_looks(every)
    panels = [_Panel(run, one, looks[run.label], first, truth) for run, one in zip(every, close_ups, strict=True)]
    highest_m = max(float(errors_m.max()) for panel in panels for _, errors_m in (panel.before, panel.after))
    late_ms = (first.now_ns - first.arrival.stamp_ns) / _MS
    if is_column(paper):
        sheet = Sheet(7.0, 4.2, paper)
        axes: Axes = sheet.plots()[0, 0]
        for panel in panels:
            panel.draw_both(axes)
        axes.axvline(-late_ms, color="black", lw=0.8)
        axes.set(xlabel=_STAMP, ylabel=quantity, ylim=(0.0, 1.05 * highest_m))
        legend_above(axes)
        return sheet.figure
    sheet = Sheet(max(9.0, 3.0 * len(every)), 7.4, paper)
    rows = sheet.plots(2, len(every), heights=(1.35, 1.0))
    reach_m = 1.25 * max(0.05, *(float(np.abs(each).max()) for panel in panels for each in panel.present_m))
    for column, panel in enumerate(panels):
        panel.draw_present(rows[0, column], reach_m, "reference" if truth is None else "truth")
        panel.draw_errors(rows[1, column], highest_m)
        for axes in rows[:, column]:
            axes.tick_params(labelleft=not column)
    rows[0, 0].set_ylabel("to the left [m]")
    rows[1, 0].set_ylabel(quantity)
    sensor = first.arrival.sensor.replace("_", " ")
    sheet.title(f"A {sensor} detection arrives {late_ms:.0f} ms late: nearer to the centre is better")
    sheet.caption("\n".join(textwrap.wrap(first.rule, int(17 * sheet.figure.get_figwidth()))))
    return sheet.figure


def _true_path(run: EvaluatedRun, one: CloseUp) -> TruePath | None:
    """Path of the true object nearest to the present; None where none is known."""
    now_ns, at_m = np.array([one.now_ns]), one.after.means[-1, :2]
    paths = [path for path in true_paths(run.run.tables["truth"]) if np.isfinite(path.at(now_ns)[0, 0])]
    return min(paths, key=lambda path: float(np.hypot(*(path.at(now_ns)[0, :2] - at_m))), default=None)


class _Panel:
    """Errors of one run before and after, ahead and to the left of the reference."""

    def __init__(self, run: EvaluatedRun, one: CloseUp, look: Look, first: CloseUp, truth: TruePath | None) -> None:
        self._label, self._look, self._one = run.label, look, one
        self._forgets = run.run.meta.get("estimator") in _FORGET
        turn, now_ns = rotation(-float(first.after.means[-1, YAW])), one.now_ns
        errors, present_m = [], []
        for each in (one.before, one.after):
            since_ns = (each.stamps_ns - now_ns).astype(np.float64)  # differences are exact as floats
            known_ns = (first.after.stamps_ns - now_ns).astype(np.float64)
            at_m = np.stack([np.interp(since_ns, known_ns, first.after.means[:, k]) for k in range(2)], axis=-1)
            at_m = at_m if truth is None else truth.at(each.stamps_ns)[:, :2]
            off_m = (each.means[:, :2] - at_m) @ turn.T
            regular = since_ns % nanoseconds(STEP_S) == 0
            errors.append((since_ns[regular] / _MS, np.hypot(*off_m[regular].T)))
            present_m.append(off_m[-1])
        self.before, self.after = errors
        self.present_m = present_m

    def _lengths(self, sign: str) -> str:
        before_m, after_m = (float(np.hypot(*each)) for each in self.present_m)
        return f"{self._label}{sign}{before_m:.2f} m before, {after_m:.2f} m after"

    def draw_both(self, axes: Axes) -> None:
        """Both in one plot with other runs: thin dotted before, after in the line of the estimator."""
        axes.plot(*self.before, color=self._look.colour, ls=":", lw=0.9)
        axes.plot(*self.after, color=self._look.colour, ls=self._look.line, lw=1.5, label=self._lengths(": "))

    def draw_present(self, axes: Axes, reach_m: float, centre: str) -> None:
        """The present before and after, seen from the reference."""
        ring_m = max([each for each in _RING_M if each < 0.8 * reach_m], default=0.5 * reach_m)
        for times in (1, 2, 3):
            axes.add_patch(Circle((0.0, 0.0), times * ring_m, fill=False, ec="#d0d0d0", lw=0.8, zorder=1))
        axes.plot(0.0, 0.0, "+", color="black", ms=12, mew=1.4, zorder=3)
        axes.annotate(centre, (0.0, 0.0), (5, -11), textcoords="offset points", fontsize="small")
        before, after = self.present_m
        axes.annotate("", after, before, arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.2}, zorder=4)
        for end, word, colour, face in (
            (before, "before", GREY, "white"),
            (after, "after", self._look.colour, self._look.colour),
        ):
            axes.plot([0.0, end[0]], [0.0, end[1]], color=colour, lw=1.0, ls=":", zorder=3)
            axes.plot(*end, "o", color=colour, ms=8.5, mfc=face, mew=1.8, zorder=5)
            axes.annotate(word, end, (0, 8), textcoords="offset points", ha="center", fontsize="small", zorder=7)
        axes.set_title(self._lengths("\n"), color=self._look.colour, loc="left")
        axes.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), xlabel="ahead [m]", aspect="equal")
        axes.grid(visible=False)

    def draw_errors(self, axes: Axes, highest_m: float) -> None:
        """Errors at the stamps up to now; at the bottom the measurements since that of the detection."""
        (at_ms, error_m), colour = self.after, self._look.colour
        axes.plot(*self.before, color=GREY, ls="--", lw=1.4, label="before it arrives")
        axes.plot(at_ms, error_m, color=colour, lw=1.8, label="after")
        was_m = np.interp(at_ms, *self.before)
        axes.fill_between(at_ms, error_m, was_m, where=error_m <= was_m, color=colour, alpha=0.18, lw=0)
        late_ms = (self._one.arrival.stamp_ns - self._one.now_ns) / _MS
        axes.axvline(late_ms, ymax=0.66, color="black", lw=0.9)
        marks: dict[str, Any] = {"color": "black", "clip_on": False, "zorder": 6, "ls": "none"}  # Any: keywords
        axes.plot(late_ms, 0.0, marker="x", ms=8, mew=2.0, label="late detection: its stamp", **marks)
        since_ms = (self._one.fused_ns[self._one.fused_ns > self._one.arrival.stamp_ns] - self._one.now_ns) / _MS
        if len(since_ms):
            label = "fused meanwhile, now forgotten" if self._forgets else "fused meanwhile, kept"
            face = "white" if self._forgets else "black"
            axes.plot(since_ms, np.zeros(len(since_ms)), marker="^", mfc=face, ms=7, label=label, **marks)
        axes.set(xlabel=_STAMP, ylim=(0.0, 1.6 * highest_m))
        axes.legend(loc="upper left", frameon=False, handlelength=1.6, borderaxespad=0.1, labelspacing=0.2)

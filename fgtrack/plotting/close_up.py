"""The figure of one late detection: where it comes in, and what it does to the errors of past and present."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import rotation
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import YAW, FloatArray, IntArray
from fgtrack.evaluation.palette import Look
from fgtrack.evaluation.runs import JudgedRun, Runs, judged
from fgtrack.evaluation.truth import true_paths
from fgtrack.plotting.paper import Paper, Sheet, is_column, styled
from fgtrack.plotting.slow_motion import STEP_S, CloseUp, Estimates
from fgtrack.plotting.style import GREY, legend_above, run_looks

_FORGET = ("ekf-backward-forward", "rewind-forget", "backward-forward")
_RING_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_MS = NS_PER_S / 1e3
_STAMP = "stamp relative to now [ms]"


@styled
def close_up(runs: Runs, close_ups: Sequence[CloseUp], **paper: Unpack[Paper]) -> Figure:
    """A late detection and what it does to the estimates of each run.

    Above, for each run, the present seen from the true position, in the direction of travel to the right: nearer to
    the centre is better. Below the error of the estimates at the stamps up to now, before the detection arrived (grey)
    and after it. In a column of a paper all errors are in one plot. Without truth the estimate of the first run
    afterwards takes its role.

    Parameters
    ----------
    runs
        The runs.
    close_ups
        That of each run, of the same detection: `fgtrack.close_ups`.
    **paper
        `width`, `font`, `style`, `ax`.

    Raises
    ------
    CallError
        They are not as many, or of different detections.
    """
    every = judged(runs)
    if len(every) != len(close_ups) or len({one.arrival for one in close_ups}) != 1:
        raise CallError(f"{len(every)} runs need as many close-ups of one detection")
    view = _View(every, close_ups)
    styles = run_looks(every)
    if is_column(paper):
        return _errors_in_one(every, close_ups, view, styles, Sheet(7.0, 4.2, paper))
    sheet = Sheet(max(9.0, 3.0 * len(every)), 7.4, paper)
    rows = sheet.plots(2, len(every), heights=(1.35, 1.0))
    for column, (run, one) in enumerate(zip(every, close_ups, strict=True)):
        colour = styles[run.label].colour
        _draw_present(rows[0, column], view, run, one, colour)
        _draw_errors(rows[1, column], view, run, one, colour)
        for axes in rows[:, column]:
            axes.tick_params(labelleft=not column)
    rows[0, 0].set_ylabel("to the left [m]")
    rows[1, 0].set_ylabel(view.quantity)
    first = close_ups[0]
    late_ms = (first.now_ns - first.arrival.stamp_ns) / _MS
    sensor = first.arrival.sensor.replace("_", " ")
    sheet.title(f"A {sensor} detection arrives {late_ms:.0f} ms late: nearer to the centre is better")
    sheet.caption("\n".join(textwrap.wrap(first.rule, int(17 * sheet.figure.get_figwidth()))))
    return sheet.figure


def _errors_in_one(
    runs: Sequence[JudgedRun], close_ups: Sequence[CloseUp], view: "_View", styles: Mapping[str, Look], sheet: Sheet
) -> Figure:
    """The errors of all runs in one plot: thin dotted before, after in the line of the estimator."""
    axes: Axes = sheet.plots()[0, 0]
    for run, one in zip(runs, close_ups, strict=True):
        its = styles[run.label]
        before, after = (view.errors(each, one.now_ns) for each in (one.before, one.after))
        axes.plot(*before, color=its.colour, ls=":", lw=0.9)
        label = f"{run.label}: {before[1][-1]:.2f} m before, {after[1][-1]:.2f} m after"
        axes.plot(*after, color=its.colour, ls=its.line, lw=1.5, label=label)
    axes.axvline((close_ups[0].arrival.stamp_ns - close_ups[0].now_ns) / _MS, color="black", lw=0.8)
    axes.set(xlabel=_STAMP, ylabel=view.quantity, ylim=(0.0, 1.05 * view.highest_m))
    legend_above(axes)
    return sheet.figure


class _View:
    """The reference of all panels: the true path, or that of the first run; first axis in the direction of travel."""

    def __init__(self, runs: Sequence[JudgedRun], close_ups: Sequence[CloseUp]) -> None:
        one = close_ups[0]
        self._turn = rotation(-float(one.after.means[-1, YAW]))
        now_ns = np.array([one.now_ns])
        paths = [path for path in true_paths(runs[0].run.tables["truth"]) if np.isfinite(path.at(now_ns)[0, 0])]
        self._path = min(
            paths, key=lambda path: float(np.hypot(*(path.at(now_ns)[0, :2] - one.after.means[-1, :2]))), default=None
        )
        self._instead = one.after
        self.has_truth = self._path is not None
        self.quantity = "position error [m]" if self.has_truth else f"distance to {runs[0].label}\nafterwards [m]"
        reach_m = max(float(np.abs(self.off(each)[-1]).max()) for c in close_ups for each in (c.before, c.after))
        self.half_m = 1.25 * max(reach_m, 0.05)
        self.highest_m = max(
            float(self.errors(each, c.now_ns)[1].max()) for c in close_ups for each in (c.before, c.after)
        )

    def off(self, estimates: Estimates) -> FloatArray:
        """Return how far the estimates are ahead and to the left of the reference at their stamps, shape (m, 2)."""
        return np.asarray((estimates.means[:, :2] - self._reference_m(estimates.stamps_ns)) @ self._turn.T)

    def errors(self, estimates: Estimates, now_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return stamps before now in ms, in steps of `STEP_S`, and the distances to the reference, shape (m,)."""
        regular = (now_ns - estimates.stamps_ns) % nanoseconds(STEP_S) == 0
        return (estimates.stamps_ns[regular] - now_ns) / _MS, np.hypot(*self.off(estimates)[regular].T)

    def _reference_m(self, stamps_ns: IntArray) -> FloatArray:
        if self._path is not None:
            return self._path.at(stamps_ns)[:, :2]
        known_ns = (self._instead.stamps_ns - stamps_ns[-1]).astype(np.float64)
        wanted_ns = (stamps_ns - stamps_ns[-1]).astype(np.float64)
        return np.stack([np.interp(wanted_ns, known_ns, self._instead.means[:, k]) for k in range(2)], axis=-1)


def _draw_present(axes: Axes, view: _View, run: JudgedRun, one: CloseUp, colour: str) -> None:
    """The present before and after, seen from where the car is."""
    ring_m = max([each for each in _RING_M if each < 0.8 * view.half_m], default=0.5 * view.half_m)
    for times in (1, 2, 3):
        axes.add_patch(Circle((0.0, 0.0), times * ring_m, fill=False, ec="#d0d0d0", lw=0.8, zorder=1))
    axes.plot(0.0, 0.0, "+", color="black", ms=12, mew=1.4, zorder=3)
    axes.annotate(
        "truth" if view.has_truth else "reference", (0.0, 0.0), (5, -11), textcoords="offset points", fontsize="small"
    )
    before, after = (view.off(each)[-1] for each in (one.before, one.after))
    for end, tint in ((before, GREY), (after, colour)):
        axes.plot([0.0, end[0]], [0.0, end[1]], color=tint, lw=1.0, ls=":", zorder=3)
    axes.annotate("", after, before, arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.2}, zorder=4)
    axes.plot(*before, "o", color=GREY, ms=8, mfc="white", mew=1.8, zorder=5)
    axes.plot(*after, "o", color=colour, ms=9, zorder=6)
    for end, word in ((before, "before"), (after, "after")):
        axes.annotate(word, end, (0, 8), textcoords="offset points", ha="center", fontsize="small", zorder=7)
    lengths_m = [float(np.hypot(*each)) for each in (before, after)]
    axes.set_title(f"{run.label}\n{lengths_m[0]:.2f} m before, {lengths_m[1]:.2f} m after", color=colour, loc="left")
    axes.set(
        xlim=(-view.half_m, view.half_m),
        ylim=(-view.half_m, view.half_m),
        xlabel="ahead [m]",
    )
    axes.set_aspect("equal")
    axes.grid(visible=False)


def _draw_errors(axes: Axes, view: _View, run: JudgedRun, one: CloseUp, colour: str) -> None:
    """Errors at the stamps up to now, before and after; at the bottom what was fused since that of the detection."""
    before, after = (view.errors(each, one.now_ns) for each in (one.before, one.after))
    axes.plot(*before, color=GREY, ls="--", lw=1.4, label="before it arrives")
    axes.plot(*after, color=colour, lw=1.8, label="after")
    at_ms, error_m = after
    was_m = np.interp(at_ms, *before)
    axes.fill_between(at_ms, error_m, was_m, where=error_m <= was_m, color=colour, alpha=0.18, lw=0)
    late_ms = (one.arrival.stamp_ns - one.now_ns) / _MS
    axes.axvline(late_ms, ymax=0.66, color="black", lw=0.9)
    axes.plot(
        late_ms, 0.0, "x", color="black", ms=8, mew=2.0, clip_on=False, zorder=6, label="late detection: its stamp"
    )
    since_ms = np.array(
        [(each.stamp_ns - one.now_ns) / _MS for each in one.fused if each.stamp_ns > one.arrival.stamp_ns]
    )
    forgets = run.run.meta.get("estimator") in _FORGET
    if len(since_ms):
        label = "fused meanwhile, now forgotten" if forgets else "fused meanwhile, kept"
        face = "white" if forgets else "black"
        axes.plot(
            since_ms, np.zeros(len(since_ms)), "^", color="black", mfc=face, ms=7, clip_on=False, zorder=6, label=label
        )
    axes.set(xlabel=_STAMP, ylim=(0.0, 1.6 * view.highest_m))
    axes.legend(loc="upper left", frameon=False, handlelength=1.6, borderaxespad=0.1, labelspacing=0.2)

"""The figure of one late detection: the past that it corrects, and the present that follows from it."""

import math
from collections.abc import Callable, Sequence
from typing import Unpack

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import rotation
from fgtrack.core.linalg import congruence
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, FloatArray, IntArray
from fgtrack.evaluation.figures.paper import Paper, styled
from fgtrack.evaluation.figures.style import GREY, StyledFigure, colour
from fgtrack.evaluation.palette import PALETTE
from fgtrack.evaluation.runs import JudgedRun, Runs, judged
from fgtrack.evaluation.truth import true_paths
from fgtrack.evaluation.viewer.ellipse import AROUND_95, ellipses
from fgtrack.tracking.close_up import CloseUp

_WIDTH_IN = 10.0
_AROUND_M = 1.0
_FORGET = ("ekf-backward-forward", "rewind-forget", "backward-forward")
_SINCE = "fused since it was sensed"


@styled
def close_up(runs: Runs, close_ups: Sequence[CloseUp], **paper: Unpack[Paper]) -> Figure:
    """A late detection and what it does to a track, one panel for each run, and the factor graph around it.

    Panels have the direction of travel to the right, in true proportion. Ellipses hold 95 %.

    Parameters
    ----------
    runs
        The runs.
    close_ups
        That of each run, of the same detection: `fgtrack.close_ups`.

    Raises
    ------
    CallError
        They are not as many, or of different detections.
    """
    every = judged(runs)
    if len(every) != len(close_ups) or len({one.arrival for one in close_ups}) != 1:
        raise CallError(f"{len(every)} runs need as many close-ups of one detection")
    view = _View(close_ups)
    heights = [view.height_in + 0.5] * len(every) + [2.1]
    figure = StyledFigure(figsize=(_WIDTH_IN, sum(heights) + 1.0))
    *panels, graph = figure.subplots(len(heights), 1, height_ratios=heights)
    for place, (axes, run, one) in enumerate(zip(panels, every, close_ups, strict=True)):
        _draw_panel(axes, view, run, one, colour(place))
    for axes in panels[:-1]:
        axes.tick_params(labelbottom=False)
    panels[-1].set_xlabel("along the direction of travel [m]; ellipses hold 95 %")
    panels[len(panels) // 2].set_ylabel("across [m]")
    _draw_graph(graph, close_ups[0])
    late_ms = 1e3 * seconds(view.now_ns - view.arrival.stamp_ns)
    figure.suptitle(
        f"A {view.arrival.sensor} detection, sensed {late_ms:.0f} ms ago, arrives now. It corrects the state where it "
        "was sensed,\nand all that follows up to now: dashed what was believed before, solid what is believed after."
    )
    entries: dict[str, Artist] = {}
    for axes in (*panels, graph):
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure


class _View:
    """The frame of all panels: origin where the detection was sensed, first axis along the direction of travel."""

    def __init__(self, close_ups: Sequence[CloseUp]) -> None:
        first = close_ups[0]
        self.arrival, self.now_ns = first.arrival, first.now_ns
        state = first.after.means[first.after.at(self.arrival.stamp_ns)]
        self.origin_m: FloatArray = state[:2]
        self.turn = rotation(-float(state[YAW]))
        shown = np.concatenate([self.seen(b.means[:, :2]) for one in close_ups for b in (one.before, one.after)])
        reach_m = max(_reach_m(b.covariances) for one in close_ups for b in (one.before, one.after))
        across_m = float(np.abs(shown[:, 1]).max()) + reach_m
        detection_m = float(np.abs(self.seen(first.position_m)[1]))
        self.across_m = max(across_m, detection_m) + 0.3
        self.along_m = float(shown[:, 0].min()) - _AROUND_M, float(shown[:, 0].max()) + reach_m + _AROUND_M
        self.height_in = 0.9 * _WIDTH_IN * 2.0 * self.across_m / (self.along_m[1] - self.along_m[0])

    def seen(self, positions_m: FloatArray) -> FloatArray:
        """Positions in the map, shape (..., 2), in the frame of the panels."""
        return np.asarray((positions_m - self.origin_m) @ self.turn.T)

    def ellipse(self, position_m: FloatArray, covariance: FloatArray) -> Ellipse:
        """The 95 % ellipse of a position."""
        turned = congruence(self.turn, covariance[:2, :2])
        ((long_m, short_m, direction_rad),) = ellipses(turned[None], AROUND_95).tolist()
        return Ellipse(tuple(self.seen(position_m[:2])), long_m, short_m, angle=math.degrees(direction_rad), fill=False)


def _reach_m(covariances: FloatArray) -> float:
    """How far the longest of the 95 % ellipses reaches from its middle."""
    return float(ellipses(covariances[:, :2, :2], AROUND_95)[:, 0].max()) / 2.0


def _draw_panel(axes: Axes, view: _View, run: JudgedRun, one: CloseUp, color: str) -> None:
    arrival, stamp_ns = one.arrival, one.arrival.stamp_ns
    true_m = _true_m(run, one)
    if true_m is not None:
        axes.plot(*view.seen(true_m(one.after.stamps_ns)).T, color="#cccccc", lw=7.0, label="truth", zorder=1)
    for believed, style, shade, label in (
        (one.before, "--", GREY, "believed before"),
        (one.after, "-", color, "believed after"),
    ):
        axes.plot(*view.seen(believed.means[:, :2]).T, style, color=shade, lw=1.6, label=label, zorder=3)
        for at_ns in (stamp_ns, one.now_ns):
            place = believed.at(at_ns)
            ring = view.ellipse(believed.means[place], believed.covariances[place])
            ring.set(edgecolor=shade, linestyle=style, linewidth=1.1, zorder=3)
            axes.add_patch(ring)
            axes.plot(*view.seen(believed.means[place, :2]), "o", color=shade, ms=4.5, zorder=5)
    _draw_fused(axes, view, run, one)
    ring = view.ellipse(one.position_m, one.position_covariance)
    ring.set(edgecolor="black", linestyle=":", linewidth=1.0)
    axes.add_patch(ring)
    axes.plot(*view.seen(one.position_m), "kx", ms=9, mew=2.2, label=f"late {arrival.sensor} detection", zorder=6)
    start, end = (view.seen(b.means[-1, :2]) for b in (one.before, one.after))
    axes.annotate("", tuple(end), tuple(start), arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.2}, zorder=7)
    moved_m = float(np.linalg.norm(end - start))
    text = f"{run.label}: the present moves by {moved_m:.2f} m"
    if true_m is not None:
        errors = [np.linalg.norm(b.means[-1, :2] - true_m(b.stamps_ns[-1:])[0]) for b in (one.before, one.after)]
        text += f"; its error was {errors[0]:.2f} m and is {errors[1]:.2f} m"
    axes.set_title(text, loc="left")
    axes.set(xlim=view.along_m, ylim=(-view.across_m, view.across_m), aspect="equal")
    for at_ns, name in ((stamp_ns, "sensed"), (one.now_ns, "now")):
        along_m = view.seen(one.after.means[one.after.at(at_ns), :2])[0]
        axes.annotate(name, (along_m, -view.across_m), (0, 3), textcoords="offset points", ha="center", fontsize=8)


def _draw_fused(axes: Axes, view: _View, run: JudgedRun, one: CloseUp) -> None:
    """What had been fused since the detection was sensed, on the path believed before; crossed out if now lost."""
    since = [record for record in one.fused if record.stamp_ns > one.arrival.stamp_ns]
    if not since:
        return
    places = [one.before.at(record.stamp_ns) for record in since]
    points = view.seen(one.before.means[places, :2]).T
    axes.plot(*points, "^", color=PALETTE[3], ms=8, label=_SINCE, zorder=5)
    if run.run.meta.get("estimator") in _FORGET:
        axes.plot(*points, "x", color="black", ms=14, mew=1.2, label="... and forgotten by this method", zorder=4)


def _true_m(run: JudgedRun, one: CloseUp) -> Callable[[IntArray], FloatArray] | None:
    """Position of the true object nearest to the track now, as a function of stamps; None without truth."""
    now = np.array([one.now_ns])
    paths = [path for path in true_paths(run.run.truth) if np.isfinite(path.at(now)[0, 0])]
    if not paths:
        return None
    nearest = min(paths, key=lambda path: float(np.linalg.norm(path.at(now)[0, :2] - one.after.means[-1, :2])))
    return lambda stamps_ns: nearest.at(stamps_ns)[:, :2]


def _draw_graph(axes: Axes, one: CloseUp) -> None:
    """The factor graph around the detection before (above) and after (below) its state is inserted."""
    sensors = sorted({record.sensor for record in one.fused} | {one.arrival.sensor})
    others = [(record.stamp_ns, record.sensor) for record in one.fused]
    late = (one.arrival.stamp_ns, one.arrival.sensor)
    for row, factors, name in ((1.0, others, "before"), (0.0, sorted([*others, late]), "after")):
        nodes_ms = _ms(np.unique([stamp_ns for stamp_ns, _ in factors]), one.now_ns)
        axes.plot(nodes_ms, np.full(len(nodes_ms), row), color=GREY, lw=1.2, zorder=1)
        middles_ms = (nodes_ms[1:] + nodes_ms[:-1]) / 2.0
        axes.plot(middles_ms, np.full(len(middles_ms), row), "s", color="black", ms=4, zorder=2, label="motion factor")
        axes.plot(
            *(nodes_ms, np.full(len(nodes_ms), row)), "o", ms=10, mfc="white", mec="black", zorder=3, label="state"
        )
        for place, sensor in enumerate(sensors):
            at_ms = _ms(np.array([stamp_ns for stamp_ns, of in factors if of == sensor], dtype=np.int64), one.now_ns)
            axes.vlines(at_ms, row, row + 0.36, color=GREY, lw=0.8, zorder=1)
            label = f"{sensor} factor"
            axes.plot(
                at_ms, np.full(len(at_ms), row + 0.36), "s", color=PALETTE[2 + place], ms=7, label=label, zorder=3
            )
        axes.annotate(
            name,
            (0.0, row),
            (-2, 0),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            ha="right",
            va="center",
            fontsize=9,
        )
    new_ms = _ms(np.array([late[0]]), one.now_ns)
    axes.plot(new_ms, [0.0], "o", ms=15, mfc="none", mec=PALETTE[5], mew=2.0, zorder=4, label="new state")
    axes.set(yticks=[], ylim=(-0.35, 1.6), xlabel="stamp before now [ms]")
    axes.set_title(
        "The factor graph of that moment: the motion factor across the new state is split in two", loc="left"
    )
    axes.grid(visible=False)
    axes.spines["left"].set_visible(False)


def _ms(stamps_ns: IntArray, now_ns: int) -> FloatArray:
    return np.asarray((stamps_ns - now_ns) / (NS_PER_S / 1e3))

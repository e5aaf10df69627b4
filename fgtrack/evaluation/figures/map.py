"""The figure of ego, detections, tracks and truth on the map."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.figures.ranges import bulk
from fgtrack.evaluation.figures.style import (
    GREY,
    WRONG,
    StyledFigure,
    broken_line,
    colour,
    legend_above,
    styled,
    title,
    titled,
    usual_step_ns,
)
from fgtrack.evaluation.matching import Matching, confirmed
from fgtrack.evaluation.runs import OneRun, one_judged
from fgtrack.evaluation.truth import true_paths
from fgtrack.evaluation.viewer.placement import placed
from fgtrack.evaluation.viewer.surroundings import excluded_lines, road_lines, roads
from fgtrack.io.run import Run, Table

_NAMED_OBJECTS = 8  # more objects than these share two entries of the legend


@styled
def tracks_on_map(run: OneRun) -> Figure:
    """Ego, detections, tracks and truth on the map that `config.yaml` names as `map.track`.

    Truth is a broad pale line, so a stretch that nothing tracked stays visible; a track has the colour of the
    object that it is paired with, and is black where it is paired with none. Without truth every confirmed
    track has a colour. The picture holds map, ego, truth and the bulk of the tracks and detections; what lies
    outside is counted.

    Raises
    ------
    DataError
        `config.yaml` is not YAML, or the map that it names is no map.
    """
    one = one_judged(run)
    matching, text = one.matching, [titled(one.label, "on the map")]
    figure = StyledFigure(figsize=(8.0, 7.0))
    axes = figure.add_subplot()
    maps, notes = roads(one.run)
    bounds_m = [line for road in maps.values() for line in road_lines(road)[:2]]
    for line in bounds_m:
        axes.plot(*line.T, color=GREY, lw=0.7, zorder=3)
    label = "excluded"
    for ring in excluded_lines(one.run):
        axes.plot(*ring.T, color=GREY, lw=1.2, ls=":", zorder=3, label=label)
        label = ""
    if notes:
        text.append("the map file is not there any more")
    detections_m, ego_m = placed(one.run).position_m, _positions(one.run.ego)
    label = f"detections ({int(np.isfinite(detections_m[:, 0]).sum())})"
    if np.isfinite(detections_m).any():
        axes.plot(*detections_m.T, ".", ms=2.0, mew=0, color=GREY, label=label, zorder=2.5, rasterized=True)
    if np.isfinite(ego_m).any():
        axes.plot(*ego_m.T, color="black", lw=0.8, ls="--", label="ego", zorder=3.5)
    if matching is None:
        tracks = one.run.tracks.where(confirmed(one.run.tracks))
        step_ns = usual_step_ns(tracks["now_ns"])
        ids = np.unique(tracks["track_id"]).tolist()
        for k, track_id in enumerate(ids):
            _draw_tracks(axes, tracks.where(tracks["track_id"] == track_id), step_ns, colour(k), "")
        text.append(f"{len(ids)} confirmed tracks, no truth")
    else:
        tracks = matching.tracks
        _draw_matched(axes, one.run, matching)
    held = [*bounds_m, ego_m, *(path.states[:, :2] for path in true_paths(one.run.truth))]
    outside = _limit(axes, [_positions(tracks), detections_m], held)
    if outside:
        text.append(f"{outside} rows of tracks and detections are outside of the picture")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    legend_above(axes, figure.get_figwidth())
    title(figure, "\n".join(text))
    return figure


def _positions(table: Table) -> FloatArray:
    """Shape (n, 2)."""
    return np.stack([table["x_m"], table["y_m"]], axis=-1)


def _limit(axes: Axes, samples_m: list[FloatArray], held_m: list[FloatArray]) -> int:
    """Show the bulk of `samples_m` and all of `held_m`, shape (n, 2) each; gives how many samples are outside."""
    lows, highs = np.transpose(
        [bulk([one[:, k] for one in samples_m], [one[:, k] for one in held_m]) for k in range(2)]
    )
    axes.set_xlim(lows[0], highs[0], auto=True)  # an equal aspect may widen one of the two
    axes.set_ylim(lows[1], highs[1], auto=True)
    outside = [((one < lows) | (one > highs)).any(axis=-1).sum() for one in samples_m]
    return int(sum(outside))


def _draw_matched(axes: Axes, run: Run, matching: Matching) -> None:
    paths, tracks = true_paths(run.truth), matching.tracks
    step_ns = usual_step_ns(tracks["now_ns"])
    few = len(paths) <= _NAMED_OBJECTS
    for index, path in enumerate(paths):
        name = f"object {path.object_id}" if few else "objects"
        label = f"{name}, truth" if few or not index else ""
        x_m, y_m = path.states[:, :2].T
        line = broken_line(path.stamps_ns, x_m, y_m, usual_step_ns(path.stamps_ns))
        axes.plot(*line, color=colour(index), lw=4.0, alpha=0.3, label=label)
        label = f"{name}, track" if few or not index else ""
        _draw_tracks(axes, tracks.where(matching.object_index == index), step_ns, colour(index), label)
    _draw_tracks(axes, tracks.where(~matching.paired), step_ns, WRONG, "paired with no object")


def _draw_tracks(axes: Axes, tracks: Table, step_ns: float, color: str, label: str) -> None:
    for track_id in np.unique(tracks["track_id"]).tolist():
        rows = tracks.where(tracks["track_id"] == track_id)
        line = broken_line(rows["stamp_ns"], rows["x_m"], rows["y_m"], step_ns)
        axes.plot(*line, color=color, lw=1.2, label=label, zorder=4)
        label = ""

"""The figure of tracks and truth on the map."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.evaluation.figures.style import (
    GREY,
    WRONG,
    StyledFigure,
    broken_line,
    colour,
    legend_above,
    styled,
    usual_step_ns,
)
from fgtrack.evaluation.matching import CONFIRMED_MEASUREMENTS, Matching
from fgtrack.evaluation.runs import OneRun, one_judged
from fgtrack.evaluation.truth import true_paths
from fgtrack.io.run import Run, Table
from fgtrack.models.oval import OVAL, make_oval
from fgtrack.models.track_map import TrackMap

_NAMED_OBJECTS = 8  # more objects than these share two entries of the legend


@styled
def tracks_on_map(run: OneRun) -> Figure:
    """Tracks and truth on the map that `config.yaml` names as `map.track`.

    Truth is a broad pale line, so a stretch that nothing tracked stays visible; a track has the colour of the
    object that it is paired with, and is black where it is paired with none. Without truth every track with
    enough measurements has a colour.

    Raises
    ------
    DataError
        `config.yaml` is not YAML, or the map that it names is no map.
    """
    one = one_judged(run)
    title, matching = one.label, one.matching
    figure = StyledFigure(figsize=(8.0, 7.0))
    axes = figure.add_subplot()
    name = (one.run.config.get("map") or {}).get("track")
    if name == OVAL:
        _draw_bounds(axes, make_oval())
    elif name and Path(str(name)).exists():
        _draw_bounds(axes, TrackMap.read(Path(str(name))))
    elif name:
        title += "\n(the map file is not there any more)"
    if matching is None:
        tracks = one.run.tracks.where(one.run.tracks["num_measured"] >= CONFIRMED_MEASUREMENTS)
        step_ns = usual_step_ns(tracks["now_ns"])
        for k, track_id in enumerate(np.unique(tracks["track_id"]).tolist()):
            _draw_tracks(axes, tracks.where(tracks["track_id"] == track_id), step_ns, colour(k), "")
        count = len(np.unique(tracks["track_id"]))
        title += f"\n{count} tracks with at least {CONFIRMED_MEASUREMENTS} measurements, no truth"
    else:
        _draw_matched(axes, one.run, matching)
        legend_above(axes, width=75)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    figure.suptitle(title.strip())
    return figure


def _draw_bounds(axes: Axes, track_map: TrackMap) -> None:
    s_m = np.linspace(0.0, track_map.length_m, 2000)
    left_m, right_m = track_map.bounds(s_m)
    for lateral_m in (left_m, -right_m):
        axes.plot(*track_map.position(s_m, lateral_m).T, color=GREY, lw=0.7, zorder=3)


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

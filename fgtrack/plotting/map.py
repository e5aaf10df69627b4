"""The figure of ego, detections, tracks and truth on the map."""

from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import confirmed
from fgtrack.evaluation.placement import placed
from fgtrack.evaluation.roads import excluded_lines, road_lines, roads
from fgtrack.evaluation.runs import EvaluatedRun, OneRun, one_evaluated
from fgtrack.evaluation.truth import true_paths
from fgtrack.io.run import Table
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.ranges import bulk
from fgtrack.plotting.style import GREY, WRONG, broken_line, colour, legend_above, titled, usual_step_ns

_NAMED_OBJECTS = 8  # more objects than these share two entries of the legend
_DETECTIONS = "#8C7A1F"


@styled
def tracks_on_map(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Ego, detections, tracks and truth on the map that `config.yaml` names as `map.track`.

    Truth is a broad pale line, so a stretch that nothing tracked stays visible; a track has the colour of the
    object that it is paired with, and is black where it is paired with none. Without truth every confirmed
    track has a colour. The picture holds map, ego, truth and the bulk of the tracks and detections; what lies
    outside is counted. Raises `DataError` if `config.yaml` is not YAML, or the map that it names is no map.
    """
    one = one_evaluated(run)
    maps, notes = roads(one.run)
    bounds_m = [line for road in maps.values() for line in road_lines(road)[:2]]
    every = one.run.tables["tracks"]
    tracks = every.where(confirmed(every)) if one.matching is None else one.matching.tracks
    detections_m, ego_m = placed(one.run).position_m, _positions(one.run.tables["ego"])
    required = [*bounds_m, ego_m, *(path.states[:, :2] for path in true_paths(one.run.tables["truth"]))]
    samples_m = [_positions(tracks), detections_m]
    edges = [bulk([each[:, k] for each in samples_m], [each[:, k] for each in required]) for k in range(2)]
    lows_m, highs_m = np.transpose(edges)
    sheet = Sheet(8.0, 6.0, paper)
    axes: Axes = sheet.plots()[0, 0]
    for line in bounds_m:
        axes.plot(*line.T, color=GREY, lw=0.7, zorder=3)
    for k, ring in enumerate(excluded_lines(one.run)):
        axes.plot(*ring.T, color=GREY, lw=1.2, ls=":", zorder=3, label="" if k else "excluded")
    if np.isfinite(ego_m).any():
        axes.plot(*ego_m.T, color="black", lw=0.8, ls="--", label="ego", zorder=3.5)
    if np.isfinite(detections_m).any():
        label = f"detections ({int(np.isfinite(detections_m[:, 0]).sum())})"
        axes.plot(*detections_m.T, "x", ms=1.5, mew=0.3, color=_DETECTIONS, label=label, zorder=2.2)
    _draw_objects(axes, one, tracks)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x, east [m]", ylabel="y, north [m]")
    axes.set_xlim(lows_m[0], highs_m[0], auto=True)  # an equal aspect may widen one of the two
    axes.set_ylim(lows_m[1], highs_m[1], auto=True)
    text = [titled(one.label, "on the map")]
    if notes:
        text.append("the map file is not there any more")
    if one.matching is None:
        text.append(f"{len(np.unique(tracks['track_id']))} confirmed tracks, no truth")
    outside = sum(int(((each < lows_m) | (each > highs_m)).any(axis=-1).sum()) for each in samples_m)
    if outside:
        text.append(f"{outside} rows of tracks and detections are outside of the picture")
    legend_above(axes)
    sheet.title("\n".join(text))
    return sheet.figure


def _positions(table: Table) -> FloatArray:
    """Shape (n, 2)."""
    return np.stack([table["x_m"], table["y_m"]], axis=-1)


def _draw_objects(axes: Axes, one: EvaluatedRun, tracks: Table) -> None:
    """Truth and tracks, in their colours."""
    step_ns = usual_step_ns(one.run.tables["tracks"]["now_ns"])
    matching = one.matching
    if matching is None:
        for k, track_id in enumerate(np.unique(one.run.tables["tracks"]["track_id"]).tolist()):
            _draw_tracks(axes, tracks.where(tracks["track_id"] == track_id), step_ns, colour(k), "")
        return
    paths = true_paths(one.run.tables["truth"])
    few = len(paths) <= _NAMED_OBJECTS
    for index, path in enumerate(paths):
        name = (f"object {path.object_id}" if few else "objects") if few or not index else ""
        x_m, y_m = path.states[:, :2].T
        line = broken_line(path.stamps_ns, x_m, y_m, usual_step_ns(path.stamps_ns))
        axes.plot(*line, color=colour(index), lw=4.0, alpha=0.3, label=name and f"{name}, truth")
        mine = tracks.where(matching.object_index == index)
        _draw_tracks(axes, mine, step_ns, colour(index), name and f"{name}, track")
    _draw_tracks(axes, tracks.where(matching.object_index < 0), step_ns, WRONG, "paired with no object")


def _draw_tracks(axes: Axes, tracks: Table, step_ns: float, color: str, label: str) -> None:
    for track_id in np.unique(tracks["track_id"]).tolist():
        rows = tracks.where(tracks["track_id"] == track_id)
        line = broken_line(rows["stamp_ns"], rows["x_m"], rows["y_m"], step_ns)
        axes.plot(*line, color=color, lw=1.2, label=label, zorder=4)
        label = ""

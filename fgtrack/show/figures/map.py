"""Figure of the ego, detections, tracks and truth on the map."""

from typing import NamedTuple, Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.evaluation.matching import confirmed
from fgtrack.evaluation.placement import detections_in_map, road_lines, roads
from fgtrack.evaluation.runs import EvaluatedRun, OneRun, one_evaluated, start_ns
from fgtrack.runs import Columns, Run
from fgtrack.show.figures.paper import Paper, Sheet, styled
from fgtrack.show.figures.style import (
    GREY,
    WRONG,
    broken_line,
    bulk,
    legend_above,
    map_axes,
    usual_step_ns,
)
from fgtrack.show.palette import PALETTE
from fgtrack.show.states import groups

# With more objects, all share two entries of the legend.
_NAMED_OBJECTS = 8
# Time before and after the moment of the close-up, and its least number of updates of a track.
_AROUND_S = 0.4
_FEWEST_UPDATES = 3
# Least half side of the close-up.
_LEAST_M = 4.0
_DETECTIONS = "#8C7A1F"


@styled
def tracks_on_map(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Ego, detections, tracks and truth on the map that `config.yaml` names in `map.track`, with a close-up.

    Truth is a broad pale line, so parts without a track remain visible. A track has the
    colour of its true object, and is black if it has no true object. Without truth
    every confirmed track has its own colour. The picture contains the map, the ego, the truth, and most
    of the tracks and detections. The title counts those outside. The close-up shows the
    track with the most updates within 0.8 s. Raises `DataError` for an invalid
    `config.yaml`, or an invalid map.
    """
    one = one_evaluated(run)
    maps, notes = roads(one.run)
    bounds_m = [line for road in maps.values() for line in road_lines(road)[:2]]
    every = one.run.tables["tracks"]
    tracks = (
        every.where(confirmed(every)) if one.matching is None else one.matching.tracks
    )
    detections_m = detections_in_map(one.run).position_m
    ego_m = _positions(one.run.tables["ego"])
    paths = () if one.matching is None else one.matching.paths
    required = [
        *bounds_m,
        ego_m,
        *(path.states[:, :2] for path in paths),
    ]
    samples_m = [_positions(tracks), detections_m]
    edges = [
        bulk([each[:, k] for each in samples_m], [each[:, k] for each in required])
        for k in range(2)
    ]
    lows_m, highs_m = np.transpose(edges)
    window = _window(one.run)
    sheet = Sheet(8.0 if window is None else 11.0, 6.0, paper)
    overview, *close_ups = sheet.plots(1, 1 if window is None else 2)[0]
    for axes, near in ((overview, None), *((axes, window) for axes in close_ups)):
        for line in bounds_m:
            axes.plot(*line.T, color=GREY, lw=0.7, zorder=3)
        ego, shown = (
            _near(one.run.tables[name]["stamp_ns"], near)
            for name in ("ego", "detections")
        )
        if np.isfinite(ego_m).any():
            axes.plot(
                *ego_m[ego].T, color="black", lw=0.8, ls="--", label="ego", zorder=3.5
            )
        if np.isfinite(detections_m).any():
            label = f"detections ({int(np.isfinite(detections_m[:, 0]).sum())})"
            size, above = (1.5, 2.2) if near is None else (5.0, 4.5)
            axes.plot(
                *detections_m[shown].T,
                "x",
                ms=size,
                mew=0.2 * size,
                color=_DETECTIONS,
                label=label,
                zorder=above,
            )
        _draw_objects(axes, one, tracks, near)
        corners = (
            (lows_m, highs_m)
            if near is None
            else (near.middle_m - near.half_m, near.middle_m + near.half_m)
        )
        map_axes(axes, float((corners[1] - corners[0]).max()))
        x_m, y_m = np.transpose(corners)
        axes.set_xlim(*x_m, auto=True)  # an equal aspect may widen one of the two
        axes.set_ylim(*y_m, auto=True)
        if near is not None:
            at_s = (near.middle_ns - start_ns([one])) / NS_PER_S
            axes.set_title(
                f"close-up: {2 * _AROUND_S:g} s around {at_s:.1f} s", loc="left"
            )
            overview.plot(
                *near.middle_m,
                "s",
                ms=14,
                mfc="none",
                mec="black",
                mew=1.2,
                label="close-up",
                zorder=6,
            )
    text = [f"{one.label}: on the map", *notes]
    outside = sum(
        int(((each < lows_m) | (each > highs_m)).any(axis=-1).sum())
        for each in samples_m
    )
    if outside:
        text.append(f"{outside} rows of tracks and detections are outside the picture")
    legend_above(overview, 1.0 / (1 + len(close_ups)))
    sheet.title("\n".join(text))
    return sheet.figure


class _Window(NamedTuple):
    """Time and region of the close-up."""

    middle_ns: int
    middle_m: FloatArray
    half_m: float


def _window(run: Run) -> _Window | None:
    """Return the window around the track with the most updates within `_AROUND_S` of a stamp.

    None if no window has three updates. If several stamps have as many updates, the
    first is used.
    """
    used = run.tables["updates"].where(run.tables["updates"]["track_id"] >= 0)
    around_ns = nanoseconds(_AROUND_S)
    busiest: tuple[int, int, int] = (0, 0, 0)
    for track_id in np.unique(used["track_id"]).tolist():
        stamps_ns = np.sort(used["stamp_ns"][used["track_id"] == track_id])
        first = np.searchsorted(stamps_ns, stamps_ns - around_ns)
        counts = np.searchsorted(stamps_ns, stamps_ns + around_ns, "right") - first
        row = int(counts.argmax())
        busiest = max(busiest, (int(counts[row]), -int(stamps_ns[row]), track_id))
    count, earlier_ns, track_id = busiest
    tracks = run.tables["tracks"]
    is_near = np.abs(tracks["stamp_ns"] + earlier_ns) <= around_ns
    positions_m = _positions(tracks.where((tracks["track_id"] == track_id) & is_near))
    if count < _FEWEST_UPDATES or not len(positions_m):
        return None
    low_m = positions_m.min(axis=0)
    high_m = positions_m.max(axis=0)
    return _Window(
        -earlier_ns,
        (low_m + high_m) / 2.0,
        max(_LEAST_M, 0.6 * float((high_m - low_m).max())),
    )


def _near(stamps_ns: IntArray, window: _Window | None) -> BoolArray:
    """Mask of the stamps in the time of `window`; all True without a window."""
    middle_ns, reach_ns = (
        (0, np.inf)
        if window is None
        else (window.middle_ns, 2 * nanoseconds(_AROUND_S))
    )
    return np.asarray(np.abs(stamps_ns - middle_ns) <= reach_ns)


def _positions(table: Columns) -> FloatArray:
    """Positions x, y of the rows, shape (n, 2)."""
    return np.stack([table["x_m"], table["y_m"]], axis=-1)


def _draw_objects(
    axes: Axes, one: EvaluatedRun, tracks: Columns, window: _Window | None
) -> None:
    """Draw truth and tracks in the colours of the objects; without truth every track has its own colour."""
    every = one.run.tables["tracks"]
    step_ns = usual_step_ns(every["now_ns"])
    # The columns of a long table are read once, not for every track.
    ids, stamps_ns, x_m, y_m = (
        tracks[name] for name in ("track_id", "stamp_ns", "x_m", "y_m")
    )
    owners = (
        np.searchsorted(np.unique(every["track_id"]), ids)
        if one.matching is None
        else one.matching.object_index
    )
    near = _near(stamps_ns, window)
    paths = () if one.matching is None else one.matching.paths
    few = len(paths) <= _NAMED_OBJECTS
    for index in (*range(max(len(paths), owners.max(initial=-1) + 1)), -1):
        color, label = (
            (PALETTE[index % len(PALETTE)], "")
            if index >= 0
            else (WRONG, "paired with no object")
        )
        if 0 <= index < len(paths):
            path = paths[index]
            name = (
                f"object {path.object_id}" if few else "objects" if index == 0 else ""
            )
            rows = _near(path.stamps_ns, window)
            true_x_m, true_y_m = path.states[rows, :2].T
            line = broken_line(
                path.stamps_ns[rows], true_x_m, true_y_m, usual_step_ns(path.stamps_ns)
            )
            axes.plot(
                *line,
                color=color,
                lw=4.0,
                alpha=0.3,
                label=f"{name}, truth" if name else "",
            )
            label = f"{name}, track" if name else ""
        mine = np.flatnonzero(near & (owners == index))
        for _, of_track in groups(ids[mine]):
            each = mine[of_track]
            line = broken_line(stamps_ns[each], x_m[each], y_m[each], step_ns)
            axes.plot(*line, color=color, lw=1.2, label=label, zorder=4)
            label = ""

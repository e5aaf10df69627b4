"""The figure of a run along its track: where everything is on the road, over time."""

from collections.abc import Iterator
from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import confirmed
from fgtrack.evaluation.roads import roads
from fgtrack.evaluation.runs import JudgedRun, OneRun, one_judged, start_ns
from fgtrack.evaluation.truth import true_paths
from fgtrack.io.run import Table
from fgtrack.models.track_map import TrackMap
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.ranges import bulk
from fgtrack.plotting.style import (
    GREY,
    WRONG,
    broken_line,
    colour,
    legend_above,
    titled,
    usual_step_ns,
)

_NAMED_OBJECTS = 8  # more objects than these share two entries of the legend
_TRACK, _FEW_TRUE, _MANY_TRUE, _PALE = 1.2, 5.0, 2.5, 0.3  # widths of lines, and how opaque those of truth are


@styled
def frenet(run: OneRun, **paper: Unpack[Paper]) -> Figure:
    """Along the track, ahead of the ego and to the left of the reference line, over time: truth, tracks, ego.

    The three are the Frenet coordinates of the map that `config.yaml` names as `map.track`; the first jumps where a
    lap ends. Without an ego the second is left out. Colours are those of `map`.

    Raises
    ------
    DataError
        The run has no map, or nothing on it.
    """
    one = one_judged(run)
    road = roads(one.run)[0].get("track")
    if road is None:
        raise DataError(f"{one.label}: has no map, so there is nothing along a track to draw")
    lines = list(_lines(one, road))
    if not lines:
        raise DataError(f"{one.label}: has no tracks and no truth, so there is nothing along a track to draw")
    ego = _ego(one.run.tables["ego"], road)
    sheet = Sheet(10.0, 6.2 if ego is None else 8.0, paper)
    along, *middle, lateral = sheet.plots(2 if ego is None else 3, sharex=True)[:, 0]
    first_ns = start_ns([one])
    for line in lines:
        line.draw(along, line.s_m, first_ns, road.length_m)
        line.draw(lateral, line.lateral_m, first_ns)
        if ego is not None:
            line.draw(middle[0], ego.behind(line, road.length_m), first_ns, road.length_m)
    if ego is not None:
        ego.draw(along, ego.s_m, first_ns, road.length_m)
        ego.draw(lateral, ego.lateral_m, first_ns)
        middle[0].axhline(0.0, color="black", lw=0.9, ls="--")
        middle[0].set_ylabel("ahead of the ego [m]")
    bounds_m = np.stack(road.bounds(np.linspace(0.0, road.length_m, 500)))
    for bound_m in (float(bounds_m[0].min()), float(-bounds_m[1].min())):
        lateral.axhline(bound_m, color=GREY, lw=0.8)
    lateral.set_ylim(*bulk([line.lateral_m for line in lines], [np.array([bounds_m[0].max(), -bounds_m[1].max()])]))
    along.set_ylabel("along the track [m]")
    lateral.set(ylabel="left of the reference\nline [m] (grey: bounds)", xlabel="time [s]")
    legend_above(along)
    sheet.title(titled(one.label, "along the track"))
    return sheet.figure


class _Line:
    """Something that moves along the track."""

    def __init__(
        self,
        road: TrackMap,
        stamps_ns: IntArray,
        positions_m: FloatArray,
        color: str,
        label: str,
        style: str = "-",
        width: float = _TRACK,
    ) -> None:
        order = np.argsort(stamps_ns, kind="stable")
        order = order[np.isfinite(positions_m[order]).all(axis=-1)]
        self.stamps_ns = stamps_ns[order]
        self.s_m, self.lateral_m = road.frenet(positions_m[order])
        self._color, self._label, self._style, self._width = color, label, style, width

    def draw(self, axes: Axes, values_m: FloatArray, first_ns: int, period_m: float = np.inf) -> None:
        """Draw `values_m` at the stamps over time, not across a pause nor across a jump of more than half a period."""
        jumps = np.flatnonzero(np.abs(np.diff(values_m)) > period_m / 2.0) + 1
        values_m = np.insert(values_m, jumps, np.nan)
        stamps_ns = np.asarray(np.insert(self.stamps_ns, jumps, self.stamps_ns[jumps]), dtype=np.int64)
        line = broken_line(stamps_ns, (stamps_ns - first_ns) / NS_PER_S, values_m, usual_step_ns(self.stamps_ns))
        alpha = _PALE if self._width > _TRACK else 1.0
        axes.plot(*line, label=self._label, color=self._color, ls=self._style, lw=self._width, alpha=alpha)

    def behind(self, other: "_Line", period_m: float) -> FloatArray:
        """How far `other` is ahead of this one at its stamps, within half a lap; NaN where this one is not known."""
        laps_m = np.unwrap(self.s_m, period=period_m)
        first_ns = self.stamps_ns[0]  # differences are exact as floats, epoch stamps are not
        own_m = np.interp(
            (other.stamps_ns - first_ns).astype(np.float64),
            (self.stamps_ns - first_ns).astype(np.float64),
            laps_m,
            left=np.nan,
            right=np.nan,
        )
        ahead_m = other.s_m - own_m
        return np.asarray(ahead_m - period_m * np.round(ahead_m / period_m))


def _lines(one: JudgedRun, road: TrackMap) -> Iterator[_Line]:
    """Truth and tracks, in their colours."""
    matching, paths = one.matching, true_paths(one.run.tables["truth"])
    few = len(paths) <= _NAMED_OBJECTS
    for index, path in enumerate(paths):
        name = f"object {path.object_id}" if few else "objects"
        label = f"{name}, truth" if few or not index else ""
        yield _Line(
            road, path.stamps_ns, path.states[:, :2], colour(index), label, "-", _FEW_TRUE if few else _MANY_TRUE
        )
    tracks = one.run.tables["tracks"] if matching is None else matching.tracks
    tracks = tracks.where(confirmed(tracks)) if matching is None else tracks
    named: set[str] = set()
    for place, track_id in enumerate(np.unique(tracks["track_id"]).tolist()):
        mine = tracks["track_id"] == track_id
        index = -1 if matching is None else matching.object_index[mine]
        for of in np.unique(index).tolist():
            rows = tracks.where(mine) if matching is None else tracks.where(mine & (matching.object_index == of))
            if matching is None:
                color, name = colour(place), "tracks"
            elif of < 0:
                color, name = WRONG, "paired with no object"
            else:
                color, name = colour(of), f"object {matching.object_ids[of]}, track" if few else "objects, track"
            positions_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
            yield _Line(road, rows["stamp_ns"], positions_m, color, "" if name in named else name)
            named.add(name)


def _ego(ego: Table, road: TrackMap) -> _Line | None:
    positions_m = np.stack([ego["x_m"], ego["y_m"]], axis=-1)
    if not np.isfinite(positions_m).all(axis=-1).any():
        return None
    return _Line(road, ego["stamp_ns"], positions_m, "black", "ego", "--", 0.9)

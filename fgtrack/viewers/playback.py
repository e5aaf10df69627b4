"""What the viewer of a report shows, as JSON values: recordings (map, ego, truth) and the runs of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import EGO_ID, LATE, FloatArray, IntArray
from fgtrack.evaluation.cautions import USED
from fgtrack.evaluation.palette import SENSORS, distinct_colours
from fgtrack.evaluation.placement import placed, update_rows
from fgtrack.evaluation.recordings import by_recording
from fgtrack.evaluation.roads import excluded_lines, road_lines, roads
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.io.run import Run, Table
from fgtrack.viewers.states import AROUND_95, NOMINAL_SIZE_M, ellipses, final_ns, located, start_ns, track_positions

FORMAT = "fgtrack-report/2"
MOST_ROWS = 60_000
"""Rows of a table that the viewer shows of all runs together; of more every second tick or stamp, every third ..."""

Json = dict[str, Any]  # Any: JSON values
_TIME_S, _POSITION_M, _ANGLE_RAD = 1e-4, 1e-3, 1e-4  # steps that numbers are rounded to
_LONGEST_S = 1e7  # times farther from the start are of another clock, and missing


@dataclass
class _Recording:
    """Runs of the same recording, their common start, and the place that their positions are relative to."""

    runs: list[Run]
    start_ns: int = 0
    origin_m: FloatArray = field(default_factory=lambda: np.zeros(2))


@dataclass(frozen=True)
class Moment:
    """A time and a position in the map that are worth a look."""

    now_ns: int
    x_m: float
    y_m: float


@dataclass(frozen=True)
class Scene:
    """What the viewer shows."""

    values: Json
    notes: tuple[str, ...]
    """What it does not show, a line each."""


def scene(runs: Sequence[JudgedRun], moment: Moment | None = None) -> Scene:
    """Return everything that the viewer shows of `runs`, first `moment`; times are seconds from the start.

    Raises
    ------
    DataError
        A run or its map is damaged.
    """
    recordings, notes = _recordings(runs), dict[str, None]()
    shown = []
    for one in runs:
        index = next(k for k, recording in enumerate(recordings) if any(one.run is its for its in recording.runs))
        packing = _Packing(recordings[index], notes, one.label, len(runs))
        shown.append({"label": one.label, "recording": index, **_run(one.run, packing)})
    values = {
        "format": FORMAT,
        "colours": distinct_colours([str(one.run.meta.get("estimator", "")) for one in runs]),
        "sensor_colours": SENSORS,
        "moment": None if moment is None else _first(moment, recordings[0]),
        "size_m": NOMINAL_SIZE_M[:2],
        "used": USED,
        "late": sorted(LATE),
        "recordings": [_recording(one, _Packing(one, notes, "", len(recordings))) for one in recordings],
        "runs": shown,
    }
    return Scene(values, tuple(notes))


def _first(moment: Moment, of: _Recording) -> Json:
    x0_m, y0_m = of.origin_m.tolist()
    return {"t": (moment.now_ns - of.start_ns) / NS_PER_S, "x": moment.x_m - x0_m, "y": moment.y_m - y0_m}


def _column(values: npt.ArrayLike, step: float = 1.0) -> Json:
    """Return a column as whole steps, with null for what is not finite."""
    steps = np.rint(np.asarray(values, dtype=np.float64) / step)
    finite = np.isfinite(steps)
    whole = np.where(finite, steps, 0.0).astype(np.int64).tolist()
    if not finite.all():
        whole = [value if known else None for value, known in zip(whole, finite.tolist(), strict=True)]
    return {"step": step, "values": whole}


@dataclass(frozen=True)
class _Packing:
    """Packs columns of a recording."""

    recording: _Recording
    notes: dict[str, None]
    label: str
    num_runs: int

    def time(self, ns: IntArray) -> Json:
        times_s = (ns - self.recording.start_ns) / NS_PER_S
        return _column(np.where(np.abs(times_s) < _LONGEST_S, times_s, math.nan), _TIME_S)

    def place(self, x_m: FloatArray, y_m: FloatArray) -> Json:
        x0_m, y0_m = self.recording.origin_m
        return {"x": _column(x_m - x0_m, _POSITION_M), "y": _column(y_m - y0_m, _POSITION_M)}

    def ellipse(self, states: Table) -> Json:
        """Half axes and direction of the ellipses that hold 95 %."""
        found = ellipses(states, AROUND_95)
        return {
            "long": _column(found[:, 0], _POSITION_M),
            "short": _column(found[:, 1], _POSITION_M),
            "direction": self.angle(found[:, 2]),
        }

    def angle(self, angles_rad: FloatArray) -> Json:
        return _column(angles_rad, _ANGLE_RAD)

    def thinned(self, table: Table, what: str) -> Table:
        """`table`, or the rows of every k-th of its stamps where it has too many."""
        stamps_ns = self.thinned_times(np.unique(table["stamp_ns"]), table.num_rows, what)
        return table.where(np.isin(table["stamp_ns"], stamps_ns))

    def thinned_times(self, times_ns: IntArray, num_rows: int, what: str) -> IntArray:
        """Every k-th of `times_ns`, which have `num_rows` rows."""
        step = max(1, math.ceil(num_rows * self.num_runs / MOST_ROWS))
        if step > 1:
            name = f"{self.label}: " if self.label else ""
            self.notes[f"{name}the viewer shows one of {step} times of {what}, as there are {num_rows} rows"] = None
        return times_ns[::step]


def _recordings(runs: Sequence[JudgedRun]) -> list[_Recording]:
    found = [_Recording([one.run for one in group]) for group in by_recording(runs)]
    for one in found:
        one.start_ns = min(map(start_ns, one.runs))
        one.origin_m = _origin_m(one.runs)
    return found


def _origin_m(runs: Sequence[Run]) -> FloatArray:
    """A place near the middle of all that is drawn, in whole metres."""
    for table in (runs[0].tables["ego"], runs[0].tables["truth"], *(run.tables["tracks"] for run in runs)):
        places_m = np.stack([table["x_m"], table["y_m"]], axis=-1)
        places_m = places_m[np.isfinite(places_m).all(axis=1)]
        if len(places_m):
            return np.asarray(np.rint(0.5 * (places_m.min(axis=0) + places_m.max(axis=0))))
    return np.zeros(2)


def _recording(one: _Recording, packing: _Packing) -> Json:
    run = one.runs[0]
    maps, notes = roads(run)
    packing.notes.update(dict.fromkeys(notes))
    lines = [
        {"kind": kind, **packing.place(*points_m.T)}
        for road in maps.values()
        for kind, points_m in zip(("bound", "bound", "centre"), road_lines(road), strict=True)
    ]
    lines += [{"kind": "bound", **packing.place(*points_m.T)} for points_m in excluded_lines(run)]
    ego = packing.thinned(located(run.tables["ego"]), "the ego")
    ego = _sorted(ego, ego["stamp_ns"])
    truth = run.tables["truth"].where(run.tables["truth"]["object_id"] != EGO_ID)
    truth = packing.thinned(located(truth), "the truth")
    truth = _sorted(truth, truth["stamp_ns"], truth["object_id"])
    return {
        "start_ns": str(one.start_ns),  # of more digits than a number of JavaScript holds
        "origin_m": one.origin_m.tolist(),
        "map": lines,
        "ego": {"t": packing.time(ego["stamp_ns"]), **_pose(ego, packing)},
        "truth": {
            "object": _column(truth["object_id"]),
            "t": packing.time(truth["stamp_ns"]),
            **_pose(truth, packing),
        },
    }


def _run(run: Run, packing: _Packing) -> Json:
    statuses = np.unique(run.tables["tracks"]["status"]).tolist()
    tracks, lagged = (
        located(run.tables["tracks"]),
        located(run.tables["lagged"].where(run.tables["lagged"]["lag_s"] > 0.0)),
    )
    ticks_ns = packing.thinned_times(
        np.unique(run.tables["timing"]["now_ns"]), max(tracks.num_rows, lagged.num_rows), "the ticks"
    )
    tracks = tracks.where(np.isin(tracks["now_ns"], ticks_ns))
    past = lagged.where(np.isin(lagged["now_ns"], ticks_ns))
    tracks = _sorted(tracks, tracks["now_ns"], tracks["track_id"])
    past = _sorted(past, past["now_ns"], past["track_id"], past["stamp_ns"])
    final = packing.thinned(
        located(run.tables["smoothed"].where(run.tables["smoothed"]["kind"] == "final")), "final states"
    )
    final = _sorted(final, final["track_id"], final["stamp_ns"])
    return {
        "estimator": str(run.meta.get("estimator", "")),
        "statuses": statuses,
        "ticks": packing.time(ticks_ns),
        "tracks": {
            "t": packing.time(tracks["now_ns"]),
            "track": _column(tracks["track_id"]),
            "status": _column(_codes(tracks["status"], statuses)),
            **_pose(tracks, packing),
            **packing.ellipse(tracks),
        },
        "past": {
            "t": packing.time(past["now_ns"]),
            "track": _column(past["track_id"]),
            **packing.place(past["x_m"], past["y_m"]),
            **packing.ellipse(past),
        },
        "final": {
            "track": _column(final["track_id"]),
            "t": packing.time(final["stamp_ns"]),
            "known": packing.time(final_ns(run, final)),
            **packing.place(final["x_m"], final["y_m"]),
            **packing.ellipse(final),
        },
        **_detections(run, packing),
    }


def _detections(run: Run, packing: _Packing) -> Json:
    """Detections in order of receipt: where they were, when, what became of them, where their track was then."""
    table, updates = run.tables["detections"], run.tables["updates"]
    if updates.num_rows and not table.num_rows:
        packing.notes[f"{packing.label}: has no detections.csv, so no detections are shown; repeat the run"] = None
    where, became = placed(run), update_rows(run)
    sensors = np.unique(table["sensor"]).tolist()
    known = became >= 0
    rows = np.where(known, became, 0)
    fates = np.where(known, updates["disposition"][rows], "") if updates.num_rows else np.full(len(became), "")
    ids = np.where(known, updates["track_id"][rows], -1) if updates.num_rows else np.full(len(became), -1)
    ticks = updates["tick"][rows].tolist() if updates.num_rows else [0] * len(became)
    positions = track_positions(run)
    nowhere = (math.nan, math.nan)
    track_m = np.array(
        [positions.get((tick, track), nowhere) for tick, track in zip(ticks, ids.tolist(), strict=True)]
    ).reshape(-1, 2)
    order = np.argsort(table["receipt_ns"], kind="stable")
    dispositions = np.unique(fates).tolist()
    track = packing.place(*track_m[order].T)
    found = {
        "stamp": packing.time(table["stamp_ns"][order]),
        "receipt": packing.time(table["receipt_ns"][order]),
        "sensor": _column(_codes(table["sensor"][order], sensors)),
        "disposition": _column(_codes(fates[order], dispositions)),
        "track": _column(ids[order]),
        **packing.place(*where.position_m[order].T),
        "track_x": track["x"],
        "track_y": track["y"],
    }
    if (np.isnan(where.position_m).any(axis=1) & np.isfinite(where.bearing_rad)).any():
        origin = packing.place(*where.sensor_m[order].T)
        found |= {"from_x": origin["x"], "from_y": origin["y"], "bearing": packing.angle(where.bearing_rad[order])}
    return {"sensors": sensors, "dispositions": dispositions, "detections": found}


def _pose(states: Table, packing: _Packing) -> Json:
    return {**packing.place(states["x_m"], states["y_m"]), "yaw": packing.angle(states["yaw_rad"])}


def _codes(names: Any, among: Sequence[str]) -> IntArray:
    """The place of each of `names`, shape (n,), in the sorted `among`."""
    return np.asarray(np.searchsorted(np.array(among, dtype=np.str_), names), dtype=np.int64)


def _sorted(table: Table, *keys: IntArray) -> Table:
    """The rows in the order of `keys`, the first one counts most."""
    order = np.lexsort(keys[::-1])
    return Table({name: values[order] for name, values in table.items()})

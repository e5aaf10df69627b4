"""JSON values for the viewer of a report: recordings (map, ego, truth) and their runs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import EGO_ID, LATE, FloatArray, IntArray
from fgtrack.evaluation.diagnostics import USED
from fgtrack.evaluation.placement import (
    detections_in_map,
    road_lines,
    roads,
    update_rows,
)
from fgtrack.evaluation.runs import EvaluatedRun, by_recording
from fgtrack.runs import Columns
from fgtrack.show.palette import SENSORS, distinct_colours
from fgtrack.show.states import (
    AROUND_95,
    NOMINAL_SIZE_M,
    ellipses,
    final_ns,
    start_ns,
    track_positions,
    with_position,
)

MOST_ROWS = 60_000
"""Largest number of table rows in the viewer, for all runs together; a larger table is thinned."""

Json = dict[str, Any]  # Any: JSON values
Moment = tuple[int, float, float]
"""Time [ns] and map position that the viewer shows first."""

# Decimal digits of seconds, and of metres and radians.
_TIME_DIGITS = 4
_DIGITS = 3
# Times farther from the start come from another clock and are excluded.
_LONGEST_S = 1e7


def playback(
    runs: Sequence[EvaluatedRun], moment: Moment | None = None
) -> tuple[Json, list[str]]:
    """Return the content of the viewer for `runs`, and a line for each content that it does not show.

    `moment` is shown first. Times are seconds from the start of the recording, and
    missing values are null. Raises `DataError` if a run or its map is damaged.
    """
    recordings = [
        _Recording(group, min(start_ns(item.run) for item in group))
        for group in by_recording(runs)
    ]
    notes = dict[str, None]()
    return {
        "colours": distinct_colours(
            [str(item.run.meta.get("estimator", "")) for item in runs]
        ),
        "sensor_colours": SENSORS,
        "moment": None
        if moment is None
        else {
            "t": (moment[0] - recordings[0].start_ns) / NS_PER_S,
            "x": moment[1],
            "y": moment[2],
        },
        "size_m": NOMINAL_SIZE_M[:2],
        "recordings": [
            item.values(notes, MOST_ROWS // len(recordings)) for item in recordings
        ],
        "runs": [
            {
                "label": item.label,
                "recording": index,
                **recording.run(item, notes, MOST_ROWS // len(runs)),
            }
            for item in runs
            for index, recording in enumerate(recordings)
            if item in recording.runs
        ],
    }, list(notes)


@dataclass(frozen=True)
class _Recording:
    """Runs of one recording, with the start of their time axis."""

    runs: Sequence[EvaluatedRun]
    start_ns: int

    def seconds(self, times_ns: IntArray) -> FloatArray:
        times_s = (times_ns - self.start_ns) / NS_PER_S
        return np.where(np.abs(times_s) < _LONGEST_S, times_s, math.nan)

    def rows(self, states: Columns, time: str, *order: str) -> Columns:
        """Return the rows of `states` with a finite position and time, sorted by the column `time`, then by the columns
        `order`.
        """
        states = self.placed(states, time)
        keys = np.lexsort([states[name] for name in (*reversed(order), time)])
        return states.where(keys)

    def placed(self, states: Columns, time: str) -> Columns:
        """Return the rows of `states` with a finite position and time."""
        states = with_position(states)
        return states.where(np.isfinite(self.seconds(states[time])))

    def columns(self, states: Columns, time: str) -> Json:
        """Return the columns of the viewer for rows of `states`: times, positions, and yaws if there are any.

        If the rows have covariances, the half axes and directions of the 95 % ellipses are added. `time` is the column
        with the times.
        """
        columns = {"t": _column(self.seconds(states[time]), _TIME_DIGITS)}
        columns |= {name: _column(states[f"{name}_m"]) for name in "xy"}
        if "yaw_rad" in states:
            columns["yaw"] = _column(states["yaw_rad"])
        if "p_x_x" in states:
            axes = ellipses(states, AROUND_95)
            columns |= {
                name: _column(axes[:, k])
                for k, name in enumerate(("long", "short", "direction"))
            }
        return columns

    def values(self, notes: dict[str, None], most: int) -> Json:
        """Return map, ego and truth for the viewer, at most about `most` rows each.

        A line for each content that is left out or thinned is added to `notes`.
        """
        run = self.runs[0].run
        maps, gone = roads(run)
        notes.update(dict.fromkeys(gone))
        lines = [
            (kind, line)
            for road in maps.values()
            for kind, line in zip(_LINES, road_lines(road), strict=True)
        ]
        ego = run.tables["ego"]
        truth = run.tables["truth"].where(run.tables["truth"]["object_id"] != EGO_ID)
        (ego,) = _thinned([self.rows(ego, "stamp_ns")], "stamp_ns", most, "ego", notes)
        # A long table is thinned before it is sorted.
        (truth,) = _thinned(
            [self.placed(truth, "stamp_ns")], "stamp_ns", most, "truth", notes
        )
        truth = self.rows(truth, "stamp_ns", "object_id")
        return {
            # A text, because a number of JavaScript has too few digits.
            "start_ns": str(self.start_ns),
            "map": [{"kind": kind, **_place(line)} for kind, line in lines],
            "ego": self.columns(ego, "stamp_ns"),
            "truth": {
                "object": _column(truth["object_id"]),
                **self.columns(truth, "stamp_ns"),
            },
        }

    def run(self, one: EvaluatedRun, notes: dict[str, None], most: int) -> Json:
        """Return the ticks of a run, its tracks and their past at every tick, its final states and its detections.

        A line for each thinned table is added to `notes`.
        """
        tables = one.run.tables
        lagged = tables["lagged"]
        smoothed = tables["smoothed"]
        past = self.rows(
            lagged.where(lagged["lag_s"] > 0.0), "now_ns", "track_id", "stamp_ns"
        )
        final = self.rows(smoothed.where(smoothed["kind"] == "final"), "stamp_ns")
        ticks = Columns({"now_ns": np.unique(tables["timing"]["now_ns"])})
        of_ticks = [ticks, self.placed(tables["tracks"], "now_ns"), past]
        ticks, tracks, past = _thinned(of_ticks, "now_ns", most, one.label, notes)
        tracks = self.rows(tracks, "now_ns", "track_id")
        (final,) = _thinned(
            [final], "stamp_ns", most, f"{one.label}, final states", notes
        )
        return {
            "ticks": _column(self.seconds(ticks["now_ns"]), _TIME_DIGITS),
            "tracks": {
                "track": _column(tracks["track_id"]),
                "confirmed": _column(tracks["status"] == "confirmed"),
                **self.columns(tracks, "now_ns"),
            },
            "past": {
                "track": _column(past["track_id"]),
                **self.columns(past, "now_ns"),
            },
            "final": {
                "track": _column(final["track_id"]),
                "known": _column(self.seconds(final_ns(one.run, final)), _TIME_DIGITS),
                **self.columns(final, "stamp_ns"),
            },
            **self.detections(one, notes, most),
        }

    def detections(self, one: EvaluatedRun, notes: dict[str, None], most: int) -> Json:
        """Return detections in order of receipt: stamp, sensor, fate, position, position of the track.

        The fate is 0 for unused, 1 for used and 2 for late detections. More than `most`
        rows are thinned to the lists of every k-th receipt.
        """
        run = one.run
        table = run.tables["detections"]
        updates = run.tables["updates"]
        where = detections_in_map(run)
        rows = update_rows(run)
        sensors, sensor = np.unique(table["sensor"], return_inverse=True)
        # Row -1 selects the empty text at the end.
        outcome = np.append(updates["disposition"].astype(np.str_), "")[rows]
        fate = np.isin(outcome, USED).astype(np.int64) + np.isin(outcome, LATE)
        order = np.argsort(table["receipt_ns"], kind="stable")
        order = order[np.isfinite(self.seconds(table["receipt_ns"][order]))]
        (shown,) = _thinned(
            [Columns({"receipt_ns": table["receipt_ns"][order], "row": order})],
            "receipt_ns",
            most,
            f"{one.label}, detections",
            notes,
        )
        order = shown["row"]
        return {
            "sensors": sensors.tolist(),
            "detections": {
                "stamp": _column(self.seconds(table["stamp_ns"][order]), _TIME_DIGITS),
                "receipt": _column(
                    self.seconds(table["receipt_ns"][order]), _TIME_DIGITS
                ),
                "sensor": _column(sensor[order]),
                "fate": _column(fate[order]),
                **_place(where.position_m[order]),
                **_place(track_positions(run, rows)[order], "track_"),
                **_place(where.sensor_m[order], "from_"),
                "bearing": _column(where.bearing_rad[order]),
            },
        }


_LINES = ("bound", "bound", "centre")  # kinds of the three lines of a road


def _place(position_m: FloatArray, prefix: str = "") -> Json:
    """Return the coordinates of positions (n, 2) as columns `x` and `y`, whose names begin with `prefix`."""
    return {f"{prefix}{name}": _column(position_m[:, k]) for k, name in enumerate("xy")}


def _thinned(
    tables: Sequence[Columns], time: str, most: int, label: str, notes: dict[str, None]
) -> list[Columns]:
    """Return `tables`, thinned to every k-th distinct time of the first table, so that about `most` rows remain.

    `time` is the column with the times. If no table has more than `most` rows, all are returned unchanged. A line on
    the thinning of `label` is added to `notes`.
    """
    num_rows = max(item.num_rows for item in tables)
    step = max(1, math.ceil(num_rows / most))
    if step > 1:
        notes[
            f"{label}: the viewer shows one time in {step}, because there are {num_rows} rows"
        ] = None
    kept_ns = np.unique(tables[0][time])[::step]
    return [
        item.where(np.isin(item[time], kept_ns)) if step > 1 else item
        for item in tables
    ]


def _column(values: npt.ArrayLike, digits: int = _DIGITS) -> list[float | int | None]:
    """Return numbers rounded to `digits`; None for a value that is not finite."""
    given = np.asarray(values)
    rounded = given + 0 if given.dtype.kind != "f" else np.round(given, digits) + 0.0
    return [value if math.isfinite(value) else None for value in rounded.tolist()]

"""Detections of a run in the map frame, their updates, and the roads of the map."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgtrack.core.geometry import cartesian, rotations, wrap_angles
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.truth import ego_states
from fgtrack.models.oval import OVAL, make_oval, make_pit_lane
from fgtrack.models.road import OPEN_SPACE
from fgtrack.models.track_map import TrackMap
from fgtrack.runs import Run

_BOUND_STEP_M = 2.0
_KEY = ["sensor", "stamp_ns", "receipt_ns", "index"]


@dataclass(frozen=True)
class DetectionsInMap:
    """Detections of a run in the map frame, in the order of `Run.detections`."""

    position_m: FloatArray
    """Position, shape (n, 2); NaN for a direction alone, and without an ego pose."""
    yaw_rad: FloatArray
    """Yaw, shape (n,); NaN if not measured."""
    sensor_m: FloatArray
    """Position of the sensor, shape (n, 2); NaN without an ego pose."""
    bearing_rad: FloatArray
    """Direction from the sensor, shape (n,); NaN if not measured."""

    def of(self, rows: IntArray) -> "DetectionsInMap":
        """Return the detections of `rows`."""
        return DetectionsInMap(
            self.position_m[rows],
            self.yaw_rad[rows],
            self.sensor_m[rows],
            self.bearing_rad[rows],
        )


def detections_in_map(run: Run) -> DetectionsInMap:
    """Return the detections of `run` in the map frame.

    The ego poses come from ego.csv, with linear interpolation between stamps.
    """
    table = run.tables["detections"]
    frame = table["frame"]
    stamps_ns = table["stamp_ns"]
    poses = ego_states(run.tables["ego"], stamps_ns)
    ego = run.config.get("ego") or {}
    sensors = run.config.get("sensors") or {}
    origin = [
        float(ego.get("detection_origin_x_m", 0.0)),
        float(ego.get("detection_origin_y_m", 0.0)),
        0.0,
    ]
    mounts = np.tile(origin, (len(frame), 1))  # ahead, left, yaw
    for name in np.unique(table["sensor"]).tolist():
        mount = (sensors.get(name) or {}).get("mount") or {}
        mine = (frame == "sensor") & (table["sensor"] == name)
        mounts[mine] += [
            float(mount.get(key, 0.0)) for key in ("x_m", "y_m", "yaw_rad")
        ]
    sensor_rad = poses[:, 2] + mounts[:, 2]
    sensor_m = poses[:, :2] + np.einsum(
        "nij,nj->ni", rotations(poses[:, 2]), mounts[:, :2]
    )
    in_map = frame == "map"
    given_m = np.stack([table["x_m"], table["y_m"]], axis=-1)
    turned_m = sensor_m + np.einsum("nij,nj->ni", rotations(sensor_rad), given_m)
    bearing_rad = sensor_rad + table["bearing_rad"]
    polar_m = sensor_m + cartesian(np.stack([bearing_rad, table["range_m"]], axis=-1))
    position_m = np.where(in_map[:, None], given_m, turned_m)
    position_m = np.where(
        np.isfinite(given_m).all(axis=-1)[:, None], position_m, polar_m
    )
    yaw_rad = np.where(in_map, table["yaw_rad"], table["yaw_rad"] + sensor_rad)
    with np.errstate(invalid="ignore"):  # angles may be infinite
        return DetectionsInMap(
            position_m, wrap_angles(yaw_rad), sensor_m, wrap_angles(bearing_rad)
        )


def update_rows(run: Run) -> IntArray:
    """Return the row of `Run.updates` for each row of `Run.detections`, shape (n,); -1 for a detection without an
    update.
    """
    updates = run.tables["updates"]
    detections = run.tables["detections"]
    n = updates.num_rows
    # The writer has one order for both; detections that were never processed follow.
    if n <= detections.num_rows and all(
        np.array_equal(updates[name], detections[name][:n]) for name in _KEY
    ):
        return np.where(
            np.arange(detections.num_rows) < n, np.arange(detections.num_rows), -1
        )
    import pandas as pd

    frames = run.updates[_KEY], run.detections[_KEY]
    keys = [
        pd.MultiIndex.from_frame(frame.assign(nth=frame.groupby(_KEY).cumcount()))
        for frame in frames
    ]
    return np.asarray(keys[0].get_indexer(keys[1]), dtype=np.int64)


def roads(run: Run) -> tuple[dict[str, TrackMap], list[str]]:
    """Return the configured maps, `track` and `pit`, and a line for each missing map file.

    Raises `DataError` for an invalid map.
    """
    result = {}
    notes = []
    config = run.config.get("map") or {}
    for key, built_in in (("track", make_oval), ("pit", make_pit_lane)):
        name = config.get(key)
        if name == OVAL:
            result[key] = built_in()
        elif name and Path(str(name)).is_file():
            result[key] = TrackMap.read(Path(str(name)))
        elif name and name != OPEN_SPACE:
            notes.append(f"map.{key}: the file {name} is missing, so it is not shown")
    return result, notes


def road_lines(road: TrackMap) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the left bound, the right bound and the reference line of `road`, shape (n, 2) each."""
    s_m = np.linspace(
        0.0, road.length_m, max(2, round(road.length_m / _BOUND_STEP_M)) + 1
    )
    left_m, right_m = road.bounds(s_m)
    return (
        road.position(s_m, left_m),
        road.position(s_m, -right_m),
        road.position(s_m, np.zeros_like(s_m)),
    )

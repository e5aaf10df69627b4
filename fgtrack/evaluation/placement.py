"""Detections of a run in the map, the outcome of each, and the roads of the map."""

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
class Placed:
    """The detections of a run in the map, in the order of `Run.detections`."""

    position_m: FloatArray
    """Shape (n, 2); NaN where only a direction was measured, and where no pose of the ego is known."""
    yaw_rad: FloatArray
    """Shape (n,); NaN where it was not measured."""
    sensor_m: FloatArray
    """Position of the sensor, shape (n, 2); NaN where no pose of the ego is known."""
    bearing_rad: FloatArray
    """Direction from the sensor, shape (n,); NaN where it was not measured."""


def placed(run: Run) -> Placed:
    """The detections of `run` in the map, by the path of the ego in ego.csv, linear between its stamps."""
    table = run.tables["detections"]
    frame, stamps_ns = table["frame"], table["stamp_ns"]
    poses = ego_states(run.tables["ego"], stamps_ns)
    ego, sensors = run.config.get("ego") or {}, run.config.get("sensors") or {}
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
    turns, sensor_rad = rotations(poses[:, 2]), poses[:, 2] + mounts[:, 2]
    sensor_m = poses[:, :2] + np.einsum("nij,nj->ni", turns, mounts[:, :2])
    in_map, given_m = frame == "map", np.stack([table["x_m"], table["y_m"]], axis=-1)
    turned_m = sensor_m + np.einsum("nij,nj->ni", rotations(sensor_rad), given_m)
    bearing_rad = sensor_rad + table["bearing_rad"]
    polar_m = sensor_m + cartesian(np.stack([bearing_rad, table["range_m"]], axis=-1))
    position_m = np.where(in_map[:, None], given_m, turned_m)
    position_m = np.where(
        np.isfinite(given_m).all(axis=-1)[:, None], position_m, polar_m
    )
    yaw_rad = np.where(in_map, table["yaw_rad"], table["yaw_rad"] + sensor_rad)
    with np.errstate(invalid="ignore"):  # of infinite angles
        return Placed(
            position_m, wrap_angles(yaw_rad), sensor_m, wrap_angles(bearing_rad)
        )


def update_rows(run: Run) -> IntArray:
    """Row of `Run.updates` with the outcome of each of `Run.detections`, shape (n,); -1 without one."""
    import pandas as pd

    frames = run.updates[_KEY], run.detections[_KEY]
    keys = [
        pd.MultiIndex.from_frame(frame.assign(nth=frame.groupby(_KEY).cumcount()))
        for frame in frames
    ]
    return np.asarray(keys[0].get_indexer(keys[1]), dtype=np.int64)


def roads(run: Run) -> tuple[dict[str, TrackMap], list[str]]:
    """The maps that the configuration names, `track` and `pit`, and a line for each that is gone; or `DataError`."""
    result, notes = {}, []
    config = run.config.get("map") or {}
    for key, built_in in (("track", make_oval), ("pit", make_pit_lane)):
        name = config.get(key)
        if name == OVAL:
            result[key] = built_in()
        elif name and Path(str(name)).is_file():
            result[key] = TrackMap.read(Path(str(name)))
        elif name and name != OPEN_SPACE:
            notes.append(f"map.{key}: {name} is not there any more, so it is not shown")
    return result, notes


def road_lines(road: TrackMap) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the left bound, the right bound and the reference line of `road`, each of shape (n, 2)."""
    s_m = np.linspace(
        0.0, road.length_m, max(2, round(road.length_m / _BOUND_STEP_M)) + 1
    )
    left_m, right_m = road.bounds(s_m)
    return (
        road.position(s_m, left_m),
        road.position(s_m, -right_m),
        road.position(s_m, np.zeros_like(s_m)),
    )

"""Positions of the detections of a run in the map, and the outcome of each."""

from collections import defaultdict, deque
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import cartesian, rotations, wrap_angles
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.evaluation.truth import ego_states
from fgtrack.io.run import Run
from fgtrack.io.run.schema import Column

_KEY = ("sensor", "stamp_ns", "receipt_ns", "index")


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
    """The detections of `run` in the map, by the path of the ego in ego.csv, linear between its stamps.

    The tracker itself uses what it knew of the ego when they came.
    """
    table = run.tables["detections"]
    frame, stamps_ns = table["frame"], table["stamp_ns"]
    poses = ego_states(run.tables["ego"], stamps_ns)
    mounts = _mounts(run, table["sensor"], frame == "sensor")
    turns, sensor_rad = rotations(poses[:, 2]), poses[:, 2] + mounts[:, 2]
    sensor_m = poses[:, :2] + np.einsum("nij,nj->ni", turns, mounts[:, :2])
    in_map, given_m = frame == "map", np.stack([table["x_m"], table["y_m"]], axis=-1)
    turned_m = sensor_m + np.einsum("nij,nj->ni", rotations(sensor_rad), given_m)
    bearing_rad = sensor_rad + table["bearing_rad"]
    polar_m = sensor_m + cartesian(np.stack([bearing_rad, table["range_m"]], axis=-1))
    position_m = np.where(in_map[:, None], given_m, turned_m)
    position_m = np.where(np.isfinite(given_m).all(axis=-1)[:, None], position_m, polar_m)
    yaw_rad = np.where(in_map, table["yaw_rad"], table["yaw_rad"] + sensor_rad)
    with np.errstate(invalid="ignore"):  # of infinite angles
        return Placed(position_m, wrap_angles(yaw_rad), sensor_m, wrap_angles(bearing_rad))


def update_rows(run: Run) -> IntArray:
    """Row of `Run.updates` with the outcome of each of `Run.detections`, shape (n,); -1 without one."""
    waiting: defaultdict[tuple[object, ...], deque[int]] = defaultdict(deque)
    for row, key in enumerate(zip(*(run.tables["updates"][name].tolist() for name in _KEY), strict=True)):
        waiting[key].append(row)
    keys = zip(*(run.tables["detections"][name].tolist() for name in _KEY), strict=True)
    return np.array([waiting[key].popleft() if waiting[key] else -1 for key in keys], dtype=np.int64)


def _mounts(run: Run, sensors: Column, mounted: BoolArray) -> FloatArray:
    """Position (ahead, left) and yaw, shape (n, 3), of the frames of detections on the ego.

    `mounted` is True for the frames of the sensors themselves; the others are the ego's detection frame.
    """
    config = run.config
    ego, known = config.get("ego") or {}, config.get("sensors") or {}
    origin = np.array([float(ego.get("detection_origin_x_m", 0.0)), float(ego.get("detection_origin_y_m", 0.0)), 0.0])
    result = np.tile(origin, (len(sensors), 1))
    for name in np.unique(sensors).tolist():
        mount = (known.get(name) or {}).get("mount") or {}
        result[mounted & (sensors == name)] += [float(mount.get(key, 0.0)) for key in ("x_m", "y_m", "yaw_rad")]
    return result

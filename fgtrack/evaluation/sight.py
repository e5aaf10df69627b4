"""Which true objects some sensor could have seen, so that only these count as missed."""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from fgtrack.core.errors import DataError
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.evaluation.truth import TruePath
from fgtrack.io.run import Run, Table
from fgtrack.models.sensors import SensorModel


@cache
def _models() -> TypeAdapter[dict[str, SensorModel]]:
    return TypeAdapter(dict[str, SensorModel])


def in_sight(run: Run, paths: Sequence[TruePath], now_ns: IntArray) -> tuple[BoolArray, bool]:
    """Whether each object of `paths` is in range and in the field of view of a sensor at `now_ns`, shape (n, objects).

    Asked are the sensors that the run had detections of, as its configuration describes them, from the pose of the ego
    that ego.csv gives (linear between its stamps). Nothing hides an object. Where the ego's path, a sensor or its range
    and field of view are not known, every object counts as seen, and the second value is false; an object without
    truth is not seen.

    Raises
    ------
    DataError
        The configuration of the run is damaged.
    """
    positions_m = np.stack([path.at(now_ns)[:, :2] for path in paths], axis=1)
    present = np.asarray(np.isfinite(positions_m).all(axis=-1))
    sensors, poses = _sensors(run), ego_poses(run.tables["ego"], now_ns)
    if poses is None or not sensors:
        return present, False
    ego = run.config.get("ego") or {}
    origin_m = (float(ego.get("detection_origin_x_m", 0.0)), float(ego.get("detection_origin_y_m", 0.0)))
    positions_m[~present] = 0.0
    everywhere = np.broadcast_to(poses[:, None], (*present.shape, 3))
    seen = np.stack([sensor.sees(positions_m, everywhere, origin_m) for sensor in sensors])
    return present & np.asarray(seen.any(axis=0)), all(map(_is_limited, sensors))


def ego_poses(ego: Table, stamps_ns: IntArray) -> FloatArray | None:
    """x, y and yaw (not wrapped) of the ego at `stamps_ns`, shape (n, 3), constant beyond the ends; None if unknown."""
    states = ego_states(ego, stamps_ns)
    return None if states is None else states[:, :3]


def ego_states(ego: Table, stamps_ns: IntArray) -> FloatArray | None:
    """As `ego_poses`, with the speed, shape (n, 4)."""
    rows = np.stack([ego[name] for name in ("x_m", "y_m", "yaw_rad", "speed_mps")], axis=-1)
    known = np.flatnonzero(np.isfinite(rows[:, :3]).all(axis=1))
    if not len(known):
        return None
    at_ns, first = np.unique(ego["stamp_ns"][known], return_index=True)
    rows = rows[known[first]]
    rows[:, 2] = np.unwrap(rows[:, 2])
    times, wanted = ((ns - at_ns[0]).astype(np.float64) for ns in (at_ns, stamps_ns))
    return np.stack([np.interp(wanted, times, column) for column in rows.T], axis=-1)


def _is_limited(sensor: SensorModel) -> bool:
    limits_m = (sensor.max_range_m, sensor.view_range_m, sensor.max_range_behind_m)
    return any(limit_m is not None for limit_m in limits_m) or (sensor.field_of_view_rad or math.tau) < math.tau


def _sensors(run: Run) -> list[SensorModel]:
    """Models of the sensors that occur in the run."""
    found: Mapping[str, Any] = run.config.get("sensors") or {}
    heard = np.unique(run.tables["updates"]["sensor"]).tolist()
    try:
        models = _models().validate_python({name: found[name] for name in heard if name in found})
    except ValidationError as error:
        (first, *_) = error.errors()
        where = ".".join(map(str, first["loc"]))
        raise DataError(f"{run.config_path}: sensors.{where}: {first['msg']}") from error
    return list(models.values()) if len(models) == len(heard) else []

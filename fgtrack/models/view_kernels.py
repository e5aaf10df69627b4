"""Compiled test for the field of view and the range of sensors."""

import math

import numpy as np

from fgtrack.core.compiled import check, inlined, njit, wrapped
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.sensors import NUM_LIMITS

AHEAD_M, LEFT_M, YAW_RAD, HALF_FIELD_RAD, LEAST_M, MOST_M, MOST_BEHIND_M = range(7)
"""Columns of the limits of sensors: pose of the sensor in the ego frame, half of the field of view, least and
largest range, and largest range in the half-plane behind the sensor."""


@inlined
def _is_in_view(range_m: float, bearing_rad: float, limits: FloatArray) -> bool:
    """True for an object in range, at most half of the field of view away from the axis of the sensor."""
    off_axis_rad = abs(wrapped(bearing_rad))
    most_m = limits[MOST_M]
    if off_axis_rad > math.pi / 2.0:
        most_m = min(limits[MOST_BEHIND_M], most_m)
    is_in_range = limits[LEAST_M] <= range_m <= most_m
    return bool(is_in_range and off_axis_rad <= limits[HALF_FIELD_RAD])


@njit("b1[::1](float64[::1], float64[::1], float64[::1])")
def in_view(
    range_m: FloatArray, bearing_rad: FloatArray, limits: FloatArray
) -> BoolArray:
    """Return True for each object that a sensor with `limits` (7,) sees, shape (m,).

    Ranges and bearings (m,) are those from the sensor; a bearing is 0 on the axis of the sensor.
    """
    check(len(bearing_rad) >= len(range_m) and len(limits) >= NUM_LIMITS)
    result = np.empty(len(range_m), np.bool_)
    for i in range(len(range_m)):
        result[i] = _is_in_view(range_m[i], bearing_rad[i], limits)
    return result


@njit("void(float64[:, :], float64[:, ::1], float64[:, ::1], int64[::1], b1[:, ::1])")
def look(
    positions_m: FloatArray,
    poses: FloatArray,
    limits: FloatArray,
    columns: IntArray,
    views: BoolArray,
) -> None:
    """Write True to `views` (m, sensors) for each object that a sensor sees.

    Sensors with `limits` (s, 7) have the `columns` (s,). The ego has the poses x, y, yaw (1, 3) or (m, 3) in the map.
    """
    m = len(positions_m)
    check(positions_m.shape[1] >= 2 and poses.shape[1] >= 3)
    check(len(poses) == 1 or len(poses) >= m)
    check(limits.shape[1] == NUM_LIMITS and len(columns) >= len(limits))
    check(len(views) >= m)
    for k in range(len(limits)):
        check(0 <= columns[k] < views.shape[1])
    for i in range(m):
        pose = poses[min(i, len(poses) - 1)]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        for k in range(len(limits)):
            own = limits[k]
            dx = positions_m[i, 0] - pose[0] - (c * own[AHEAD_M] - s * own[LEFT_M])
            dy = positions_m[i, 1] - pose[1] - (s * own[AHEAD_M] + c * own[LEFT_M])
            bearing_rad = math.atan2(dy, dx) - pose[2] - own[YAW_RAD]
            views[i, columns[k]] = _is_in_view(math.hypot(dx, dy), bearing_rad, own)

"""Angles and planar transforms in REP-103 (yaw 0 along +x, counter-clockwise)."""

import math
from typing import TypeVar

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray

TWO_PI = 2.0 * math.pi
Real = TypeVar("Real", float, FloatArray)


def may_be_radians(least: float, most: float) -> bool:
    """True if angles from `least` to `most` lie within one turn, and none is larger than a turn."""
    turn_rad = 2.0 * math.pi + 0.01
    return most - least <= turn_rad and max(-least, most) <= turn_rad


def wrap_angle(angle_rad: float) -> float:
    """Angle in (-pi, pi]; exact (unchanged to the bit) where it lies there already."""
    if -math.pi < angle_rad <= math.pi:
        return angle_rad
    wrapped = math.fmod(angle_rad + math.pi, TWO_PI)
    return wrapped + math.pi if wrapped <= 0.0 else wrapped - math.pi


def wrap_angles(angles_rad: FloatArray) -> FloatArray:
    """Angles in (-pi, pi], any shape; exact (unchanged to the bit) where they lie there already."""
    largest_rad = (
        abs(angles_rad.item())
        if angles_rad.size == 1
        else np.abs(angles_rad).max(initial=0.0)
    )
    if largest_rad < np.pi:
        return angles_rad
    inside = (angles_rad > -np.pi) & (angles_rad <= np.pi)
    wrapped = np.pi - np.mod(np.pi - angles_rad, TWO_PI)
    wrapped = np.where(
        wrapped <= -np.pi, np.pi, wrapped
    )  # one rounding above pi; NaN stays NaN
    return np.asarray(np.where(inside, angles_rad, wrapped))


def rotation(yaw_rad: float) -> FloatArray:
    """Rotation matrix parent_from_child, shape (2, 2), of a child frame turned by `yaw_rad`."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


def rotations(yaws_rad: FloatArray) -> FloatArray:
    """Rotation matrices, shape (..., 2, 2), of child frames turned by `yaws_rad`, shape (...)."""
    c, s = np.cos(yaws_rad), np.sin(yaws_rad)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def in_polygon(points: FloatArray, corners: FloatArray) -> BoolArray:
    """True (n,) where `points` (n, 2) lie inside a polygon with `corners` (m, 2), by the parity of crossed edges."""
    x, y = points[:, :1], points[:, 1:]
    (ax, ay), (bx, by) = corners.T, np.roll(corners, -1, axis=0).T
    spans = (ay > y) != (by > y)
    at = ax + (y - ay) * (bx - ax) / np.where(ay == by, 1.0, by - ay)
    return np.asarray((spans & (x < at)).sum(axis=1) % 2 == 1)


def circular_mean(angles_rad: FloatArray) -> float:
    """Mean direction of `angles_rad`, shape (n,), in (-pi, pi]."""
    return math.atan2(float(np.sin(angles_rad).sum()), float(np.cos(angles_rad).sum()))


def polar(vector: FloatArray) -> FloatArray:
    """Direction in [-pi, pi], 0 for the zero vector, and length of `vector`; both of shape (..., 2)."""
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([np.arctan2(y, x), np.hypot(x, y)], axis=-1)


def polar_gradient(vector: FloatArray, floor: float) -> FloatArray:
    """Derivative of `polar` by `vector`, shape (..., 2, 2), of the direction as if the length were at least `floor`."""
    x, y = vector[..., 0], vector[..., 1]
    direction, length = np.arctan2(y, x), np.maximum(np.hypot(x, y), floor)
    c, s = np.cos(direction), np.sin(direction)
    return np.stack(
        [np.stack([-s / length, c / length], axis=-1), np.stack([c, s], axis=-1)],
        axis=-2,
    )


def cartesian(direction_length: FloatArray) -> FloatArray:
    """Vector of a direction and a (signed) length, both of shape (..., 2)."""
    direction, length = direction_length[..., 0], direction_length[..., 1]
    return np.stack([length * np.cos(direction), length * np.sin(direction)], axis=-1)


def cartesian_gradient(direction_length: FloatArray) -> FloatArray:
    """Derivative of `cartesian` by direction and length, shape (..., 2, 2)."""
    direction, length = direction_length[..., 0], direction_length[..., 1]
    c, s = np.cos(direction), np.sin(direction)
    return np.stack(
        [np.stack([-length * s, c], axis=-1), np.stack([length * c, s], axis=-1)],
        axis=-2,
    )


def body_point(
    x_m: Real,
    y_m: Real,
    yaw_rad: Real,
    speed_mps: Real,
    yaw_rate_radps: Real,
    ahead_m: float,
    left_m: float,
) -> tuple[Real, Real, Real, Real]:
    """Position x, y and velocity vx, vy = v + w x r, in the map, of a point fixed to a body that moves along its yaw.
    The lever arm r from the body's reference point x, y is `ahead_m` and to the `left_m`. Floats, or arrays of one
    shape.
    """
    own = (
        np if isinstance(yaw_rad, np.ndarray) else math
    )  # a third of the time for floats
    c, s = own.cos(yaw_rad), own.sin(yaw_rad)
    arm_x_m, arm_y_m = c * ahead_m - s * left_m, s * ahead_m + c * left_m
    vx_mps, vy_mps = (
        speed_mps * c - yaw_rate_radps * arm_y_m,
        speed_mps * s + yaw_rate_radps * arm_x_m,
    )
    return x_m + arm_x_m, y_m + arm_y_m, vx_mps, vy_mps

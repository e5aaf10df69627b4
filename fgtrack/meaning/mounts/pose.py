"""Planar poses: yaw, x and y of a sensor in the ego, or in another sensor."""

from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import rotation, wrap_angle
from fgtrack.core.types import FloatArray

__all__ = ["QUARTER", "Pose2", "inverse"]

QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
"""Rotation by a quarter of a turn."""


class Pose2(NamedTuple):
    """A planar pose: yaw, x and y."""

    yaw_rad: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0

    @property
    def shift_m(self) -> FloatArray:
        """The translation, shape (2,)."""
        return np.array([self.x_m, self.y_m])

    def shifted(self, d: FloatArray) -> "Pose2":
        """Return the pose with `d`, shape (3,), added to yaw, x and y."""
        yaw_rad, x_m, y_m = map(float, d)
        return Pose2(wrap_angle(self.yaw_rad + yaw_rad), self.x_m + x_m, self.y_m + y_m)

    def after(self, other: "Pose2") -> "Pose2":
        """Return the pose, given in the frame of `other`, in the parent of `other`."""
        x_m, y_m = rotation(other.yaw_rad) @ self.shift_m + other.shift_m
        return Pose2(wrap_angle(self.yaw_rad + other.yaw_rad), float(x_m), float(y_m))

    def moved(self, points_m: FloatArray) -> FloatArray:
        """Return `points_m` (n, 2), given in this frame, in its parent."""
        return np.asarray(points_m @ rotation(self.yaw_rad).T + self.shift_m)


def inverse(pose: Pose2) -> Pose2:
    """Return the pose of the parent in the frame of `pose`."""
    x_m, y_m = -rotation(-pose.yaw_rad) @ pose.shift_m
    return Pose2(-pose.yaw_rad, float(x_m), float(y_m))

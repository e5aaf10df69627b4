"""Propagation of the error of the ego's pose and motion into the innovation of a detection."""

from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.models.measurement import MeasurementModel, SensorPose


class PoseError(NamedTuple):
    """The error e of a sensor pose in the innovation z - h(x, pose) = ... + G e of a detection.

    e is the estimated pose minus the true one, of x, y, yaw, vx and vy of the sensor, the same for all detections of a
    batch. It enters z where the detection was placed in the map by the pose, and h where it is relative to the sensor.
    """

    covariance: FloatArray
    """Covariance of e, shape (5, 5)."""
    placement: FloatArray
    """Derivative of z by the pose, shape (k, 5), or (m, k, 5) of many detections."""
    R: FloatArray
    """Covariance of the detection itself, without e, shape (k, k) or (m, k, k)."""

    def gain(self, model: MeasurementModel, pose: SensorPose, x: FloatArray) -> FloatArray:
        """G at the states `x` (..., n) of the object, shape (..., k, 5), or (k, 5) where it is the same at all."""
        return self.placement - model.pose_jacobian(x, pose) if model.relative else self.placement

    def noise(self, model: MeasurementModel, pose: SensorPose, x: FloatArray) -> FloatArray:
        """R + G P_e G' at the states `x` (..., n), shape (..., k, k), or (k, k) where it is the same at all."""
        return self.R + symmetrise(congruence(self.gain(model, pose, x), self.covariance))


def placement(components: tuple[str, ...], offsets_m: FloatArray, assumed: tuple[str, ...] = ()) -> FloatArray:
    """Derivative, shape (..., k, 5), of detections that a pose placed in the map, by its x, y, yaw, vx and vy.

    `offsets_m` (..., 2) is where they lie in the map, seen from the pose. What is `assumed`, as a heading from the map,
    was not turned by the pose; a speed is over ground, whatever the ego does.
    """
    D = np.zeros((*offsets_m.shape[:-1], len(components), 5))
    for row, name in enumerate(components):
        if name == "x_m":
            D[..., row, 0], D[..., row, 2] = 1.0, -offsets_m[..., 1]
        elif name == "y_m":
            D[..., row, 1], D[..., row, 2] = 1.0, offsets_m[..., 0]
        elif name == "yaw_rad" and name not in assumed:
            D[..., row, 2] = 1.0
    return D

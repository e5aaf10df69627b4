"""The ego's state from odometry."""

import math

import numpy as np

from fgtrack.core.types import EgoState, FloatArray
from fgtrack.io.adapters.common import RosMessage, planar, signed_speed_mps, speed_gradient, stamp_ns, yaw_rad

ODOMETRY = "nav_msgs/msg/Odometry"

_UNKNOWN = 1e3


def ego_from_odometry(message: RosMessage, receipt_ns: int) -> EgoState:
    """`nav_msgs/Odometry`: pose in the map, twist in the ego's own frame; an unknown yaw is NaN."""
    pose, twist = message.pose.pose, message.twist.twist
    yaw = yaw_rad(pose.orientation)
    return EgoState(
        stamp_ns(message.header.stamp),
        receipt_ns,
        x_m=pose.position.x,
        y_m=pose.position.y,
        yaw_rad=math.nan if yaw is None else yaw,
        speed_mps=signed_speed_mps(twist.linear.x, twist.linear.y, 0.0),
        yaw_rate_radps=twist.angular.z,
        covariance=_covariance(message),
    )


def _covariance(message: RosMessage) -> tuple[float, ...] | None:
    """Covariance of x, y, yaw, speed and yaw rate, row-major; of pose and twist each, zero where it is not known."""
    full = np.zeros((5, 5))
    pose = planar(message.pose.covariance)
    if _is_known(pose):
        full[:3, :3] = pose
    twist = planar(message.twist.covariance)
    velocity = message.twist.twist.linear
    direction = speed_gradient(velocity.x, velocity.y)
    J = np.eye(2, 3, k=1)  # of speed and yaw rate by vx, vy and yaw rate
    J[0, :2] = -direction if signed_speed_mps(velocity.x, velocity.y, 0.0) < 0.0 else direction
    turned = J @ twist @ J.T
    if _is_known(turned):
        full[3:, 3:] = turned
    return tuple(full.ravel().tolist()) if full.any() else None


def _is_known(covariance: FloatArray) -> bool:
    """True if all is finite and every variance is in use: "unknown" is 0 or -1 in ROS, 1e3 or more in many drivers."""
    variances = np.diag(covariance)
    return bool(np.isfinite(covariance).all() and (variances > 0.0).all() and (variances < _UNKNOWN).all())

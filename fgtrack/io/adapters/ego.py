"""The ego's state from odometry."""

import math

from fgtrack.core.types import EgoState
from fgtrack.io.adapters.common import RosMessage, signed_speed_mps, stamp_ns, yaw_rad

ODOMETRY = "nav_msgs/msg/Odometry"


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
    )

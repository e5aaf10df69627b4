"""Adapters of common ROS message types: object lists, and the ego from odometry.

Each adapter reads all components that a message measures. A speed is negative if the
object moves backwards. NaN stays NaN and is counted by the tracker.
"""

import math
from typing import Any

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import Detection, EgoState, FloatArray
from fgtrack.inputs.formats.common import (
    ObjectList,
    RosMessage,
    covariance,
    object_id,
    object_list,
    planar,
    signed_speed_mps,
    speed_gradient,
    stamp_ns,
    yaw_rad,
)

ODOMETRY = "nav_msgs/msg/Odometry"
_ORIENTATION_AVAILABLE = 2  # in autoware's DetectedObjectKinematics
_AUTOWARE_CLASSES = (
    "unknown",
    "car",
    "truck",
    "bus",
    "trailer",
    "motorcycle",
    "bicycle",
    "pedestrian",
)
_ESR_NO_TARGET = 0  # a status
_ID_MASK = (1 << 63) - 1
#: Variance from which a driver means "unknown".
_UNKNOWN = 1e3


def detection3d_array(message: RosMessage) -> ObjectList:
    """Return the object list of a `vision_msgs/Detection3DArray`, versions 2 to 4: position and yaw.

    Position and yaw are taken from the box, or from the first hypothesis if the box has
    no size. The covariance is taken from the first hypothesis.
    """
    return object_list(message.header, map(_detection3d, message.detections))


def _detection3d(item: RosMessage) -> Detection:
    pose = item.bbox.center
    size = item.bbox.size
    first = item.results[0] if len(item.results) else None
    hypothesis = getattr(first, "pose", None)
    if hypothesis is not None and size.x == size.y == size.z == 0.0:
        pose = hypothesis.pose
    # Class and score have different names in different versions.
    kind = getattr(first, "hypothesis", first)
    name = getattr(kind, "class_id", getattr(kind, "id", None))
    identity = getattr(item, "id", "") or getattr(item, "tracking_id", "")
    values = {
        "x_m": pose.position.x,
        "y_m": pose.position.y,
        "yaw_rad": yaw_rad(pose.orientation),
    }
    return Detection(
        **values,
        covariance=None
        if hypothesis is None
        else covariance(values, planar(hypothesis.covariance)),
        stamp_ns=stamp_ns(item.header.stamp) or None,
        object_id=object_id(identity),
        **_size(size, pose.position.z),
        score=getattr(kind, "score", None),
        class_name=None if name in (None, "") else str(name),
    )


def _size(size: RosMessage, z_m: float | None = None) -> dict[str, Any]:
    """Return the height `z_m` of the centre, and length, width and height of a box with a length."""
    centre = {"z_m": z_m}
    if size.x > 0.0:
        centre |= {"length_m": size.x, "width_m": size.y, "height_m": size.z}
    return centre


def autoware_objects(message: RosMessage) -> ObjectList:
    """Return the object list of Autoware's detected, tracked or predicted objects, in either message package.

    Position; yaw if its sign is certain; speed if there is a twist, which is in the
    object's own frame.
    """
    return object_list(message.header, map(_autoware_object, message.objects))


def _autoware_object(item: RosMessage) -> Detection:
    """Return the detection of an object, which may lack an id, a twist or covariances.

    A predicted object has an initial pose and twist, and always an orientation.
    """
    kinematics = item.kinematics
    has_twist = getattr(kinematics, "has_twist", True)
    is_predicted = hasattr(kinematics, "initial_pose_with_covariance")
    start = "initial_" if is_predicted else ""
    posed = getattr(kinematics, f"{start}pose_with_covariance")
    pose = posed.pose
    twist = getattr(kinematics, f"{start}twist_with_covariance")
    velocity = twist.twist.linear
    available = is_predicted or (
        kinematics.orientation_availability == _ORIENTATION_AVAILABLE
    )
    values = {
        "x_m": pose.position.x,
        "y_m": pose.position.y,
        "yaw_rad": yaw_rad(pose.orientation) if available else None,
        "speed_mps": signed_speed_mps(
            velocity.x, velocity.y, 0.0 if available else None
        )
        if has_twist
        else None,
    }
    pose_covariance = None
    has_twist_covariance = getattr(kinematics, "has_twist_covariance", True)
    if getattr(kinematics, "has_position_covariance", True):
        pose_covariance = planar(posed.covariance)
    label = (
        max(item.classification, key=lambda each: each.probability).label
        if len(item.classification)
        else 0
    )
    return Detection(
        **values,
        covariance=covariance(
            values,
            pose_covariance,
            planar(twist.covariance) if has_twist_covariance else None,
            velocity,
        ),
        object_id=_uuid(item.object_id) if hasattr(item, "object_id") else None,
        **_size(item.shape.dimensions, pose.position.z),
        score=float(item.existence_probability),
        class_name=_AUTOWARE_CLASSES[label]
        if 0 < label < len(_AUTOWARE_CLASSES)
        else None,
    )


def delphi_esr(message: RosMessage) -> ObjectList:
    """Return the object list of a `delphi_esr_msgs/EsrTrack`: one track of a Delphi (Aptiv) ESR.

    Its angles are in degrees, clockwise.
    """
    bearing_rad = -math.radians(message.angle)
    track = Detection(
        range_m=float(message.range),
        bearing_rad=wrap_angle(bearing_rad) if math.isfinite(bearing_rad) else math.nan,
        range_rate_mps=float(message.range_rate),
        object_id=int(message.id),
        width_m=float(message.width) if message.width > 0.0 else None,
    )
    return object_list(
        message.header, [track] if message.status != _ESR_NO_TARGET else [], "sensor"
    )


def radar_tracks(message: RosMessage) -> ObjectList:
    """Return the object list of a `radar_msgs/RadarTracks`: position and speed; there is no heading."""
    return object_list(message.header, map(_radar_track, message.tracks))


def _radar_track(item: RosMessage) -> Detection:
    from scipy.linalg import block_diag

    position = item.position
    velocity = item.velocity
    values = {
        "x_m": position.x,
        "y_m": position.y,
        "speed_mps": signed_speed_mps(velocity.x, velocity.y, None),
    }
    pose = block_diag(_planar_triangle(item.position_covariance), [0.0])
    return Detection(
        **values,
        covariance=covariance(
            values, pose, _planar_triangle(item.velocity_covariance), velocity
        ),
        object_id=_uuid(item.uuid),
        **_size(item.size, position.z),
    )


def _uuid(identity: RosMessage) -> int | None:
    return int.from_bytes(bytes(identity.uuid), "little") & _ID_MASK or None


def _planar_triangle(triangle: RosMessage) -> np.ndarray:
    """Return the covariance of x and y, shape (2, 2), from the upper triangle xx, xy, xz, yy, yz, zz."""
    return np.asarray(triangle, dtype=np.float64)[[0, 1, 1, 3]].reshape(2, 2)


def pose_array(message: RosMessage) -> ObjectList:
    """Return the object list of a `geometry_msgs/PoseArray`: position and yaw."""
    objects = [
        Detection(
            each.position.x,
            each.position.y,
            yaw_rad(each.orientation),
            z_m=each.position.z,
        )
        for each in message.poses
    ]
    return object_list(message.header, objects)


def odometry(message: RosMessage) -> ObjectList:
    """Return the object list of the `nav_msgs/Odometry` of one object: position, yaw and speed.

    The twist is in the object's own frame.
    """
    pose = message.pose.pose
    velocity = message.twist.twist.linear
    values = {
        "x_m": pose.position.x,
        "y_m": pose.position.y,
        "yaw_rad": yaw_rad(pose.orientation),
        "speed_mps": signed_speed_mps(velocity.x, velocity.y, 0.0),
    }
    measured = covariance(
        values,
        planar(message.pose.covariance),
        planar(message.twist.covariance),
        velocity,
    )
    return object_list(message.header, [Detection(**values, covariance=measured)])


def ego_from_odometry(message: RosMessage, receipt_ns: int) -> EgoState:
    """Return the state of the ego from a `nav_msgs/Odometry`: pose in the map, twist in the ego's own frame.

    An unknown yaw is NaN.
    """
    pose = message.pose.pose
    twist = message.twist.twist
    yaw = yaw_rad(pose.orientation)
    return EgoState(
        stamp_ns(message.header.stamp),
        receipt_ns,
        x_m=pose.position.x,
        y_m=pose.position.y,
        yaw_rad=math.nan if yaw is None else yaw,
        speed_mps=signed_speed_mps(twist.linear.x, twist.linear.y, 0.0),
        yaw_rate_radps=twist.angular.z,
        covariance=_ego_covariance(message),
    )


@np.errstate(all="ignore")  # a block that is not finite counts as unknown
def _ego_covariance(message: RosMessage) -> tuple[float, ...] | None:
    """Return the row-major covariance of x, y, yaw, speed and yaw rate; None if the pose's and the twist's blocks
    are unknown.

    An unknown block is 0.
    """
    from scipy.linalg import block_diag

    velocity = message.twist.twist.linear
    direction = speed_gradient(velocity.x, velocity.y)
    # Jacobian of speed and yaw rate by vx, vy and yaw rate.
    J = np.eye(2, 3, k=1)
    J[0, :2] = (
        -direction if signed_speed_mps(velocity.x, velocity.y, 0.0) < 0.0 else direction
    )
    parts = planar(message.pose.covariance), J @ planar(message.twist.covariance) @ J.T
    full = block_diag(
        *(part if is_known_covariance(part) else np.zeros_like(part) for part in parts)
    )
    return tuple(full.ravel().tolist()) if full.any() else None


def is_known_covariance(covariance: FloatArray) -> bool:
    """True if the covariance is finite and no variance means "unknown": 0 or -1 in ROS, 1e3 or more in many drivers."""
    in_use = (np.diag(covariance) > 0.0) & (np.diag(covariance) < _UNKNOWN)
    return bool(np.isfinite(covariance).all() and in_use.all())

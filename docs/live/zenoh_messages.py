"""ROS 2 messages as bytes (CDR) without ROS: object lists and odometry, and a number by which a lost one is noticed."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import atan2, cos, sin

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import fgtrack

LIST, ODOMETRY = "vision_msgs/msg/Detection3DArray", "nav_msgs/msg/Odometry"
_DEFINITIONS = {  # of vision_msgs 4, which rosbags does not ship
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id",
    "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections",
}
TYPES = get_typestore(Stores.ROS2_HUMBLE)
for _name, _text in _DEFINITIONS.items():
    TYPES.register(get_types_from_msg(_text, f"vision_msgs/msg/{_name}"))


def _make(kind: str, *fields: object) -> object:
    return TYPES.types[kind](*fields)


def _header(stamp_ns: int, frame_id: str) -> object:
    return _make("std_msgs/msg/Header", _make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9)), frame_id)


def _pose(x_m: float, y_m: float, yaw_rad: float = 0.0) -> object:
    turned = _make("geometry_msgs/msg/Quaternion", 0.0, 0.0, sin(yaw_rad / 2.0), cos(yaw_rad / 2.0))
    return _make("geometry_msgs/msg/Pose", _make("geometry_msgs/msg/Point", x_m, y_m, 0.0), turned)


def _vector(x: float = 0.0, z: float = 0.0) -> object:
    return _make("geometry_msgs/msg/Vector3", x, 0.0, z)


def _stamp_ns(header: object) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def objects_to_cdr(stamp_ns: int, frame_id: str, objects: Iterable[tuple[str, float, float, float]]) -> bytes:
    """`Detection3DArray` of objects with their id, x, y and yaw."""
    header, detections = _header(stamp_ns, frame_id), []
    for name, x_m, y_m, yaw_rad in objects:
        box = _make("vision_msgs/msg/BoundingBox3D", _pose(x_m, y_m, yaw_rad), _vector())
        detections.append(_make("vision_msgs/msg/Detection3D", header, [], box, name))
    return bytes(TYPES.serialize_cdr(_make(LIST, header, detections), LIST))


def odometry_to_cdr(ego: fgtrack.EgoState) -> bytes:
    """`Odometry` in the map."""
    unknown = np.zeros(36)
    pose = _make("geometry_msgs/msg/PoseWithCovariance", _pose(ego.x_m, ego.y_m, ego.yaw_rad), unknown)
    twist = _make("geometry_msgs/msg/Twist", _vector(x=ego.speed_mps), _vector(z=ego.yaw_rate_radps))
    twist = _make("geometry_msgs/msg/TwistWithCovariance", twist, unknown)
    return bytes(TYPES.serialize_cdr(_make(ODOMETRY, _header(ego.stamp_ns, "map"), "base_link", pose, twist), ODOMETRY))


def cdr_to_list(data: bytes, sensor: str, receipt_ns: int) -> fgtrack.DetectionList:
    """The object list of a sensor. Raises the errors of rosbags for other bytes."""
    message = TYPES.deserialize_cdr(data, LIST)
    centres = [detection.bbox.center.position for detection in message.detections]
    frame = "map" if message.header.frame_id == "map" else "ego"
    objects = [fgtrack.Detection(x_m=centre.x, y_m=centre.y) for centre in centres]
    return fgtrack.DetectionList(sensor, _stamp_ns(message.header), receipt_ns, objects, frame=frame)


def cdr_to_ego(data: bytes, receipt_ns: int) -> fgtrack.EgoState:
    """The ego. Raises the errors of rosbags for other bytes."""
    message = TYPES.deserialize_cdr(data, ODOMETRY)
    pose, twist = message.pose.pose, message.twist.twist
    yaw_rad = 2.0 * atan2(pose.orientation.z, pose.orientation.w)
    where = (pose.position.x, pose.position.y, yaw_rad)
    return fgtrack.EgoState(_stamp_ns(message.header), receipt_ns, *where, twist.linear.x, twist.angular.z)


def stamp_of(data: bytes) -> int:
    """Stamp of an object list in ns."""
    return _stamp_ns(TYPES.deserialize_cdr(data, LIST).header)


def attachment(number: int, sent_ns: int) -> bytes:
    """What travels beside a message: its number on its topic, from 0, and when it was sent."""
    return struct.pack("<qq", number, sent_ns)


def read_attachment(data: bytes) -> tuple[int, int]:
    """Number and time of sending. Raises `struct.error` for anything else."""
    number, sent_ns = struct.unpack("<qq", data)
    return number, sent_ns


@dataclass
class Numbers:
    """Which messages of a topic have come, by their numbers."""

    received: int = 0
    repeated: int = 0
    missing: set[int] = field(default_factory=set)
    """Not come yet, although a later one has."""
    _next: int = 0

    def add(self, number: int) -> None:
        """A message has come."""
        self.received += 1
        if number >= self._next:
            self.expect(number)
            self._next = number + 1
        elif number in self.missing:
            self.missing.remove(number)
        else:
            self.repeated += 1

    def expect(self, count: int) -> None:
        """So many have been sent."""
        self.missing |= set(range(self._next, count))
        self._next = max(self._next, count)

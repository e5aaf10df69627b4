"""States of the ego from topics: odometry, poses, positions of GNSS, transforms."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.types import EgoState
from fgtrack.inputs.formats.common import RosMessage, planar, stamp_ns
from fgtrack.inputs.formats.ego_motion import missing_motion
from fgtrack.inputs.formats.fields import ego_by_fields
from fgtrack.inputs.formats.native import EGO, ego
from fgtrack.inputs.formats.objects import (
    ODOMETRY,
    ego_from_odometry,
    is_known_covariance,
)
from fgtrack.inputs.geodetic import LocalPlane
from fgtrack.inputs.ros.bag import BagTopic
from fgtrack.inputs.ros.frames import TF_TYPES, BagFrames, named
from fgtrack.inputs.settings import FieldPath, TopicInput

__all__ = ["EGO_TYPES", "POSE_FIELDS", "computed_motion", "ego_states"]


def _pose(path: str) -> dict[str, FieldPath]:
    return {
        "x_m": f"{path}.position.x",
        "y_m": f"{path}.position.y",
        "yaw_rad": f"{path}.orientation",
    }


POSE_FIELDS: Mapping[str, Mapping[str, FieldPath]] = {
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose("pose.pose"),
    "geometry_msgs/msg/PoseStamped": _pose("pose"),
    "geometry_msgs/msg/TransformStamped": {
        "x_m": "transform.translation.x",
        "y_m": "transform.translation.y",
        "yaw_rad": "transform.rotation",
    },
    "geographic_msgs/msg/GeoPoseStamped": {
        "latitude_deg": "pose.position.latitude",
        "longitude_deg": "pose.position.longitude",
        "yaw_rad": "pose.orientation",
    },
    "sensor_msgs/msg/NavSatFix": {
        "latitude_deg": "latitude",
        "longitude_deg": "longitude",
    },
    "geographic_msgs/msg/GeoPointStamped": {
        "latitude_deg": "position.latitude",
        "longitude_deg": "position.longitude",
    },
}
"""Fields of the ego's pose or position, by message type."""
EGO_TYPES = (ODOMETRY, *POSE_FIELDS, *sorted(TF_TYPES))
"""Message types from which the ego is read without `fields`, the most complete first."""
ToEgo = Callable[[RosMessage, int], Iterable[EgoState]]
"""Converts a ROS message and its receipt to states of the ego."""


def computed_motion(topic: BagTopic, item: TopicInput) -> tuple[str, ...]:
    """Return the components of the ego to compute from its successive poses, because the topic does not contain
    them.
    """
    if item.fields is not None:
        return missing_motion(item.fields)
    if topic.type in POSE_FIELDS:
        return missing_motion(POSE_FIELDS[topic.type])
    return missing_motion(("yaw_rad",)) if topic.type in TF_TYPES else ()


def ego_states(
    topic: BagTopic, item: TopicInput, plane: LocalPlane, frames: BagFrames
) -> ToEgo:
    """Return the conversion of a topic of the ego; computed components are NaN (`computed_motion`).

    Raises `CallError` for a type that needs `fields`, and for transforms without a
    moving frame of the ego.
    """
    if item.fields is not None:
        fields = item.fields
        return lambda message, receipt_ns: (
            ego_by_fields(message, fields, receipt_ns, plane),
        )
    if topic.type == EGO:
        return lambda message, receipt_ns: (
            message if isinstance(message, EgoState) else ego(message, receipt_ns),
        )
    if topic.type == ODOMETRY:
        return lambda message, receipt_ns: (ego_from_odometry(message, receipt_ns),)
    if topic.type in TF_TYPES:
        return _from_transforms(topic, frames)
    if topic.type not in POSE_FIELDS:
        raise CallError(
            f"topic {topic.name}: an ego of type {topic.type} needs `fields`; read without are {', '.join(EGO_TYPES)}"
        )
    pose_fields = POSE_FIELDS[topic.type]
    return lambda message, receipt_ns: (
        replace(
            ego_by_fields(message, pose_fields, receipt_ns, plane),
            covariance=_covariance(message),
        ),
    )


@np.errstate(all="ignore")  # a block that is not finite counts as unknown
def _covariance(message: RosMessage) -> tuple[float, ...] | None:
    """Return the row-major covariance of x, y, yaw, speed and yaw rate from a message with a pose and its
    covariance.
    """
    given = getattr(getattr(message, "pose", None), "covariance", None)
    if given is None or not is_known_covariance(pose := planar(given)):
        return None
    full = np.zeros((5, 5))
    full[:3, :3] = pose
    return tuple(full.ravel().tolist())


def _from_transforms(topic: BagTopic, frames: BagFrames) -> ToEgo:
    """Return the conversion of transforms: a state of the ego at each stamp of its nearest moving frame.

    Raises `CallError` if no frame of the ego moves. Heading comes from the transforms; the speed is NaN.
    """
    moving = frames.moving_ego_frame
    ego_frame = frames.ego_frame
    map_frame = frames.map_frame
    if moving is None or ego_frame is None or map_frame is None:
        raise CallError(
            f"topic {topic.name}: no transform moves a frame of the ego (base_link ...), name another topic of the ego"
        )

    def states(message: RosMessage, receipt_ns: int) -> Iterable[EgoState]:
        for each in message.transforms:
            if named(each.child_frame_id) != moving:
                continue
            at_ns = stamp_ns(each.header.stamp)
            pose = frames.transforms.pose(ego_frame, map_frame, at_ns)
            assert pose is not None  # a path connects the ego and its map
            x_m, y_m, _ = pose.translation_m.tolist()
            yield EgoState(at_ns, receipt_ns, x_m, y_m, pose.yaw_rad, np.nan)

    return states

"""Creates ROS messages: fgtrack's own types, and standard types that other tools display."""

import math

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import (
    STATE_NAMES,
    Detection,
    DetectionList,
    EgoState,
    FloatArray,
    Frame,
    TruthState,
)
from fgtrack.inputs.formats.common import PLANAR, RosMessage
from fgtrack.inputs.formats.native import (
    DETECTION_OPTIONAL,
    DETECTIONS,
    EGO,
    LISTS,
    TEXTS,
    TRUTH,
    TRUTH_OPTIONAL,
)
from fgtrack.inputs.ros.typestore import typestore_of

ODOMETRY = "nav_msgs/msg/Odometry"
DETECTION3D_ARRAY = "vision_msgs/msg/Detection3DArray"
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_FRAME_IDS: dict[Frame, str] = {"map": "map", "ego": "base_link"}
#: Limit of the seconds in `builtin_interfaces/Time`, a signed integer of 32 bits.
_SECONDS_LIMIT = 1 << 31


class MessageFactory:
    """Creates and serializes messages of the types that fgtrack writes."""

    def __init__(self) -> None:
        self.typestore = typestore_of(
            (
                EGO,
                DETECTIONS,
                TRUTH,
                ODOMETRY,
                DETECTION3D_ARRAY,
                MARKER_ARRAY,
                TRANSFORMS,
            )
        )

    def serialize(self, message: RosMessage) -> memoryview:
        """Return the CDR bytes of `message`."""
        return self.typestore.serialize_cdr(message, message.__msgtype__)

    def ego(self, state: EgoState) -> RosMessage:
        """Create a `fgtrack_msgs/Ego`."""
        return self._make(
            EGO,
            header=self._header(state.stamp_ns, "map"),
            **{name: getattr(state, name) for name in STATE_NAMES},
            has_in_pit=state.in_pit is not None,
            in_pit=bool(state.in_pit),
            covariance=np.array(state.covariance or (), dtype=np.float64),
        )

    def detections(self, message: DetectionList) -> RosMessage:
        """Create a `fgtrack_msgs/DetectionList`; the header's `frame_id` is fgtrack's name of the frame."""
        return self._make(
            DETECTIONS,
            header=self._header(message.stamp_ns, message.frame),
            sensor=message.sensor,
            objects=[self._detection(item) for item in message.objects],
            origin_deg=np.array(message.origin_deg or (), dtype=np.float64),
        )

    def truth(self, state: TruthState) -> RosMessage:
        """Create a `fgtrack_msgs/Truth`."""
        return self._make(
            TRUTH,
            header=self._header(state.stamp_ns, "map"),
            object_id=state.object_id,
            x_m=state.x_m,
            y_m=state.y_m,
            ignored=state.ignored,
            **_optional(state, TRUTH_OPTIONAL),
        )

    def odometry(self, state: EgoState) -> RosMessage:
        """Create a `nav_msgs/Odometry` in the frame `map`."""
        covariance = np.reshape(state.covariance or (0.0,) * 25, (5, 5))
        pose = np.zeros((6, 6))
        pose[np.ix_(PLANAR, PLANAR)] = covariance[:3, :3]
        twist = np.zeros((6, 6))
        twist[np.ix_([0, 5], [0, 5])] = covariance[3:, 3:]
        linear = self._vector(state.speed_mps)
        angular = self._vector(z=state.yaw_rate_radps)
        return self._make(
            ODOMETRY,
            header=self._header(state.stamp_ns, "map"),
            child_frame_id=_FRAME_IDS["ego"],
            pose=self._with_covariance(
                "Pose", self._pose(state.x_m, state.y_m, state.yaw_rad), pose
            ),
            twist=self._with_covariance(
                "Twist",
                self._make("geometry_msgs/msg/Twist", linear=linear, angular=angular),
                twist,
            ),
        )

    def detection3d_array(self, message: DetectionList) -> RosMessage:
        """Create a `vision_msgs/Detection3DArray` with the objects that have a position."""
        return self._make(
            DETECTION3D_ARRAY,
            header=self._header(
                message.stamp_ns, _FRAME_IDS.get(message.frame, message.sensor)
            ),
            detections=[
                self._detection3d(item)
                for item in message.objects
                if None not in (item.x_m, item.y_m)
            ],
        )

    def _make(self, name: str, **fields: RosMessage) -> RosMessage:
        return self.typestore.types[name](**fields)

    def _header(self, stamp_ns: int, frame_id: str) -> RosMessage:
        sec, nanosec = divmod(stamp_ns, NS_PER_S)
        if not -_SECONDS_LIMIT <= sec < _SECONDS_LIMIT:
            raise DataError(
                f"stamp {stamp_ns} ns is out of the range of a ROS header (1901 to 2038): correct the stamps"
            )
        stamp = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def _detection(self, item: Detection) -> RosMessage:
        return self._make(
            "fgtrack_msgs/msg/Detection", **_optional(item, DETECTION_OPTIONAL)
        )

    def _detection3d(self, item: Detection) -> RosMessage:
        pose = self._pose(item.x_m, item.y_m, item.yaw_rad)
        size = self._vector(item.length_m, item.width_m, item.height_m)
        results = []
        if (covariance := _full_covariance(item)) is not None:
            hypothesis = self._make(
                "vision_msgs/msg/ObjectHypothesis",
                class_id=item.class_name or "",
                score=1.0,
            )
            result = "vision_msgs/msg/ObjectHypothesisWithPose"
            results.append(
                self._make(
                    result,
                    hypothesis=hypothesis,
                    pose=self._with_covariance("Pose", pose, covariance),
                )
            )
        return self._make(
            "vision_msgs/msg/Detection3D",
            header=self._header(item.stamp_ns or 0, ""),
            results=results,
            bbox=self._make("vision_msgs/msg/BoundingBox3D", center=pose, size=size),
            id="" if item.object_id is None else str(item.object_id),
        )

    def _vector(
        self, x: float | None = None, y: float | None = None, z: float | None = None
    ) -> RosMessage:
        return self._make(
            "geometry_msgs/msg/Vector3", x=x or 0.0, y=y or 0.0, z=z or 0.0
        )

    def _pose(
        self, x_m: float | None, y_m: float | None, yaw_rad: float | None
    ) -> RosMessage:
        """Create a pose. A missing yaw gives the quaternion 0, a yaw that is not finite gives NaN."""
        z = w = 0.0
        if yaw_rad is not None:
            is_finite = math.isfinite(yaw_rad)
            z = math.sin(0.5 * yaw_rad) if is_finite else math.nan
            w = math.cos(0.5 * yaw_rad) if is_finite else math.nan
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x_m, y=y_m, z=0.0),
            orientation=self._make(
                "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w
            ),
        )

    def _with_covariance(
        self, kind: str, value: RosMessage, covariance: FloatArray
    ) -> RosMessage:
        fields = {kind.lower(): value, "covariance": covariance.ravel()}
        return self._make(f"geometry_msgs/msg/{kind}WithCovariance", **fields)


def _optional(
    value: Detection | TruthState, names: tuple[str, ...]
) -> dict[str, RosMessage]:
    """Return the fields `names` of `value`, with 0 or empty for None, and `present` with a bit for each given field."""
    given = {name: getattr(value, name) for name in names}
    present = sum(1 << bit for bit, name in enumerate(names) if given[name] is not None)
    given |= {name: "" if name in TEXTS else 0 for name in names if given[name] is None}
    lists = {
        name: np.array(given[name] or (), dtype=np.float64)
        for name in LISTS & given.keys()
    }
    return given | lists | {"present": present}


def _full_covariance(item: Detection) -> FloatArray | None:
    """Return the covariance of the pose, shape (6, 6); None if the detection has no covariance, or one of a wrong
    size.
    """
    size = len(item.measured)
    if item.covariance is None or len(item.covariance) != size**2:
        return None
    given = np.asarray(item.covariance).reshape(size, size)
    pose = np.zeros((6, 6))
    axes = {"x_m": 0, "y_m": 1, "yaw_rad": 5}
    kept = [index for index, name in enumerate(item.measured) if name in axes]
    rows = [axes[item.measured[index]] for index in kept]
    pose[np.ix_(rows, rows)] = given[np.ix_(kept, kept)]
    return pose

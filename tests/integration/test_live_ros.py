"""The ROS 2 node of docs/live, on stand-ins for rclpy, tf2_ros and the messages."""

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from support.scripts import LIVE, load_file

from fgtrack.inputs.ros.typestore import typestore_of

MS = 1_000_000
NOW_NS = 1_700_000_000_000_000_000
CAR_M = (100.0, 3.0)  # in the map
SPEED_MPS = 20.0  # of the ego, along x, turning


TYPES = (
    *(
        "vision_msgs/msg/Detection3DArray",
        "vision_msgs/msg/Detection3D",
        "vision_msgs/msg/ObjectHypothesisWithPose",
    ),
    *(
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/TransformStamped",
        "builtin_interfaces/msg/Time",
    ),
)
STORE = typestore_of(TYPES)


# --- stand-ins for rclpy, tf2_ros and message packages: what docs/live/ros_node.py uses of them


def _default(kind: Any, what: Any) -> Any:
    if kind is Nodetype.NAME:
        return message_class(what)()
    if kind is Nodetype.ARRAY:
        return np.zeros(what[1])
    if kind is Nodetype.SEQUENCE:
        return []
    return {"string": ""}.get(what[0], 0.0 if what[0].startswith("float") else 0)


@cache
def message_class(name: str) -> type:
    """A message type with the fields of its definition and no others, which begin with defaults."""
    fields = dict(STORE.fielddefs[name][1])

    def make(self: Any, **values: Any) -> None:
        for field_name, (kind, what) in fields.items():
            setattr(
                self,
                field_name,
                values.pop(field_name)
                if field_name in values
                else _default(kind, what),
            )
        assert not values, f"{name} has no {values}"

    return type(
        name.rpartition("/")[2], (), {"__slots__": tuple(fields), "__init__": make}
    )


@dataclass(frozen=True)
class Time:
    nanoseconds: int = 0

    @classmethod
    def from_msg(cls, message: Any) -> "Time":
        return cls(message.sec * 10**9 + message.nanosec)

    def to_msg(self) -> Any:
        seconds, nanoseconds = divmod(self.nanoseconds, 10**9)
        return message_class("builtin_interfaces/msg/Time")(
            sec=seconds, nanosec=nanoseconds
        )


class TransformException(Exception):  # noqa: N818 - its name
    pass


class Buffer:
    """Transforms at given stamps, and linearly in between."""

    def __init__(self) -> None:
        self.known: dict[int, tuple[float, float, float]] = {}  # by stamp: x, y, yaw

    def clear(self) -> None:
        self.known.clear()

    def lookup_transform(self, target_frame: str, source_frame: str, time: Time) -> Any:
        assert (target_frame, source_frame) == ("map", "base_link")
        stamps = sorted(self.known)
        stamp_ns = time.nanoseconds or max(stamps, default=0)
        if not stamps or not stamps[0] <= stamp_ns <= stamps[-1]:
            raise TransformException(
                "Lookup would require extrapolation into the future"
            )
        since = [stamp - stamps[0] for stamp in stamps]
        x, y, yaw = (
            float(
                np.interp(
                    stamp_ns - stamps[0], since, [self.known[s][k] for s in stamps]
                )
            )
            for k in range(3)
        )
        found = message_class("geometry_msgs/msg/TransformStamped")()
        found.header.stamp = Time(stamp_ns).to_msg()
        found.transform.translation.x, found.transform.translation.y = x, y
        found.transform.rotation.z, found.transform.rotation.w = (
            np.sin(yaw / 2.0),
            np.cos(yaw / 2.0),
        )
        return found


def listener(buffer: Buffer, node: "Node") -> None:
    node.buffer = buffer


class Node:
    """Keeps what is subscribed, published and timed, for the test to call; its clock stands."""

    given: Mapping[str, Any] = {}  # parameters, by name
    buffer: Buffer

    def __init__(self, name: str) -> None:
        self.time_ns = 0
        self.jumps: list[tuple[Any, Callable[[Any], None]]] = []
        self.subscriptions: dict[str, Callable[[Any], None]] = {}
        self.published: dict[str, list[Any]] = {}
        self.timers: list[Callable[[], None]] = []

    def declare_parameter(self, name: str, value: Any) -> Any:
        return SimpleNamespace(value=self.given.get(name, value))

    def get_clock(self) -> Any:
        return SimpleNamespace(
            now=lambda: Time(self.time_ns), create_jump_callback=self._on_jumps
        )

    def _on_jumps(
        self, threshold: Any, *, post_callback: Callable[[Any], None]
    ) -> None:
        self.jumps.append((threshold, post_callback))

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=lambda line: None)

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos_profile: Any
    ) -> None:
        self.subscriptions[topic] = callback

    def create_publisher(self, kind: type, topic: str, qos_profile: Any) -> Any:
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], None]
    ) -> None:
        self.timers.append(callback)


def messages_of(package: str) -> dict[str, type]:
    return {
        name.rpartition("/")[2]: message_class(name)
        for name in TYPES
        if name.startswith(package)
    }


STAND_INS: Mapping[str, Mapping[str, Any]] = {
    "rclpy": {},
    "rclpy.clock": {"JumpThreshold": SimpleNamespace, "TimeJump": object},
    "rclpy.duration": {"Duration": SimpleNamespace},
    "rclpy.executors": {"ExternalShutdownException": RuntimeError},
    "rclpy.node": {"Node": Node},
    "rclpy.qos": {
        "QoSHistoryPolicy": SimpleNamespace(KEEP_LAST=1),
        "QoSProfile": SimpleNamespace,
        "QoSReliabilityPolicy": SimpleNamespace(BEST_EFFORT=2),
    },
    "rclpy.time": {"Time": Time},
    "tf2_ros": {
        "Buffer": Buffer,
        "TransformException": TransformException,
        "TransformListener": listener,
    },
    "nav_msgs": {},
    "nav_msgs.msg": messages_of("nav_msgs"),
    "vision_msgs": {},
    "vision_msgs.msg": messages_of("vision_msgs"),
}


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        for name, members in STAND_INS.items():
            patch.setitem(sys.modules, name, ModuleType(name))
            vars(sys.modules[name]).update(members)
        yield load_file(LIVE / "ros_node.py", "live")


def made(script: ModuleType, **parameters: Any) -> Any:
    Node.given = {
        "sensors": ["lidar_cluster", "radar"],
        "config": "smoother",
        **parameters,
    }
    node = script.TrackerNode()
    node.time_ns = NOW_NS
    return node


def pose(stamp_ns: int) -> tuple[float, float, float]:
    passed_s = (stamp_ns - NOW_NS) / 1e9
    return SPEED_MPS * passed_s, 0.0, 0.3 * passed_s


def detections(stamp_ns: int, frame_id: str = "base_link") -> Any:
    """What a sensor in the middle of the ego says of the car, and of nothing else."""
    message = message_class("vision_msgs/msg/Detection3DArray")()
    message.header.stamp, message.header.frame_id = Time(stamp_ns).to_msg(), frame_id
    found = message_class("vision_msgs/msg/Detection3D")()
    x, y, yaw = pose(stamp_ns) if frame_id != "map" else (0.0, 0.0, 0.0)
    east, north = CAR_M[0] - x, CAR_M[1] - y
    centre = found.bbox.center.position
    centre.x = math.cos(yaw) * east + math.sin(yaw) * north
    centre.y = math.cos(yaw) * north - math.sin(yaw) * east
    message.detections = [found]
    return message


def send(node: Any, topic: str, message: Any, receipt_ns: int) -> None:
    node.time_ns = receipt_ns
    node.subscriptions[topic](message)


def tick(node: Any, now_ns: int) -> Any:
    """The timer's tick; the message that it publishes, if any."""
    node.time_ns = now_ns
    before = len(node.published["tracks"])
    node.timers[0]()
    published = node.published["tracks"][before:]
    return published[0] if published else None


def counts(node: Any) -> dict[str, dict[str, int]]:
    return {
        sensor: dict(of_sensor) for sensor, of_sensor in node.tracker.counts.items()
    }


def test_a_standing_car_is_tracked_from_a_turning_ego_with_late_lists_and_late_poses(
    script: ModuleType,
) -> None:
    node = made(script, published_ago_s=0.1)
    for k in range(1, 60):
        now_ns = NOW_NS + 20 * MS * k
        node.buffer.known[now_ns - 30 * MS] = pose(now_ns - 30 * MS)
        odometry = message_class("nav_msgs/msg/Odometry")()
        odometry.twist.twist.linear.x, odometry.twist.twist.angular.z = SPEED_MPS, 0.3
        send(node, "odometry", odometry, now_ns - 5 * MS)
        if k > 10:
            send(
                node, "radar/detections", detections(now_ns - 17 * MS), now_ns - 3 * MS
            )  # between two poses
            send(
                node,
                "lidar_cluster/detections",
                detections(now_ns - 111 * MS),
                now_ns - 2 * MS,
            )
        published = tick(node, now_ns)
    [track] = published.detections
    assert Time.from_msg(published.header.stamp).nanoseconds == now_ns - 100 * MS
    assert (published.header.frame_id, track.header.frame_id, track.id) == (
        "map",
        "map",
        "0",
    )
    at_m = (track.bbox.center.position.x, track.bbox.center.position.y)
    assert at_m == pytest.approx(
        CAR_M, abs=2.2
    )  # the middle of the car is not where detections are taken
    P = np.reshape(track.results[0].pose.covariance, (6, 6))
    np.testing.assert_allclose(P, P.T)
    assert np.linalg.eigvalsh(P[np.ix_((0, 1, 5), (0, 1, 5))])[0] > 0.0
    assert (P[2:5] == 0.0).all()
    found = counts(node)
    assert (
        sum(map(sum, (one.values() for one in found.values()))) == 2 * 49 - 1
    )  # the newest one waits for its pose
    assert found["lidar_cluster"]["out_of_sequence"] > 40
    assert (node.without_pose, node.tracker.refused, node.tracker.failures) == (
        0,
        {},
        {},
    )
    assert node.tracker.lateness["radar"].delay_median_s == pytest.approx(0.014)
    assert node.tracker.lateness["lidar_cluster"].delay_median_s == pytest.approx(0.109)


def test_a_list_waits_for_its_pose_and_keeps_its_receipt(script: ModuleType) -> None:
    node = made(script)
    node.buffer.known[NOW_NS] = pose(NOW_NS)
    send(node, "radar/detections", detections(NOW_NS + 30 * MS), NOW_NS + 40 * MS)
    tick(node, NOW_NS + 50 * MS)
    assert counts(node) == {}
    node.buffer.known[NOW_NS + 60 * MS] = pose(NOW_NS + 60 * MS)
    tick(node, NOW_NS + 70 * MS)
    tick(node, NOW_NS + 90 * MS)
    assert counts(node) == {"radar": {"birth": 1}}
    assert node.tracker.refused == {}  # no pose is given twice
    assert node.tracker.lateness["radar"].delay_worst_s == 0.01
    assert node.without_pose == 0


def test_where_time_begins_again_the_tracker_does(script: ModuleType) -> None:
    node = made(script)
    node.buffer.known = {NOW_NS + k * MS: pose(NOW_NS + k * MS) for k in (0, 500)}
    send(node, "radar/detections", detections(NOW_NS + 10 * MS), NOW_NS + 20 * MS)
    assert len(tick(node, NOW_NS + 40 * MS).detections) == 1
    send(node, "radar/detections", detections(NOW_NS + 900 * MS), NOW_NS + 910 * MS)
    [(threshold, on_jump)] = node.jumps
    assert threshold.min_forward is None
    assert threshold.min_backward.nanoseconds < 0
    on_jump(None)
    published = tick(node, NOW_NS - 5_000 * MS)
    assert (
        published.detections,
        Time.from_msg(published.header.stamp).nanoseconds,
    ) == ([], NOW_NS - 5_000 * MS)
    assert (counts(node), node.tracker.refused, node.buffer.known) == ({}, {}, {})

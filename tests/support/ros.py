"""Stand-ins for rclpy, tf2_ros and message packages: what docs/live/ros_node.py uses of them, with their signatures.

Messages have the fields of the real definitions and no others.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from fgtrack.io.ros.typestore import typestore_of

TYPES = (
    "vision_msgs/msg/Detection3DArray",
    "vision_msgs/msg/Detection3D",
    "vision_msgs/msg/ObjectHypothesisWithPose",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TransformStamped",
    "builtin_interfaces/msg/Time",
)
STORE = typestore_of(TYPES)


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
    """A message type whose instances begin with defaults, as those of rclpy do."""
    fields = dict(STORE.fielddefs[name][1])

    def make(self: Any, **values: Any) -> None:
        for field_name, (kind, what) in fields.items():
            setattr(self, field_name, values.pop(field_name) if field_name in values else _default(kind, what))
        assert not values, f"{name} has no {values}"

    return type(name.rpartition("/")[2], (), {"__slots__": tuple(fields), "__init__": make, "type_name": name})


Stamp: Any = message_class("builtin_interfaces/msg/Time")


@dataclass(frozen=True)
class Time:
    nanoseconds: int = 0

    @classmethod
    def from_msg(cls, message: Any) -> "Time":
        return cls(message.sec * 10**9 + message.nanosec)

    def to_msg(self) -> Any:
        return Stamp(sec=self.nanoseconds // 10**9, nanosec=self.nanoseconds % 10**9)


@dataclass(frozen=True)
class Duration:
    seconds: float = 0
    nanoseconds: int = 0


@dataclass(frozen=True)
class QoSProfile:
    reliability: str = "reliable"
    history: str = "keep_last"
    depth: int = 10


class QoSReliabilityPolicy:
    BEST_EFFORT = "best_effort"


class QoSHistoryPolicy:
    KEEP_LAST = "keep_last"


@dataclass(frozen=True)
class JumpThreshold:
    min_forward: Duration | None
    min_backward: Duration | None
    on_clock_change: bool = True


class TransformException(Exception):  # noqa: N818 - its name
    pass


class ExtrapolationException(TransformException):
    pass


class Buffer:
    """Transforms that are known at given stamps, and linearly in between."""

    def __init__(self) -> None:
        self.known: dict[int, tuple[float, float, float]] = {}  # by stamp: x, y, yaw

    def clear(self) -> None:
        self.known.clear()

    def lookup_transform(self, target_frame: str, source_frame: str, time: Time) -> Any:
        assert (target_frame, source_frame) == ("map", "base_link")
        stamps = sorted(self.known)
        if not stamps:
            raise TransformException("no such frame")
        stamp_ns = time.nanoseconds or stamps[-1]
        if not stamps[0] <= stamp_ns <= stamps[-1]:
            raise ExtrapolationException("Lookup would require extrapolation into the future")
        x, y, yaw = (
            float(np.interp(stamp_ns - stamps[0], [s - stamps[0] for s in stamps], [self.known[s][k] for s in stamps]))
            for k in range(3)
        )
        found = message_class("geometry_msgs/msg/TransformStamped")()
        found.header.stamp = Time(stamp_ns).to_msg()
        found.transform.translation.x, found.transform.translation.y = x, y
        found.transform.rotation.z, found.transform.rotation.w = np.sin(yaw / 2.0), np.cos(yaw / 2.0)
        return found


class TransformListener:
    def __init__(self, buffer: Buffer, node: "Node") -> None:
        node.buffer = buffer


@dataclass
class Clock:
    """Stands at a time; messages and timers come when the test says so."""

    time_ns: int = 0
    jumps: list[tuple[JumpThreshold, Callable[[Any], None]]] = field(default_factory=list)

    def now(self) -> Time:
        return Time(self.time_ns)

    def create_jump_callback(self, threshold: JumpThreshold, *, post_callback: Callable[[Any], None]) -> object:
        self.jumps.append((threshold, post_callback))
        return self.jumps[-1]


@dataclass
class Publisher:
    messages: list[Any] = field(default_factory=list)

    def publish(self, message: Any) -> None:
        self.messages.append(message)


@dataclass
class Logger:
    lines: list[str] = field(default_factory=list)

    def warning(self, line: str) -> None:
        self.lines.append(line)


class Node:
    """Keeps what is subscribed, published and timed, for the test to call."""

    given: Mapping[str, Any] = {}  # parameters, by name
    buffer: Buffer

    def __init__(self, name: str) -> None:
        self.name = name
        self.clock, self.logger = Clock(), Logger()
        self.subscriptions: dict[str, tuple[type, Callable[[Any], None], QoSProfile]] = {}
        self.publishers: dict[str, Publisher] = {}
        self.timers: list[tuple[float, Callable[[], None]]] = []

    def declare_parameter(self, name: str, value: Any) -> Any:
        return Parameter(self.given.get(name, value))

    def get_clock(self) -> Clock:
        return self.clock

    def get_logger(self) -> Logger:
        return self.logger

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos_profile: QoSProfile
    ) -> None:
        self.subscriptions[topic] = (kind, callback, qos_profile)

    def create_publisher(self, kind: type, topic: str, qos_profile: QoSProfile | int) -> Publisher:
        self.publishers[topic] = Publisher()
        return self.publishers[topic]

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> None:
        self.timers.append((timer_period_sec, callback))


@dataclass(frozen=True)
class Parameter:
    value: Any


_STAND_INS: Mapping[str, Sequence[Any]] = {
    "rclpy": (),
    "rclpy.clock": (JumpThreshold, type("TimeJump", (), {})),
    "rclpy.duration": (Duration,),
    "rclpy.executors": (type("ExternalShutdownException", (Exception,), {}),),
    "rclpy.node": (Node,),
    "rclpy.qos": (QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy),
    "rclpy.time": (Time,),
    "tf2_ros": (Buffer, TransformException, TransformListener),
    "nav_msgs": (),
    "nav_msgs.msg": tuple(message_class(name) for name in TYPES if name.startswith("nav_msgs")),
    "vision_msgs": (),
    "vision_msgs.msg": tuple(message_class(name) for name in TYPES if name.startswith("vision_msgs")),
}


@contextmanager
def stand_ins() -> Iterator[None]:
    """Within, `import rclpy` and the like give what is here."""
    before = {name: sys.modules.get(name) for name in _STAND_INS}
    for name, members in _STAND_INS.items():
        sys.modules[name] = ModuleType(name)
        vars(sys.modules[name]).update({member.__name__: member for member in members})
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module

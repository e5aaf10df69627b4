"""The ROS 2 node of ros2/fgtrack_ros, on stand-ins for rclpy, tf2_ros and the messages."""

import gc
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from ruamel.yaml import YAML
from support.scripts import ROOT, load_file

import fgtrack
from fgtrack.inputs.ros.bag_writer import write_bag
from fgtrack.inputs.ros.typestore import typestore_of

PACKAGE = ROOT / "ros2/fgtrack_ros"

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
    *(
        "diagnostic_msgs/msg/DiagnosticArray",
        "diagnostic_msgs/msg/DiagnosticStatus",
        "diagnostic_msgs/msg/KeyValue",
        "autoware_perception_msgs/msg/DetectedObjects",
        "autoware_perception_msgs/msg/DetectedObject",
        "autoware_perception_msgs/msg/ObjectClassification",
    ),
)
STORE = typestore_of(TYPES)


# --- stand-ins for rclpy, tf2_ros and message packages: what the node uses of them


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
    "diagnostic_msgs": {},
    "diagnostic_msgs.msg": messages_of("diagnostic_msgs"),
    "autoware_perception_msgs": {},
    "autoware_perception_msgs.msg": messages_of("autoware_perception_msgs"),
    "vision_msgs": {},
    "vision_msgs.msg": messages_of("vision_msgs"),
}


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        for name, members in STAND_INS.items():
            patch.setitem(sys.modules, name, ModuleType(name))
            vars(sys.modules[name]).update(members)
        patch.setattr(
            gc, "freeze", lambda: None
        )  # the other tests of this process want their garbage collected
        yield load_file(PACKAGE / "fgtrack_ros/node.py", "ros2")


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


@pytest.mark.parametrize(
    ("scenario", "duration_s"),
    [
        ("single_opponent", 4.0),
        pytest.param("default", 60.0, marks=pytest.mark.slow, id="demo"),
    ],
)
def test_a_bag_through_the_node_gives_the_tracks_of_its_replay(
    script: ModuleType, tmp_path: Path, scenario: str, duration_s: float
) -> None:
    """The recorded messages go in as bytes, and the tracks come out as bytes of another bag."""
    drive = fgtrack.simulate(scenario, seed=1, duration_s=duration_s)
    write_bag(tmp_path / "in", drive)
    sensors = ("lidar_cluster", "radar")
    topics = {f"/detections/{sensor}": f"{sensor}/detections" for sensor in sensors}
    reads = {sensor: {"topic": f"/detections/{sensor}"} for sensor in sensors}
    settings = {"input.ego": {"topic": "/ego/odometry"}, "input.detections": reads}
    config = fgtrack.Config.from_yaml("smoother").replace(
        {**settings, "map.track": "oval", "estimator": "ekf-replay"}
    )
    config.to_yaml(tmp_path / "config.yaml")
    run = fgtrack.replay(tmp_path / "in", config)
    node = made(script, config=str(tmp_path / "config.yaml"), ego_from_odometry=True)
    received = list(recorded(tmp_path / "in", {**topics, "/ego/odometry": "odometry"}))
    for now_ns in run.timing["now_ns"]:
        while received and received[0][0] <= now_ns:
            receipt_ns, topic, message = received.pop(0)
            send(node, topic, message, receipt_ns)
        tick(node, int(now_ns))
    node.timers[1]()
    keep(tmp_path / "out", node.published)
    found = [
        (Time.from_msg(message.header.stamp).nanoseconds, int(one.id), *at(one))
        for _, _, message in recorded(tmp_path / "out", {"/tracks": "tracks"})
        for one in message.detections
    ]
    rows = run.tracks[["now_ns", "track_id", "x_m", "y_m", "yaw_rad"]]
    expected = sorted(rows.itertuples(index=False, name=None))
    assert len(expected) > 100
    np.testing.assert_allclose(sorted(found), expected, rtol=0.0, atol=1e-9)
    assert (node.tracker.refused, node.tracker.failures) == ({}, {})
    [(_, _, diagnostics)] = recorded(tmp_path / "out", {"/diagnostics": "diagnostics"})
    names = [status.name for status in diagnostics.status]
    assert names[0] == "fgtrack"
    assert {"fgtrack: radar", "fgtrack: lidar_cluster", "fgtrack: ego"} <= set(names)
    of_radar = diagnostics.status[names.index("fgtrack: radar")]
    values = {each.key: each.value for each in of_radar.values}
    assert float(values["NIS per component"]) > 0.0


def at(detection: Any) -> tuple[float, float, float]:
    centre = detection.bbox.center
    turned = centre.orientation
    return (
        centre.position.x,
        centre.position.y,
        2.0 * math.atan2(turned.z, turned.w),
    )


def recorded(path: Path, topics: Mapping[str, str]) -> Iterator[tuple[int, str, Any]]:
    """Receipt, other name of the topic and message of each message of a bag."""
    with Reader(path) as bag:
        chosen = [each for each in bag.connections if each.topic in topics]
        for connection, receipt_ns, data in bag.messages(chosen):
            message = STORE.deserialize_cdr(data, connection.msgtype)
            yield receipt_ns, topics[connection.topic], message


def keep(path: Path, published: Mapping[str, list[Any]]) -> None:
    """Write what a node has published into a bag; a byte is a number there."""
    kinds = {
        "tracks": "vision_msgs/msg/Detection3DArray",
        "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    }
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for topic, messages in published.items():
            connection = bag.add_connection(
                f"/{topic.lstrip('/')}", kinds[topic], typestore=STORE
            )
            for message in messages:
                for status in getattr(message, "status", []):
                    status.level = status.level[0]
                stamp_ns = Time.from_msg(message.header.stamp).nanoseconds
                data = STORE.serialize_cdr(message, kinds[topic])
                bag.write(connection, stamp_ns, data)


def test_lists_of_autoware_have_speeds(script: ModuleType) -> None:
    node = made(script, sensors=[""], autoware_sensors=["radar"])
    node.buffer.known = {NOW_NS + k * MS: pose(NOW_NS + k * MS) for k in (0, 500)}
    message = message_class("autoware_perception_msgs/msg/DetectedObjects")()
    car = message_class("autoware_perception_msgs/msg/DetectedObject")()
    message.header.stamp, message.header.frame_id = Time(NOW_NS).to_msg(), "base_link"
    car.kinematics.pose_with_covariance.pose.position.x = 40.0
    car.kinematics.twist_with_covariance.twist.linear.x = 20.0
    car.kinematics.has_twist = True
    message.objects = [car]
    send(node, "radar/objects", message, NOW_NS + 20 * MS)
    [track] = tick(node, NOW_NS + 40 * MS).detections
    assert counts(node) == {"radar": {"birth": 1}}
    [report] = node.tracker.tracks_at(NOW_NS + 40 * MS)
    assert report.speed_mps == pytest.approx(20.0, abs=0.5)
    assert track.bbox.center.position.x == pytest.approx(40.0, abs=4.0)


def test_a_node_that_restarts_goes_on_with_its_tracks(
    script: ModuleType, tmp_path: Path
) -> None:
    path = tmp_path / "state"
    nodes = [made(script, state_file=str(path))]
    nodes[0].buffer.known = {NOW_NS + k * MS: pose(NOW_NS + k * MS) for k in (0, 500)}
    send(nodes[0], "radar/detections", detections(NOW_NS), NOW_NS + 20 * MS)
    tick(nodes[0], NOW_NS + 40 * MS)
    nodes[0].timers[2]()
    nodes.append(made(script, state_file=str(path)))
    tracks = [tick(node, NOW_NS + 60 * MS).detections for node in nodes]
    assert [each.id for each in tracks[0]] == [each.id for each in tracks[1]] == ["0"]
    assert at(tracks[0][0]) == at(tracks[1][0])
    for content in (b"broken", path.read_bytes()):
        path.write_bytes(content)
        other = made(script, state_file=str(path), config="karle2023")
        assert counts(other) == {}


def test_the_state_of_the_tracker_is_published(script: ModuleType) -> None:
    node = made(script)
    tick(node, NOW_NS)
    tick(node, NOW_NS + 5_000 * MS)
    node.timers[1]()
    [message] = node.published["/diagnostics"]
    first = message.status[0]
    assert (first.name, first.level) == ("fgtrack", b"\x03")
    assert "no sensor that starts tracks sends anything" in first.message
    assert [each.level for each in message.status[1:]] == [b"\x01"] * 3


def test_the_package_starts_the_node_with_the_parameters_that_it_declares(
    script: ModuleType,
) -> None:
    given = YAML(typ="safe").load((PACKAGE / "config/tracker.yaml").read_text("utf-8"))
    assert given["fgtrack"]["ros__parameters"] == script.PARAMETERS
    view = YAML(typ="safe").load((PACKAGE / "rviz/tracker.rviz").read_text("utf-8"))
    shown = [each["Class"] for each in view["Visualization Manager"]["Displays"]]
    assert "vision_msgs_rviz_plugins/Detection3DArray" in shown
    setup = (PACKAGE / "setup.py").read_text("utf-8")
    launch = (PACKAGE / "launch/tracker.launch.py").read_text("utf-8")
    compile(launch, "launch", "exec")
    for name in ("package.xml", "launch/tracker.launch.py", "config/tracker.yaml"):
        assert (PACKAGE / name).is_file()
        assert f'"{name}"' in setup
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    needed = {each.text for each in manifest.iter("exec_depend")}
    source = (PACKAGE / "fgtrack_ros/node.py").read_text("utf-8")
    imported = {
        line.split()[1].partition(".")[0]
        for line in (*source.splitlines(), *launch.splitlines())
        if line.startswith(("from ", "import ")) and "fgtrack" not in line
    }
    assert imported - set(sys.stdlib_module_names) == needed

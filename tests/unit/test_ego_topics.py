"""The ego from topics of poses, positions and transforms; objects in nested lists."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fgtrack.core.errors import CallError
from fgtrack.core.types import DetectionList, EgoState
from fgtrack.inputs.formats.fields import items_by_fields
from fgtrack.inputs.settings import InputConfig, TopicInput
from fgtrack.inputs.source import open_input
from fgtrack.meaning.draft import opened

START_NS = 1_700_000_000 * 10**9
SPEED_MPS = 8.0
RATE_RADPS = 0.1
NESTED = {
    "acme_msgs/msg/Kinematics": "geometry_msgs/PoseWithCovariance initial_pose_with_covariance",
    "acme_msgs/msg/Thing": "uint32 id\nacme_msgs/Kinematics kinematics",
    "acme_msgs/msg/Cluster": "string name\nacme_msgs/Thing[] things",
    "acme_msgs/msg/Clusters": "std_msgs/Header header\nacme_msgs/Cluster[] clusters",
}


def pose_at(t_s):
    """Position and yaw of the ego on a circle."""
    yaw = RATE_RADPS * t_s
    radius = SPEED_MPS / RATE_RADPS
    return radius * math.sin(yaw), radius * (1.0 - math.cos(yaw)), yaw


class Bag:
    """Writer of a small bag of ROS 2, or of ROS 1, with messages in the order of time."""

    def __init__(self, path, ros1=False):
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        types = {}
        for name, text in NESTED.items():
            types |= get_types_from_msg(text, name)
        self.store.register(types)
        self.ros1 = ros1
        self.path = path
        self.rows = []

    def make(self, kind, **fields):
        if self.ros1 and kind == "std_msgs/msg/Header":
            fields["seq"] = 0
        return self.store.types[kind](**fields)

    def header(self, t_s, frame):
        ns = START_NS + round(t_s * 1e9)
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9
        )
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def pose(self, x, y, yaw):
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
            orientation=self.turn(yaw),
        )

    def turn(self, yaw):
        z, w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
        return self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)

    def transform(self, t_s, parent, child, x, y, yaw):
        move = self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0)
        moved = self.make(
            "geometry_msgs/msg/Transform", translation=move, rotation=self.turn(yaw)
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(t_s, parent),
            child_frame_id=child,
            transform=moved,
        )

    def put(self, topic, kind, message, t_s, delay_s=0.02):
        self.rows.append(
            (START_NS + round((t_s + delay_s) * 1e9), topic, kind, message)
        )

    def write(self):
        name = "serialize_ros1" if self.ros1 else "serialize_cdr"
        writer = (
            Writer1(self.path)
            if self.ros1
            else Writer2(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        )
        known = {}
        with writer:
            for log_ns, topic, kind, message in sorted(
                self.rows, key=lambda row: row[0]
            ):
                if topic not in known:
                    known[topic] = writer.add_connection(
                        topic, kind, typestore=self.store
                    )
                writer.write(
                    known[topic], log_ns, getattr(self.store, name)(message, kind)
                )
        return self.path

    def ego(self, kind, t_s):
        x, y, yaw = pose_at(t_s)
        if kind == "geometry_msgs/msg/PoseWithCovarianceStamped":
            pose = self.make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self.pose(x, y, yaw),
                covariance=np.diag([0.01] * 6).ravel(),
            )
            return self.make(kind, header=self.header(t_s, "map"), pose=pose)
        if kind == "geometry_msgs/msg/PoseStamped":
            return self.make(
                kind, header=self.header(t_s, "map"), pose=self.pose(x, y, yaw)
            )
        if kind == "geometry_msgs/msg/TransformStamped":
            return self.transform(t_s, "map", "base_link", x, y, yaw)
        if kind == "sensor_msgs/msg/NavSatFix":
            status = self.make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
            return self.make(
                kind,
                header=self.header(t_s, "gps"),
                status=status,
                latitude=48.0 + y / 111_200.0,
                longitude=11.0 + x / 74_600.0,
                altitude=500.0,
                position_covariance=np.zeros(9),
                position_covariance_type=0,
            )
        move = self.transform(t_s, "odom", "base_link", x - 100.0, y, yaw)
        still = self.transform(t_s, "map", "odom", 100.0, 0.0, 0.0)
        return self.make(kind, transforms=[still, move] if "tf2" in kind else [move])

    def objects(self, t_s):
        poses = [self.pose(10.0 + 10.0 * k, 2.0 * k, 0.0) for k in range(3)]
        self.put(
            "/clusters",
            "geometry_msgs/msg/PoseArray",
            self.make(
                "geometry_msgs/msg/PoseArray",
                header=self.header(t_s, "base_link"),
                poses=poses,
            ),
            t_s,
        )


KINDS = {
    "/amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/vehicle/pose": "geometry_msgs/msg/PoseStamped",
    "/vicon/car": "geometry_msgs/msg/TransformStamped",
    "/gps/fix": "sensor_msgs/msg/NavSatFix",
    "/tf": "tf2_msgs/msg/TFMessage",
}


def egos(source):
    return [each for each in source.messages() if isinstance(each, EgoState)]


def errors(states):
    """Largest errors of yaw and speed."""
    yaws = [pose_at((each.stamp_ns - START_NS) / 1e9)[2] for each in states]
    turned = [
        math.remainder(each.yaw_rad - yaw, math.tau)
        for each, yaw in zip(states, yaws, strict=True)
    ]
    speeds = [each.speed_mps - SPEED_MPS for each in states]
    return max(map(abs, turned)), max(map(abs, speeds))


@pytest.mark.parametrize("topic", KINDS)
def test_the_ego_is_read_from_poses_and_drafted(tmp_path, topic):
    bag = Bag(tmp_path / "drive")
    for k in range(60):
        bag.put(topic, KINDS[topic], bag.ego(KINDS[topic], 0.1 * k), 0.1 * k)
        bag.objects(0.1 * k)
    bag.write()
    config = InputConfig(ego=TopicInput(topic))
    found = egos(open_input(tmp_path / "drive", config))
    assert len(found) == 60
    yaw, speed = errors(found[10:])
    assert yaw < 0.03
    assert speed < 0.3
    # NaN, the heading before the first way, does not equal itself.
    assert repr(found) == repr(egos(open_input(tmp_path / "drive", config)))
    assert (found[20].covariance is not None) == (topic == "/amcl_pose")
    source = open_input(tmp_path / "drive", config)
    assert repr(egos(source)) == repr(egos(source)) == repr(found)
    drafted = opened(tmp_path / "drive").config.input
    assert drafted.ego is not None
    assert drafted.ego.topic == topic
    assert list(drafted.detections) == ["clusters"]


def test_odometry_is_the_ego_before_poses_and_a_goal_is_not(tmp_path):
    bag = Bag(tmp_path / "drive")
    kind = "geometry_msgs/msg/PoseStamped"
    for k in range(20):
        bag.put("/a/goal_pose", kind, bag.ego(kind, 0.1 * k), 0.1 * k)
        bag.put("/tf", KINDS["/tf"], bag.ego(KINDS["/tf"], 0.1 * k), 0.1 * k)
        bag.put(
            "/gps/fix", KINDS["/gps/fix"], bag.ego(KINDS["/gps/fix"], 0.1 * k), 0.1 * k
        )
        bag.objects(0.1 * k)
    draft = opened(bag.write())
    assert draft.config.input.ego is not None
    assert draft.config.input.ego.topic == "/gps/fix"
    assert any("goal_pose" in line and "not the ego" in line for line in draft.unused)


def test_transforms_without_a_frame_of_the_ego_are_one_line(tmp_path):
    bag = Bag(tmp_path / "drive")
    for k in range(20):
        arm = bag.transform(0.1 * k, "arm", "hand", 0.1 * k, 0.0, 0.0)
        message = bag.make("tf2_msgs/msg/TFMessage", transforms=[arm])
        bag.put("/tf", "tf2_msgs/msg/TFMessage", message, 0.1 * k)
    with pytest.raises(CallError, match="no transform moves a frame of the ego"):
        open_input(bag.write(), InputConfig(ego=TopicInput("/tf")))


def test_transforms_of_ros1_are_the_ego_and_no_detections(tmp_path):
    bag = Bag(tmp_path / "drive.bag", ros1=True)
    bag.store.register(
        get_types_from_msg(
            "geometry_msgs/TransformStamped[] transforms", "tf/msg/tfMessage"
        )
    )
    for k in range(30):
        bag.put(
            "/tf", "tf/msg/tfMessage", bag.ego("tf/msg/tfMessage", 0.1 * k), 0.1 * k
        )
        bag.objects(0.1 * k)
    draft = opened(bag.write())
    assert draft.config.input.ego is not None
    assert draft.config.input.ego.topic == "/tf"
    assert list(draft.config.input.detections) == ["clusters"]
    yaw, speed = errors(egos(draft.source)[10:])
    assert yaw < 0.01
    assert speed < 0.1


def test_objects_in_nested_lists_and_deep_poses_are_drafted(tmp_path):
    bag = Bag(tmp_path / "drive")
    for k in range(30):
        t = 0.1 * k
        things = [
            bag.make(
                "acme_msgs/msg/Thing",
                id=i,
                kinematics=bag.make(
                    "acme_msgs/msg/Kinematics",
                    initial_pose_with_covariance=bag.make(
                        "geometry_msgs/msg/PoseWithCovariance",
                        pose=bag.pose(5.0 + i, 1.0 * i + t, 0.1),
                        covariance=np.zeros(36),
                    ),
                ),
            )
            for i in range(4)
        ]
        clusters = [
            bag.make("acme_msgs/msg/Cluster", name=name, things=part)
            for name, part in (("a", things[:1]), ("b", things[1:]), ("c", []))
        ]
        message = bag.make(
            "acme_msgs/msg/Clusters", header=bag.header(t, "map"), clusters=clusters
        )
        bag.put("/deep", "acme_msgs/msg/Clusters", message, t)
    draft = opened(bag.write())
    fields = draft.config.input.detections["deep"].fields
    assert fields is not None
    assert fields["objects"] == "clusters.things"
    lists = [
        each for each in draft.source.messages() if isinstance(each, DetectionList)
    ]
    assert [item.x_m for item in lists[0].objects] == [5.0, 6.0, 7.0, 8.0]


def test_a_path_may_lead_through_lists():
    inner = [
        SimpleNamespace(items=[1, 2]),
        SimpleNamespace(items=[]),
        SimpleNamespace(items=[3]),
    ]
    message = SimpleNamespace(groups=inner, top=[4])
    assert items_by_fields(message, {"objects": "groups.items"}) == [1, 2, 3]
    assert items_by_fields(message, {"objects": "groups.0.items"}) == [1, 2]
    assert items_by_fields(message, {"objects": "top"}) == [4]

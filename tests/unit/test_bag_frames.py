"""Frames of detections in bags: the odometry's frames, tf, optical frames and names."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fgtrack.core.types import DetectionList, EgoState
from fgtrack.inputs.ros.bag import Bag
from fgtrack.inputs.ros.frames import BagFrames, Edge, Transforms
from fgtrack.inputs.settings import InputConfig, TopicInput
from fgtrack.inputs.source import open_input

S = 1_000_000_000
EGO_YAW = 0.4
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""Orientation x, y, z, w of an optical frame that looks along the x axis of its parent."""
Turn = tuple[float, float, float, float]
Transform = tuple[str, str, tuple[float, float, float], Turn]


def about_z(yaw_rad: float) -> Turn:
    return (0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad))


class SmallBag:
    """Ego at (2 t, 0) with yaw 0.4 in the frame `odom_frame`, and one detected point for each second."""

    def __init__(self, path: Path, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(
                get_types_from_msg(definition, "tf2_msgs/msg/TFMessage")
            )
        self.types = self.store.types
        self.writer = (
            Writer1(path)
            if ros1
            else Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
        )
        self.writer.open()
        self.connections: dict[str, object] = {}

    def put(self, topic: str, time_ns: int, message: object) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(
                topic, kind, typestore=self.store
            )
        write = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time_ns, write(message, kind))

    def header(self, time_ns: int, frame: str) -> object:
        stamp = self.types["builtin_interfaces/msg/Time"](
            sec=time_ns // S, nanosec=time_ns % S
        )
        number = {"seq": 0} if self.ros1 else {}
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **number)

    def point(self, xyz: Sequence[float], kind: str = "Point") -> object:
        x, y, z = map(float, xyz)
        return self.types[f"geometry_msgs/msg/{kind}"](x=x, y=y, z=z)

    def pose(self, xyz: Sequence[float], turn: Turn) -> object:
        orientation = self.types["geometry_msgs/msg/Quaternion"](*turn)
        return self.types["geometry_msgs/msg/Pose"](
            position=self.point(xyz), orientation=orientation
        )

    def odometry(self, time_ns: int, frame: str, child: str) -> None:
        g = "geometry_msgs/msg/"
        vector = self.point((0.0, 0.0, 0.0), "Vector3")
        twist = self.types[g + "Twist"](linear=vector, angular=vector)
        message = self.types["nav_msgs/msg/Odometry"](
            header=self.header(time_ns, frame),
            child_frame_id=child,
            pose=self.types[g + "PoseWithCovariance"](
                pose=self.pose((2.0 * time_ns / S, 0.0, 0.0), about_z(EGO_YAW)),
                covariance=np.zeros(36),
            ),
            twist=self.types[g + "TwistWithCovariance"](
                twist=twist, covariance=np.zeros(36)
            ),
        )
        self.put("/odom", time_ns, message)

    def transforms(self, topic: str, time_ns: int, *items: Transform) -> None:
        made = []
        for parent, child, xyz, turn in items:
            transform = self.types["geometry_msgs/msg/Transform"](
                translation=self.point(xyz, "Vector3"),
                rotation=self.types["geometry_msgs/msg/Quaternion"](*turn),
            )
            made.append(
                self.types["geometry_msgs/msg/TransformStamped"](
                    header=self.header(time_ns, parent),
                    child_frame_id=child,
                    transform=transform,
                )
            )
        name = "tf2_msgs/msg/TFMessage"
        self.put(topic, time_ns, self.types[name](transforms=made))

    def detections(self, time_ns: int, frame: str, xyz: Sequence[float]) -> None:
        message = self.types["geometry_msgs/msg/PoseArray"](
            header=self.header(time_ns, frame),
            poses=[self.pose(xyz, about_z(0.3))],
        )
        self.put("/objects", time_ns, message)


def read(path: Path, frame: str | None = None) -> list[DetectionList]:
    config = InputConfig(
        ego=TopicInput("/odom"),
        detections={"radar": TopicInput("/objects", frame=frame)},  # type: ignore[arg-type]  # a name
    )
    messages = list(open_input(path, config).messages())
    assert any(isinstance(item, EgoState) for item in messages)
    return [item for item in messages if isinstance(item, DetectionList)]


def recorded(
    path: Path,
    frame: str,
    *items: Transform,
    odom: tuple[str, str] = ("odom", "base_link"),
    ros1: bool = False,
    point: Sequence[float] = (10.0, 3.0, 1.0),
) -> Path:
    bag = SmallBag(path, ros1)
    if items:
        bag.transforms("/tf_static", 0, *items)
    for k in range(1, 4):
        bag.odometry(k * S, *odom)
        bag.detections(k * S, frame, point)
    bag.writer.close()
    return path


@pytest.mark.parametrize("frame", ["car1/map", "/car1/map"])
def test_the_frame_of_the_ego_odometry_is_the_map(tmp_path: Path, frame: str) -> None:
    path = recorded(tmp_path / "bag", frame, odom=("car1/map", "car1/hull"))
    assert [each.frame for each in read(path)] == ["map"] * 3


def test_the_child_frame_of_the_ego_odometry_is_the_ego(tmp_path: Path) -> None:
    path = recorded(tmp_path / "bag", "world_of_car", odom=("utm", "world_of_car"))
    assert {each.frame for each in read(path)} == {"ego"}


@pytest.mark.parametrize("ros1", [False, True])
def test_tf_moves_detections_of_a_rear_radar_into_the_ego_frame(
    tmp_path: Path, ros1: bool
) -> None:
    chain: list[Transform] = [
        ("base_link", "roof", (0.5, 0.0, 1.0), about_z(0.0)),
        ("roof", "radar_rear", (-1.5, 0.2, 0.0), about_z(math.pi)),
    ]
    path = tmp_path / ("bag.bag" if ros1 else "bag")
    first = read(recorded(path, "radar_rear", *chain, ros1=ros1))[0]
    assert first.frame == "ego"
    (item,) = first.objects
    assert (item.x_m, item.y_m) == pytest.approx((-1.0 - 10.0, 0.2 - 3.0))
    assert item.yaw_rad == pytest.approx(0.3 - math.pi)


def test_tf_moves_detections_of_an_optical_frame(tmp_path: Path) -> None:
    mounted: Transform = ("base_link", "camera", (1.5, 0.0, 1.2), OPTICAL)
    path = recorded(tmp_path / "bag", "camera", mounted, point=(-2.0, 0.7, 20.0))
    (item,) = read(path)[0].objects
    assert (item.x_m, item.y_m, item.z_m) == pytest.approx((21.5, 2.0, 0.5))
    assert item.yaw_rad is None


def test_the_mount_of_a_static_upright_frame_is_known(tmp_path: Path) -> None:
    mounted: Transform = ("base_link", "radar", (3.0, 0.5, 0.6), about_z(0.6))
    tilted: Transform = ("base_link", "camera", (1.5, 0.0, 1.2), OPTICAL)
    path = recorded(tmp_path / "bag", "radar", mounted, tilted)
    frames = BagFrames(Bag(path), "/odom")
    assert frames.mount("/radar") == pytest.approx((3.0, 0.5, 0.6))
    assert frames.mount("camera") is None
    assert frames.mount("unknown") is None


def test_an_optical_frame_can_be_configured(tmp_path: Path) -> None:
    path = recorded(tmp_path / "bag", "zed", point=(-2.0, 0.7, 20.0))
    first = read(path, "optical")[0]
    assert first.frame == "sensor"
    assert (first.objects[0].x_m, first.objects[0].y_m) == pytest.approx((20.0, 2.0))


def test_tf_moves_detections_of_a_second_fixed_frame_into_the_map(
    tmp_path: Path,
) -> None:
    fixed: Transform = ("map", "odom", (100.0, 0.0, 0.0), about_z(0.5 * math.pi))
    path = recorded(tmp_path / "bag", "map", fixed)
    first = read(path)[0]
    assert first.frame == "map"
    assert (first.objects[0].x_m, first.objects[0].y_m) == pytest.approx((3.0, 90.0))


def test_a_moving_transform_is_interpolated_at_the_stamp(tmp_path: Path) -> None:
    bag = SmallBag(tmp_path / "bag")
    for k in range(1, 4):
        turn = about_z(0.2 * (k - 0.5))
        bag.transforms(
            "/tf", k * S - S // 2, ("base_link", "turret", (0.0, 0.0, 0.0), turn)
        )
        bag.odometry(k * S, "odom", "base_link")
        bag.detections(k * S, "turret", (10.0, 0.0, 0.0))
    bag.transforms("/tf", 4 * S, ("base_link", "turret", (0.0, 0.0, 0.0), about_z(0.8)))
    bag.writer.close()
    angles = [
        math.atan2(each.objects[0].y_m or 0.0, each.objects[0].x_m or 0.0)
        for each in read(tmp_path / "bag")
    ]
    assert angles == pytest.approx([0.2, 0.4, 0.6])


def test_a_moving_transform_is_unknown_long_before_its_first_sample() -> None:
    stamps_ns = np.array([10 * S, 11 * S])
    quaternions = np.array([about_z(0.0), about_z(1.0)])
    edge = Edge("base", stamps_ns, np.array([[0.0, 0, 0], [1.0, 0, 0]]), quaternions)
    transforms = Transforms({"arm": edge})
    early = transforms.pose("arm", "base", 5 * S)
    inside = transforms.pose("arm", "base", 10 * S + S // 2)
    assert early is not None
    assert inside is not None
    assert np.isnan(early.translation_m).all()
    assert inside.translation_m == pytest.approx([0.5, 0.0, 0.0])
    assert transforms.pose("arm", "elsewhere", 10 * S) is None

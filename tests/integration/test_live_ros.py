"""The ROS 2 node of docs/live, on stand-ins for rclpy, tf2_ros and the messages."""

import math
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.ros import Node, Time, message_class, stand_ins
from support.scripts import LIVE, load_file

MS = 1_000_000
NOW_NS = 1_700_000_000_000_000_000
CAR_M = (100.0, 3.0)  # in the map
SPEED_MPS = 20.0  # of the ego, along x, turning


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    with stand_ins():
        yield load_file(LIVE / "ros_node.py", "live")


def made(script: ModuleType, **parameters: Any) -> Any:
    Node.given = {"sensors": ["lidar_cluster", "radar"], "config": "smoother", **parameters}
    node = script.TrackerNode()
    node.clock.time_ns = NOW_NS
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
    node.clock.time_ns = receipt_ns
    node.subscriptions[topic][1](message)


def tick(node: Any, now_ns: int) -> Any:
    """The timer's tick; the message that it publishes, if any."""
    node.clock.time_ns = now_ns
    before = len(node.publishers["tracks"].messages)
    node.timers[0][1]()
    published = node.publishers["tracks"].messages[before:]
    return published[0] if published else None


def counts(node: Any) -> dict[str, dict[str, int]]:
    return {sensor: dict(of_sensor) for sensor, of_sensor in node.tracker.counts.items()}


def test_a_standing_car_is_tracked_from_a_turning_ego_with_late_lists_and_late_poses(script: ModuleType) -> None:
    node = made(script, published_ago_s=0.1)
    for k in range(1, 60):
        now_ns = NOW_NS + 20 * MS * k
        node.buffer.known[now_ns - 30 * MS] = pose(now_ns - 30 * MS)
        odometry = message_class("nav_msgs/msg/Odometry")()
        odometry.twist.twist.linear.x, odometry.twist.twist.angular.z = SPEED_MPS, 0.3
        send(node, "odometry", odometry, now_ns - 5 * MS)
        if k > 10:
            send(node, "radar/detections", detections(now_ns - 17 * MS), now_ns - 3 * MS)  # between two poses
            send(node, "lidar_cluster/detections", detections(now_ns - 111 * MS), now_ns - 2 * MS)
        published = tick(node, now_ns)
    [track] = published.detections
    assert Time.from_msg(published.header.stamp).nanoseconds == now_ns - 100 * MS
    assert (published.header.frame_id, track.header.frame_id, track.id) == ("map", "map", "0")
    at_m = (track.bbox.center.position.x, track.bbox.center.position.y)
    assert at_m == pytest.approx(CAR_M, abs=2.2)  # the middle of the car is not where detections are taken
    P = np.reshape(track.results[0].pose.covariance, (6, 6))
    np.testing.assert_allclose(P, P.T)
    assert np.linalg.eigvalsh(P[np.ix_((0, 1, 5), (0, 1, 5))])[0] > 0.0
    assert (P[2:5] == 0.0).all()
    found = counts(node)
    assert sum(map(sum, (one.values() for one in found.values()))) == 2 * 49 - 1  # the newest one waits for its pose
    assert found["lidar_cluster"]["out_of_sequence"] > 40
    assert (node.without_pose, node.tracker.refused, node.tracker.failures) == (0, {}, {})
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
    [(threshold, on_jump)] = node.clock.jumps
    assert threshold.min_forward is None
    assert threshold.min_backward.nanoseconds < 0
    on_jump(None)
    published = tick(node, NOW_NS - 5_000 * MS)
    assert (published.detections, Time.from_msg(published.header.stamp).nanoseconds) == ([], NOW_NS - 5_000 * MS)
    assert (counts(node), node.tracker.refused, node.buffer.known) == ({}, {}, {})

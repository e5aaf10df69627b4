"""A ROS 2 node: object lists, odometry and TF in, tracks out.

    python docs/live/ros_node.py --ros-args -p sensors:="[radar, lidar]" -p use_sim_time:=true

Subscribes `SENSOR/detections` (vision_msgs/Detection3DArray) and `odometry` (nav_msgs/Odometry, its twist), publishes
`tracks` (vision_msgs/Detection3DArray). A list is given to the tracker with the pose of the ego at the list's own
stamp, from TF. Often TF comes later than the list: then the list waits, at most `tf_wait_s`.
"""

import math
from collections import deque
from functools import partial
from typing import NamedTuple

import rclpy
from nav_msgs.msg import Odometry
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.time import Time
from tf2_ros import Buffer, TransformException, TransformListener
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

import fgtrack

# What a sensor has sent and the network has lost is not sent again; a publisher may be reliable all the same.
SENSOR_DATA = QoSProfile(reliability=QoSReliabilityPolicy.BEST_EFFORT, history=QoSHistoryPolicy.KEEP_LAST, depth=50)
PARAMETERS = {
    "config": "smoother",
    "map": "",
    "sensors": ["radar"],
    "map_frame": "map",
    "base_frame": "base_link",
    "tf_wait_s": 0.2,
    "published_ago_s": 0.0,
}


class Waiting(NamedTuple):
    """A list that has been received and not yet been given to the tracker."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    message: Detection3DArray


class TrackerNode(Node):
    """Feeds the tracker, and publishes its tracks at every tick."""

    def __init__(self) -> None:
        super().__init__("fgtrack")
        self._set = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self)
        self._begin()
        backwards = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True)
        self._jumps = self.get_clock().create_jump_callback(backwards, post_callback=self._on_jump)
        self._tracks = self.create_publisher(Detection3DArray, "tracks", 10)
        self.create_subscription(Odometry, "odometry", self._on_odometry, SENSOR_DATA)
        for sensor in self._set["sensors"]:
            on_list = partial(self._on_list, sensor)
            self.create_subscription(Detection3DArray, f"{sensor}/detections", on_list, SENSOR_DATA)
        self.create_timer(1.0 / (self.tracker.config.clock.node_hz or 50.0), self._on_tick)  # simulated time included
        self.create_timer(10.0, self._on_report)

    def _begin(self) -> None:
        """Everything that depends on the past."""
        self.tracker = fgtrack.Tracker.from_config(self._set["config"], map=self._set["map"] or None)
        self._waiting: list[Waiting] = []
        self._poses: deque[int] = deque(maxlen=1000)  # stamps at which the tracker has the ego from TF
        self._odometry: Odometry | None = None
        self.without_pose = 0

    def _on_jump(self, jump: TimeJump) -> None:
        """Time has begun again, as where a recording is played in a loop."""
        self.get_logger().warning("time went back: starting over")
        self._buffer.clear()
        self._begin()

    def _now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    def _on_odometry(self, message: Odometry) -> None:
        self._odometry = message

    def _on_list(self, sensor: str, message: Detection3DArray) -> None:
        stamp_ns = Time.from_msg(message.header.stamp).nanoseconds
        self._waiting.append(Waiting(sensor, stamp_ns, self._now_ns(), message))

    def _on_tick(self) -> None:
        now_ns = self._now_ns()
        if now_ns == 0:
            return  # simulated time has not begun
        self._give_pose(Time())  # the newest
        self._waiting = [waiting for waiting in self._waiting if not self._give(waiting, now_ns)]
        self.tracker.tick(now_ns)
        stamp_ns = now_ns - round(1e9 * self._set["published_ago_s"])
        self._tracks.publish(self._message(stamp_ns, self.tracker.tracks_at(stamp_ns)))

    def _give(self, waiting: Waiting, now_ns: int) -> bool:
        """Give a list to the tracker, unless it is worth waiting for the pose at its stamp."""
        frames = {self._set["map_frame"]: "map", self._set["base_frame"]: "ego"}
        frame = frames.get(waiting.message.header.frame_id, "sensor")  # mounted as configured
        if frame != "map" and not self._give_pose(Time(nanoseconds=waiting.stamp_ns)):
            if now_ns - waiting.receipt_ns < 1e9 * self._set["tf_wait_s"]:
                return False
            self.without_pose += 1  # the tracker extrapolates, or reports `failed`
        centres = [detection.bbox.center.position for detection in waiting.message.detections]
        objects = [fgtrack.Detection(x_m=centre.x, y_m=centre.y) for centre in centres]
        self.tracker.receive(
            fgtrack.DetectionList(waiting.sensor, waiting.stamp_ns, waiting.receipt_ns, objects, frame=frame)
        )
        return True

    def _give_pose(self, time: Time) -> bool:
        """Give the pose of the ego at a time to the tracker; False if TF lacks it."""
        try:
            found = self._buffer.lookup_transform(self._set["map_frame"], self._set["base_frame"], time)
        except TransformException:  # not yet, not any more, or no such frame
            return False
        stamp_ns = Time.from_msg(found.header.stamp).nanoseconds
        if stamp_ns not in self._poses:
            self._poses.append(stamp_ns)
            where, turned = found.transform.translation, found.transform.rotation
            sine, cosine = turned.w * turned.z + turned.x * turned.y, turned.y * turned.y + turned.z * turned.z
            yaw_rad = math.atan2(2.0 * sine, 1.0 - 2.0 * cosine)
            twist = (0.0, 0.0)
            if self._odometry is not None:
                twist = (self._odometry.twist.twist.linear.x, self._odometry.twist.twist.angular.z)
            self.tracker.receive(fgtrack.EgoState(stamp_ns, self._now_ns(), where.x, where.y, yaw_rad, *twist))
        return True

    def _message(self, stamp_ns: int, tracks: tuple[fgtrack.TrackReport, ...]) -> Detection3DArray:
        message = Detection3DArray()
        message.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
        message.header.frame_id = self._set["map_frame"]
        for track in tracks:
            found, hypothesis = Detection3D(), ObjectHypothesisWithPose()
            pose, P = found.bbox.center, track.covariance
            pose.position.x, pose.position.y = track.x_m, track.y_m
            pose.orientation.z, pose.orientation.w = math.sin(track.yaw_rad / 2.0), math.cos(track.yaw_rad / 2.0)
            hypothesis.pose.pose = pose
            for row, i in ((0, 0), (1, 1), (5, 2)):  # x, y and yaw of ROS' x, y, z, roll, pitch, yaw
                for column, j in ((0, 0), (1, 1), (5, 2)):
                    hypothesis.pose.covariance[6 * row + column] = float(P[i, j])
            found.header, found.id, found.results = message.header, str(track.track_id), [hypothesis]
            message.detections.append(found)
        return message

    def _on_report(self) -> None:
        """Counts for the log."""
        for sensor, late in self.tracker.lateness.items():
            if late.silent_s > 1.0:
                self.get_logger().warning(f"{sensor}: silent for {late.silent_s:.1f} s")
        losses = {"refused": self.tracker.refused, "failures": self.tracker.failures}
        losses |= {"without pose": self.without_pose, "deadlines missed": self.tracker.timing.deadline_misses}
        for what, count in losses.items():
            if count:
                self.get_logger().warning(f"{what}: {count}")


def main() -> None:
    """Run the node."""
    rclpy.init()
    node = TrackerNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

"""A ROS 2 node: object lists, odometry and TF in; tracks and diagnostics out.

    ros2 launch fgtrack_ros tracker.launch.py parameters:=MY.yaml
    python ros2/fgtrack_ros/fgtrack_ros/node.py --ros-args -p sensors:="[radar, lidar]"

`config/tracker.yaml` lists the parameters. The node subscribes to `SENSOR/detections`
(vision_msgs/Detection3DArray) or `SENSOR/objects` (autoware_perception_msgs/DetectedObjects), and to `odometry`
(nav_msgs/Odometry). It publishes `tracks` (vision_msgs/Detection3DArray) and `/diagnostics`. A list is given to the
tracker with the pose of the ego at the list's stamp, from TF. Often TF comes later than the list: then the list waits,
at most `tf_wait_s`.
"""

import gc
import math
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
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
from fgtrack.inputs.formats.objects import autoware_objects, detection3d_array, ego_from_odometry

# What a sensor has sent and the network has lost is not sent again; a publisher may be reliable all the same.
SENSOR_DATA = QoSProfile(reliability=QoSReliabilityPolicy.BEST_EFFORT, history=QoSHistoryPolicy.KEEP_LAST, depth=50)
PARAMETERS: dict[str, Any] = {
    "config": "smoother",
    "map": "",
    "sensors": ["radar"],
    "autoware_sensors": [""],
    "map_frame": "map",
    "base_frame": "base_link",
    "ego_from_odometry": False,
    "tf_wait_s": 0.2,
    "published_ago_s": 0.0,
    "state_file": "",
    "save_every_s": 1.0,
}
LEVELS = {
    fgtrack.HealthState.OK: b"\x00",
    fgtrack.HealthState.DEGRADED: b"\x01",
    fgtrack.HealthState.STALE: b"\x03",
}
Adapter = Callable[[Any], fgtrack.ObjectList]


class Waiting(NamedTuple):
    """A list that has been received and not yet been given to the tracker."""

    sensor: str
    receipt_ns: int
    frame_id: str
    content: fgtrack.ObjectList

    @property
    def stamp_ns(self) -> int:
        """Stamp of the list; its receipt if the driver sets no stamp."""
        return self.content.stamp_ns or self.receipt_ns


class TrackerNode(Node):
    """Feeds the tracker, and publishes its tracks at every tick."""

    def __init__(self) -> None:
        super().__init__("fgtrack")
        self._set = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self)
        self._begin()
        self._resume()
        gc.collect()
        gc.freeze()  # what is loaded stays, so that no search for garbage goes through it
        backwards = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True)
        self._jumps = self.get_clock().create_jump_callback(backwards, post_callback=self._on_jump)
        self._tracks = self.create_publisher(Detection3DArray, "tracks", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_subscription(Odometry, "odometry", self._on_odometry, SENSOR_DATA)
        for sensor in filter(None, self._set["sensors"]):
            on_list = partial(self._on_list, sensor, detection3d_array)
            self.create_subscription(Detection3DArray, f"{sensor}/detections", on_list, SENSOR_DATA)
        self._subscribe_autoware(list(filter(None, self._set["autoware_sensors"])))
        self.create_timer(1.0 / (self.tracker.config.clock.node_hz or 50.0), self._on_tick)  # simulated time included
        self.create_timer(1.0, self._on_report)
        self.create_timer(self._set["save_every_s"], self._on_save)

    def _subscribe_autoware(self, sensors: list[str]) -> None:
        """Subscribe to the lists of Autoware, whose package is needed for these alone."""
        if not sensors:
            return
        from autoware_perception_msgs.msg import DetectedObjects

        for sensor in sensors:
            on_list = partial(self._on_list, sensor, autoware_objects)
            self.create_subscription(DetectedObjects, f"{sensor}/objects", on_list, SENSOR_DATA)

    def _begin(self) -> None:
        """Everything that depends on the past."""
        self.tracker = fgtrack.Tracker.from_config(self._set["config"], map=self._set["map"] or None)
        self._waiting: list[Waiting] = []
        self._poses: deque[int] = deque(maxlen=1000)  # stamps at which the tracker has the ego from TF
        self._odometry: Odometry | None = None
        self.without_pose = 0

    def _resume(self) -> None:
        """Go on from the state that a former process saved, if it belongs to the same configuration."""
        path = self._set["state_file"]
        if not path or not Path(path).exists():
            return
        try:
            saved = fgtrack.Tracker.load(path)
        except fgtrack.FgtrackError as error:
            self.get_logger().warning(f"the saved state is not used: {error}")
            return
        if saved.config == self.tracker.config:
            self.tracker = saved
        else:
            self.get_logger().warning(f"the saved state is not used: {path} belongs to another configuration")

    def _on_save(self) -> None:
        if self._set["state_file"]:
            self.tracker.save(self._set["state_file"])

    def _on_jump(self, jump: TimeJump) -> None:
        """Time has begun again, as where a recording is played in a loop."""
        self.get_logger().warning("time went back: starting over")
        self._buffer.clear()
        self._begin()

    def _now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    def _on_odometry(self, message: Odometry) -> None:
        self._odometry = message
        if self._set["ego_from_odometry"]:
            self.tracker.receive(ego_from_odometry(message, self._now_ns()))

    def _on_list(self, sensor: str, adapter: Adapter, message: Any) -> None:
        self._waiting.append(Waiting(sensor, self._now_ns(), message.header.frame_id, adapter(message)))

    def _on_tick(self) -> None:
        now_ns = self._now_ns()
        if now_ns == 0:
            return  # simulated time has not begun
        if not self._set["ego_from_odometry"]:
            self._give_pose(Time())  # the newest
        self._waiting = [waiting for waiting in self._waiting if not self._give(waiting, now_ns)]
        self.tracker.tick(now_ns)
        stamp_ns = now_ns - round(1e9 * self._set["published_ago_s"])
        self._tracks.publish(self._message(stamp_ns, self.tracker.tracks_at(stamp_ns)))

    def _give(self, waiting: Waiting, now_ns: int) -> bool:
        """Give a list to the tracker, unless it is worth waiting for the pose at its stamp."""
        frames = {self._set["map_frame"]: "map", self._set["base_frame"]: "ego"}
        frame = frames.get(waiting.frame_id, "sensor")  # mounted as configured
        needs_pose = frame != "map" and not self._set["ego_from_odometry"]
        if needs_pose and not self._give_pose(Time(nanoseconds=waiting.stamp_ns)):
            if now_ns - waiting.receipt_ns < 1e9 * self._set["tf_wait_s"]:
                return False
            self.without_pose += 1  # the tracker extrapolates, or reports `failed`
        objects = waiting.content.objects
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
            found, result = Detection3D(), ObjectHypothesisWithPose()
            pose, P = found.bbox.center, track.covariance
            pose.position.x, pose.position.y = track.x_m, track.y_m
            pose.orientation.z, pose.orientation.w = math.sin(track.yaw_rad / 2.0), math.cos(track.yaw_rad / 2.0)
            if track.object is not None and track.object.length_m is not None:
                size = found.bbox.size
                size.x, size.y = track.object.length_m, track.object.width_m or 0.0
                size.z = track.object.height_m or 0.0
            result.hypothesis.class_id = (track.object and track.object.class_name) or ""
            result.hypothesis.score = 1.0 if track.score is None else track.score
            result.pose.pose = pose
            for row, i in ((0, 0), (1, 1), (5, 2)):  # x, y and yaw of ROS' x, y, z, roll, pitch, yaw
                for column, j in ((0, 0), (1, 1), (5, 2)):
                    result.pose.covariance[6 * row + column] = float(P[i, j])
            found.header, found.id, found.results = message.header, str(track.track_id), [result]
            message.detections.append(found)
        return message

    def _on_report(self) -> None:
        """Publish the health: one status of the tracker, and one of each sensor and of the ego."""
        health, timing = self.tracker.health(), self.tracker.timing
        counts: dict[str, Any] = {
            **{f"refused: {reason}": count for reason, count in self.tracker.refused.items()},
            **{f"failures: {kind}": count for kind, count in self.tracker.failures.items()},
            "lists without pose": self.without_pose,
            "tick median [ms]": 1e3 * (timing.median_s or 0.0),
            "tick worst [ms]": 1e3 * (timing.worst_s or 0.0),
            "deadlines missed": timing.deadline_misses,
        }
        message = DiagnosticArray()
        message.header.stamp = Time(nanoseconds=self._now_ns()).to_msg()
        message.status.append(_status("fgtrack", health.state, health.reasons, counts))
        for name, one in health.sensors.items():
            values: dict[str, Any] = {"silent [s]": one.silent_s, "failed share": one.failed_share}
            if one.nis is not None:
                values["NIS per component"] = one.nis.mean_per_component
            values |= {f"bias {component}": mean for component, mean in one.bias.items()}
            values |= {f"share later than {key}": share for key, share in one.late_shares.items()}
            message.status.append(_status(f"fgtrack: {name}", one.state, one.reasons, values))
        self._diagnostics.publish(message)


def _status(
    name: str, state: fgtrack.HealthState, reasons: tuple[str, ...], values: dict[str, Any]
) -> DiagnosticStatus:
    """Return a status with its values as text."""
    status = DiagnosticStatus()
    status.level, status.name, status.hardware_id = LEVELS[state], name, "fgtrack"
    status.message = "; ".join(reasons) or state.value
    for key, value in values.items():
        pair = KeyValue()
        pair.key, pair.value = key, f"{value:.4g}" if isinstance(value, float) else str(value)
        status.values.append(pair)
    return status


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

"""Frames of a recording: the header's frame ids, the frames of the ego's odometry, and all transforms of tf."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, pairwise
from typing import Literal, NamedTuple

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Detection, FloatArray, Frame, IntArray
from fgtrack.inputs.formats.common import MAP_FRAMES, stamp_ns
from fgtrack.inputs.ros.bag import Bag

__all__ = ["EGO_FRAMES", "OPTICAL", "BagFrames", "FrameUse", "Transforms"]

EGO_FRAMES = frozenset(
    {"base_link", "base_footprint", "ego", "ego_vehicle", "vehicle", "body"}
)
"""Usual last names of the ego's frame."""
TF_TYPES = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
"""Message types of transforms, in ROS 2 and in ROS 1."""
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from an optical frame (x right, y down, z forward) to the sensor frame (x forward, y left, z up)."""
# A moving transform is used up to this time before its first and after its last sample.
_HOLD_S = 0.5
# Cosine of the largest tilt of a frame in which headings and covariances are kept.
_UPRIGHT = 0.94


class Pose(NamedTuple):
    """Pose of a frame in its parent: parent_from_frame."""

    rotation: FloatArray
    """Rotation matrix, shape (3, 3)."""
    translation_m: FloatArray
    """Translation, shape (3,)."""

    def then(self, parent: "Pose") -> "Pose":
        """Return the pose in the parent of `parent`."""
        return Pose(
            parent.rotation @ self.rotation,
            parent.rotation @ self.translation_m + parent.translation_m,
        )

    @property
    def inverse(self) -> "Pose":
        """Pose of the parent in this frame."""
        turned = self.rotation.T
        return Pose(turned, -turned @ self.translation_m)

    @property
    def is_upright(self) -> bool:
        """True if the z axes of both frames are nearly parallel."""
        return bool(self.rotation[2, 2] > _UPRIGHT)

    @property
    def yaw_rad(self) -> float:
        """Yaw of the frame's x axis in its parent."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))


_SAME = Pose(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Edge:
    """Pose of a frame in its parent over time."""

    parent: str
    stamps_ns: IntArray
    """Ascending stamps, shape (n,)."""
    translations_m: FloatArray
    """Translations, shape (n, 3)."""
    quaternions: FloatArray
    """Orientations x, y, z, w, shape (n, 4)."""

    @cached_property
    def is_constant(self) -> bool:
        """True if all samples are equal."""
        return bool(
            np.ptp(self.translations_m, axis=0).max() < 1e-9
            and np.ptp(self.quaternions, axis=0).max() < 1e-9
        )

    def at(self, time_ns: int) -> Pose:
        """Return the pose at `time_ns`, interpolated.

        A moving edge keeps its first and last pose for a short time beyond the samples; beyond this time the pose is
        NaN.
        """
        from scipy.spatial.transform import Rotation, Slerp

        if self.is_constant:
            return Pose(
                Rotation.from_quat(self.quaternions[0]).as_matrix(),
                self.translations_m[0],
            )
        first_ns = int(self.stamps_ns[0])
        last_ns = int(self.stamps_ns[-1])
        hold_ns = nanoseconds(_HOLD_S)
        if not first_ns - hold_ns <= time_ns <= last_ns + hold_ns:
            return Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
        time_ns = min(max(time_ns, first_ns), last_ns)
        k = int(np.searchsorted(self.stamps_ns, time_ns, side="right")) - 1
        k = min(k, len(self.stamps_ns) - 2)
        begin_ns, end_ns = self.stamps_ns[k : k + 2].tolist()
        share = (time_ns - begin_ns) / (end_ns - begin_ns)
        turn = Slerp([0.0, 1.0], Rotation.from_quat(self.quaternions[k : k + 2]))
        ends_m = self.translations_m[k : k + 2]
        return Pose(
            turn([share]).as_matrix()[0], ends_m[0] + share * (ends_m[1] - ends_m[0])
        )


@dataclass(frozen=True)
class Transforms:
    """Tree of the transforms of a recording: static and moving ones."""

    edges: Mapping[str, Edge]
    """Edge to the parent, by the name of the frame."""

    @classmethod
    def of_bag(cls, bag: Bag) -> "Transforms":
        """Read all transforms of `bag`; frame names lose their leading slash.

        A frame with several parents keeps the parent with most samples. Samples of a
        frame with invalid numbers are left out.
        """
        topics = {
            topic.name
            for topic in bag.topics
            if topic.type in TF_TYPES and topic.problem is None
        }
        samples: dict[tuple[str, str], dict[int, list[float]]] = {}
        messages = (message for _, _, message in bag.messages(topics)) if topics else ()
        for item in chain.from_iterable(message.transforms for message in messages):
            edge = named(item.child_frame_id), named(item.header.frame_id)
            move = item.transform.translation
            turn = item.transform.rotation
            values = [move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w]
            if np.isfinite(values).all() and any(values[3:]):
                samples.setdefault(edge, {})[stamp_ns(item.header.stamp)] = values
        edges: dict[str, Edge] = {}
        for (child, parent), rows in samples.items():
            if child in edges and len(edges[child].stamps_ns) >= len(rows):
                continue
            stamps_ns = np.array(sorted(rows), dtype=np.int64)
            table = np.array([rows[stamp] for stamp in stamps_ns.tolist()])
            edges[child] = Edge(parent, stamps_ns, table[:, :3], table[:, 3:])
        return cls(edges)

    def ancestors(self, frame: str) -> list[str]:
        """Return `frame` and its ancestors up to the root."""
        result = [frame]
        while (edge := self.edges.get(result[-1])) and edge.parent not in result:
            result.append(edge.parent)
        return result

    def path(self, source: str, target: str) -> list[str] | None:
        """Return the frames on the way from `source` to `target`; None if the tree does not connect them."""
        up = self.ancestors(source)
        down = self.ancestors(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        return up[: up.index(common) + 1] + down[: down.index(common)][::-1]

    def pose(self, source: str, target: str, time_ns: int) -> Pose | None:
        """Return the pose of `source` in `target` at `time_ns`; None if the tree does not connect them."""
        up = self.ancestors(source)
        down = self.ancestors(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        in_common = self._chain(up[: up.index(common)], time_ns)
        common_pose = self._chain(down[: down.index(common)], time_ns).inverse
        return in_common.then(common_pose)

    def is_constant(self, path: list[str]) -> bool:
        """True if no transform along `path` moves."""
        for first, second in pairwise(path):
            up = self.edges.get(first)
            child = first if up is not None and up.parent == second else second
            if not self.edges[child].is_constant:
                return False
        return True

    def _chain(self, frames: list[str], time_ns: int) -> Pose:
        pose = _SAME
        for frame in frames:
            pose = pose.then(self.edges[frame].at(time_ns))
        return pose


class FrameUse(NamedTuple):
    """Frame of fgtrack in which the detections of a header frame are read, and the evidence for it."""

    frame: Frame
    evidence: Literal["odometry", "tf", "name", "unknown"]
    """`odometry`: the ego's message names the frame. `tf`: transforms connect it to the ego or to the map."""
    target: str | None = None
    """Frame into which tf transforms the detections; None without a transform."""


class BagFrames:
    """Frames of one recording; transforms are read when a frame needs them."""

    def __init__(self, bag: Bag, ego_topic: str | None) -> None:
        self._bag = bag
        self._ego_topic = ego_topic
        self._uses: dict[str, FrameUse] = {}

    @cached_property
    def transforms(self) -> Transforms:
        """Transforms of the recording."""
        return Transforms.of_bag(self._bag)

    @cached_property
    def _ego_message(self) -> object | None:
        """First message of the ego; None if there is no ego, or no message."""
        if self._ego_topic is None:
            return None
        messages = self._bag.messages({self._ego_topic})
        return next((message for _, _, message in messages), None)

    @cached_property
    def map_frame(self) -> str | None:
        """Frame of the ego's positions, which is the map; None without an ego, or without a name.

        If transforms give the ego, it is the usual name of a fixed frame above the ego's
        frame, else the root.
        """
        header = getattr(self._ego_message, "header", None)
        if header is None and hasattr(self._ego_message, "transforms"):
            above = self.transforms.ancestors(self.ego_frame or "")[1:]
            ranked = sorted(above, key=lambda frame: _last(frame) not in MAP_FRAMES)
            best = [each for each in ranked if _last(each) == "map"] or ranked
            return next(iter(best), None)
        return named(getattr(header, "frame_id", "")) or None

    @cached_property
    def moving_ego_frame(self) -> str | None:
        """First frame from the ego's frame upwards that moves in its parent; None if none moves."""
        chain = self.transforms.ancestors(self.ego_frame or "")
        edges = self.transforms.edges
        return next(
            (each for each in chain if each in edges and not edges[each].is_constant),
            None,
        )

    @cached_property
    def ego_frame(self) -> str | None:
        """Frame of the ego: of its odometry, else the frame with the usual name in tf; None if there is neither."""
        name = named(getattr(self._ego_message, "child_frame_id", ""))
        if name:
            return name
        frames = {*self.transforms.edges, *self._parents()}
        return min((each for each in frames if _last(each) in EGO_FRAMES), default=None)

    def _parents(self) -> Iterator[str]:
        return (edge.parent for edge in self.transforms.edges.values())

    def use(self, frame_id: str) -> FrameUse:
        """Return the use of a header's `frame_id`.

        The odometry's `frame_id` is the map, and its `child_frame_id` is the ego. tf
        connects other frames to the ego, or to the map if the way to the ego leads
        through the map. Else the usual names of fixed frames are the map.
        """
        name = named(frame_id)
        if name not in self._uses:
            self._uses[name] = self._use(name)
        return self._uses[name]

    def _use(self, name: str) -> FrameUse:
        if name and name == self.map_frame:
            return FrameUse("map", "odometry")
        if name and name == self.ego_frame:
            return FrameUse("ego", "odometry")
        to_ego = self.ego_frame and self.transforms.path(name, self.ego_frame)
        if to_ego and self.map_frame not in to_ego:
            return FrameUse("ego", "tf", self.ego_frame)
        if self.map_frame and self.transforms.path(name, self.map_frame):
            return FrameUse("map", "tf", self.map_frame)
        if _last(name) in MAP_FRAMES:
            return FrameUse("map", "name")
        return FrameUse("ego", "name" if _last(name) in EGO_FRAMES else "unknown")

    def mount(self, frame_id: str) -> tuple[float, float, float] | None:
        """Return x, y and yaw of a frame in the ego; None if tf does not connect them, or it moves or is tilted."""
        name = named(frame_id)
        if self.ego_frame is None or self.use(name).frame != "ego":
            return None
        path = self.transforms.path(name, self.ego_frame)
        if path is None or not self.transforms.is_constant(path):
            return None
        pose = self.transforms.pose(name, self.ego_frame, 0)
        if pose is None or not pose.is_upright:
            return None
        x_m, y_m, _ = pose.translation_m.tolist()
        return x_m, y_m, pose.yaw_rad

    def placed(
        self, objects: tuple[Detection, ...], frame_id: str, time_ns: int
    ) -> tuple[Frame, tuple[Detection, ...]]:
        """Return the frame of fgtrack for `objects` in the header frame `frame_id`, and the objects in it.

        `time_ns` is the time of the measurement. Ranges and bearings, which tf would
        change, stay in the sensor frame.
        """
        use = self.use(frame_id)
        if use.target is None:
            return use.frame, objects
        if any(item.x_m is None or item.y_m is None for item in objects):
            return "sensor", objects
        pose = self.transforms.pose(named(frame_id), use.target, time_ns)
        assert pose is not None  # `use` has seen the path
        return use.frame, tuple(moved_detection(item, pose) for item in objects)


def named(frame_id: str) -> str:
    """Return the name of a frame without leading slashes."""
    return str(frame_id).strip().lstrip("/")


def _last(frame: str) -> str:
    """Return the last name of a frame with a namespace: `map` of `car1/map`."""
    return frame.rsplit("/", 1)[-1].lower()


def moved_detection(item: Detection, pose: Pose) -> Detection:
    """Return a detection with a position, moved into the parent frame of `pose`.

    A missing height counts as 0. In a tilted frame, heading and covariance about its z
    axis mean nothing: they are left out.
    """
    at_m = np.array([item.x_m, item.y_m, item.z_m or 0.0], dtype=float)
    x_m, y_m, z_m = (pose.rotation @ at_m + pose.translation_m).tolist()
    changes: dict[str, object] = {"yaw_rad": None, "covariance": None}
    if pose.is_upright:
        changes = {"covariance": _turned(item, pose)}
        if item.yaw_rad is not None and np.isfinite([item.yaw_rad, pose.yaw_rad]).all():
            changes["yaw_rad"] = wrap_angle(item.yaw_rad + pose.yaw_rad)
    height = {} if item.z_m is None else {"z_m": z_m}
    return replace(item, x_m=x_m, y_m=y_m, **height, **changes)  # type: ignore[arg-type]  # by name


def _turned(item: Detection, pose: Pose) -> tuple[float, ...] | None:
    """Return the covariance of the measured components, with x and y turned by the yaw of `pose`.

    None if the detection has no covariance. A covariance of another size is returned
    unchanged.
    """
    size = len(item.measured)
    if item.covariance is None or len(item.covariance) != size**2:
        return item.covariance
    J = np.eye(size)
    J[:2, :2] = pose.rotation[:2, :2]
    full = J @ np.reshape(item.covariance, (size, size)) @ J.T
    return tuple(full.ravel().tolist())

"""Writer of rosbag2 recordings of standard messages that show a run, for RViz and other ROS tools."""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from fgtrack.core.output import new_path
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import DetectionList, EgoState
from fgtrack.inputs.formats.common import RosMessage
from fgtrack.inputs.ros.bag_writer import (
    RECORDING,
    BagTopics,
    as_write_error,
    is_recording,
)
from fgtrack.inputs.ros.messages import MARKER_ARRAY, TRANSFORMS, MessageFactory
from fgtrack.show.shapes import Entity, Scene, Shape, ViewerMessage

_FRAME_IDS = {"map": "map", "ego": "base_link"}
# Numbers of Marker.msg.
_KINDS = {
    "arrow": 0,
    "cube": 1,
    "sphere": 2,
    "cylinder": 3,
    "line": 4,
    "text": 9,
}
_ADD = 0
_DELETE = 2
_FOREVER = QosTime(0, 0)


def write_ros2(
    path: Path, messages: Iterable[ViewerMessage], overwrite: bool = False
) -> dict[str, int]:
    """Write `messages`, in order of log times, as a rosbag2 recording; return their number by topic.

    `path` becomes a rosbag2 folder, or a single MCAP file if the name ends in `.mcap`.
    It appears when it is complete. Outcomes have no standard message and are not
    written. Raises like `write_bag`.
    """
    with as_write_error(path):
        if path.suffix != ".mcap":
            with new_path(path, overwrite, is_recording, RECORDING) as folder:
                return _write(folder, messages)
        with new_path(path, overwrite) as file:
            counts = _write(file.with_name(path.stem), messages)
            (file.with_name(path.stem) / path.name).rename(file)
            return counts


def _write(folder: Path, messages: Iterable[ViewerMessage]) -> dict[str, int]:
    factory = _MarkerFactory()
    counts: Counter[str] = Counter()
    bag = Writer(
        folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP
    )
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        topics = BagTopics(bag, factory)
        for message in messages:
            latched = isinstance(message.content, Scene) and message.content.latched
            quality = Qos(
                QosHistory.KEEP_LAST,
                10,
                QosReliability.RELIABLE,
                QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
                _FOREVER,
                _FOREVER,
                QosLiveliness.SYSTEM_DEFAULT,
                _FOREVER,
                False,
            )
            for topic, made in factory.messages(message):
                topics.put(topic, made, message.log_ns, [quality])
                counts[topic] += 1
    return dict(counts)


class _MarkerFactory(MessageFactory):
    """Factory of markers and transforms.

    It stores the number of markers of each entity, to remove surplus markers later.
    """

    def __init__(self) -> None:
        super().__init__()
        self._shown: dict[tuple[str, str], int] = {}
        nothing = np.zeros(0, dtype=np.uint8)
        image = self._make(
            "sensor_msgs/msg/CompressedImage",
            header=self._header(0, ""),
            format="",
            data=nothing,
        )
        self._unused: dict[str, Any] = {  # Any: fields of a marker
            **dict.fromkeys(("texture_resource", "mesh_resource"), ""),
            **{name: [] for name in ("colors", "uv_coordinates")},
            "texture": image,
            "mesh_file": self._make(
                "visualization_msgs/msg/MeshFile", filename="", data=nothing
            ),
            "mesh_use_embedded_materials": False,
        }

    def messages(self, message: ViewerMessage) -> Iterator[tuple[str, RosMessage]]:
        """Yield each topic of `message` with the ROS message for it."""
        content = message.content
        topic = message.topic
        stamp_ns = message.stamp_ns
        if isinstance(content, Scene):
            markers = [
                item
                for entity in content.entities
                for item in self._markers(topic, stamp_ns, entity)
            ]
            markers += [
                item
                for name in content.removed
                for item in self._markers(topic, stamp_ns, Entity(name, ()))
            ]
            yield f"{topic}/markers", self._make(MARKER_ARRAY, markers=markers)
        elif isinstance(content, EgoState):
            turn = self._pose(content.x_m, content.y_m, content.yaw_rad).orientation
            way = self._vector(content.x_m, content.y_m)
            transform = self._make(
                "geometry_msgs/msg/Transform", translation=way, rotation=turn
            )
            frames = {
                "header": self._header(stamp_ns, "map"),
                "child_frame_id": _FRAME_IDS["ego"],
            }
            stamped = self._make(
                "geometry_msgs/msg/TransformStamped", **frames, transform=transform
            )
            yield "/tf", self._make(TRANSFORMS, transforms=[stamped])
            yield f"{topic}/odometry", self.odometry(content)
        elif isinstance(content, tuple):
            yield (
                topic,
                self.detection3d_array(
                    DetectionList("", stamp_ns, message.log_ns, content, "map")
                ),
            )

    def _markers(self, topic: str, stamp_ns: int, entity: Entity) -> list[RosMessage]:
        """Return the markers of an entity: one namespace, with a marker for each shape.

        Markers of a previous state with more shapes are removed.
        """
        shapes = [*entity.shapes]
        before = self._shown.get((topic, entity.name), 0)
        self._shown[topic, entity.name] = len(shapes)
        shapes += [Shape("sphere", (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))] * (
            before - len(shapes)
        )
        header = self._header(stamp_ns, _FRAME_IDS[entity.frame])
        lifetime_ns = nanoseconds(entity.lifetime_s or 0.0)
        sec, nanosec = divmod(lifetime_ns, NS_PER_S)
        lifetime = self._make(
            "builtin_interfaces/msg/Duration", sec=sec, nanosec=nanosec
        )
        markers = []
        for number, shape in enumerate(shapes):
            pose = self._pose(*shape.at_m, shape.yaw_rad)
            pose.position.z = shape.height_m
            marker = self._make(
                "visualization_msgs/msg/Marker",
                header=header,
                ns=entity.name,
                id=number,
                type=_KINDS[shape.kind],
                action=_ADD if number < len(entity.shapes) else _DELETE,
                pose=pose,
                scale=self._vector(*shape.size_m),
                color=self._make(
                    "std_msgs/msg/ColorRGBA",
                    **dict(zip("rgba", shape.colour, strict=True)),
                ),
                lifetime=lifetime,
                frame_locked=entity.frame == "ego",
                points=[
                    self._make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
                    for x, y in shape.points_m
                ],
                text=shape.text,
                **self._unused,
            )
            markers.append(marker)
        return markers

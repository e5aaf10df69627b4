"""Recordings that are right: fgtrack's own, and those of other programs."""

import json
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from ruamel.yaml import YAML

from fgtrack.io.adapters import message_types
from fgtrack.io.adapters.ego import ODOMETRY
from fgtrack.io.ros.bag_writer import write_bag
from fgtrack.io.ros.typestore import build_typestore
from fgtrack.pipeline.shipped import shipped_folder
from fuzz.inputs import Files, drive


def bag(storage: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_bag(Path(folder) / "bag", drive(), storage)
        (file,) = (file for file in (Path(folder) / "bag").iterdir() if file.suffix != ".yaml")
        return file.read_bytes()


def ros1() -> bytes:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.bag"
        with Rosbag1Writer(path) as writer:
            topic = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
            for k in range(40):
                time = types["builtin_interfaces/msg/Time"](1000 + k // 20, (k % 20) * 50_000_000)
                header = types["std_msgs/msg/Header"](k, time, "map")
                pose = types["geometry_msgs/msg/Pose"](
                    types["geometry_msgs/msg/Point"](1.0 * k, 0.0, 0.0),
                    types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
                )
                zero = types["geometry_msgs/msg/Vector3"](20.0, 0.0, 0.0)
                message = types["nav_msgs/msg/Odometry"](
                    header,
                    "base",
                    types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
                    types["geometry_msgs/msg/TwistWithCovariance"](
                        types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
                    ),
                )
                receipt_ns = 1_000_000_000_000 + k * 50_000_000
                writer.write(topic, receipt_ns, store.serialize_ros1(message, "nav_msgs/msg/Odometry"))
        return path.read_bytes()


class _Filled:
    """Messages of any type with numbers in all fields, of objects that drive ahead of an ego."""

    def __init__(self) -> None:
        self.store: Typestore = build_typestore(dict.fromkeys(message_types()), ros1=False)[0]

    def message(self, name: str, stamp_ns: int, t_s: float) -> Any:
        """A message of type `name`."""
        if name == "builtin_interfaces/msg/Time":
            return self.store.types[name](stamp_ns // 10**9, stamp_ns % 10**9)
        if name == "geometry_msgs/msg/Quaternion":
            return self.store.types[name](0.0, 0.0, 0.0, 1.0)
        fields = self.store.fielddefs[name][1]
        return self.store.types[name](**{field: self._value(field, *kind, stamp_ns, t_s) for field, kind in fields})

    def _value(self, field: str, kind: Nodetype, what: Any, stamp_ns: int, t_s: float) -> Any:
        match kind:
            case Nodetype.BASE:
                return _number(field, what[0], t_s)
            case Nodetype.NAME:
                return self.message(what, stamp_ns, t_s)
        (inner, inside), length = what
        if inner is Nodetype.NAME:
            return [self.message(inside, stamp_ns, t_s + 1.5 * k) for k in range(length or 2)]
        if inside[0] == "string":
            return []
        if length == 36:
            return np.eye(6).reshape(-1)
        numbers = (1, 0, 0, 1, 0, 1) if length == 6 else range(1, (length or 3) + 1)
        return np.array(numbers, dtype={"octet": "uint8", "byte": "uint8"}.get(inside[0], inside[0]))


def _number(field: str, kind: str, t_s: float) -> Any:
    if kind == "string":
        return "base_link" if field == "frame_id" else "7"
    if not kind.startswith("float"):
        return kind == "bool" if kind == "bool" else 0 if "invalid" in field or "clutter" in field else 2
    if field in ("x", "range", "longitude_dist"):
        return 20.0 + 2.0 * t_s
    return 0.1 if field in ("angle", "azimuth") else 0.5


@cache
def foreign() -> Files:
    """A recording with every type of object lists that is known, odometry of three cars, and its configuration."""
    filled, kinds = _Filled(), [name for name in message_types() if name != ODOMETRY]
    topics = {f"/{name.replace('/', '_')}": name for name in kinds}
    cars = ("/ego", "/car_2", "/car_3")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            named = {**dict.fromkeys(cars, ODOMETRY), **topics}
            connections = {
                topic: writer.add_connection(topic, name, typestore=filled.store) for topic, name in named.items()
            }
            for k in range(20):
                for place, (topic, name) in enumerate(named.items()):
                    stamp_ns = 10**18 + k * 10**8 + place
                    message = filled.message(name, stamp_ns, 0.1 * k + (2.0 * place if topic in cars else 0.0))
                    writer.write(connections[topic], stamp_ns + 10**7, bytes(filled.store.serialize_cdr(message, name)))
        (file,) = path.glob("*.mcap")
        return {"x.mcap": file.read_bytes(), "x.yaml": _configuration(topics)}


def _configuration(topics: Mapping[str, str]) -> bytes:
    """Reads the object lists of `topics`, and a car by its fields."""
    by_hand = {
        "x_m": "pose.pose.position.x",
        "y_m": {"path": "pose.pose.position.y", "scale": -1, "offset": 2.0},
        "speed_mps": ["twist.twist.linear.x", "twist.twist.linear.y"],
    }
    seen: dict[str, Any] = {"by_hand": {"topic": "/car_3", "fields": by_hand, "frame": "map"}}
    sensors: dict[str, Any] = {"by_hand": {"std": {"x_m": 0.5, "y_m": 0.5}}}
    for number, (topic, name) in enumerate(topics.items()):
        polar = "delphi" in name
        more = {"scan_s": 0.02, "stamp_from": "receipt"} if polar else {"filters": {"x_m": {"min": -9.0}}}
        seen[f"s{number}"] = {"topic": topic, **more}
        std = {"range_m": 0.5, "bearing_rad": 0.02} if polar else {"x_m": 0.5, "y_m": 0.5}
        sensors[f"s{number}"] = {"std": std, "max_delay_s": 0.5}
    truth = [{"topic": "/car_2", "object_id": 2}, {"topic": "/car_3", "object_id": "car_3"}]
    config = YAML(typ="safe").load((shipped_folder() / "open_space.yaml").read_bytes())
    config |= {"input": {"ego": {"topic": "/ego"}, "truth": truth, "detections": seen}, "sensors": sensors}
    return json.dumps(config).encode()


def folders() -> list[Files]:
    """rosbag2 folders, compressed in every way."""
    store, found = _Filled(), list[Files]()
    for storage in StoragePlugin:
        for mode in CompressionMode:
            if (storage, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
                continue
            with tempfile.TemporaryDirectory() as folder:
                writer = Writer(Path(folder) / "in", version=9, storage_plugin=storage)
                writer.set_compression(mode, CompressionFormat.ZSTD)
                with writer:
                    for name, topic in ((ODOMETRY, "/ego"), ("geometry_msgs/msg/PoseArray", "/seen")):
                        connection = writer.add_connection(topic, name, typestore=store.store)
                        for k in range(20):
                            stamp_ns = 10**18 + k * 10**8
                            message = store.message(name, stamp_ns, 0.1 * k)
                            writer.write(connection, stamp_ns, bytes(store.store.serialize_cdr(message, name)))
                found.append({f"in/{file.name}": file.read_bytes() for file in (Path(folder) / "in").iterdir()})
    return found

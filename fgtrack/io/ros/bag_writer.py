"""Writes rosbag2 recordings: fgtrack's own messages, exact to the bit, and twins in standard types for other tools."""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.types import DetectionList, EgoState, Message, TruthState
from fgtrack.io.adapters.common import RosMessage
from fgtrack.io.errors import UntilBreak, one_line
from fgtrack.io.output import check_output, new_folder
from fgtrack.io.ros.bag_files import METADATA, SETTINGS, files_of
from fgtrack.io.ros.messages import MessageFactory

_CHECKPOINT = 1000  # messages; a killed writer loses no more than that
_PLUGINS = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
_INT64_LIMIT = 1 << 63
RECORDING = "a rosbag2 folder with nothing else in it"
_JOURNALS = ("-wal", "-shm", "-journal")  # that SQLite may leave beside a file


def write_bag(
    path: Path | str,
    messages: Iterable[Message],
    storage: Literal["mcap", "sqlite3"] = "mcap",
    overwrite: bool = False,
    settings: Mapping[str, object] | None = None,
) -> int:
    """Write `messages` to the rosbag2 folder `path`; gives their number. With `overwrite` a recording is replaced.

    `/fgtrack/ego`, `/fgtrack/detections/SENSOR` and `/fgtrack/truth` hold every field to the bit and carry their
    definitions; the log time is the receipt, the header stamp the stamp. The twins for other tools are `/ego/odometry`
    (nav_msgs/Odometry) and `/detections/SENSOR` (vision_msgs/Detection3DArray, of objects with a position, without
    speeds). Every thousand messages reach the disk: a killed writer leaves a readable recording (`<path>.*.part`).
    `settings`, what the recording carries of a configuration, are in the custom data of metadata.yaml.

    Raises `TruncatedInput` where `messages` broke off, after writing what came before; as `new_folder`; and `DataError`
    for a time outside what ROS messages hold.
    """
    path = Path(path)
    try:
        with (
            new_folder(path, overwrite, is_recording, RECORDING) as folder,
            Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=_PLUGINS[storage]) as bag,
        ):
            if settings:
                bag.set_custom_data(SETTINGS, json.dumps(settings))
            writer = _MessageWriter(bag)
            readable = UntilBreak(messages)
            for message in readable:
                writer.write(message)
            readable.raise_before_replacing(Path(path))
    except FgtrackError:
        raise
    except Exception as error:  # rosbags lets SQLite and struct errors through
        raise DataError(
            f"{path}: cannot be written ({one_line(error)}), free some space or choose another place"
        ) from error
    readable.raise_error()
    return writer.count


def token(name: str) -> str:
    """Return `name` as a part of a topic name."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def check_bag(path: Path, overwrite: bool) -> None:
    """Raise `CallError` where `write_bag` would for what is at `path`."""
    check_output(path, overwrite, is_recording, RECORDING)


def is_recording(path: Path) -> bool:
    """True if `path` is a folder of what its metadata.yaml lists, and of nothing else."""
    if not (path / METADATA).is_file():
        return False
    try:
        listed = [file.name for file in files_of(path)]
    except DataError:
        return False
    known = {METADATA, *listed, *(f"{name}{journal}" for name in listed for journal in _JOURNALS)}
    return bool(listed) and all(file.name in known and file.is_file() for file in path.iterdir())


class _MessageWriter:
    """Puts messages on their topics."""

    def __init__(self, bag: Writer) -> None:
        self._bag = bag
        self._factory = MessageFactory()
        self._connections: dict[str, Connection] = {}
        self.count = 0

    def write(self, message: Message) -> None:
        match message:
            case EgoState():
                self._put("/fgtrack/ego", self._factory.ego(message), message.receipt_ns)
                self._put("/ego/odometry", self._factory.odometry(message), message.receipt_ns)
            case DetectionList():
                topic = f"/detections/{token(message.sensor)}"
                self._put(f"/fgtrack{topic}", self._factory.detections(message), message.receipt_ns)
                self._put(topic, self._factory.detection3d_array(message), message.receipt_ns)
            case TruthState():
                self._put("/fgtrack/truth", self._factory.truth(message), message.receipt_ns)
        self.count += 1
        if self.count % _CHECKPOINT == 0:
            match self._bag.storage:
                case McapWriter() as storage:
                    storage.close_chunk()
                    storage.bio.flush()
                case Sqlite3Writer() as storage:
                    storage.conn.commit()

    def _put(self, topic: str, message: RosMessage, log_ns: int) -> None:
        if not 0 <= log_ns < _INT64_LIMIT:
            raise DataError(f"receipt {log_ns} ns lies outside what a recording holds")
        msgtype = message.__msgtype__
        key = f"{topic} {msgtype}"
        connection = self._connections.get(key)
        if connection is None:
            connection = self._bag.add_connection(topic, msgtype, typestore=self._factory.typestore)
            self._connections[key] = connection
        self._bag.write(connection, log_ns, self._factory.serialize(message))

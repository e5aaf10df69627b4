"""Writes rosbag2 recordings: fgtrack's own messages, exact to the bit, and twins in standard types for other tools."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.output import check_output, new_path
from fgtrack.core.types import DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.errors import UntilBreak, one_line
from fgtrack.inputs.formats.common import RosMessage
from fgtrack.inputs.ros.bag_files import METADATA, SETTINGS, files_of
from fgtrack.inputs.ros.messages import MessageFactory

_CHECKPOINT = 1000  # messages; a killed writer loses no more than that
RECORDING = "a rosbag2 folder with nothing else in it"


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
    speeds). Every thousand messages reach the disk: a killed writer leaves a readable recording (in `<path>.*.part`).
    `settings`, what the recording carries of a configuration, are in the custom data of metadata.yaml. Raises
    `TruncatedInput` after writing what came before it, and `DataError` for a time that ROS messages cannot hold.
    """
    path, count = Path(path), 0
    with (
        as_write_error(path),
        new_path(path, overwrite, is_recording, RECORDING) as folder,
        Writer(
            folder,
            version=Writer.VERSION_LATEST,
            storage_plugin=StoragePlugin[storage.upper()],
        ) as bag,
    ):
        if settings:
            bag.set_custom_data(SETTINGS, json.dumps(settings))
        factory = MessageFactory()
        topics = BagTopics(bag, factory)
        readable = UntilBreak(messages)
        for message in readable:
            match message:
                case EgoState():
                    topics.put("/fgtrack/ego", factory.ego(message), message.receipt_ns)
                    topics.put(
                        "/ego/odometry", factory.odometry(message), message.receipt_ns
                    )
                case DetectionList():
                    topic = f"/detections/{token(message.sensor)}"
                    topics.put(
                        f"/fgtrack{topic}",
                        factory.detections(message),
                        message.receipt_ns,
                    )
                    topics.put(
                        topic, factory.detection3d_array(message), message.receipt_ns
                    )
                case TruthState():
                    topics.put(
                        "/fgtrack/truth", factory.truth(message), message.receipt_ns
                    )
            count += 1
            if count % _CHECKPOINT == 0:
                match bag.storage:
                    case McapWriter() as opened:
                        opened.close_chunk()
                        opened.bio.flush()
                    case Sqlite3Writer() as opened:
                        opened.conn.commit()
        if path.exists():  # it is kept
            readable.raise_error()
    readable.raise_error()
    return count


class BagTopics:
    """Topics of a recording that is written, each added with its first message."""

    def __init__(self, bag: Writer, factory: MessageFactory) -> None:
        self._bag = bag
        self._factory = factory
        self._connections: dict[str, Connection] = {}

    def put(
        self, topic: str, message: RosMessage, log_ns: int, qos: Sequence[Qos] = ()
    ) -> None:
        """Write `message`, and the `qos` profiles that are offered with a new topic."""
        if not 0 <= log_ns < 1 << 63:
            raise DataError(f"the time {log_ns} ns lies outside what a recording holds")
        if topic not in self._connections:
            self._connections[topic] = self._bag.add_connection(
                topic,
                message.__msgtype__,
                typestore=self._factory.typestore,
                offered_qos_profiles=qos,
            )
        self._bag.write(
            self._connections[topic], log_ns, self._factory.serialize(message)
        )


@contextmanager
def as_write_error(path: Path) -> Iterator[None]:
    """Raise `DataError` for whatever rosbags raises in the block that writes `path`: also SQLite and struct errors."""
    try:
        yield
    except FgtrackError:
        raise
    except Exception as error:
        raise DataError(
            f"{path}: cannot be written ({one_line(error)}), free some space or choose another path"
        ) from error


def token(name: str) -> str:
    """Return `name` as a part of a topic name."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def check_bag(path: Path, overwrite: bool) -> None:
    """Raise `CallError` where `write_bag` would for what is at `path`."""
    check_output(path, overwrite, is_recording, RECORDING)


def is_recording(path: Path) -> bool:
    """True if `path` is a folder of what its metadata.yaml lists, and of nothing else."""
    try:
        listed = (
            [file.name for file in files_of(path)]
            if (path / METADATA).is_file()
            else []
        )
    except Exception:  # whatever a damaged metadata.yaml raises
        return False
    return bool(listed) and {file.name for file in path.iterdir()} <= {
        METADATA,
        *listed,
    }

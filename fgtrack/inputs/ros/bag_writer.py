"""Writes rosbag2 recordings: fgtrack's own messages, exact to the bit, and copies in standard types for other tools."""

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

#: Messages between two writes to the disk; a killed writer loses fewer than these.
_CHECKPOINT = 1000
RECORDING = "a rosbag2 folder with nothing else in it"
"""Description of a folder that may be overwritten, for messages."""


def write_bag(
    path: Path | str,
    messages: Iterable[Message],
    storage: Literal["mcap", "sqlite3"] = "mcap",
    overwrite: bool = False,
    settings: Mapping[str, object] | None = None,
) -> int:
    """Write `messages` to the rosbag2 folder `path` and return their number.

    With `overwrite`, an existing recording is replaced. `settings` are configuration
    keys and values that the recording carries, in the custom data of metadata.yaml.

    `/fgtrack/ego`, `/fgtrack/detections/SENSOR` and `/fgtrack/truth` contain every
    field, exact to the bit, and their message definitions. The log time is the receipt,
    the header stamp is the stamp. The copies for other tools are `/ego/odometry`
    (nav_msgs/Odometry) and `/detections/SENSOR` (vision_msgs/Detection3DArray). The
    latter contains the objects with a position, without speeds. Every thousand messages
    are written to the disk, so a killed writer leaves a readable recording (in
    `<path>.*.part`).

    Raises `TruncatedInput` after writing the messages before the break, and `DataError`
    for a time out of the range of ROS messages.
    """
    path = Path(path)
    count = 0
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
                    topic = f"/detections/{topic_part(message.sensor)}"
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
        # A truncated recording does not replace an existing one.
        if path.exists():
            readable.raise_error()
    readable.raise_error()
    return count


class BagTopics:
    """Topics of a recording that is being written; a topic is added with its first message."""

    def __init__(self, bag: Writer, factory: MessageFactory) -> None:
        self._bag = bag
        self._factory = factory
        self._connections: dict[str, Connection] = {}

    def put(
        self, topic: str, message: RosMessage, log_ns: int, qos: Sequence[Qos] = ()
    ) -> None:
        """Write `message`; `qos` contains the offered profiles if the topic is new.

        Raises `DataError` for a log time out of the range of a bag.
        """
        if not 0 <= log_ns < 1 << 63:
            raise DataError(
                f"the log time {log_ns} ns is out of the range of a recording: correct the receipts"
            )
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
    """Convert all exceptions of the block that writes `path` into `DataError`: rosbags raises many kinds."""
    try:
        yield
    except FgtrackError:
        raise
    except Exception as error:
        raise DataError(
            f"{path}: cannot be written ({one_line(error)}), free some space or choose another path"
        ) from error


def topic_part(name: str) -> str:
    """Return `name` as a part of a topic name: other characters than letters, digits and `_` become `_`."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def check_bag(path: Path, overwrite: bool) -> None:
    """Raise `CallError` if `write_bag` may not write to `path`."""
    check_output(path, overwrite, is_recording, RECORDING)


def is_recording(path: Path) -> bool:
    """True if `path` is a folder that contains the files in its metadata.yaml, and no others."""
    try:
        listed = (
            [file.name for file in files_of(path)]
            if (path / METADATA).is_file()
            else []
        )
    except Exception:  # a damaged metadata.yaml causes any exception
        return False
    return bool(listed) and {file.name for file in path.iterdir()} <= {
        METADATA,
        *listed,
    }

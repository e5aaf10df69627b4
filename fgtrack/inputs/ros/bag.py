"""Reads recordings without ROS: rosbag2 folders, single MCAP and SQLite files, and ROS 1 bags."""

import heapq
import struct
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

import zstandard
from rosbags.interfaces import Connection

from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.time import NS_PER_S
from fgtrack.inputs.errors import TruncatedInput, one_line
from fgtrack.inputs.ros.bag_files import (
    ZSTD_MAGIC,
    BagFile,
    bags_in,
    decompressed,
    files_of,
    storage_of,
)
from fgtrack.inputs.ros.rosbag1_file import Rosbag1File
from fgtrack.inputs.ros.typestore import Key, MessageTypes


@dataclass(frozen=True)
class BagTopic:
    """A topic of a recording."""

    name: str
    type: str
    problem: str | None
    """Reason why the messages cannot be decoded; None if they can."""


class Bag:
    """A recording that can be read any number of times.

    `path` is a rosbag2 folder (with or without metadata.yaml), an `.mcap` or `.db3`
    file, or a ROS 1 `.bag` file. The package of a `.msg` file in `message_definitions`
    is the name of its folder; above a folder `msg`, of the parent folder.
    """

    def __init__(
        self, path: Path | str, message_definitions: Collection[str] = ()
    ) -> None:
        self.path = Path(path)
        with _as_data_error(self.path):
            self._paths = files_of(self.path)
        with self._files() as files:
            connections = sorted(
                (item for file in files for item in file.connections),
                key=_topic_and_type,
            )
            of_ros1 = [isinstance(file, Rosbag1File) for file in files]
            self._ros1 = any(of_ros1)
            if self._ros1 and not all(of_ros1):
                raise DataError(
                    f"{self.path}: contains bags of ROS 1 and of ROS 2, give one of the files"
                )
            self.break_off = self._break_off(files)
        for item in connections:
            if (kind := getattr(item.ext, "serialization_format", "cdr")) != "cdr":
                raise DataError(
                    f"{self.path}: topic {item.topic} is serialized as {kind!r}, fgtrack reads 'cdr' only"
                )
        self._types = MessageTypes(
            map(_key, connections), self._ros1, message_definitions
        )
        self._topics: dict[tuple[str, str], BagTopic] = {}
        for name, group in groupby(connections, _topic_and_type):
            problems = [self._types.problems.get(_key(item)) for item in group]
            self._topics[name] = BagTopic(*name, next(filter(None, problems), None))
        self.topics = tuple(self._topics.values())
        """Topics by name; a topic with two types is listed twice."""

    def messages(
        self, topics: Collection[str], own: bool = False
    ) -> Iterator[tuple[BagTopic, int, Any]]:
        """Yield topic, log time and decoded message of every message on `topics`, in the order of log time.

        With `own`, messages of fgtrack's own types are decoded to a `Message` that is
        received at the log time, if their layout is the present one. Raises
        `TruncatedInput` after the messages before a break, and `DataError` for a
        message that cannot be decoded.
        """
        for topic in self.topics:
            if topic.name in topics and topic.problem:
                raise DataError(
                    f"{self.path}: topic {topic.name} cannot be read: {topic.problem}"
                )
        for connection, log_ns, data in self._records(topics):
            what = f"{self.path}: the message on {connection.topic} at {log_ns} ns"
            decoded = self._types.decode(
                _key(connection), data, what, log_ns if own else None
            )
            yield self._topics[_topic_and_type(connection)], log_ns, decoded

    def stamps(self) -> Iterator[tuple[BagTopic, int, int | None]]:
        """Yield topic, log time and header stamp of every message.

        The stamp is None for an unknown type, and for a type without a header.
        """
        offset = 4  # of the stamp: behind the CDR header, in ROS 1 behind the sequence number
        for connection, log_ns, data in self._records(
            {topic.name for topic in self.topics}
        ):
            stamp_ns = None
            if (
                self._types.starts_with_header(_key(connection))
                and len(data) >= offset + 8
            ):
                order = ">iI" if not self._ros1 and data[1] == 0 else "<iI"
                sec, nanosec = struct.unpack_from(order, data, offset)
                stamp_ns = sec * NS_PER_S + nanosec
            yield self._topics[_topic_and_type(connection)], log_ns, stamp_ns

    @contextmanager
    def _files(self) -> Iterator[list[BagFile]]:
        with _as_data_error(self.path), ExitStack() as stack:
            files: list[BagFile] = []
            for part in self._paths:
                if part.stat().st_size == 0 and len(self._paths) > 1:
                    continue
                path = stack.enter_context(decompressed(part))
                kind = storage_of(path)
                if kind is None:
                    raise DataError(
                        f"{part}: is {'not a bag file' if part.stat().st_size else 'empty'}"
                    )
                file = kind(path)
                stack.callback(file.close)
                file.open()
                files.append(file)
            yield files

    def _break_off(self, files: list[BagFile]) -> str | None:
        """Return the reason why the recording breaks off: the first file that is truncated or empty."""
        broken = [f"{file.path} {file.break_off}" for file in files if file.break_off]
        empty = [f"{path} is empty" for path in self._paths if path.stat().st_size == 0]
        return next(iter(broken + empty), None)

    def _records(
        self, topics: Collection[str]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        count = 0
        decompress = zstandard.ZstdDecompressor().decompress
        with self._files() as files:
            try:
                wanted = [
                    (file, [item for item in file.connections if item.topic in topics])
                    for file in files
                ]
                records = [
                    iter(file.messages(connections))
                    for file, connections in wanted
                    if connections
                ]
                for connection, log_ns, data in heapq.merge(
                    *records, key=itemgetter(1)
                ):
                    if data[:4] == ZSTD_MAGIC and not self._ros1:
                        data = decompress(data)
                    yield connection, log_ns, data
                    count += 1
            except (FgtrackError, MemoryError):
                raise
            except Exception as error:  # damaged bytes cause any exception in rosbags or its decompressors
                raise TruncatedInput(
                    f"{self.path}: breaks off after {count} messages ({one_line(error)})"
                ) from error
            if broken := self._break_off(files):
                raise TruncatedInput(f"{broken}, after {count} messages")


def is_bag(path: Path) -> bool:
    """True if the folder `path` contains a rosbag2 recording, or the file `path` begins as a bag file."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or bool(bags_in(path))
    return storage_of(path) is not None


_topic_and_type = attrgetter("topic", "msgtype")


def _key(connection: Connection) -> Key:
    return connection.msgtype, connection.msgdef


@contextmanager
def _as_data_error(path: Path) -> Iterator[None]:
    try:
        yield
    except (FgtrackError, MemoryError):
        raise
    except Exception as error:  # rosbags raises its own errors and errors of struct, SQLite, YAML and Unicode
        raise DataError(
            f"{path}: cannot be read as a recording ({one_line(error)})"
        ) from error

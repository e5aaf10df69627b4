"""Reads recordings without ROS: rosbag2 folders, single MCAP and SQLite files, ROS 1 bags."""

import heapq
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import zstandard
from rosbags.interfaces import Connection, ConnectionExtRosbag2

from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.time import NS_PER_S
from fgtrack.io.errors import TruncatedInput, one_line
from fgtrack.io.ros.bag_files import ZSTD_MAGIC, BagFile, bags_in, decompressed, files_of, storage_of
from fgtrack.io.ros.rosbag1_file import Rosbag1File
from fgtrack.io.ros.typestore import Key, MessageTypes, type_name

HEADER = "std_msgs/msg/Header"


@dataclass(frozen=True)
class BagTopic:
    """A topic of a recording."""

    name: str
    type: str
    count: int
    problem: str | None
    """Why its messages cannot be decoded; None when they can."""


@dataclass(frozen=True)
class BagMessage:
    """A decoded message."""

    topic: str
    type: str
    log_ns: int
    """When the recorder received it."""
    # A message has the attributes of its type, which is known only when the recording is read.
    data: Any


class Bag:
    """A recording, which can be read any number of times.

    `path` is a rosbag2 folder (with or without metadata.yaml), an `.mcap`, `.db3` or ROS 1 `.bag` file. The package of
    a `.msg` file of `message_definitions` is the name of its folder (or of the one above a folder `msg`). Raises
    `DataError` where it cannot be read at all.
    """

    def __init__(self, path: Path | str, message_definitions: Collection[str] = ()) -> None:
        self.path = Path(path)
        with _as_data_error(self.path):
            self._paths = files_of(self.path)
        with self._files() as files:
            connections = [item for file in files for item in file.connections]
            for item in connections:
                kind = item.ext.serialization_format if isinstance(item.ext, ConnectionExtRosbag2) else "cdr"
                if kind != "cdr":
                    raise DataError(
                        f"{self.path}: topic {item.topic} is serialized as {kind!r}, only 'cdr' can be read"
                    )
            self._ros1 = any(isinstance(file, Rosbag1File) for file in files)
            self._types = MessageTypes(map(_key, connections), self._ros1, message_definitions)
            first = {key: types[key[0]][1][:1] for key, types in self._types.types.items()}
            self._stamped = {key for key, members in first.items() if members and members[0][1][1] == HEADER}
            self.break_off = self._break_off(files)
        self.topics = _topics(connections, self._types.problems)
        """Topics by name; a topic with two types is listed twice."""

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Decoded messages on `topics` in log-time order; equal times keep the order of the recording.

        Raises `TruncatedInput` after every message before a break, and `DataError` for what cannot be decoded.
        """
        for topic in self.topics:
            if topic.name in topics and topic.problem:
                raise DataError(f"{self.path}: topic {topic.name} cannot be read: {topic.problem}")
        for connection, log_ns, data in self._records(topics):
            what = f"{self.path}: the message on {connection.topic} at {log_ns} ns"
            message = self._types.decode(_key(connection), data, what)
            yield BagMessage(connection.topic, connection.msgtype, log_ns, message)

    def stamps(self) -> Iterator[tuple[BagTopic, int, int | None]]:
        """Topic, log time and header stamp of every message, without decoding it.

        The stamp is None where the type does not start with a header or is not known.
        """
        by_key = {(topic.name, topic.type): topic for topic in self.topics}
        for connection, log_ns, data in self._records({topic.name for topic in self.topics}):
            topic = by_key[connection.topic, connection.msgtype]
            yield topic, log_ns, self._stamp_ns(data) if _key(connection) in self._stamped else None

    def _stamp_ns(self, data: bytes) -> int | None:
        """Stamp of the header with which the message `data` begins."""
        offset = 4  # behind the CDR header, or in ROS 1 behind the sequence number
        if len(data) < offset + 8:
            return None
        sec, nanosec = struct.unpack_from(">iI" if not self._ros1 and data[1] == 0 else "<iI", data, offset)
        return int(sec * NS_PER_S + nanosec)

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
                    raise DataError(f"{part}: is {'not a bag file' if part.stat().st_size else 'empty'}")
                file = kind(path)
                stack.callback(file.close)
                file.open()
                files.append(file)
            yield files

    def _break_off(self, files: list[BagFile]) -> str | None:
        """Reason why the first file that is not whole breaks off."""
        broken = [f"{file.path} {file.break_off}" for file in files if file.break_off]
        empty = [f"{path} is empty" for path in self._paths if path.stat().st_size == 0]
        return next(iter(broken + empty), None)

    def _records(self, topics: Collection[str]) -> Iterator[tuple[Connection, int, bytes]]:
        count, decompress = 0, zstandard.ZstdDecompressor().decompress
        with self._files() as files:
            try:
                wanted = [(file, [item for item in file.connections if item.topic in topics]) for file in files]
                records = [iter(file.messages(connections)) for file, connections in wanted if connections]
                for connection, log_ns, data in heapq.merge(*records, key=itemgetter(1)):
                    if data[:4] == ZSTD_MAGIC and not self._ros1:
                        data = decompress(data)
                    yield connection, log_ns, data
                    count += 1
            except (FgtrackError, MemoryError):
                raise
            except Exception as error:  # whatever damaged bytes make rosbags or its decompressors raise
                raise TruncatedInput(f"{self.path}: breaks off after {count} messages ({one_line(error)})") from error
            if broken := self._break_off(files):
                raise TruncatedInput(f"{broken}, after {count} messages")


def is_bag(path: Path) -> bool:
    """True if the folder `path` holds a rosbag2 recording, or the file `path` starts as one."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or bool(bags_in(path))
    return storage_of(path) is not None


def _key(connection: Connection) -> Key:
    return connection.msgtype, connection.msgdef


def _topics(connections: list[Connection], problems: Mapping[Key, str]) -> tuple[BagTopic, ...]:
    counts: Counter[tuple[str, str]] = Counter()
    found: dict[tuple[str, str], str] = {}
    for item in connections:
        counts[item.topic, item.msgtype] += item.msgcount
        if _key(item) in problems:
            found.setdefault((item.topic, item.msgtype), problems[_key(item)])
    return tuple(BagTopic(*topic, count, found.get(topic)) for topic, count in sorted(counts.items()))


@contextmanager
def _as_data_error(path: Path) -> Iterator[None]:
    try:
        yield
    except (FgtrackError, MemoryError):
        raise
    except Exception as error:  # rosbags raises its own, assertions, struct, SQLite, YAML, Unicode errors
        raise DataError(f"{path}: cannot be read as a recording ({one_line(error)})") from error


__all__ = ["Bag", "BagMessage", "BagTopic", "is_bag", "type_name"]

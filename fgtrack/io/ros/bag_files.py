"""The files of a recording, each read in log-time order, and up to the break where it was cut off."""

import heapq
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Protocol

from rosbags.interfaces import Connection
from rosbags.rosbag2.reader import DirectoryReader

from fgtrack.io.ros.mcap_file import McapFile
from fgtrack.io.ros.rosbag1_file import Rosbag1File
from fgtrack.io.ros.sqlite3_file import Sqlite3File

Record = tuple[Connection, int, bytes]
"""Connection, log time in ns, serialized message."""

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
ROSBAG1_MAGIC = b"#ROSBAG V2.0\n"


class BagFile(Protocol):
    """One file of a recording."""

    path: Path
    connections: list[Connection]
    break_off: str | None
    """How the file breaks off in the middle; None when it is whole."""

    def open(self) -> None:
        """Open the file and read which connections it holds."""

    def close(self) -> None:
        """Close the file."""

    def messages(self, connections: Collection[Connection]) -> Iterator[Record]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""


class BagFolder(DirectoryReader):
    """A rosbag2 folder: the reading of its metadata and the unpacking of its files."""

    STORAGE_PLUGINS = {"mcap": McapFile, "sqlite3": Sqlite3File}  # noqa: RUF012 - declared by the base


class EmptyFile:
    """A file into which a killed recorder has not written anything yet."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = "is empty"

    def open(self) -> None:
        """Open the file, of which nothing can be read."""

    def close(self) -> None:
        """Close the file."""

    def messages(self, connections: Collection[Connection]) -> Iterator[Record]:
        """No records."""
        return iter(())


def storage_of(path: Path) -> type[McapFile | Sqlite3File | Rosbag1File] | None:
    """What reads the file `path`, by its first bytes."""
    with path.open("rb") as file:
        magic = file.read(len(SQLITE_MAGIC))
    for start, kind in ((MCAP_MAGIC, McapFile), (SQLITE_MAGIC, Sqlite3File), (ROSBAG1_MAGIC, Rosbag1File)):
        if magic.startswith(start):
            return kind
    return None


def merged(files: list[BagFile], wanted: Collection[str]) -> Iterator[Record]:
    """Records on the `wanted` topics of all files in log-time order; equal times keep the files' order."""

    def records(file: BagFile) -> Iterator[Record]:
        connections = [item for item in file.connections if item.topic in wanted]
        return file.messages(connections) if connections else iter(())

    return heapq.merge(*map(records, files), key=lambda record: record[1])

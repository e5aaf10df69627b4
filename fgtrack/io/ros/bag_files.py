"""The files of a recording, each read in log-time order, and up to the break where it was cut off."""

import heapq
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from rosbags.interfaces import Connection
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file, read_whole
from fgtrack.io.ros.mcap_file import MCAP_MAGIC, McapFile
from fgtrack.io.ros.rosbag1_file import Rosbag1File
from fgtrack.io.ros.sqlite3_file import Sqlite3File
from fgtrack.io.ros.unpacking import unpacked_file

Record = tuple[Connection, int, bytes]
"""Connection, log time in ns, serialized message."""

METADATA = "metadata.yaml"
_LARGEST_METADATA_MB = 1.0
_NEWEST_VERSION = 9
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


def listed_files(path: Path) -> list[Path]:
    """The storage files of the rosbag2 folder `path` that its metadata.yaml lists; raises as `bag_folder`."""
    file = path / METADATA
    try:
        return [path / PurePath(name).name for name in _metadata(file)["relative_file_paths"]]
    except (KeyError, TypeError) as error:
        raise DataError(f"{file}: is no metadata of a recording ({type(error).__name__}: {error})") from error


def _metadata(file: Path) -> Mapping[str, Any]:  # Any: YAML values, checked by who asks for them
    try:
        known = YAML(typ="safe", pure=True).load(read_whole(file, _LARGEST_METADATA_MB).decode())
        metadata = known["rosbag2_bagfile_information"]
    except (KeyError, TypeError, ValueError, RecursionError, YAMLError) as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise DataError(f"{file}: is no metadata of a recording ({what})") from error
    if not isinstance(metadata, Mapping):
        raise DataError(f"{file}: is no metadata of a recording (a {type(metadata).__name__})")
    return metadata


@contextmanager
def bag_folder(path: Path) -> Iterator[list[Path]]:
    """Files of the rosbag2 folder `path` by its metadata.yaml; unpacked, where each was packed.

    Raises `DataError` where it does not say what a rosbag2 folder says.
    """
    file = path / METADATA
    metadata = _metadata(file)
    try:
        files = listed_files(path)
        version = int(metadata["version"])
        mode = str(metadata.get("compression_mode") or "none").lower()
        form = metadata.get("compression_format") or "zstd"
        topics = [item["topic_metadata"] for item in metadata.get("topics_with_message_count") or ()]
        serializations = {str(topic["name"]): str(topic["serialization_format"]) for topic in topics}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{file}: is no metadata of a recording ({type(error).__name__}: {error})") from error
    if missing := [file for file in files if not file.is_file()]:
        raise DataError(f"{missing[0]}: is missing, {file} names it")
    if version > _NEWEST_VERSION or (mode != "none" and form != "zstd"):
        what = f"version {version}" if version > _NEWEST_VERSION else f"compression {form!r}"
        raise DataError(f"{file}: {what} of a recording is not known")
    for topic, serialization in serializations.items():
        check_serialization(file, topic, serialization)
    with TemporaryDirectory() if mode == "file" else nullcontext("") as folder:
        if folder:
            packed, files = files, [Path(folder) / file.stem for file in files]
            for source, target in zip(packed, files, strict=True):
                with target.open("wb") as out:
                    unpacked_file(source, out)
        yield files


def check_serialization(path: Path, topic: str, serialization: str) -> None:
    """Raise `DataError` where the messages of a topic cannot be decoded."""
    if serialization != "cdr":
        raise DataError(f"{path}: topic {topic} is serialized as {serialization!r}, only 'cdr' can be read")


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
    with open_file(path) as file:
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

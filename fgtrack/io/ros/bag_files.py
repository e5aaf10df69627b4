"""The files of a recording, each read in log-time order, and up to the break where it was cut off."""

import filecmp
import heapq
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from rosbags.interfaces import Connection
from ruamel.yaml.error import YAMLError

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file, read_whole
from fgtrack.io.ros.mcap_file import MCAP_MAGIC, McapFile
from fgtrack.io.ros.rosbag1_file import Rosbag1File
from fgtrack.io.ros.sqlite3_file import Sqlite3File
from fgtrack.io.ros.unpacking import unpacked_file
from fgtrack.io.yaml_text import YamlSizeError, safe_yaml

Record = tuple[Connection, int, bytes]
"""Connection, log time in ns, serialized message."""

METADATA = "metadata.yaml"
_LONGEST_METADATA = 1_000_000
_BAG_SUFFIXES = (".mcap", ".db3")
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


@dataclass(frozen=True)
class Parts:
    """The files of a recording."""

    files: tuple[Path, ...]
    packed: bool = False
    """Whether each is a zstd file."""

    @contextmanager
    def unpacked(self) -> Iterator[tuple[Path, ...]]:
        """The files, where each is packed in a temporary folder."""
        if not self.packed:
            yield self.files
            return
        with TemporaryDirectory() as folder:
            targets = tuple(Path(folder) / file.stem for file in self.files)
            for source, target in zip(self.files, targets, strict=True):
                with target.open("wb") as out:
                    unpacked_file(source, out)
            yield targets


def parts_of(path: Path) -> Parts:
    """The files of the recording at `path`: itself, those that metadata.yaml names, or those of the folder.

    Raises `DataError` where metadata.yaml does not say what that of a rosbag2 folder says, and for copies of one file.
    """
    if (path / METADATA).is_file():
        return _named_parts(path)
    files = tuple(bags_in(path)) if path.is_dir() else (path,)
    for one, other in combinations(files, 2):
        if one.stat().st_size and filecmp.cmp(one, other, shallow=False):
            raise DataError(f"{path}: {one.name} and {other.name} are copies of one recording: remove or name one")
    return Parts(files)


def bags_in(path: Path) -> list[Path]:
    """Storage files of a folder, `x_2` before `x_10`."""

    def natural(file: Path) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"([0-9]+)", file.name)]

    return sorted((file for file in path.iterdir() if file.suffix in _BAG_SUFFIXES), key=natural)


def _named_parts(path: Path) -> Parts:
    file = path / METADATA
    try:
        text = read_whole(file, 1e-6 * _LONGEST_METADATA).decode()
        metadata = _parsed(text)["rosbag2_bagfile_information"]
        files = [path / PurePath(_text(name)).name for name in metadata["relative_file_paths"]]
        version = int(_text(metadata["version"], int))
        mode = _text(metadata.get("compression_mode") or "none").lower()
        form = _text(metadata.get("compression_format") or "zstd")
        topics = [item["topic_metadata"] for item in metadata.get("topics_with_message_count") or ()]
        serializations = {_text(topic["name"]): _text(topic["serialization_format"]) for topic in topics}
    except RecursionError as error:
        raise DataError(f"{file}: is nested too deeply, or has an alias that contains itself") from error
    except YamlSizeError as error:
        raise DataError(f"{file}: {error}, that of no recording is so long") from error
    except (KeyError, TypeError, ValueError, AttributeError, YAMLError) as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise DataError(f"{file}: is no metadata of a recording ({what})") from error
    if missing := [file for file in files if not file.is_file()]:
        raise DataError(f"{missing[0]}: is missing, {file} names it")
    if len(set(files)) < len(files):
        raise DataError(f"{file}: names a file twice")
    if version > _NEWEST_VERSION or (mode != "none" and form != "zstd"):
        what = f"version {version}" if version > _NEWEST_VERSION else f"compression {form!r}"
        raise DataError(f"{file}: {what} of a recording is not known")
    for topic, serialization in serializations.items():
        check_serialization(file, topic, serialization)
    return Parts(tuple(files), mode == "file")


@lru_cache(maxsize=4)
def _parsed(text: str) -> Any:  # what YAML says is checked where it is used
    """What a metadata.yaml says. Cached: a command opens its recording several times."""
    return safe_yaml(text, _LONGEST_METADATA)


def _text(value: object, *also: type) -> str:
    if not isinstance(value, (str, *also)) or isinstance(value, bool):
        raise TypeError(f"a text expected, not a {type(value).__name__}")
    return str(value)


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

"""The files of a recording, and its metadata.yaml."""

import filecmp
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import combinations
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

import zstandard
from ruamel.yaml.error import YAMLError

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file, read_whole
from fgtrack.core.yaml_text import safe_yaml
from fgtrack.inputs.ros.mcap_file import MCAP_MAGIC, McapFile
from fgtrack.inputs.ros.rosbag1_file import Rosbag1File
from fgtrack.inputs.ros.sqlite3_file import Sqlite3File

BagFile = McapFile | Sqlite3File | Rosbag1File
"""One file of a recording; its messages are read in the order of log time up to a break (`break_off`)."""

METADATA = "metadata.yaml"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
SETTINGS = "fgtrack"
"""Entry of the metadata's custom data with configuration keys and values that the recording carries, as JSON."""
_ENDINGS = frozenset((".mcap", ".db3", ".bag"))
_READERS: Mapping[bytes, type[BagFile]] = {
    MCAP_MAGIC: McapFile,
    b"SQLite format 3\x00": Sqlite3File,
    b"#ROSBAG V2.0\n": Rosbag1File,
}


@contextmanager
def decompressed(file: Path) -> Iterator[Path]:
    """Yield the path of the file as the recorder wrote it; a zstd file is decompressed into a temporary folder."""
    with open_file(file) as source, TemporaryDirectory() as folder:
        if source.read(len(ZSTD_MAGIC)) != ZSTD_MAGIC:
            yield file
            return
        source.seek(0)
        target = Path(folder) / file.stem
        with target.open("wb") as out:
            zstandard.ZstdDecompressor().copy_stream(source, out)
        yield target


def files_of(path: Path) -> list[Path]:
    """Return the files of the recording at `path`.

    `path` is a file, or a folder. The files of a folder are named in its metadata.yaml. Without metadata.yaml, or if a
    named file is missing, they are all bag files in the folder.

    Raises `DataError` if two files have the same content.
    """
    files = [path]
    if (path / METADATA).is_file():
        files = [
            path / PurePath(name).name
            for name in _metadata(path)["relative_file_paths"]
        ]
    if path.is_dir() and (files == [path] or not all(map(Path.exists, files))):
        files = bags_in(path) or files
    for first, other in combinations(files, 2):
        if first.stat().st_size and filecmp.cmp(first, other, shallow=False):
            raise DataError(
                f"{path}: {first.name} and {other.name} have the same content: remove one, or give one of the files"
            )
    return files


def settings_of(path: Path) -> Any:  # Any: validated by `fgtrack.config.recorded`
    """Return the settings that the recording at `path` carries in its metadata.yaml; empty if there are none."""
    if not (path / METADATA).is_file():
        return {}
    try:
        return json.loads(_metadata(path)["custom_data"][SETTINGS])
    except (KeyError, TypeError, ValueError, RecursionError, YAMLError):
        return {}


def bags_in(path: Path) -> list[Path]:
    """Return the bag files of a folder, sorted by name. Compressed files and files of ROS 1 are included."""
    return sorted(
        file
        for file in path.iterdir()
        if _ENDINGS & set(file.suffixes[-2:]) and file.is_file()
    )


def _metadata(path: Path) -> Any:  # Any: YAML values, checked by the caller
    return safe_yaml(read_whole(path / METADATA, 1.0).decode())[
        "rosbag2_bagfile_information"
    ]


def storage_of(path: Path) -> type[BagFile] | None:
    """Return the reader class for the file `path`, recognised by its first bytes; None for other files.

    The bytes of a zstd file are decompressed first.
    """
    size = max(map(len, _READERS))
    with open_file(path) as file:
        start = file.read(size)
        if start.startswith(ZSTD_MAGIC):
            file.seek(0)
            with suppress(zstandard.ZstdError):
                start = zstandard.ZstdDecompressor().stream_reader(file).read(size)
    return next(
        (kind for magic, kind in _READERS.items() if start.startswith(magic)), None
    )

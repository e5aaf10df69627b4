"""The files of a recording: which they are, and the contents of its metadata.yaml."""

import filecmp
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
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
"""One file of a recording, read in log-time order up to where it breaks off (`break_off`)."""

METADATA = "metadata.yaml"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
SETTINGS = "fgtrack"
"""Entry of its custom data with what the recording carries of a configuration, as JSON."""
_READERS: Mapping[bytes, type[BagFile]] = {
    MCAP_MAGIC: McapFile,
    b"SQLite format 3\x00": Sqlite3File,
    b"#ROSBAG V2.0\n": Rosbag1File,
}


@contextmanager
def decompressed(file: Path) -> Iterator[Path]:
    """The file as the recorder wrote it; a zstd file is decompressed into a temporary folder."""
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
    """Files of the recording at `path`: itself, those that metadata.yaml names, or those of the folder."""
    files = [path]
    if (path / METADATA).is_file():
        files = [
            path / PurePath(name).name
            for name in _metadata(path)["relative_file_paths"]
        ]
    elif path.is_dir():
        files = bags_in(path)
    for first, other in combinations(files, 2):
        if first.stat().st_size and filecmp.cmp(first, other, shallow=False):
            raise DataError(
                f"{path}: {first.name} and {other.name} are copies of one recording: remove or name one"
            )
    return files


def settings_of(
    path: Path,
) -> Any:  # Any: JSON values, validated by `fgtrack.config.recorded`
    """Settings that the recording at `path` carries: none without a metadata.yaml that has them."""
    if not (path / METADATA).is_file():
        return {}
    try:
        return json.loads(_metadata(path)["custom_data"][SETTINGS])
    except (KeyError, TypeError, ValueError, RecursionError, YAMLError):
        return {}


def bags_in(path: Path) -> list[Path]:
    """Storage files of a folder."""
    return sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))


def _metadata(path: Path) -> Any:  # Any: YAML values, checked by who reads them
    return safe_yaml(read_whole(path / METADATA, 1.0).decode())[
        "rosbag2_bagfile_information"
    ]


def storage_of(path: Path) -> type[BagFile] | None:
    """Reader of the file `path`, by its first bytes; None for other files."""
    with open_file(path) as file:
        start = file.read(max(map(len, _READERS)))
    return next(
        (kind for magic, kind in _READERS.items() if start.startswith(magic)), None
    )

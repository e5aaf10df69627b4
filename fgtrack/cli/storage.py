"""Writing recordings: what the name and the storage option mean."""

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.core.types import Message
from fgtrack.io.ros.bag_writer import write_bag
from fgtrack.io.stream import write_stream


class Storage(StrEnum):
    """Storage of a rosbag2 folder."""

    MCAP = "mcap"
    SQLITE3 = "sqlite3"


StorageOption = Annotated[Storage, typer.Option("--storage", help="Storage of a rosbag2 folder.")]


def write_recording(out: Path, messages: Iterable[Message], storage: Storage) -> int:
    """Write a stream where `out` ends in .jsonl or .jsonl.gz, else a rosbag2 folder; gives the message count."""
    if out.name.endswith((".jsonl", ".jsonl.gz")):
        return write_stream(out, messages)
    return write_bag(out, messages, storage="mcap" if storage is Storage.MCAP else "sqlite3")

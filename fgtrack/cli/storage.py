"""Writing recordings: what the name and the storage option mean."""

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.core.types import Message
from fgtrack.io.output import check_output
from fgtrack.io.ros.bag_writer import RECORDING, write_bag
from fgtrack.io.stream import STREAM, write_stream


class Storage(StrEnum):
    """Storage of a rosbag2 folder."""

    MCAP = "mcap"
    SQLITE3 = "sqlite3"


StorageOption = Annotated[Storage, typer.Option("--storage", help="Storage of a rosbag2 folder.")]


def write_recording(out: Path, messages: Iterable[Message], storage: Storage, overwrite: bool) -> int:
    """Write a stream where `out` ends in .jsonl or .jsonl.gz, else a rosbag2 folder; gives the message count."""
    if _is_stream(out):
        return write_stream(out, messages, overwrite=overwrite)
    return write_bag(out, messages, "mcap" if storage is Storage.MCAP else "sqlite3", overwrite=overwrite)


def check_recording(out: Path, overwrite: bool) -> None:
    """Raise `CallError` where `write_recording` would for what is there, before the messages are made."""
    check_output(out, STREAM if _is_stream(out) else RECORDING, overwrite)


def _is_stream(out: Path) -> bool:
    return out.name.endswith((".jsonl", ".jsonl.gz"))

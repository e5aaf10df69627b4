"""Writes a recording: a stream or a rosbag2 folder, as its name specifies."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from fgtrack.core.errors import CallError
from fgtrack.core.output import check_output
from fgtrack.core.types import Message
from fgtrack.inputs.stream import SETTINGS, write_stream

Storage = Literal["mcap", "sqlite3"]
"""Storage of a rosbag2 folder."""

_FILE_ENDING = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,5}$")


def write_recording(
    out: Path,
    messages: Iterable[Message],
    storage: Storage = "mcap",
    *,
    settings: Mapping[str, object] | None = None,
    overwrite: bool = False,
) -> int:
    """Write a stream where `out` ends in .jsonl or .jsonl.gz, else a rosbag2 folder; gives the message count.
    `settings` are what it carries of a configuration, plain values by the names of its keys.
    """
    if _is_stream(out):
        return write_stream(
            out, messages, {SETTINGS: settings} if settings else None, overwrite
        )
    from fgtrack.inputs.ros.bag_writer import (
        write_bag,
    )  # and with it rosbags, where a bag is written

    return write_bag(out, messages, storage, settings=settings, overwrite=overwrite)


def check_recording(out: Path, overwrite: bool) -> None:
    """Raise `CallError` where `write_recording` would for what is there, before the messages are made."""
    if _is_stream(out):
        check_output(out, overwrite)
    elif _FILE_ENDING.search(out.name) and not out.is_dir():
        raise CallError(
            f"{out}: is written as .jsonl, as .jsonl.gz, or as a rosbag2 folder without such an ending"
        )
    else:
        from fgtrack.inputs.ros.bag_writer import check_bag

        check_bag(out, overwrite)


def _is_stream(out: Path) -> bool:
    return out.name.endswith((".jsonl", ".jsonl.gz"))

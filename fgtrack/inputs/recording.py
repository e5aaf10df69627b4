"""Writes messages as a recording: a stream or a rosbag2 folder, depending on the name."""

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
    """Write `messages` and return their number.

    A name that ends in .jsonl or .jsonl.gz gives a stream, another name a rosbag2
    folder. `settings` are configuration keys and plain values that the recording
    carries.
    """
    if _is_stream(out):
        return write_stream(
            out, messages, {SETTINGS: settings} if settings else None, overwrite
        )
    # rosbags is imported only if a bag is written.
    from fgtrack.inputs.ros.bag_writer import write_bag

    return write_bag(out, messages, storage, settings=settings, overwrite=overwrite)


def check_recording(out: Path, overwrite: bool) -> None:
    """Raise `CallError` if `write_recording` could not write `out`, before the messages are computed."""
    if _is_stream(out):
        check_output(out, overwrite)
    elif _FILE_ENDING.search(out.name) and not out.is_dir():
        raise CallError(
            f"{out}: a recording is a stream (.jsonl, .jsonl.gz) or a rosbag2 folder (no ending): choose such a name"
        )
    else:
        from fgtrack.inputs.ros.bag_writer import check_bag

        check_bag(out, overwrite)


def _is_stream(out: Path) -> bool:
    return out.name.endswith((".jsonl", ".jsonl.gz"))

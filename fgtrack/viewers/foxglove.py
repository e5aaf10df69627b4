"""Writes MCAP files for Foxglove and Lichtblick: log time is when something was known, publish time its stamp."""

import json
import struct
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from fgtrack.core.errors import CallError, DataError
from fgtrack.io.output import Kind, check_output, new_file
from fgtrack.viewers.foxglove_messages import foxglove_messages
from fgtrack.viewers.schemas import schema_text
from fgtrack.viewers.shapes import ViewerMessage

_LIBRARY = "fgtrack"
_MAGIC = b"\x89MCAP0\r\n"
_HEADER_START = len(_MAGIC) + 9  # behind opcode and length of the header


def _is_export(path: Path) -> bool:
    """Whether `path` is an MCAP file that fgtrack exported: its header says so."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(64)
    try:
        (profile_length,) = struct.unpack_from("<I", start, _HEADER_START)
        place = _HEADER_START + 4 + profile_length
        (length,) = struct.unpack_from("<I", start, place)
    except struct.error:
        return False
    return start.startswith(_MAGIC) and start[place + 4 : place + 4 + length] == _LIBRARY.encode()


EXPORT = Kind("an MCAP file of `fgtrack export`", _is_export)


def check_foxglove(path: Path, overwrite: bool) -> None:
    """Raise `CallError` where `write_foxglove` would before the first message."""
    if path.suffix != ".mcap":
        raise CallError(f"{path}: viewers know such a file by its name, let it end in .mcap")
    check_output(path, EXPORT, overwrite)


def write_foxglove(
    path: Path,
    messages: Iterable[ViewerMessage],
    metadata: Mapping[str, Mapping[str, str]],
    *,
    overwrite: bool = False,
) -> dict[str, int]:
    """Write `messages`, in the order of their log times, to the MCAP file `path`; gives their number by topic.

    The file appears when it is complete. The same messages give the same bytes. `metadata` are records of the file by
    name.

    Raises
    ------
    CallError
        The package `mcap` is missing, the name does not end in `.mcap`, something is at `path`, or it cannot be
        written.
    DataError
        The disk is full, or a time lies before 1970.
    """
    check_foxglove(path, overwrite)
    from mcap.writer import Writer

    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    counts: Counter[str] = Counter()
    with new_file(path, EXPORT, overwrite) as file:
        writer = Writer(file)
        writer.start(library=_LIBRARY)
        for name, entries in metadata.items():
            writer.add_metadata(name, dict(entries))
        for message in messages:
            log_ns, stamp_ns = message.log_ns, message.stamp_ns
            if min(log_ns, stamp_ns) < 0:
                raise DataError(f"the time {min(log_ns, stamp_ns)} ns lies before 1970, which no MCAP file holds")
            for topic, schema, value in foxglove_messages(message):
                if topic not in channels:
                    if schema not in schemas:
                        schemas[schema] = writer.register_schema(schema, "jsonschema", schema_text(schema))
                    channels[topic] = writer.register_channel(topic, "json", schemas[schema])
                data = json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
                writer.add_message(channels[topic], log_ns, data, stamp_ns, counts[topic])
                counts[topic] += 1
        writer.finish()  # type: ignore[no-untyped-call]  # as mcap has it
    return dict(counts)

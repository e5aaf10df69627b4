"""MCAP files of ROS 2 messages, including truncated ones (format: https://mcap.dev/spec)."""

from collections.abc import Collection, Iterable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO

from mcap.reader import SeekingReader
from mcap.records import Channel, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from fgtrack.io.errors import one_line

_LARGEST_BYTES = 1 << 30  # of a record: a damaged length would take more memory than there is
MCAP_MAGIC = b"\x89MCAP0\r\n"
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
_NO_SCHEMA = Schema(data=b"", encoding="", id=0, name="")


class McapFile:
    """MCAP file. One without its index is scanned, a truncated one up to its last whole chunk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = None
        self._file: BinaryIO | None = None
        self._is_indexed = True

    def open(self) -> None:
        """Open the file and read which connections it holds."""
        self._file = self.path.open("rb")
        indexed = self._indexed()
        self._is_indexed = indexed is not None
        schemas, channels = indexed or ({}, {})
        for record in () if self._is_indexed else self._records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels.setdefault(record.id, record)
        for channel in channels.values():
            schema = schemas.get(channel.schema_id, _NO_SCHEMA)
            form = _FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE)
            definition = MessageDefinition(form, schema.data.decode() if form != MessageDefinitionFormat.NONE else "")
            ext = ConnectionExtRosbag2(channel.message_encoding, [])
            self.connections.append(Connection(channel.id, channel.topic, schema.name, definition, "", 0, ext, self))

    def close(self) -> None:
        """Close the file."""
        if self._file:
            self._file.close()

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        by_id = {connection.id: connection for connection in connections}
        if self._is_indexed:
            topics = {connection.topic for connection in connections}
            messages: Iterable[Message] = (message for _, _, message in self._reader().iter_messages(topics))
        else:
            wanted = (
                record for record in self._records() if isinstance(record, Message) and record.channel_id in by_id
            )
            messages = sorted(wanted, key=attrgetter("log_time"))
        for message in messages:
            if message.channel_id in by_id:
                yield by_id[message.channel_id], message.log_time, message.data

    def _reader(self) -> SeekingReader:
        assert self._file
        return SeekingReader(self._file, validate_crcs=True, record_size_limit=_LARGEST_BYTES)

    def _indexed(self) -> tuple[dict[int, Schema], dict[int, Channel]] | None:
        """Schemas and channels by the end of the file; None unless all messages are in chunks of its index."""
        try:
            summary = self._reader().get_summary()
        except Exception:  # whatever the end of a truncated file raises
            return None
        statistics = None if summary is None else summary.statistics
        if summary is None or statistics is None or not 0 < statistics.chunk_count == len(summary.chunk_indexes):
            return None
        if statistics.channel_count > len(summary.channels):
            return None
        return summary.schemas, summary.channels

    def _records(self) -> Iterator[McapRecord]:
        """Records from the beginning of the file to its end, or to where it breaks off."""
        assert self._file
        self._file.seek(0)
        try:
            yield from StreamReader(self._file, validate_crcs=True, record_size_limit=_LARGEST_BYTES).records
        except MemoryError:
            raise
        except Exception as error:  # the end of the file, or whatever damaged bytes raise
            self.break_off = f"breaks off near byte {self._file.tell()} ({one_line(error)})"
            return
        if self._file.read(1):
            self.break_off = f"is followed by something else from byte {self._file.tell() - 1} on, split it there"

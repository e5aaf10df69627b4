"""MCAP files of ROS 2 messages, including truncated ones (format: https://mcap.dev/spec)."""

from bisect import bisect_left
from collections.abc import Collection, Iterator
from itertools import zip_longest
from operator import attrgetter, itemgetter
from pathlib import Path
from struct import Struct
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)

from fgtrack.inputs.errors import one_line

_LARGEST_BYTES = (
    1 << 30
)  # of a record: a damaged length would take more memory than there is
MCAP_MAGIC = b"\x89MCAP0\r\n"
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
_NO_SCHEMA = Schema(data=b"", encoding="", id=0, name="")
_HEAD = Struct("<BQ")
"""Operation code and length of a record."""
_MESSAGE = Struct("<HIQQ")
"""Channel, sequence number, log time and publish time, before the data of a message."""
_NEVER_NS = 1 << 64


class McapFile:
    """MCAP file. One without its index is scanned, a truncated one up to its last whole chunk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = None
        self._file: BinaryIO | None = None
        self._chunks: list[ChunkIndex] | None = None

    def open(self) -> None:
        """Open the file and read which connections it holds."""
        self._file = self.path.open("rb")
        schemas, channels, self._chunks = self._indexed() or ({}, {}, None)
        for record in () if self._chunks is not None else self._records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels.setdefault(record.id, record)
        for channel in channels.values():
            schema = schemas.get(channel.schema_id, _NO_SCHEMA)
            form = _FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE)
            definition = MessageDefinition(
                form,
                schema.data.decode() if form != MessageDefinitionFormat.NONE else "",
            )
            ext = ConnectionExtRosbag2(channel.message_encoding, [])
            self.connections.append(
                Connection(
                    channel.id, channel.topic, schema.name, definition, "", 0, ext, self
                )
            )

    def close(self) -> None:
        """Close the file."""
        if self._file:
            self._file.close()

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        by_id = {connection.id: connection for connection in connections}
        if self._chunks is None:
            wanted = (
                each
                for each in self._records()
                if isinstance(each, Message) and each.channel_id in by_id
            )
            for message in sorted(wanted, key=attrgetter("log_time")):
                yield by_id[message.channel_id], message.log_time, message.data
            return
        chunks = [
            (each.message_start_time, each.chunk_start_offset)
            for each in self._chunks
            if not (
                each.message_index_offsets
                and by_id.keys().isdisjoint(each.message_index_offsets)
            )
        ]
        chunks.sort()
        waiting: list[tuple[int, int, int, bytes]] = []
        for (_, offset), after in zip_longest(
            chunks, chunks[1:], fillvalue=(_NEVER_NS, 0)
        ):
            waiting += self._messages_in(offset, by_id.keys())
            waiting.sort(key=itemgetter(0, 1))
            count = bisect_left(
                waiting, after[:1]
            )  # the others may belong behind messages of the chunk after it
            for log_ns, _, channel, data in waiting[:count]:
                yield by_id[channel], log_ns, data
            del waiting[:count]

    def _messages_in(
        self, offset: int, channels: Collection[int]
    ) -> Iterator[tuple[int, int, int, bytes]]:
        """Log time, `offset`, channel and data of the messages of `channels` in the chunk at `offset`."""
        assert self._file
        self._file.seek(offset + _HEAD.size)
        stream, size = get_chunk_data_stream(
            Chunk.read(ReadDataStream(self._file)), validate_crc=True
        )
        records, end = stream.read(size), 0
        while end < size:
            opcode, length = _HEAD.unpack_from(records, end)
            begin = end + _HEAD.size
            end = begin + length
            if opcode == Opcode.MESSAGE:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(records, begin)
                if channel in channels:
                    yield log_ns, offset, channel, records[begin + _MESSAGE.size : end]

    def _indexed(
        self,
    ) -> tuple[dict[int, Schema], dict[int, Channel], list[ChunkIndex]] | None:
        """Schemas, channels and chunks by the end of the file; None unless all messages are in these chunks."""
        assert self._file
        try:
            summary = SeekingReader(
                self._file, record_size_limit=_LARGEST_BYTES
            ).get_summary()
        except Exception:  # whatever the end of a truncated file raises
            return None
        statistics = None if summary is None else summary.statistics
        if (
            summary is None
            or statistics is None
            or not 0 < statistics.chunk_count == len(summary.chunk_indexes)
        ):
            return None
        if statistics.channel_count > len(summary.channels):
            return None
        return summary.schemas, summary.channels, summary.chunk_indexes

    def _records(self) -> Iterator[McapRecord]:
        """Records from the beginning of the file to its end, or to where it breaks off."""
        assert self._file
        self._file.seek(0)
        try:
            yield from StreamReader(
                self._file, validate_crcs=True, record_size_limit=_LARGEST_BYTES
            ).records
        except MemoryError:
            raise
        except (
            Exception
        ) as error:  # the end of the file, or whatever damaged bytes raise
            self.break_off = (
                f"breaks off near byte {self._file.tell()} ({one_line(error)})"
            )
            return
        if self._file.read(1):
            self.break_off = f"is followed by something else from byte {self._file.tell() - 1} on, split it there"

"""MCAP files of ROS 2 messages, also truncated files (format: https://mcap.dev/spec)."""

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

#: Largest record; a damaged length could exceed the memory.
_LARGEST_BYTES = 1 << 30
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
"""Channel, sequence number, log time and publish time, which precede the data of a message."""
_NEVER_NS = 1 << 64


class McapFile:
    """MCAP file. A file without an index is scanned; a truncated file is read up to its last complete chunk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = None
        self._file: BinaryIO | None = None
        self._chunks: list[ChunkIndex] | None = None

    def open(self) -> None:
        """Open the file and read its connections."""
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
        """Yield connection, log time and data of the messages of `connections`, in the order of log time.

        Messages with equal times keep their order in the file.
        """
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
            # Later messages may belong behind messages of the next chunk.
            count = bisect_left(waiting, after[:1])
            for log_ns, _, channel, data in waiting[:count]:
                yield by_id[channel], log_ns, data
            del waiting[:count]

    def _messages_in(
        self, offset: int, channels: Collection[int]
    ) -> Iterator[tuple[int, int, int, bytes]]:
        """Yield log time, `offset`, channel and data of the messages of `channels` in the chunk at `offset`."""
        assert self._file
        self._file.seek(offset + _HEAD.size)
        stream, size = get_chunk_data_stream(
            Chunk.read(ReadDataStream(self._file)), validate_crc=True
        )
        records = stream.read(size)
        end = 0
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
        """Return schemas, channels and chunks from the index at the end of the file.

        Returns None unless the index covers all messages.
        """
        assert self._file
        try:
            summary = SeekingReader(
                self._file, record_size_limit=_LARGEST_BYTES
            ).get_summary()
        except Exception:  # the end of a truncated file causes any exception
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
        """Yield the records from the beginning of the file to its end, or to a break."""
        assert self._file
        self._file.seek(0)
        try:
            yield from StreamReader(
                self._file, validate_crcs=True, record_size_limit=_LARGEST_BYTES
            ).records
        except MemoryError:
            raise
        except Exception as error:  # the end of the file, or damaged bytes
            self.break_off = (
                f"breaks off near byte {self._file.tell()} ({one_line(error)})"
            )
            return
        if self._file.read(1):
            first = self._file.tell() - 1
            self.break_off = (
                f"has other data behind its end: split the file at byte {first}"
            )

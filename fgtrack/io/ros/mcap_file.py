"""MCAP files of ROS 2 messages, including truncated ones (format: https://mcap.dev/spec)."""

import heapq
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import partial
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame  # type: ignore[import-untyped]  # has no stubs
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from fgtrack.core.errors import DataError
from fgtrack.io.errors import LARGEST_BYTES, refuse_larger

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
_NO_SCHEMA = Schema(data=b"", encoding="", id=0, name="")
_RECORD_HEADER = struct.Struct("<BQ")  # opcode, length
_CHUNK_HEADER = struct.Struct("<QQQI")  # first and last log time, size, checksum
_CHUNK = 0x06


class McapFile:
    """MCAP file. One without its index is scanned, a truncated one read up to its last whole message."""

    def __init__(self, path: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = None
        self.end_time = 0
        """Last log time in ns according to the chunks; 0 without chunks."""
        self._largest_bytes = largest_bytes
        self._file: BinaryIO | None = None
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[tuple[int, int]] = []  # first log time, offset of the record
        self._cut_chunk: Chunk | None = None
        self._loose: list[tuple[int, int]] = []  # messages outside of chunks: log time, offset of the record

    def open(self) -> None:
        """Open the file and read which connections it holds."""
        self._file = self.path.open("rb")
        if self._file.read(MAGIC_SIZE) != MCAP_MAGIC:
            raise DataError(f"{self.path}: does not begin as an MCAP file")
        statistics = self._summary() or self._scan()
        if statistics is None or statistics.channel_count > len(self._channels):
            self._read_chunks()
        else:
            self._counts = Counter({number: min(n, 1 << 62) for number, n in statistics.channel_message_counts.items()})
        self.connections = [self._connection(channel) for channel in self._channels.values()]

    def close(self) -> None:
        """Close the file."""
        if self._file:
            self._file.close()

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        by_id = {connection.id: connection for connection in connections}

        def of(first_ns: int, records: Callable[[], list[McapRecord]]) -> Iterator[tuple[int, Message | None]]:
            yield first_ns, None  # a chunk is decompressed when its time has come
            found = [one for one in records() if isinstance(one, Message) and one.channel_id in by_id]
            yield from ((one.log_time, one) for one in sorted(found, key=lambda one: one.log_time))

        sources = [of(first_ns, partial(self._inner_at, offset)) for first_ns, offset in self._chunks]
        if self._cut_chunk:
            sources.append(of(self._cut_chunk.message_start_time, partial(self._inner, self._cut_chunk)))
        loose = sorted(self._loose, key=itemgetter(0))
        sources.append((log_ns, self._message_at(offset)) for log_ns, offset in loose)
        for log_ns, message in heapq.merge(*sources, key=itemgetter(0)):
            if message is not None and message.channel_id in by_id:
                yield by_id[message.channel_id], log_ns, message.data

    def sendings(self) -> Iterator[tuple[Connection, int, int, bytes]]:
        """Connection, publish time, log time and data of every message, in the order of the file."""
        by_id = {connection.id: connection for connection in self.connections}
        for records in (
            *(self._inner_at(offset) for _, offset in self._chunks),
            (self._message_at(offset) for _, offset in self._loose),
        ):
            for one in records:
                if isinstance(one, Message) and one.channel_id in by_id:
                    yield by_id[one.channel_id], one.publish_time, one.log_time, one.data

    def _summary(self) -> Statistics | None:
        """Statistics of a whole file whose messages are all in chunks with an index; notes its channels and chunks."""
        assert self._file
        try:
            summary = SeekingReader(self._file, record_size_limit=self._largest_bytes).get_summary()
        except Exception:  # whatever the end of a truncated file raises
            return None
        found = None if summary is None else summary.statistics
        if summary is None or found is None or not 0 < found.chunk_count == len(summary.chunk_indexes):
            return None
        self._schemas.update(summary.schemas)
        self._channels.update(summary.channels)
        self._chunks = [(one.message_start_time, one.chunk_start_offset) for one in summary.chunk_indexes]
        self.end_time = found.message_end_time
        return found

    def _scan(self) -> Statistics | None:
        """Statistics of the file, if it has any; notes channels, chunks and a truncation on the way."""
        assert self._file
        statistics, offset = None, MAGIC_SIZE
        records = self._records(offset)
        try:
            for record in records:
                if isinstance(record, Chunk):
                    self._chunks.append((record.message_start_time, offset))
                    self.end_time = max(self.end_time, record.message_end_time)
                elif isinstance(record, Message):
                    self._loose.append((record.log_time, offset))
                elif isinstance(record, Statistics):
                    statistics = record
                self._note(record)
                offset = self._file.tell()
        except (EndOfFile, struct.error, MemoryError):  # a damaged length may be larger than the memory
            self.break_off = f"breaks off at byte {offset}"
            self._cut_chunk = self._cut_chunk_at(offset)
            return None
        if rest := self._file.read(1):
            self.break_off = (
                f"is followed by something else from byte {self._file.tell() - len(rest)} on, split it there"
            )
        return statistics

    def _read_chunks(self) -> None:
        """Note the channels and count the messages of all chunks; a damaged chunk ends the file."""
        self._counts.clear()
        for k, (_, offset) in enumerate(self._chunks):
            try:
                inner = self._inner_at(offset)
            except Exception as error:  # whatever damaged bytes raise
                self._chunks, self._cut_chunk = self._chunks[:k], None
                self.break_off = f"is damaged ({error})"
                break
            for record in inner:
                self._note(record)
        for record in [] if self._cut_chunk is None else self._inner(self._cut_chunk):
            self._note(record)
        self._counts.update(self._message_at(offset).channel_id for _, offset in self._loose)

    def _note(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels.setdefault(record.id, record)
        elif isinstance(record, Message):
            self._counts[record.channel_id] += 1

    def _connection(self, channel: Channel) -> Connection:
        schema = self._schemas.get(channel.schema_id, _NO_SCHEMA)
        form = _FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE)
        definition = MessageDefinition(form, schema.data.decode() if form != MessageDefinitionFormat.NONE else "")
        ext = ConnectionExtRosbag2(channel.message_encoding, [])
        return Connection(channel.id, channel.topic, schema.name, definition, "", self._counts[channel.id], ext, self)

    def _records(self, offset: int) -> Iterator[McapRecord]:
        assert self._file
        self._file.seek(offset)
        reader = StreamReader(self._file, skip_magic=True, emit_chunks=True, record_size_limit=self._largest_bytes)
        return iter(reader.records)

    def _inner_at(self, offset: int) -> list[McapRecord]:
        chunk = next(self._records(offset))
        assert isinstance(chunk, Chunk)
        return self._inner(chunk)

    def _message_at(self, offset: int) -> Message:
        message = next(self._records(offset))
        assert isinstance(message, Message)
        return message

    def _inner(self, chunk: Chunk) -> list[McapRecord]:
        content = _decompressed(chunk.compression, chunk.data, self._largest_bytes + 1)
        refuse_larger(len(content), f"{self.path}: a chunk", self._largest_bytes)
        if len(content) != chunk.uncompressed_size:
            raise DataError(f"{self.path}: a chunk of {len(content)} bytes is damaged, its size is wrong")
        return breakup_chunk(replace(chunk, compression="", data=content), validate_crc=True)

    def _cut_chunk_at(self, offset: int) -> Chunk | None:
        """Whole messages of the chunk that is cut at the end of the file, as an uncompressed chunk."""
        assert self._file
        self._file.seek(offset)
        data = BytesIO(self._file.read(self._largest_bytes))
        head = data.read(_RECORD_HEADER.size + _CHUNK_HEADER.size)
        if len(head) < _RECORD_HEADER.size + _CHUNK_HEADER.size or head[0] != _CHUNK:
            return None
        first_ns, last_ns, _, _ = _CHUNK_HEADER.unpack_from(head, _RECORD_HEADER.size)
        try:
            stream: Any = ReadDataStream(data)
            compression = stream.read_prefixed_string()
            stream.read8()
            content = _whole_records(_decompressed(compression, data.read(), self._largest_bytes))
        except Exception:  # whatever a few bytes of a chunk make its decompressor raise
            return None
        return Chunk(
            compression="",
            data=content,
            message_end_time=last_ns,
            message_start_time=first_ns,
            uncompressed_crc=0,
            uncompressed_size=len(content),
        )


def _decompressed(compression: str, data: bytes, largest_bytes: int) -> bytes:
    """At most `largest_bytes` of the content of compressed data, as far as they reach.

    Raises `DataError` for an unknown compression.
    """
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            return bytes(reader.read(largest_bytes))
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, largest_bytes))
    if compression not in ("", "none"):
        raise DataError(f"compression {compression!r} is unknown")
    return data


def _whole_records(content: bytes) -> bytes:
    """Records at the beginning of `content` that are not cut."""
    end = 0
    while end + _RECORD_HEADER.size <= len(content):
        after = end + _RECORD_HEADER.size + _RECORD_HEADER.unpack_from(content, end)[1]
        if after > len(content):
            break
        end = after
    return content[:end]

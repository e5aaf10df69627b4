"""An MCAP file, including a truncated one."""

from collections.abc import Collection, Generator, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from rosbags.interfaces import Connection
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import (
    DECOMPRESSORS,
    ChunkInfo,
    McapReader,
    deserialize_hiqq,
    deserialize_qqqi,
    deserialize_uint64,
    read_string,
)

_CHUNK_HEADER = 40  # two times, size, checksum, length of the compression's name, size of the data
_RECORD_HEADER = 9  # opcode and length
_MESSAGE_HEADER = 22  # channel, sequence, two times


class McapFile(McapReader):
    """An MCAP file; one without a usable index is indexed by walking over its records."""

    path: Path
    break_off: str | None = None

    def _open(self) -> None:
        try:
            super()._open()
        except Exception:  # rosbags reads complete files only; whatever it raises, index from the start
            if not self.data_start:
                raise
            self._index_by_walking()
            self.break_off = self.break_off or "has no end record"
            return
        if any(not chunk.channel_count for chunk in self.chunks) or not self.chunks:
            self._index_by_walking()

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        if self.chunks:
            yield from super().messages(connections, start, stop)
        else:  # no chunk that could be sorted for itself
            yield from sorted(self.messages_scan(connections, start, stop), key=lambda record: record[1])

    def sendings(self) -> Iterator[tuple[Connection, int, int, bytes]]:
        """Connection, publish time and log time in ns, and bytes of every message, in the order of the file."""
        assert self.bio
        by_id = {item.id: item for item in self.connections}
        if not self.chunks:
            yield from _sendings(self.bio, self.data_start, self.data_end, by_id)
        for chunk in self.chunks:
            self.bio.seek(chunk.chunk_start_offset + _RECORD_HEADER + _CHUNK_HEADER + len(chunk.compression))
            data = DECOMPRESSORS[chunk.compression](self.bio.read(chunk.compressed_size), chunk.uncompressed_size)
            yield from _sendings(BytesIO(data), 0, len(data), by_id)

    def _index_by_walking(self) -> None:
        """Find the chunks, schemas and channels without the index at the end of the file."""
        self.schemas.clear()
        self.channels.clear()
        self.connections.clear()
        self.chunks.clear()
        chunks = self._walk()
        self.meta_scan()
        counts = dict(self.statistics.channel_message_counts) if self.statistics else {}
        self.connections[:] = [item._replace(msgcount=counts.get(item.id, 0)) for item in self.connections]
        self.chunks.extend(chunk._replace(channel_count=counts) for chunk in chunks)

    def _walk(self) -> list[ChunkInfo]:
        """Chunks up to the end of the data or the break; sets `data_end` and `break_off`."""
        assert self.bio
        size = self.path.stat().st_size
        chunks: list[ChunkInfo] = []
        position = self.data_start
        while True:
            self.bio.seek(position)
            head = self.bio.read(_RECORD_HEADER)
            opcode = head[0] if head else 0
            if opcode in (0x02, 0x0F):  # footer, end of data
                break
            length = deserialize_uint64(head[1:])[0] if len(head) == _RECORD_HEADER else size
            end = position + _RECORD_HEADER + length
            if opcode == 0 or end > size:
                self.break_off = f"breaks off at byte {position}"
                break
            if opcode == 0x06:
                chunks.append(self._chunk(position, length))
            position = end
        self.data_end = position
        return chunks

    def _chunk(self, position: int, length: int) -> ChunkInfo:
        assert self.bio
        first_ns, last_ns, size, _ = deserialize_qqqi(self.bio.read(28))
        compression = read_string(self.bio)
        (compressed_size,) = deserialize_uint64(self.bio.read(8))
        if _CHUNK_HEADER + len(compression) + compressed_size > length:
            raise ReaderError(f"Chunk at byte {position} is larger than its record.")
        return ChunkInfo(
            first_ns,
            last_ns,
            position,
            _RECORD_HEADER + length,
            {},
            0,
            compression,
            compressed_size,
            size,
            {},
        )


def _sendings(
    file: BinaryIO | BytesIO, position: int, end: int, by_id: dict[int, Connection]
) -> Iterator[tuple[Connection, int, int, bytes]]:
    """The message records between two places of `file`, as `McapFile.sendings` gives them."""
    while position < end:
        file.seek(position)
        head = file.read(_RECORD_HEADER)
        length = deserialize_uint64(head[1:])[0]
        if head[0] == 0x05:
            channel, _, log_ns, sent_ns = deserialize_hiqq(file.read(_MESSAGE_HEADER))
            if channel in by_id:
                yield by_id[channel], sent_ns, log_ns, file.read(length - _MESSAGE_HEADER)
        position += _RECORD_HEADER + length

"""An MCAP file of ROS 2 messages, including a truncated one (format: https://mcap.dev/spec)."""

import heapq
import struct
from array import array
from binascii import crc32
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from fgtrack.core.errors import DataError
from fgtrack.io.errors import LARGEST_BYTES, refuse_larger
from fgtrack.io.ros.unpacking import unpacked

MCAP_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x0B
_RECORD_HEADER = struct.Struct("<BQ")  # opcode, length
_CHUNK_HEADER = struct.Struct("<QQQI")  # first and last log time, size, checksum
_MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log and publish time
_STATISTICS_HEADER = struct.Struct("<QHIIIIQQ")
_LONGEST_COMPRESSION = 100
_CHUNKS_AT_ONCE = 2
_KEPT_BYTES = 40  # of a message that is kept, besides its own

Content = bytes | memoryview
"""Of a record."""
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}


class Sending(NamedTuple):
    """A message, and when it was sent."""

    connection: Connection
    sent_ns: int
    """Publish time."""
    log_ns: int
    data: bytes


@dataclass(frozen=True)
class _Chunk:
    """Where a chunk is."""

    place: int
    """Of its record in the file."""
    first_ns: int
    last_ns: int
    size: int
    """Of its records, unpacked."""
    checksum: int
    compression: str
    data_place: int
    data_size: int
    """As packed; of a chunk that is cut in two what there is."""
    cut: bool


class _Kept:
    """Messages of a chunk, in one piece: each by itself would take several times its bytes."""

    def __init__(self, messages: Iterator[Sending]) -> None:
        self._data = bytearray()
        self._times, self._sent, self._ends = array("Q"), array("Q"), array("Q", [0])
        self._connections: list[Connection] = []
        for connection, sent_ns, log_ns, data in messages:
            self._data += data
            self._times.append(log_ns)
            self._sent.append(sent_ns)
            self._ends.append(len(self._data))
            self._connections.append(connection)

    @property
    def num_bytes(self) -> int:
        """What they take."""
        return len(self._data) + _KEPT_BYTES * len(self._times)

    def by_time(self) -> Iterator[tuple[int, int]]:
        """Log time and place of each, in the order of log time, of equal times in that of writing."""
        return ((self._times[index], index) for index in _order(self._times))

    def at(self, index: int) -> Sending:
        """The message at a place."""
        data = bytes(memoryview(self._data)[self._ends[index] : self._ends[index + 1]])
        return Sending(self._connections[index], self._sent[index], self._times[index], data)


def _order(times: "array[int]") -> Iterator[int]:
    """Places of `times`, the earliest first."""
    return map(int, np.argsort(np.frombuffer(times, np.uint64), kind="stable")) if times else iter(())


class McapFile:
    """An MCAP file. One that breaks off is read up to the last whole message, also within its last chunk."""

    def __init__(self, path: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = None
        self._largest_bytes = largest_bytes
        self._file: BinaryIO | None = None
        self._schemas: dict[int, tuple[str, MessageDefinition]] = {}
        self._channels: dict[int, Connection] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[_Chunk] = []
        self._loose_end: int | None = None  # of the last message outside of chunks

    def open(self) -> None:
        """Open the file and read which connections it holds."""
        self._file = self.path.open("rb")
        num_channels = self._walk()
        if self.break_off or num_channels is None or num_channels > len(self._channels) or self._loose_end:
            self._counts.clear()
            try:
                for opcode, content in self._inner_records():
                    self._note(opcode, content)
            except DataError as error:  # what comes before can be read
                self.break_off = f"is damaged ({error})"
            except Exception as error:  # whatever damaged bytes raise
                self.break_off = self.break_off or f"is damaged ({error})"
        self.connections = [
            connection._replace(msgcount=self._counts[number]) for number, connection in self._channels.items()
        ]

    @property
    def end_time(self) -> int:
        """The last log time in ns as the chunks say it; 0 without chunks."""
        return max((chunk.last_ns for chunk in self._chunks), default=0)

    def close(self) -> None:
        """Close the file."""
        if self._file:
            self._file.close()

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        wanted = {connection.id: connection for connection in connections}
        held = 0  # bytes of the chunks that are unpacked at once, because their times overlap

        def of(chunk: _Chunk) -> Iterator[tuple[int, _Kept | None, int]]:
            nonlocal held
            yield chunk.first_ns, None, 0  # the chunk is unpacked when its time has come
            kept = _Kept(self._sendings(self._chunk_records(chunk), wanted))
            held += kept.num_bytes
            what = f"{self.path}: what overlaps with the chunk at byte {chunk.place}, at once"
            refuse_larger(held, what, _CHUNKS_AT_ONCE * self._largest_bytes)
            yield from ((log_ns, kept, index) for log_ns, index in kept.by_time())
            held -= kept.num_bytes

        loose = ((one.log_ns, one, 0) for one in self._loose_by_time(wanted))
        for _, source, index in heapq.merge(*map(of, self._chunks), loose, key=itemgetter(0)):
            if source is not None:
                one = source if isinstance(source, Sending) else source.at(index)
                yield one.connection, one.log_ns, one.data

    def _loose_by_time(self, wanted: dict[int, Connection]) -> Iterator[Sending]:
        """The messages outside of chunks; of them only times and places are kept."""
        times, places = array("Q"), array("Q")
        for place, content in self._loose():
            times.append(_MESSAGE_HEADER.unpack_from(content)[2])
            places.append(place)
        for index in _order(times):
            yield from self._sendings(iter([(_MESSAGE, self._content(places[index]))]), wanted)

    def sendings(self) -> Iterator[Sending]:
        """Every message, in the order of the file."""
        by_id = {connection.id: connection for connection in self.connections}
        yield from self._sendings(self._inner_records(), by_id)

    def _walk(self) -> int | None:
        """Look at the records of the file, not into its chunks; gives the number of channels, if the file says it."""
        assert self._file
        size = self.path.stat().st_size
        if self._file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise DataError(f"{self.path}: does not begin as an MCAP file")
        place, num_channels = len(MCAP_MAGIC), None
        while place < size - len(MCAP_MAGIC):
            self._file.seek(place)
            opcode, length = _RECORD_HEADER.unpack(self._file.read(_RECORD_HEADER.size))
            if opcode == _FOOTER:
                end = place + _RECORD_HEADER.size + length + len(MCAP_MAGIC)
                if end < size:
                    self.break_off = f"is followed by something else from byte {end} on, split it there"
                return num_channels
            end = place + _RECORD_HEADER.size + length
            if opcode == _CHUNK:
                self._chunks += self._chunk(place, min(end, size), end > size)
            if opcode == 0 or end > size:
                break
            if opcode == _MESSAGE:
                self._loose_end = end
            elif opcode in (_HEADER, _SCHEMA, _CHANNEL, _STATISTICS):
                refuse_larger(length, f"{self.path}: the record at byte {place}", self._largest_bytes)
                num_channels = self._note(opcode, self._file.read(length)) or num_channels
            place = end
        self.break_off = f"breaks off at byte {place}"
        return num_channels

    def _chunk(self, place: int, end: int, cut: bool) -> Iterator[_Chunk]:
        """The chunk whose record is at `place` and ends at `end`; none, where not even its header is there."""
        assert self._file
        head = self._file.read(_CHUNK_HEADER.size + 4)
        if len(head) < _CHUNK_HEADER.size + 4:
            return
        first_ns, last_ns, size, checksum = _CHUNK_HEADER.unpack_from(head)
        (length,) = struct.unpack_from("<I", head, _CHUNK_HEADER.size)
        compression = self._file.read(min(length, _LONGEST_COMPRESSION)).decode()
        stated = self._file.read(8)
        if len(stated) < 8:
            return
        data_place, data_size = self._file.tell(), int.from_bytes(stated, "little")
        if data_place + data_size > end and not cut:
            raise DataError(f"{self.path}: the chunk at byte {place} is larger than its record")
        data_size = min(data_size, end - data_place)
        yield _Chunk(place, first_ns, last_ns, size, checksum, compression, data_place, data_size, cut)

    def _note(self, opcode: int, content: Content) -> int | None:
        """Keep what a record says of the messages; gives the number of channels, where it is that of the statistics."""
        if opcode == _SCHEMA:
            (number,) = struct.unpack_from("<H", content)
            name, encoding, text = _texts(content, 2, 3)
            form = _FORMATS.get(encoding, MessageDefinitionFormat.NONE)
            self._schemas[number] = name, MessageDefinition(form, text)
        elif opcode == _CHANNEL:
            number, schema = struct.unpack_from("<HH", content)
            topic, encoding = _texts(content, 4, 2)
            name, definition = self._schemas.get(schema, ("", MessageDefinition(MessageDefinitionFormat.NONE, "")))
            ext = ConnectionExtRosbag2(encoding, [])
            self._channels.setdefault(number, Connection(number, topic, name, definition, "", 0, ext, self))
        elif opcode == _MESSAGE:
            self._counts[_MESSAGE_HEADER.unpack_from(content)[0]] += 1
        elif opcode == _STATISTICS:
            num_channels = _STATISTICS_HEADER.unpack_from(content)[2]
            counts = struct.iter_unpack("<HQ", content[_STATISTICS_HEADER.size + 4 :])
            self._counts.update({number: min(count, 1 << 62) for number, count in counts})
            return int(num_channels)
        return None

    def _inner_records(self) -> Iterator[tuple[int, Content]]:
        """Opcode and content of the records in all chunks, and of the messages outside of chunks."""
        for chunk in self._chunks:
            yield from self._chunk_records(chunk)
        for _, content in self._loose():
            yield _MESSAGE, content

    def _chunk_records(self, chunk: _Chunk) -> Iterator[tuple[int, Content]]:
        assert self._file
        what = f"{self.path}: the chunk at byte {chunk.place}"
        for num_bytes in (chunk.size, chunk.data_size):
            refuse_larger(num_bytes, what, self._largest_bytes)
        self._file.seek(chunk.data_place)
        data = unpacked(chunk.compression, self._file.read(chunk.data_size), what, self._largest_bytes, chunk.cut)
        whole = len(data) == chunk.size and not (chunk.checksum and crc32(data) != chunk.checksum)
        if not whole and not chunk.cut:
            raise DataError(f"{what}: is damaged, its size or checksum is wrong")
        place, inside = 0, memoryview(data)
        while place + _RECORD_HEADER.size <= len(data):
            opcode, length = _RECORD_HEADER.unpack_from(data, place)
            begin = place + _RECORD_HEADER.size
            place = begin + length
            if place > len(data):
                break
            yield opcode, inside[begin:place]

    def _loose(self) -> Iterator[tuple[int, bytes]]:
        """Place and content of the messages outside of chunks."""
        assert self._file
        place = len(MCAP_MAGIC)
        while self._loose_end and place < self._loose_end:
            self._file.seek(place)
            opcode, length = _RECORD_HEADER.unpack(self._file.read(_RECORD_HEADER.size))
            if opcode == _MESSAGE:
                yield place, self._content(place)
            place += _RECORD_HEADER.size + length

    def _content(self, place: int) -> bytes:
        """Content of the record at `place`."""
        assert self._file
        self._file.seek(place)
        _, length = _RECORD_HEADER.unpack(self._file.read(_RECORD_HEADER.size))
        refuse_larger(length, f"{self.path}: the message at byte {place}", self._largest_bytes)
        return self._file.read(length)

    @staticmethod
    def _sendings(records: Iterator[tuple[int, Content]], wanted: dict[int, Connection]) -> Iterator[Sending]:
        for opcode, content in records:
            if opcode == _MESSAGE:
                channel, _, log_ns, sent_ns = _MESSAGE_HEADER.unpack_from(content)
                if channel in wanted:
                    yield Sending(wanted[channel], sent_ns, log_ns, bytes(content[_MESSAGE_HEADER.size :]))


def _texts(content: Content, place: int, count: int) -> list[str]:
    """So many texts, each behind its length, from `place` on."""
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", content, place)
        place += 4 + length
        if place > len(content):
            raise DataError("a text is longer than its record")
        found.append(bytes(content[place - length : place]).decode())
    return found

"""A ROS 1 bag, including a truncated one."""

from collections import defaultdict
from io import BytesIO
from os import SEEK_CUR
from pathlib import Path
from typing import BinaryIO

from rosbags.interfaces import Connection
from rosbags.rosbag1.reader import (
    Chunk,
    ChunkInfo,
    Header,
    IndexData,
    Reader,
    RecordType,
    read_bytes,
    read_uint32,
)

from fgtrack.io.errors import LARGEST_BYTES, refuse_larger
from fgtrack.io.ros.unpacking import unpacked

_LONGEST_MAGIC = 100


class Rosbag1File(Reader):
    """A ROS 1 bag; one without its index is indexed by walking over its chunks."""

    path: Path
    break_off: str | None = None

    def __init__(self, path: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        super().__init__(path)
        self._largest_bytes = largest_bytes
        self._index_end = 0
        self._cut: set[int] = set()  # where the data of chunks are that the file does not hold whole

    def read_chunk(self) -> Chunk:
        """The header of the chunk at this place of the file, whose data are never unpacked to more than is allowed."""
        file = self._before_headers(1)
        place = file.tell()
        compression = Header.read(file, RecordType.CHUNK).get_string("compression")
        file.seek(place)
        chunk = super().read_chunk()
        what = f"{self.path}: the chunk at byte {place}"

        def decompressor(data: bytes) -> bytes:
            return unpacked(compression, data, what, self._largest_bytes, cut=chunk.datapos in self._cut)

        return chunk._replace(decompressor=decompressor)

    def read_connection(self) -> Connection:
        """The connection at this place of the file."""
        self._before_headers(2)
        return super().read_connection()

    def read_chunk_info(self) -> ChunkInfo:
        """What the index at this place of the file says of a chunk."""
        file = self._before_headers(1)
        found = super().read_chunk_info()
        self._index_end = file.tell()
        return found

    def _before_headers(self, count: int) -> BinaryIO:
        """The file at this place, where so many headers begin that are not too long to be read."""
        file = self.bio
        assert file
        place = file.tell()
        for _ in range(count):
            num_bytes = read_uint32(file)
            refuse_larger(num_bytes, f"{self.path}: the header at byte {file.tell() - 4}", self._largest_bytes)
            file.seek(num_bytes, SEEK_CUR)
        file.seek(place)
        return file

    def open(self) -> None:
        """Open the file and read which connections it holds."""
        with self.path.open("rb") as self.bio:
            self.bio.readline(_LONGEST_MAGIC)
            self._before_headers(1)
        self.bio = None
        try:
            super().open()
            self._note_what_follows()
        except Exception:  # rosbags reads indexed files only; whatever it raises, index from the start
            self._index_by_walking()

    def _note_what_follows(self) -> None:
        """The index is the last of a bag, and what it says of its chunks the last of the index."""
        if 0 < self._index_end < self.path.stat().st_size:
            self.break_off = f"is followed by something else from byte {self._index_end} on, split it there"

    def _index_by_walking(self) -> None:
        self.bio = self.path.open("rb")
        self.bio.readline()
        Header.read(self.bio, RecordType.BAGHEADER)
        self.bio.seek(read_uint32(self.bio), 1)
        indexes: dict[int, list[IndexData]] = defaultdict(list)
        position = self.bio.tell()
        try:
            while True:
                position = self._before_headers(1).tell()
                if Header.read(self.bio).get_uint8("op") == RecordType.CHUNK:
                    self._index_chunk(position, indexes)
                else:
                    read_bytes(self.bio, read_uint32(self.bio))
        except Exception:  # the end of the file, or whatever a chunk cut in two makes its decompressor raise
            self.break_off = f"breaks off at byte {position}"
        self.indexes = {item.id: sorted(indexes[item.id]) for item in self.connections}
        self.connections = [item._replace(msgcount=len(self.indexes[item.id])) for item in self.connections]

    def _index_chunk(self, position: int, indexes: dict[int, list[IndexData]]) -> None:
        """Index the connections and messages of the chunk at `position`."""
        file = self.bio
        assert file
        file.seek(position)
        chunk = self.read_chunk()
        left = self.path.stat().st_size - chunk.datapos
        if left < chunk.datasize:
            self._cut.add(chunk.datapos)
            chunk = chunk._replace(datasize=left)
        file.seek(chunk.datapos)
        data = chunk.decompressor(read_bytes(file, chunk.datasize))
        self.chunks[position] = chunk
        known = {item.id for item in self.connections}
        self.bio = inside = BytesIO(data)  # where `read_connection` reads
        try:
            while (offset := inside.tell()) < len(data):
                header = Header.read(inside)
                if header.get_uint8("op") == RecordType.CONNECTION:
                    inside.seek(offset)
                    connection = self.read_connection()
                    if connection.id not in known:
                        known.add(connection.id)
                        self.connections.append(connection)
                else:
                    entry = IndexData(header.get_time("time"), position, offset)
                    read_bytes(inside, read_uint32(inside))  # raises where the message is cut
                    indexes[header.get_uint32("conn")].append(entry)
        finally:
            self.bio = file

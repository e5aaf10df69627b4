"""ROS 1 bags, also truncated files."""

from collections import defaultdict
from io import BytesIO
from pathlib import Path

from rosbags.rosbag1.reader import (
    Header,
    IndexData,
    Reader,
    RecordType,
    read_bytes,
    read_uint32,
)


class Rosbag1File(Reader):
    """ROS 1 bag; a file without an index is indexed by reading all complete chunks."""

    path: Path
    break_off: str | None = None

    def open(self) -> None:
        """Open the file and read its connections."""
        try:
            super().open()
        except Exception:  # rosbags reads indexed files only and raises many kinds
            self._index_by_walking()

    def _index_by_walking(self) -> None:
        self.connections.clear()
        self.bio = self.path.open("rb")
        self.bio.readline(100)
        Header.read(self.bio, RecordType.BAGHEADER)
        self.bio.seek(read_uint32(self.bio), 1)
        indexes: dict[int, list[IndexData]] = defaultdict(list)
        position = self.bio.tell()
        try:
            while True:
                position = self.bio.tell()
                if Header.read(self.bio).get_uint8("op") == RecordType.CHUNK:
                    self._index_chunk(position, indexes)
                else:
                    read_bytes(self.bio, read_uint32(self.bio))
        except Exception:  # the end of the file, or an incomplete chunk
            self.break_off = f"breaks off at byte {position}"
        self.indexes = {item.id: sorted(indexes[item.id]) for item in self.connections}

    def _index_chunk(self, position: int, indexes: dict[int, list[IndexData]]) -> None:
        """Index the connections and messages of the chunk at `position`."""
        file = self.bio
        assert file
        file.seek(position)
        chunk = self.read_chunk()
        file.seek(chunk.datapos)
        data = chunk.decompressor(read_bytes(file, chunk.datasize))
        self.chunks[position] = chunk
        ids = {item.id for item in self.connections}
        self.bio = inside = BytesIO(data)  # `read_connection` reads from `bio`
        try:
            while (offset := inside.tell()) < len(data):
                header = Header.read(inside)
                if header.get_uint8("op") == RecordType.CONNECTION:
                    inside.seek(offset)
                    connection = self.read_connection()
                    if connection.id not in ids:
                        ids.add(connection.id)
                        self.connections.append(connection)
                else:
                    indexes[header.get_uint32("conn")].append(
                        IndexData(header.get_time("time"), position, offset)
                    )
                    read_bytes(inside, read_uint32(inside))
        finally:
            self.bio = file

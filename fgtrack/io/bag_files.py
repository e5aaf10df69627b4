"""The files of a recording, each read in log-time order, and up to the break where it was cut off."""

import heapq
import shutil
import tempfile
from collections.abc import Collection, Generator, Iterator
from pathlib import Path
from typing import Protocol, cast

import apsw
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import (
    ChunkInfo,
    McapReader,
    deserialize_qqqi,
    deserialize_uint64,
    read_string,
)
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

Record = tuple[Connection, int, bytes]
"""Connection, log time in ns, serialized message."""

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
ROSBAG1_MAGIC = b"#ROSBAG V2.0\n"

_CHUNK_HEADER = 40  # two times, size, checksum, length of the compression's name, size of the data
_RECORD_HEADER = 9  # opcode and length


class BagFile(Protocol):
    """One file of a recording."""

    path: Path
    connections: list[Connection]
    break_off: str | None
    """How the file breaks off in the middle; None when it is whole."""

    def open(self) -> None:
        """Open the file and read which connections it holds."""

    def close(self) -> None:
        """Close the file."""

    def messages(self, connections: Collection[Connection]) -> Iterator[Record]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""


class McapFile(McapReader):
    """An MCAP file; one without a usable index is indexed by walking over its records."""

    path: Path
    break_off: str | None = None

    def _open(self) -> None:
        try:
            super()._open()
        except Exception:  # rosbags reads files with an end only; whatever it stumbles over, try from the start
            if not self.data_start:
                raise
            self._index_by_walking()
            self.break_off = self.break_off or "lacks its end"
            return
        if any(not chunk.channel_count for chunk in self.chunks) or not self.chunks:
            self._index_by_walking()

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[Record, None, None]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        if self.chunks:
            yield from super().messages(connections, start, stop)
        else:  # no chunk that could be sorted for itself
            yield from sorted(self.messages_scan(connections, start, stop), key=lambda record: record[1])

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


class Sqlite3File(Sqlite3Reader):
    """A SQLite file; one that was not closed is healed in a copy, a truncated one is read row by row."""

    path: Path
    break_off: str | None = None

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._copies: tempfile.TemporaryDirectory[str] | None = None
        self._damaged = False

    def _open(self) -> None:
        journals = [self.path.with_name(self.path.name + suffix) for suffix in ("-wal", "-journal")]
        left = [journal for journal in journals if journal.exists() and journal.stat().st_size]
        if left:
            self.break_off = f"was not closed by its writer ({left[0].name} is left)"
            self.path = self._healed_copy(left)
        try:
            super()._open()
            self._reconnect()
        except (apsw.Error, ReaderError):
            self._open_damaged()

    def close(self) -> None:
        """Close the file and remove its copies."""
        super().close()
        if self._copies:
            self._copies.cleanup()

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[Record, None, None]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        assert self.dbconn
        by_id = {connection.id: connection for connection in connections}
        if self._damaged:
            rows = sorted(self._rows_before_break(), key=lambda row: row[1])
        else:
            query = "SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id"
            rows = cast("list[tuple[int, int, bytes]]", self.dbconn.execute(query))
        for topic_id, log_ns, data in rows:
            if topic_id in by_id:
                yield by_id[topic_id], log_ns, data

    def _reconnect(self) -> None:
        """Connect anew: rosbags' `_open` uses a connection of its own, `open` made ours before healing."""
        if self.dbconn:
            self.dbconn.close()
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        self.dbconn = apsw.Connection(f"{self.path.absolute().as_uri()}?immutable=1", flags=flags)

    def _copy(self, files: list[Path]) -> Path:
        """Copy the recording and the `files` beside it; the recording itself is never touched."""
        self._copies = self._copies or tempfile.TemporaryDirectory()
        folder = Path(tempfile.mkdtemp(dir=self._copies.name))
        for file in (self.path, *files):
            shutil.copyfile(file, folder / file.name)
        return folder / self.path.name

    def _whole_pages(self) -> Path:
        """A copy without the page that was cut in two: SQLite would read zeros for the rest of it."""
        copy = self._copy([])
        size = copy.stat().st_size
        with copy.open("r+b") as file:
            page_size = int.from_bytes(file.read(18)[16:], "big")
            page_size = 65536 if page_size == 1 else max(page_size, 512)
            file.truncate(size - size % page_size)
        return copy

    def _healed_copy(self, journals: list[Path]) -> Path:
        """A copy whose journals SQLite has played back."""
        copy = self._copy(journals)
        connection = apsw.Connection(str(copy))
        connection.execute("SELECT count(*) FROM sqlite_master").fetchall()
        connection.execute("PRAGMA journal_mode=DELETE").fetchall()
        connection.close()
        return copy

    def _open_damaged(self) -> None:
        self._damaged = True
        self.break_off = self.break_off or "is truncated"
        self.path = self._whole_pages()
        self._reconnect()
        assert self.dbconn
        # Without it SQLite refuses a file that is shorter than its header says.
        self.dbconn.execute("PRAGMA writable_schema=ON").fetchall()
        definitions = self._definitions()
        query = "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        topics = cast("list[tuple[int, str, str, str]]", self.dbconn.execute(query).fetchall())
        counts: dict[int, int] = {}
        for topic_id, *_ in self._rows_before_break():
            counts[topic_id] = counts.get(topic_id, 0) + 1
        none = MessageDefinition(MessageDefinitionFormat.NONE, "")
        self.connections = [
            Connection(
                topic_id,
                topic,
                msgtype,
                definitions.get(msgtype, none),
                "",
                counts.get(topic_id, 0),
                ConnectionExtRosbag2(serialization, []),
                self,
            )
            for topic_id, topic, msgtype, serialization in topics
        ]

    def _definitions(self) -> dict[str, MessageDefinition]:
        assert self.dbconn
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        try:
            rows = cast("list[tuple[str, str, str]]", self.dbconn.execute(query).fetchall())
        except apsw.Error:  # an old schema has no such table
            return {}
        formats = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
        return {name: MessageDefinition(formats[kind], text) for name, kind, text in rows if kind in formats}

    def _rows_before_break(self) -> Iterator[tuple[int, int, bytes]]:
        """Topic id, log time and message, in the order of writing."""
        assert self.dbconn
        try:
            query = "SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id"
            yield from cast("Iterator[tuple[int, int, bytes]]", self.dbconn.execute(query))
        except apsw.Error as error:
            self.break_off = f"is truncated ({error})"


class Rosbag1File(Rosbag1Reader):
    """A ROS 1 bag."""

    path: Path
    break_off: str | None = None


class BagFolder(DirectoryReader):
    """A rosbag2 folder: the reading of its metadata and the unpacking of its files."""

    STORAGE_PLUGINS = {"mcap": McapFile, "sqlite3": Sqlite3File}  # noqa: RUF012 - declared by the base


def storage_of(path: Path) -> type[McapFile | Sqlite3File | Rosbag1File] | None:
    """What reads the file `path`, by its first bytes."""
    with path.open("rb") as file:
        magic = file.read(len(SQLITE_MAGIC))
    for start, kind in ((MCAP_MAGIC, McapFile), (SQLITE_MAGIC, Sqlite3File), (ROSBAG1_MAGIC, Rosbag1File)):
        if magic.startswith(start):
            return kind
    return None


def merged(files: list[BagFile], wanted: Collection[str]) -> Iterator[Record]:
    """Records on the `wanted` topics of all files in log-time order; equal times keep the files' order."""

    def records(file: BagFile) -> Iterator[Record]:
        connections = [item for item in file.connections if item.topic in wanted]
        return file.messages(connections) if connections else iter(())

    return heapq.merge(*map(records, files), key=lambda record: record[1])

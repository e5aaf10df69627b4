"""A SQLite file of a recording, including one that was not closed or is truncated."""

import shutil
import tempfile
from collections.abc import Collection, Generator, Iterable, Iterator
from pathlib import Path
from typing import cast

import apsw
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from fgtrack.io.errors import LARGEST_BYTES, refuse_larger

_Row = tuple[int, int, bytes, int]
"""Topic id, log time, message (None of one that is too large), its length."""


class Sqlite3File(Sqlite3Reader):
    """A SQLite file; one that was not closed is recovered in a copy, a truncated one is read row by row."""

    path: Path
    break_off: str | None = None
    # Of a message that is too large only its length: reading it would need twice its memory.
    _query = "SELECT topic_id, timestamp, CASE WHEN length(data) <= ? THEN data END, length(data) FROM messages"

    def __init__(self, path: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        super().__init__(path)
        self._largest_bytes = largest_bytes
        self._copies: tempfile.TemporaryDirectory[str] | None = None
        self._damaged = False

    def _open(self) -> None:
        journals = [self.path.with_name(self.path.name + suffix) for suffix in ("-wal", "-journal")]
        left = [journal for journal in journals if journal.exists() and journal.stat().st_size]
        if left:
            self.break_off = f"was not closed by its writer ({left[0].name} is left)"
            self.path = self._recovered_copy(left)
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
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        assert self.dbconn
        by_id = {connection.id: connection for connection in connections}
        rows: Iterable[_Row]
        if self._damaged:
            rows = sorted(self._rows_before_break(), key=lambda row: row[1])
        else:
            query = f"{self._query} ORDER BY timestamp, id"
            rows = cast("Iterator[_Row]", self.dbconn.execute(query, (self._largest_bytes,)))
        for topic_id, log_ns, data, num_bytes in rows:
            if topic_id in by_id:
                if data is None and num_bytes:
                    refuse_larger(num_bytes, f"{self.path}: the message at {log_ns} ns", self._largest_bytes)
                yield by_id[topic_id], log_ns, data

    def _reconnect(self) -> None:
        """Connect anew: rosbags' `_open` uses a connection of its own, `open` made ours before the recovery."""
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

    def _recovered_copy(self, journals: list[Path]) -> Path:
        """A copy to which SQLite has applied the journals."""
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

    def _rows_before_break(self) -> Iterator[_Row]:
        """Rows in the order of writing."""
        assert self.dbconn
        try:
            query = f"{self._query} NOT INDEXED ORDER BY id"
            yield from cast("Iterator[_Row]", self.dbconn.execute(query, (self._largest_bytes,)))
        except apsw.Error as error:
            self.break_off = f"is truncated ({error})"

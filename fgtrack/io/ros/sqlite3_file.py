"""SQLite files of recordings, including those that were not closed or are truncated."""

import shutil
from collections import Counter
from collections.abc import Collection, Iterator
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import apsw
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from fgtrack.core.errors import DataError

_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")
_PAGE_SIZE = slice(16, 18)  # of the header
_ROWS = "SELECT topic_id, timestamp, data FROM messages"


class Sqlite3File:
    """SQLite file; one that was not closed is recovered in a copy, a truncated one is read row by row."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = None
        self._copies: TemporaryDirectory[str] | None = None
        self._base: apsw.Connection | None = None
        self._is_truncated = False

    def open(self) -> None:
        """Open the file and read which connections it holds."""
        journals = [self.path.with_name(self.path.name + suffix) for suffix in ("-wal", "-journal")]
        left = [journal for journal in journals if journal.exists() and journal.stat().st_size]
        path = self._copy(left) if left else self.path
        if left:
            self.break_off = f"was not closed by its writer ({left[0].name} is left)"
            recovering = apsw.Connection(str(path))  # SQLite applies the journals
            recovering.execute("PRAGMA journal_mode=DELETE").fetchall()
            recovering.close()
        try:
            self._connect(path)
            self._read_topics(dict(self._rows("SELECT topic_id, count(*) FROM messages GROUP BY 1")))
        except (apsw.Error, TypeError):
            self.break_off, self._is_truncated = self.break_off or "is truncated", True
            self._connect(self._whole_pages())
            self._read_topics(Counter(topic_id for topic_id, _, _ in self._rows_before_break()))

    def close(self) -> None:
        """Close the file and remove its copies."""
        if self._base:
            self._base.close()
        if self._copies:
            self._copies.cleanup()

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        by_id = {connection.id: connection for connection in connections}
        if self._is_truncated:
            rows = iter(sorted((row for row in self._rows_before_break() if row[0] in by_id), key=itemgetter(1)))
        else:
            rows = self._rows(f"{_ROWS} ORDER BY timestamp, id")
        for topic_id, log_ns, data in rows:
            if topic_id in by_id:
                yield by_id[topic_id], log_ns, data

    def _connect(self, path: Path) -> None:
        if self._base:
            self._base.close()
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        self._base = apsw.Connection(f"{path.absolute().as_uri()}?immutable=1", flags=flags)
        if self._is_truncated:  # SQLite refuses a file that is shorter than its header states
            self._base.execute("PRAGMA writable_schema=ON").fetchall()
        tables = {name for (name,) in self._rows("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"messages", "topics"} <= tables:
            raise DataError(f"{self.path}: is not a recording, it has no tables messages and topics")

    def _rows(self, query: str) -> Iterator[tuple[Any, ...]]:  # columns have the types of their table
        assert self._base
        return iter(self._base.execute(query))

    def _rows_before_break(self) -> Iterator[tuple[Any, ...]]:
        """Rows in the order of writing, up to where the file is cut or a row has no time."""
        try:
            for topic_id, log_ns, data in self._rows(f"{_ROWS} NOT INDEXED"):
                yield topic_id, int(log_ns), bytes(data)
        except (apsw.Error, TypeError, ValueError) as error:
            self.break_off = f"is truncated ({error})"

    def _read_topics(self, counts: dict[int, int]) -> None:
        definitions: dict[str, MessageDefinition] = {}
        if any(self._rows("PRAGMA table_info(message_definitions)")):  # an old schema has none
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions ORDER BY id"
            for name, kind, text in self._rows(query):
                if kind in _FORMATS:
                    definitions.setdefault(name, MessageDefinition(_FORMATS[kind], text))
        self.connections = [
            Connection(
                *(number, topic, kind, definitions.get(kind, _NO_DEFINITION), "", counts.get(number, 0)),
                ConnectionExtRosbag2(serialization, []),
                self,
            )
            for number, topic, kind, serialization in self._rows(
                "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
            )
        ]

    def _copy(self, journals: list[Path]) -> Path:
        """Path of a copy of the file with its journals; the recording itself is never changed."""
        self._copies = self._copies or TemporaryDirectory()
        for file in (self.path, *journals):
            shutil.copyfile(file, Path(self._copies.name) / file.name)
        return Path(self._copies.name) / self.path.name

    def _whole_pages(self) -> Path:
        """Path of a copy without the page that was cut: SQLite would read zeros for the rest of it."""
        copy = self._copy([])
        with copy.open("r+b") as file:
            page_size = int.from_bytes(file.read(_PAGE_SIZE.stop)[_PAGE_SIZE], "big")
            page_size = 65536 if page_size == 1 else max(page_size, 512)
            file.truncate(copy.stat().st_size // page_size * page_size)
        return copy

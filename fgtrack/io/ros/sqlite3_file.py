"""A SQLite file of a recording, including one that was not closed or is truncated."""

import shutil
import tempfile
from array import array
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import cast

import apsw
import numpy as np
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)

from fgtrack.core.errors import DataError
from fgtrack.io.errors import LARGEST_BYTES, refuse_larger

_Row = tuple[int, int, bytes, int, int]
"""Topic id, log time, message (None of one that is too large), its length, id."""

_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_LONGEST_TEXT = 2_000_000  # of a topic or a definition
_STEPS, _STEPS_PER_BYTE, _STEPS_AT_ONCE = 10_000_000, 30, 100_000
"""Of a query: a recording takes less than one step for a byte, a table that contains itself has no end."""
_SUPER_JOURNAL = bytes.fromhex("d9d505f920a163d7")  # behind the name of a file that SQLite would delete


class Sqlite3File:
    """A SQLite file; one that was not closed is recovered in a copy, a truncated one is read row by row.

    What it says is data: tables only, no views, no columns that are computed.
    """

    # Of a message that is too large only its length: reading it would need twice its memory.
    _columns = "topic_id, timestamp, CASE WHEN length(data) <= ? THEN data END, length(data), messages.id"

    def __init__(self, path: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = None
        self.end_time = 0
        """Behind the last log time in ns; 0 where nothing says it."""
        self._largest_bytes = largest_bytes
        self._read_path = path  # the file itself or a copy
        self._copies: tempfile.TemporaryDirectory[str] | None = None
        self._base: apsw.Connection | None = None
        self._steps_left = 0
        self._readable: tuple[array[int], array[int]] | None = None  # times and ids of the rows before a break

    def open(self) -> None:
        """Open the file and read which connections it holds."""
        journals = [self.path.with_name(self.path.name + suffix) for suffix in ("-wal", "-journal")]
        left = [journal for journal in journals if journal.exists() and journal.stat().st_size]
        if left:
            self.break_off = f"was not closed by its writer ({left[0].name} is left)"
            self._read_path = self._recovered_copy(left)
        try:
            self._connect()
            self._read_topics(self._counts())
        except apsw.Error:
            self._open_damaged()

    def close(self) -> None:
        """Close the file and remove its copies."""
        if self._base:
            self._base.close()
        if self._copies:
            self._copies.cleanup()

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Records of `connections` in log-time order; equal times keep the order of writing."""
        by_id = {connection.id: connection for connection in connections}
        rows = self._rows() if self._readable is None else self._rows_before_break(*self._readable)
        for topic_id, log_ns, data, num_bytes, _ in rows:
            if topic_id in by_id:
                if data is None and num_bytes:
                    refuse_larger(num_bytes, f"{self.path}: the message at {log_ns} ns", self._largest_bytes)
                yield by_id[topic_id], log_ns, data

    def _connect(self) -> None:
        if self._base:
            self._base.close()
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        self._base = base = apsw.Connection(f"{self._read_path.absolute().as_uri()}?immutable=1", flags=flags)
        for setting in (
            apsw.SQLITE_DBCONFIG_TRUSTED_SCHEMA,
            apsw.SQLITE_DBCONFIG_ENABLE_VIEW,
            apsw.SQLITE_DBCONFIG_ENABLE_TRIGGER,
        ):
            base.config(setting, 0)
        base.limit(apsw.SQLITE_LIMIT_LENGTH, max(_LONGEST_TEXT, self._largest_bytes))
        base.set_progress_handler(self._is_too_long, _STEPS_AT_ONCE)

    def _is_too_long(self) -> bool:
        self._steps_left -= _STEPS_AT_ONCE
        return self._steps_left < 0

    def _query(self, query: str, *values: int) -> Iterator[tuple[object, ...]]:
        """Rows of a query. Raises `DataError` where it takes longer than for any recording of this size."""
        assert self._base
        self._steps_left = _STEPS + _STEPS_PER_BYTE * self._read_path.stat().st_size
        try:
            yield from self._base.execute(query, values)
        except apsw.InterruptError as error:
            raise DataError(f"{self.path}: holds more rows than a file of its size, repair or convert it") from error

    def _check_tables(self) -> set[str]:
        """Names of the tables of a recording that are there, in lower case. Raises `DataError` where one is none."""
        found = set()
        for name, kind, root in self._query("SELECT name, type, rootpage FROM sqlite_master LIMIT 10000"):
            lower = str(name).lower()
            if kind not in ("table", "view") or lower not in ("messages", "topics", "message_definitions"):
                continue
            columns = self._query(f"PRAGMA table_xinfo({lower})")
            if kind != "table" or not root or any(column[-1] for column in columns):  # a view, virtual, computed
                raise DataError(f"{self.path}: {lower} is no plain table, that of no recording is computed")
            found.add(lower)
        if not found.issuperset(("messages", "topics")):
            raise DataError(f"{self.path}: has no tables messages and topics, it is no recording")
        return found

    def _counts(self) -> dict[object, int]:
        """Number of messages by topic id."""
        self._check_tables()
        counts = {}
        for topic_id, count, last in self._query("SELECT topic_id, count(*), max(timestamp) FROM messages GROUP BY 1"):
            counts[topic_id] = cast("int", count)
            self.end_time = max(self.end_time, last + 1 if isinstance(last, int) else 0)
        return counts

    def _read_topics(self, counts: dict[object, int]) -> None:
        definitions = self._definitions()
        none = MessageDefinition(MessageDefinitionFormat.NONE, "")
        for topic_id, *texts in self._texts("SELECT id, name, type, serialization_format FROM topics ORDER BY id"):
            topic, msgtype, serialization = cast("list[str]", texts)
            self.connections.append(
                Connection(
                    cast("int", topic_id),
                    topic,
                    msgtype,
                    definitions.get(msgtype, none),
                    "",
                    counts.get(topic_id, 0),
                    ConnectionExtRosbag2(serialization, []),
                    self,
                )
            )

    def _definitions(self) -> dict[str, MessageDefinition]:
        if "message_definitions" not in self._check_tables():  # an old schema has none
            return {}
        query = "SELECT 0, topic_type, encoding, encoded_message_definition FROM message_definitions ORDER BY id"
        found: dict[str, MessageDefinition] = {}
        for _, *texts in self._texts(query):
            name, kind, text = cast("list[str]", texts)
            if kind in _FORMATS:
                found.setdefault(name, MessageDefinition(_FORMATS[kind], text))
        return found

    def _texts(self, query: str) -> Iterator[tuple[object, ...]]:
        """Rows of an id and texts, which are together no larger than a message."""
        num_bytes = 0
        assert self._base
        limit = self._base.limit(apsw.SQLITE_LIMIT_LENGTH, _LONGEST_TEXT)
        try:
            for row in self._query(query):
                if type(row[0]) is not int or not all(type(value) is str for value in row[1:]):
                    raise DataError(f"{self.path}: a topic or a definition in it is no text")
                num_bytes += sum(len(cast("str", value)) for value in row[1:])
                refuse_larger(num_bytes, f"{self.path}: what it says of its topics", self._largest_bytes)
                yield row
        finally:
            self._base.limit(apsw.SQLITE_LIMIT_LENGTH, limit)

    def _rows(self) -> Iterator[_Row]:
        order = "ORDER BY timestamp, messages.id"
        query = f"SELECT {self._columns} FROM messages {order}"
        plan = self._query(f"EXPLAIN QUERY PLAN {query}", self._largest_bytes)
        if any("TEMP B-TREE" in str(step[-1]) for step in plan):  # without an index SQLite would sort the messages too
            query = (
                f"WITH sorted AS MATERIALIZED (SELECT id FROM messages {order}) "
                f"SELECT {self._columns} FROM sorted CROSS JOIN messages ON messages.id = sorted.id"
            )
        return cast("Iterator[_Row]", self._query(query, self._largest_bytes))

    def _copy(self, files: Iterable[Path]) -> Path:
        """Copy the recording and the `files` beside it; the recording itself is never touched."""
        self._copies = self._copies or tempfile.TemporaryDirectory()
        folder = Path(tempfile.mkdtemp(dir=self._copies.name))
        for file in (self._read_path, *files):
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
        most_bytes = sum(file.stat().st_size for file in (self.path, *journals))
        copy = self._copy(journals)
        for journal in journals:
            _forget_super_journal(copy.with_name(journal.name))
        connection = apsw.Connection(str(copy))
        connection.execute("SELECT count(*) FROM sqlite_master").fetchall()
        connection.execute("PRAGMA journal_mode=DELETE").fetchall()
        connection.close()
        if copy.stat().st_size > most_bytes:
            raise DataError(f"{self.path}: {journals[0].name} beside it is damaged, remove it to read what there is")
        return copy

    def _open_damaged(self) -> None:
        self.break_off = self.break_off or "is truncated"
        self._read_path = self._whole_pages()
        self._connect()
        assert self._base
        # Without it SQLite refuses a file that is shorter than its header says.
        self._base.execute("PRAGMA writable_schema=ON").fetchall()
        self._check_tables()
        times, ids = array("q"), array("q")
        counts: dict[object, int] = {}
        query = f"SELECT {self._columns} FROM messages NOT INDEXED ORDER BY id"
        try:
            for topic_id, log_ns, _, _, row_id in self._query(query, self._largest_bytes):
                times.append(cast("int", log_ns))
                ids.append(cast("int", row_id))
                counts[topic_id] = counts.get(topic_id, 0) + 1
        except (apsw.Error, TypeError) as error:  # a time that is none is a break as well
            self.break_off = f"is truncated ({error})"
        self._readable = times, ids
        self.connections = []
        self._read_topics(counts)

    def _rows_before_break(self, times: "array[int]", ids: "array[int]") -> Iterator[_Row]:
        query = f"SELECT {self._columns} FROM messages WHERE id = ?"
        for place in np.argsort(np.frombuffer(times, np.int64), kind="stable").tolist():
            yield from cast("Iterator[_Row]", self._query(query, self._largest_bytes, ids[place]))


def _forget_super_journal(journal: Path) -> None:
    """Cut the end of `journal`, where it names a file that SQLite would delete: a recorder writes a file only."""
    size = journal.stat().st_size
    with journal.open("r+b") as file:
        file.seek(max(0, size - len(_SUPER_JOURNAL)))
        if file.read() == _SUPER_JOURNAL:
            file.truncate(size - len(_SUPER_JOURNAL))

"""SQLite files of recordings, also files that were not closed or are truncated."""

import shutil
from collections.abc import Collection, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import apsw
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)

_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
}
_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")
#: Bytes of the header that contain the page size.
_PAGE_SIZE = slice(16, 18)
_TABLES = {
    "topics": "id, name, type, serialization_format",
    "messages": "id, topic_id, timestamp, data",
    "message_definitions": "topic_type, encoding, encoded_message_definition",
}


class Sqlite3File:
    """SQLite file. A file that was not closed is read from a copy; a truncated file is copied row by row."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []
        self.break_off: str | None = None
        self._copies = TemporaryDirectory()
        self._base = apsw.Connection("")  # a temporary database

    def open(self) -> None:
        """Open the file and read its connections."""
        files = [
            self.path.with_name(self.path.name + suffix)
            for suffix in ("-wal", "-journal")
        ]
        journals = [file for file in files if file.exists() and file.stat().st_size]
        base = apsw.Connection(
            f"{self.path.absolute().as_uri()}?immutable=1",
            apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI,
        )
        if journals:
            self.break_off = (
                f"was not closed by its writer ({journals[0].name} remains)"
            )
            # SQLite applies the journals to the copy.
            base = apsw.Connection(str(self._copy(*journals)))
        try:
            self._read_topics(base)
        except apsw.Error:
            self._recover()
            self._read_topics(self._base)

    def close(self) -> None:
        """Close the file and remove its copies."""
        self._base.close()
        self._copies.cleanup()

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, log time and data of the messages of `connections`, in the order of log time.

        Messages with equal times keep their order in the file.
        """
        by_id = {connection.id: connection for connection in connections}
        query = "SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id"
        for topic_id, log_ns, data in self._base.execute(query):
            if topic_id in by_id:
                yield by_id[topic_id], log_ns, data

    def _read_topics(self, base: apsw.Connection) -> None:
        # This query raises for a truncated file.
        base.execute("SELECT topic_id, count(*) FROM messages GROUP BY 1").fetchall()
        definitions: dict[str, MessageDefinition] = {}
        # Old schemas have no table of definitions.
        if any(base.execute("PRAGMA table_info(message_definitions)")):
            for name, kind, text in base.execute(
                f"SELECT {_TABLES['message_definitions']} FROM message_definitions"
            ):
                if kind in _FORMATS:
                    definitions.setdefault(
                        name, MessageDefinition(_FORMATS[kind], text)
                    )
        self.connections = [
            Connection(
                *(number, topic, kind, definitions.get(kind, _NO_DEFINITION), "", 0),
                ConnectionExtRosbag2(serialization, []),
                self,
            )
            for number, topic, kind, serialization in base.execute(
                f"SELECT {_TABLES['topics']} FROM topics ORDER BY id"
            )
        ]
        self._base = base

    def _recover(self) -> None:
        """Copy the rows in the order of writing, up to the truncation."""
        copy = self._copy()
        # The incomplete page is removed, because SQLite would read zeros for its missing bytes.
        with copy.open("r+b") as file:
            page_size = int.from_bytes(file.read(_PAGE_SIZE.stop)[_PAGE_SIZE], "big")
            page_size = 65536 if page_size == 1 else max(page_size, 512)
            file.truncate(copy.stat().st_size // page_size * page_size)
        source = apsw.Connection(str(copy))
        # Otherwise SQLite refuses a file that is shorter than its header states.
        source.execute("PRAGMA writable_schema=ON").fetchall()
        self._base.execute("BEGIN")
        for name, columns in _TABLES.items():
            self._base.execute(f"CREATE TABLE {name} ({columns})")
            insert = (
                f"INSERT INTO {name} VALUES ({', '.join('?' for _ in columns.split())})"
            )
            try:
                self._base.executemany(
                    insert, source.execute(f"SELECT {columns} FROM {name} NOT INDEXED")
                )
            except apsw.Error as error:
                self.break_off = self.break_off or f"is truncated ({error})"
        source.close()

    def _copy(self, *journals: Path) -> Path:
        """Copy the file with its journals and return the copy's path; the recording itself is never changed."""
        for file in (self.path, *journals):
            shutil.copyfile(file, Path(self._copies.name) / file.name)
        return Path(self._copies.name) / self.path.name

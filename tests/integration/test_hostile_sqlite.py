"""SQLite recordings whose tables compute, and journals that name the files of others."""

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from faults.cases import Server
from support.messages import drive

from fgtrack.core.errors import DataError
from fgtrack.io.errors import TruncatedInput
from fgtrack.io.info import describe
from fgtrack.io.ros import sqlite3_file
from fgtrack.io.ros.bag_writer import write_bag
from fgtrack.io.source import open_input

MOST_MB, LONGEST_S = 1000.0, 20.0
_ENDLESS = "WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM r)"
_TOPICS = "type, serialization_format, offered_qos_profiles, type_description_hash FROM t2"
_MESSAGES = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER"
HOSTILE = {
    "messages without end": (
        "ALTER TABLE messages RENAME TO m2;"
        f"CREATE VIEW messages AS {_ENDLESS} "
        "SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(10) AS data FROM r",
        "messages is no plain table",
    ),
    "topics of a gigabyte": (
        "ALTER TABLE topics RENAME TO t2;"
        f"CREATE VIEW topics AS SELECT id, name || hex(zeroblob(450000000)) AS name, {_TOPICS}",
        "topics is no plain table",
    ),
    "definitions of a gigabyte": (
        "DROP TABLE message_definitions; CREATE VIEW message_definitions AS SELECT 1 AS id, 'a' AS topic_type, "
        "'ros2msg' AS encoding, hex(zeroblob(450000000)) AS encoded_message_definition",
        "message_definitions is no plain table",
    ),
    "a schema without end": (
        f"DROP TABLE schema; CREATE VIEW schema AS {_ENDLESS} SELECT max(i) AS schema_version FROM r",
        "fgtrack/truth",
    ),
    "messages that are computed": (
        f"DROP TABLE messages; CREATE TABLE messages ({_MESSAGES}, data BLOB AS (zeroblob(900000000)));"
        "INSERT INTO messages VALUES (1, 1, 1)",
        "messages is no plain table",
    ),
    "a virtual table": (
        "DROP TABLE topics; CREATE VIRTUAL TABLE topics USING fts5(id, name, type, serialization_format)",
        "topics is no plain table",
    ),
    "a large name": ("UPDATE topics SET name = hex(zeroblob(200000000)) WHERE id = 1", "too big"),
    "qualities of aliases": (
        "UPDATE topics SET offered_qos_profiles = '" + "[" * 100_000 + "'",
        "fgtrack/truth",
    ),
    "a name that is none": ("UPDATE topics SET name = x'00' WHERE id = 1", "is no text"),
    "no messages": ("DROP TABLE messages", "has no tables messages and topics"),
    "large messages without an index": (
        "DROP INDEX timestamp_idx; UPDATE messages SET data = zeroblob(100000000) WHERE id < 12",
        "fgtrack/truth",
    ),
}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def bag(folder: Path) -> Path:
    write_bag(folder / "bag", drive(), "sqlite3")
    (file,) = (folder / "bag").glob("*.db3")
    return file


def changed(file: Path, script: str) -> None:
    with closing(sqlite3.connect(file)) as base:
        base.executescript(script)
        base.commit()


@pytest.mark.parametrize("name", HOSTILE)
def test_a_table_that_computes_is_refused(server: Server, tmp_path: Path, name: str) -> None:
    script, said = HOSTILE[name]
    changed(bag(tmp_path), script)
    done = server(("info", "bag"), tmp_path, kill_after_s=120.0)
    assert done.peak_mb < MOST_MB
    assert done.cpu_s < LONGEST_S
    assert done.code in (0, 1)
    assert said in " ".join(done.said.split())


@pytest.mark.parametrize("script", ["DROP INDEX timestamp_idx", "DROP TABLE message_definitions", "DROP TABLE schema"])
def test_what_no_reader_needs_may_be_missing(tmp_path: Path, script: str) -> None:
    file = bag(tmp_path)
    changed(file, script)
    assert list(open_input(file).messages()) == drive()


def test_rows_without_an_index_come_in_the_order_of_time_and_writing(tmp_path: Path) -> None:
    file = bag(tmp_path)
    changed(file, "DROP INDEX timestamp_idx; UPDATE messages SET id = 1000000 - id")
    by_time = sorted(drive(), key=lambda message: message.receipt_ns)
    found = list(open_input(file).messages())
    assert [message.receipt_ns for message in found] == [message.receipt_ns for message in by_time]


def test_a_table_with_more_rows_than_its_file_can_hold_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = bag(tmp_path)
    for name, value in {"_STEPS": 1_000, "_STEPS_PER_BYTE": 0, "_STEPS_AT_ONCE": 100}.items():
        monkeypatch.setattr(sqlite3_file, name, value)
    with pytest.raises(DataError, match="holds more rows than a file of its size"):
        open_input(file)


def test_a_file_that_is_cut_is_named_as_the_user_knows_it(tmp_path: Path) -> None:
    file = bag(tmp_path)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(TruncatedInput) as caught:
        list(open_input(file).messages())
    assert str(caught.value).startswith(f"{file} is truncated")
    problem = describe(file).problem
    assert problem is not None
    assert problem.startswith(f"{file} is truncated")


def test_a_journal_that_names_a_file_does_not_delete_it(tmp_path: Path) -> None:
    file = bag(tmp_path)
    victim = tmp_path / "victim.txt"
    victim.write_text("mine")
    name = str(victim).encode()
    pages = file.stat().st_size // 4096
    header = bytes.fromhex("d9d505f920a163d7") + struct.pack(">IIIII", 0, 1, pages, 512, 4096)
    locking_page = (1 << 30) // 4096 + 1
    end = struct.pack(">I", locking_page) + name + struct.pack(">II", len(name), sum(name)) + header[:8]
    file.with_name(file.name + "-journal").write_bytes(header.ljust(512, b"\0") + end)
    before = file.read_bytes()
    with pytest.raises(TruncatedInput, match=r"was not closed by its writer"):
        list(open_input(file).messages())
    assert victim.read_text() == "mine"
    assert file.read_bytes() == before
    sqlite3_file._forget_super_journal(file.with_name(file.name + "-journal"))
    with closing(sqlite3.connect(file)) as base:  # an older SQLite than that of the reader, which deletes it
        base.execute("SELECT count(*) FROM sqlite_master").fetchall()
    assert victim.read_text() == "mine"

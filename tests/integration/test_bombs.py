"""A few bytes that stand for gigabytes are refused in little memory; what breaks off is read as far as it goes."""

import gzip
import json
import re
import sqlite3
import struct
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import lz4.frame
import pytest
import zstandard as zstd
from support.mcap import END, record, text
from support.messages import drive

from fgtrack.core.errors import DataError
from fgtrack.core.types import Message
from fgtrack.io.config import InputConfig
from fgtrack.io.info import describe
from fgtrack.io.ros.bag_writer import write_bag
from fgtrack.io.ros.mcap_file import MCAP_MAGIC
from fgtrack.io.source import open_input

SMALL = InputConfig(largest_mb=1.0, most_objects=1000)
BOMB = bytes(30_000_000)
HEADER = json.dumps({"type": "header", "format": "fgtrack-stream/1"}).encode() + b"\n"


@contextmanager
def little_memory() -> Iterator[None]:
    """What is done here takes no half of what a bomb unpacks to."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < len(BOMB) / 2
    finally:
        tracemalloc.stop()


def refused(path: Path, what: str) -> None:
    with little_memory(), pytest.raises(DataError, match=what) as caught:
        list(open_input(path, SMALL).messages())
    assert "input." in str(caught.value)
    with little_memory():
        try:
            told = str(describe(path, SMALL).problem)
        except DataError as error:
            told = str(error)
    assert re.search(what, told)


def drive_as(folder: Path, storage: str, messages: list[Message] | None = None) -> Path:
    write_bag(folder / "bag", drive() if messages is None else messages, storage)
    (file,) = (file for file in (folder / "bag").iterdir() if file.suffix != ".yaml")
    return file


def test_a_long_line(tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl.gz"
    path.write_bytes(gzip.compress(HEADER) + gzip.compress(BOMB.replace(b"\0", b" ")))
    refused(path, r"x\.jsonl\.gz:2: is larger than 1 MB")


def test_a_list_with_more_objects_than_allowed(tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    record = {
        "type": "detections",
        "sensor": "a",
        "stamp_ns": 1,
        "receipt_ns": 1,
        "objects": [{"x_m": 1.0, "y_m": 1.0}] * 1001,
    }
    path.write_bytes(HEADER + json.dumps(record).encode())
    with pytest.raises(DataError, match=r"a list of 1001 objects, more than input\.most_objects allows"):
        list(open_input(path, SMALL).messages())


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_of_an_mcap_file(tmp_path: Path, compression: str) -> None:
    """The memory of the process bounds what it unpacks to."""
    packed = {"zstd": zstd.compress, "lz4": lz4.frame.compress}[compression](BOMB[:1_000_000])
    for stated in (0, 2**63):
        chunk = struct.pack("<QQQI", 1, 1, stated, 0) + text(compression) + struct.pack("<Q", len(packed)) + packed
        path = tmp_path / "x.mcap"
        path.write_bytes(MCAP_MAGIC + record(0x01, text("ros2") + text("")) + record(0x06, chunk) + END)
        with pytest.raises((DataError, MemoryError)):
            list(open_input(path, SMALL).messages())


def test_a_packed_message(tmp_path: Path) -> None:
    file = drive_as(tmp_path, "sqlite3")
    with sqlite3.connect(file) as base:
        base.execute("update messages set data = ? where id = 17", (zstd.compress(BOMB),))
    base.close()
    refused(tmp_path / "bag", r"the message on \S+ at \d+ ns: is larger than 1 MB")


def test_a_packed_file(tmp_path: Path) -> None:
    file = drive_as(tmp_path, "mcap")
    file.with_name(f"{file.name}.zstd").write_bytes(zstd.compress(bytes(200_000_000)))
    metadata = tmp_path / "bag/metadata.yaml"
    changes = {
        file.name: f"{file.name}.zstd",
        "compression_mode: ''": "compression_mode: FILE",
        "compression_format: ''": "compression_format: zstd",
    }
    content = metadata.read_text()
    for old, new in changes.items():
        assert old in content
        content = content.replace(old, new)
    metadata.write_text(content)
    with pytest.raises(DataError, match="decompresses to more than 100 times its size"):
        open_input(tmp_path / "bag")

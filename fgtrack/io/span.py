"""When an input ends, so that a replay can say how far it has come."""

import gzip
import json
import os
from collections import deque
from contextlib import suppress
from pathlib import Path

from fgtrack.core.errors import FgtrackError
from fgtrack.io.ros.bag import Bag
from fgtrack.io.source import InputSource
from fgtrack.io.stream import GZIP_MAGIC

_TAIL = 1 << 16
_LARGEST_GZIP = 1 << 26  # of which the end is sought, which takes a second


def end_ns(source: InputSource) -> int | None:
    """About the receipt of the last message of `source`; None where that cannot be known without much reading.

    A recording says it in its index, a stream in its last line; data sets, which are small, are read.
    """
    with suppress(FgtrackError, OSError, ValueError, KeyError, EOFError):
        if source.kind == "recording":
            return Bag(source.path).end_ns()
        if source.kind == "stream":
            return _last_receipt_ns(source.path)
        last = deque(source.messages(), maxlen=1)
        return last[0].receipt_ns if last else None
    return None


def _last_receipt_ns(path: Path) -> int | None:
    """Receipt of the last whole record of a stream."""
    tail = _gzip_tail(path) if _head(path) == GZIP_MAGIC else _tail(path)
    lines = tail.split(b"\n")
    receipts = [
        json.loads(line)["receipt_ns"] for line in lines[-200:] if line.endswith(b"}") and b"receipt_ns" in line
    ]
    return max(receipts, default=None)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(GZIP_MAGIC))


def _tail(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
        return file.read()


def _gzip_tail(path: Path) -> bytes:
    if path.stat().st_size > _LARGEST_GZIP:
        return b""
    tail = b""
    with gzip.open(path) as file:
        while block := file.read(1 << 20):
            tail = (tail + block)[-_TAIL:]
    return tail

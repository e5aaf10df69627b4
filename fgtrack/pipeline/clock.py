"""The replay clock: which messages have arrived at which tick."""

import gzip
import json
import zlib
from collections.abc import Iterable, Iterator
from itertools import groupby, pairwise
from pathlib import Path
from typing import BinaryIO, NamedTuple

from fgtrack.core.checks import is_stamp
from fgtrack.core.errors import CallError
from fgtrack.core.files import open_file
from fgtrack.core.time import first_multiple, period_ns
from fgtrack.core.types import DetectionList, EgoState
from fgtrack.io.stream import GZIP_MAGIC

Delivered = EgoState | DetectionList

_LARGEST_BYTES = 1 << 28  # of ticks, unpacked: two days at 50 Hz
_LONGEST_LINE = 1 << 20


class Tick(NamedTuple):
    """A tick and what arrived since the one before."""

    now_ns: int
    messages: list[Delivered]


def node_ticks(messages: Iterable[Delivered], node_hz: float) -> Iterator[Tick]:
    """Ticks on multiples of the node period, from the first at or after the first receipt until all is delivered.

    What was received at or before a tick is delivered with it.
    """
    step_ns = period_ns(node_hz)
    next_ns: int | None = None
    for due_ns, delivered in groupby(messages, lambda message: first_multiple(message.receipt_ns, step_ns)):
        for now_ns in range(due_ns if next_ns is None else next_ns, due_ns, step_ns):
            yield Tick(now_ns, [])
        yield Tick(due_ns, list(delivered))
        next_ns = due_ns + step_ns


def message_ticks(messages: Iterable[Delivered]) -> Iterator[Tick]:
    """A tick at every receipt; what was received at the same nanosecond shares one."""
    for now_ns, delivered in groupby(messages, lambda message: message.receipt_ns):
        yield Tick(now_ns, list(delivered))


def listed_ticks(messages: Iterable[Delivered], ticks_ns: Iterable[int]) -> Iterator[Tick]:
    """The given ticks, and one more at the last receipt if something is left for it."""
    source = iter(messages)
    pending = next(source, None)
    for now_ns in ticks_ns:
        waiting = []
        while pending is not None and pending.receipt_ns <= now_ns:
            waiting.append(pending)
            pending = next(source, None)
        yield Tick(now_ns, waiting)
    rest = [] if pending is None else [pending, *source]
    if rest:
        yield Tick(rest[-1].receipt_ns, rest)


def read_ticks(path: Path) -> list[int]:
    """The `now_ns` of every line of a JSON-lines file, plain or gzip, ascending.

    Raises `CallError` where the file is missing or too large, or says something else.
    """
    try:
        ticks = [_now_ns(line) for line in _lines(path)]
    except CallError:
        raise
    except OSError as error:
        raise CallError(f"{path}: ticks cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, TypeError, EOFError, RecursionError, zlib.error) as error:
        raise CallError(
            f"{path}: no list of ticks, every line must be an object with now_ns, an integer of 64 bits"
        ) from error
    if not all(before < after for before, after in pairwise(ticks)):
        raise CallError(f"{path}: the ticks are not ascending")
    return ticks


def _lines(path: Path) -> Iterator[bytes]:
    """The lines of `path`, unpacked up to a size that fits into memory."""
    with open_file(path) as raw:
        packed = raw.read(len(GZIP_MAGIC)) == GZIP_MAGIC
        raw.seek(0)
        file: BinaryIO | gzip.GzipFile = gzip.GzipFile(fileobj=raw) if packed else raw
        left = _LARGEST_BYTES
        while line := file.readline(_LONGEST_LINE + 1):
            left -= len(line)
            if left < 0:
                raise CallError(f"{path}: more than {_LARGEST_BYTES >> 20} MB of ticks, replay the recording in parts")
            if len(line) > _LONGEST_LINE:
                raise CallError(f"{path}: a line of ticks with more than {_LONGEST_LINE} bytes, only now_ns is needed")
            yield line


def _now_ns(line: bytes) -> int:
    now_ns = json.loads(line.decode())["now_ns"]
    if type(now_ns) is not int or not is_stamp(now_ns):
        raise ValueError(f"{str(now_ns)[:50]} is no time")
    return now_ns

"""The replay clock: which messages have arrived at which tick."""

import gzip
import json
import zlib
from collections.abc import Iterable, Iterator
from itertools import groupby, pairwise
from pathlib import Path
from typing import NamedTuple

from fgtrack.core.errors import CallError
from fgtrack.core.time import first_multiple, period_ns
from fgtrack.core.types import DetectionList, EgoState

Delivered = EgoState | DetectionList


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

    Raises `CallError` where the file is missing or says something else.
    """
    try:
        raw = path.read_bytes()
        text = (gzip.decompress(raw) if raw[:2] == b"\x1f\x8b" else raw).decode("utf-8")
        ticks = [int(json.loads(line)["now_ns"]) for line in text.splitlines()]
    except OSError as error:
        raise CallError(f"{path}: ticks cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, TypeError, EOFError, zlib.error) as error:
        raise CallError(f"{path}: no list of ticks, every line must be an object with now_ns") from error
    if not all(before < after for before, after in pairwise(ticks)):
        raise CallError(f"{path}: the ticks are not ascending")
    return ticks

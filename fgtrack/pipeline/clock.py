"""Time in a replay: ticks of the node, and the messages of each."""

from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import NamedTuple

from fgtrack.core.time import period_ns
from fgtrack.core.types import DetectionList, EgoState

Delivered = EgoState | DetectionList


class Tick(NamedTuple):
    """A tick and the messages since the previous tick."""

    now_ns: int
    messages: list[Delivered]


def clock_ticks(messages: Iterable[Delivered], node_hz: float | None) -> Iterator[Tick]:
    """Yield ticks at multiples of the node period, from the first receipt until all messages are delivered.

    Messages received at or before a tick are delivered with it. Without `node_hz` every
    distinct receipt is a tick.
    """
    step_ns = 1 if node_hz is None else period_ns(node_hz)
    next_ns: int | None = None
    for due_ns, delivered in groupby(
        messages, lambda message: -(-message.receipt_ns // step_ns) * step_ns
    ):
        if node_hz is not None and next_ns is not None:
            for now_ns in range(next_ns, due_ns, step_ns):
                yield Tick(now_ns, [])
        yield Tick(due_ns, list(delivered))
        next_ns = due_ns + step_ns


def busy_ticks(ticks: Iterable[Tick]) -> Iterator[Tick]:
    """Yield the ticks that deliver a list, and a last tick for the messages after the last list.

    The messages of an omitted tick are delivered with the next tick. An empty list is a
    list: it reports that no object was detected.
    """
    waiting: list[Delivered] = []
    now_ns = 0
    for now_ns, messages in ticks:
        waiting += messages
        if any(isinstance(message, DetectionList) for message in messages):
            yield Tick(now_ns, waiting)
            waiting = []
    if waiting:
        yield Tick(now_ns, waiting)


def with_last(ticks: Iterable[Tick]) -> Iterator[tuple[Tick, bool]]:
    """Yield each tick, with True for the last one."""
    before: Tick | None = None
    for tick in ticks:
        if before is not None:
            yield before, False
        before = tick
    if before is not None:
        yield before, True

"""Ticks at given times, such as those of the published node."""

from collections.abc import Iterable, Iterator

from fgtrack.pipeline.clock import Delivered, Tick


def listed_ticks(
    messages: Iterable[Delivered], ticks_ns: Iterable[int]
) -> Iterator[Tick]:
    """The given ticks, and one more at the last receipt if something is left for it."""
    left = list(messages)
    for now_ns in ticks_ns:
        count = next(
            (k for k, message in enumerate(left) if message.receipt_ns > now_ns),
            len(left),
        )
        yield Tick(now_ns, left[:count])
        del left[:count]
    if left:
        yield Tick(left[-1].receipt_ns, left)

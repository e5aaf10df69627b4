"""Merges lists of one detection each into scans."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, Message
from fgtrack.inputs.errors import UntilBreak

#: Time after the receipt of a scan's last detection at which the scan is complete.
_LONGEST_NS = NS_PER_S


def grouped(
    messages: Iterable[Message], windows_ns: Mapping[str, int]
) -> Iterator[Message]:
    """Yield `messages` in receipt order, with the lists of the sensors in `windows_ns` merged into scans.

    Lists whose stamps differ from the first by at most the window make a scan, which is
    received with its last list. If the input breaks off, open scans are yielded before
    the error is raised.
    """
    # A message, or the lists of a scan, by the index of the last one.
    waiting: dict[int, list[Message]] = {}
    # Index of the open scan of each sensor.
    newest: dict[str, int] = {}
    readable = UntilBreak(messages)
    for index, message in enumerate(readable):
        group: list[Message] = []
        if (
            isinstance(message, DetectionList)
            and (window_ns := windows_ns.get(message.sensor)) is not None
        ):
            scan = waiting.get(newest.get(message.sensor, -1), [])
            if (
                scan
                and _is_recent(scan, message)
                and abs(message.stamp_ns - scan[0].stamp_ns) <= window_ns
            ):
                group = waiting.pop(newest[message.sensor])
            newest[message.sensor] = index
        waiting[index] = [*group, message]
        for first in list(waiting):
            if first in newest.values() and _is_recent(waiting[first], message):
                break
            yield _joined(waiting.pop(first))
    yield from map(_joined, waiting.values())
    readable.raise_error()


def _is_recent(scan: list[Message], message: Message) -> bool:
    return message.receipt_ns - scan[-1].receipt_ns <= _LONGEST_NS


def _joined(group: list[Message]) -> Message:
    """Merge lists into a scan: mean stamp, receipt of the last list; each detection keeps its list's stamp."""
    lists = [each for each in group if isinstance(each, DetectionList)]
    if len(lists) <= 1:
        return group[0]
    first_ns = lists[0].stamp_ns
    mean_ns = first_ns + sum(each.stamp_ns - first_ns for each in lists) // len(lists)
    stamps_differ = any(each.stamp_ns != first_ns for each in lists)
    objects = [
        replace(item, stamp_ns=each.stamp_ns)
        if stamps_differ and item.stamp_ns is None
        else item
        for each in lists
        for item in each.objects
    ]
    left_out = [name for each in lists for name in each.left_out]
    return replace(
        lists[-1], stamp_ns=mean_ns, objects=objects, left_out=tuple(left_out)
    )

"""Scans of detections that come one per message."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, Message
from fgtrack.inputs.errors import UntilBreak

_LONGEST_NS = (
    NS_PER_S  # after the last detection of a scan, in receipts: it is complete then
)


def grouped(
    messages: Iterable[Message], windows_ns: Mapping[str, int]
) -> Iterator[Message]:
    """`messages`, in the order of receipt, with the lists of the sensors in `windows_ns` joined to scans.
    Lists with stamps at most the window from the first are a scan, received with the last; a break follows open scans.
    """
    waiting: dict[
        int, list[Message]
    ] = {}  # a message, or the lists of a scan, by the index of the last
    newest: dict[
        str, int
    ] = {}  # index of the scan of every sensor to which lists are added
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
    """The scan: the mean stamp of its lists, the last receipt, and of every detection its own stamp."""
    lists = [each for each in group if isinstance(each, DetectionList)]
    if len(lists) <= 1:
        return group[0]
    first_ns = lists[0].stamp_ns
    mean_ns = first_ns + sum(each.stamp_ns - first_ns for each in lists) // len(lists)
    is_own = any(each.stamp_ns != first_ns for each in lists)
    objects = [
        replace(item, stamp_ns=each.stamp_ns)
        if is_own and item.stamp_ns is None
        else item
        for each in lists
        for item in each.objects
    ]
    left_out = [name for each in lists for name in each.left_out]
    return replace(
        lists[-1], stamp_ns=mean_ns, objects=objects, left_out=tuple(left_out)
    )

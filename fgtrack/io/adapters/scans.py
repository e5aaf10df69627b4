"""Detections that come one per message, put together to the scans that they are of."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, Message

__all__ = ["grouped"]

_LONGEST_NS = NS_PER_S  # after the last detection of a scan, in receipts: it is complete then


@dataclass(eq=False)
class _Scan:
    """Lists of one scan, whose place in the order of receipt is that of the last one."""

    lists: list[DetectionList]
    is_open: bool = True

    def joined(self) -> DetectionList:
        """The scan: the mean stamp of its lists, the last receipt, and of every detection its own stamp."""
        stamps_ns = [one.stamp_ns for one in self.lists]
        same = min(stamps_ns) == max(stamps_ns)
        objects: list[Detection] = []
        for one in self.lists:
            objects += one.objects if same else [_stamped(item, one.stamp_ns) for item in one.objects]
        last = self.lists[-1]
        mean_ns = stamps_ns[0] + sum(stamp - stamps_ns[0] for stamp in stamps_ns) // len(stamps_ns)
        left_out = tuple(chain.from_iterable(one.left_out for one in self.lists))
        return DetectionList(last.sensor, mean_ns, last.receipt_ns, objects, last.frame, left_out)


def _stamped(item: Detection, stamp_ns: int) -> Detection:
    return item if item.stamp_ns is not None else replace(item, stamp_ns=stamp_ns)


def grouped(messages: Iterable[Message], windows_ns: Mapping[str, int]) -> Iterator[Message]:
    """`messages`, in the order of receipt, with the lists of the sensors in `windows_ns` joined to scans.

    Lists whose stamps are at most the window from the first one's are one scan; it is received with its last list.
    Whatever ends `messages` in a `DataError`, the scans that are open then come before it.
    """
    scans: dict[str, _Scan] = {}
    waiting: list[Message | _Scan] = []
    error: DataError | None = None

    def ready() -> Iterator[Message]:
        while waiting and not (isinstance(waiting[0], _Scan) and waiting[0].is_open):
            first = waiting.pop(0)
            yield first.joined() if isinstance(first, _Scan) else first

    try:
        for message in messages:
            for scan in scans.values():
                scan.is_open &= message.receipt_ns - scan.lists[-1].receipt_ns <= _LONGEST_NS
            if isinstance(message, DetectionList) and (window_ns := windows_ns.get(message.sensor)) is not None:
                scan = scans.get(message.sensor, _Scan([], is_open=False))
                if scan.is_open and abs(message.stamp_ns - scan.lists[0].stamp_ns) <= window_ns:
                    waiting.remove(scan)
                else:
                    scan.is_open = False
                    scan = scans[message.sensor] = _Scan([])
                scan.lists.append(message)
                waiting.append(scan)
            else:
                waiting.append(message)
            yield from ready()
    except DataError as found:
        error = found
    for scan in scans.values():
        scan.is_open = False
    yield from ready()
    if error is not None:
        raise error

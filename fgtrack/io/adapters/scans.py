"""Detections that come one per message, put together to the scans that they are of."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, Message

__all__ = ["grouped"]

_LONGEST_NS = NS_PER_S  # after the last detection of a scan, in receipts: it is complete then


@dataclass
class _Slot:
    """A place in the order of receipt: a message, or the newest detection of a scan that is not complete."""

    message: Message | None
    """None of a scan that has moved on to a later place."""
    is_open: bool = False


@dataclass
class _Scan:
    slot: _Slot
    first_ns: int
    lists: list[DetectionList]

    @property
    def newest_ns(self) -> int:
        """Receipt of the last list."""
        return self.lists[-1].receipt_ns

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
    waiting: deque[_Slot] = deque()
    error: DataError | None = None

    def close(scan: _Scan) -> None:
        scan.slot.message, scan.slot.is_open = scan.joined(), False
        del scans[scan.lists[-1].sensor]

    def ready() -> Iterator[Message]:
        while waiting and not waiting[0].is_open:
            message = waiting.popleft().message
            if message is not None:
                yield message

    try:
        for message in messages:
            for old in [each for each in scans.values() if message.receipt_ns - each.newest_ns > _LONGEST_NS]:
                close(old)
            if isinstance(message, DetectionList) and message.sensor in windows_ns:
                scan = scans.get(message.sensor)
                slot = _Slot(None, is_open=True)
                if scan is not None and abs(message.stamp_ns - scan.first_ns) <= windows_ns[message.sensor]:
                    scan.slot.is_open = False
                    scan.slot = slot
                    scan.lists.append(message)
                else:
                    if scan is not None:
                        close(scan)
                    scans[message.sensor] = _Scan(slot, message.stamp_ns, [message])
                waiting.append(slot)
            else:
                waiting.append(_Slot(message))
            yield from ready()
    except DataError as found:
        error = found
    for scan in list(scans.values()):
        close(scan)
    yield from ready()
    if error is not None:
        raise error

"""Receipts of single messages that another clock wrote, for example log times of 0: they are left out and counted.

A recorder writes 0 before it has a time (rosbag2, issue 1276), or a clock jumps for a
moment. A replay would end there, because the receipts go back or nothing is received
for years.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Generic, TypeVar

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, Message, TruthState
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.geodetic import warn_once

WRONG_RECEIPT = "wrong receipt"
"""Reason for which detections are left out."""
#: Distance from which receipts count as written by different clocks; smaller for the receipt 0.
_FAR_NS = 3600 * NS_PER_S
_FAR_FROM_ZERO_NS = 10 * NS_PER_S
#: Largest number of messages in succession with wrong receipts, and their largest share of the messages beside them.
_MOST = 100
_SHARE = 10
_Item = TypeVar("_Item")


class _Sorter(Generic[_Item]):
    """Decides for each item whether its receipt is wrong; see `sorted_out`.

    Items wait until they are decided: the first items of the recording, and items whose receipts are far from the
    others.
    """

    def __init__(self) -> None:
        #: Items from the beginning, until there are enough of them to be certainly right, with True for a receipt.
        self._head: list[tuple[_Item, bool]] | None = []
        #: Items since a receipt that is far from the receipts before, with True for a receipt.
        self._far: list[tuple[_Item, bool]] = []
        self._num_near = 0
        self._num_far = 0
        self._newest_ns: int | None = None
        self._far_newest_ns = 0

    def neutral(self, item: _Item) -> Iterator[tuple[_Item, bool]]:
        """Take an item without a receipt. Yield items as `take` does."""
        if self._far:
            self._far.append((item, False))
        elif self._head:
            self._head.append((item, False))
        else:
            yield item, False

    def take(self, item: _Item, receipt_ns: int) -> Iterator[tuple[_Item, bool]]:
        """Take an item. Yield the items whose receipts are judged by now, each with True if its receipt is wrong."""
        newest_ns = receipt_ns if self._newest_ns is None else self._newest_ns
        far_ns = _FAR_NS if newest_ns else _FAR_FROM_ZERO_NS
        if abs(receipt_ns - newest_ns) > far_ns:
            self._far.append((item, True))
            self._num_far += 1
            self._far_newest_ns = receipt_ns
            yield from self._decided()
            return
        # A single item between items that fit each other is wrong, whatever their number.
        if self._num_far > max(1, self._most):
            yield from self._accept_far()
            yield from self.take(item, receipt_ns)
            return
        far = self._far
        self._far = []
        self._num_far = 0
        self._newest_ns = max(newest_ns, receipt_ns)
        self._num_near += 1
        if self._head is None:
            yield from far
            yield item, False
            return
        yield from far
        self._head.append((item, True))
        if self._num_near > _MOST:
            yield from self._release_head()

    def finish(self) -> Iterator[tuple[_Item, bool]]:
        """Yield the items that are not decided yet."""
        if self._num_far and self._num_near * _SHARE <= self._num_far:
            yield from self._replace_head()
        is_wrong = self._num_far <= self._most
        yield from self._release_head()
        yield from ((each, counts and is_wrong) for each, counts in self._far)

    @property
    def _most(self) -> int:
        """Largest number of successive items that may be wrong; it grows with the number of right items before them."""
        return min(_MOST, self._num_near // _SHARE)

    def _decided(self) -> Iterator[tuple[_Item, bool]]:
        if self._head is not None:
            if self._num_far > self._num_near * _SHARE:
                yield from self._replace_head()
        elif self._num_far > self._most:
            yield from self._accept_far()

    def _replace_head(self) -> Iterator[tuple[_Item, bool]]:
        """Yield the first items of the recording as wrong, and the items with far receipts as right.

        There are many more items with far receipts than first items.
        """
        yield from self._head or ()
        self._head = None
        self._num_near = 0
        yield from self._accept_far()

    def _accept_far(self) -> Iterator[tuple[_Item, bool]]:
        """Yield the items with far receipts as right: the recording has a long pause, or its clock was set."""
        yield from self._release_head()
        yield from ((each, False) for each, _ in self._far)
        self._far = []
        self._num_near += self._num_far
        self._num_far = 0
        self._newest_ns = self._far_newest_ns

    def _release_head(self) -> Iterator[tuple[_Item, bool]]:
        yield from ((each, False) for each, _ in self._head or ())
        self._head = None


def sorted_out(
    items: Iterable[_Item], receipt_ns: Callable[[_Item], int | None]
) -> Iterator[tuple[_Item, bool]]:
    """Yield each item, with True if its receipt is wrong: more than an hour from the receipts before and after it.

    Only few items in succession are wrong, at most a tenth of their neighbours; longer
    pauses remain. Items without a receipt are right. The order stays, except that wrong
    items may come earlier.
    """
    sorter = _Sorter[_Item]()
    for item in items:
        at_ns = receipt_ns(item)
        yield from sorter.neutral(item) if at_ns is None else sorter.take(item, at_ns)
    yield from sorter.finish()


def with_right_receipts(path: Path, messages: Iterable[Message]) -> Iterator[Message]:
    """Yield the `messages` whose receipts are not wrong (`sorted_out`).

    The detections are counted in the next list of their sensor (`left_out`), and a
    warning counts all messages.
    """
    readable = UntilBreak(messages)
    wrong: Counter[str] = Counter()
    left_out: Counter[str] = Counter()
    for message, is_wrong in sorted_out(readable, _receipt_ns):
        name = message.sensor if isinstance(message, DetectionList) else "the ego"
        if is_wrong:
            wrong[name] += 1
            if isinstance(message, DetectionList):
                left_out[name] += len(message.objects)
        elif isinstance(message, DetectionList) and left_out[name]:
            more = (WRONG_RECEIPT,) * left_out.pop(name)
            yield replace(message, left_out=(*message.left_out, *more))
        else:
            yield message
    if wrong:
        counts = ", ".join(
            f"{count} of {name}" for name, count in sorted(wrong.items())
        )
        warn_once(
            f"{path}: left out messages with receipts that do not fit the others: {counts}"
        )
    readable.raise_error()


def _receipt_ns(message: Message) -> int | None:
    return None if isinstance(message, TruthState) else message.receipt_ns

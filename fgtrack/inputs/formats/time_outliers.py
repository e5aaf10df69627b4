"""Wrong times among the times of successive reports."""

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import TypeVar

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.inputs.formats.time_texts import DAY_S

WRONG_TIME = "wrong time"
"""Reason for which reports and rows are left out."""
#: Times are compared with this number of neighbours, of which some on both sides of the range may be wrong too.
_NEIGHBOURS = 20
_WRONG = 2
#: A time is wrong if it lies outside the range of its neighbours by more than this number of ranges plus a margin in s.
_RANGES = 5.0
_AHEAD_S = 60.0
_BEHIND_S = float(DAY_S)
#: Number of items that are decided together.
_BATCH = 2000
_Item = TypeVar("_Item")


def outliers(times_s: FloatArray, behind_s: float = _BEHIND_S) -> BoolArray:
    """Return a mask of the wrong times among `times_s`, shape (n,); NaN stands for a missing time, which is not wrong.

    A time is wrong if it is more than a minute and five ranges after its neighbours, or more than `behind_s` and five
    ranges before them. The range is the difference of the latest and the earliest time of the neighbours. Reports that
    a satellite delivers late are earlier than their neighbours, but by less.
    """
    present = np.flatnonzero(~np.isnan(times_s))
    is_wrong = np.zeros(len(times_s), dtype=bool)
    num_near = min(_NEIGHBOURS + 1, len(present))
    if num_near < 2 * _WRONG + 2:
        return is_wrong
    values_s = times_s[present]
    windows_s = np.sort(np.lib.stride_tricks.sliding_window_view(values_s, num_near))
    first = np.clip(np.arange(len(present)) - num_near // 2, 0, len(windows_s) - 1)
    low_s = windows_s[first, _WRONG]
    high_s = windows_s[first, -1 - _WRONG]
    margin_s = _RANGES * (high_s - low_s)
    is_wrong[present] = (values_s > high_s + margin_s + _AHEAD_S) | (
        values_s < low_s - margin_s - behind_s
    )
    return is_wrong


def with_outliers(
    items: Iterable[_Item],
    time_s: Callable[[_Item], float],
    behind_s: float = _BEHIND_S,
) -> Iterator[tuple[_Item, bool]]:
    """Yield each item with True if its time is wrong, as `outliers` decides; items are read ahead."""
    source = iter(items)
    waiting: list[_Item] = []
    num_decided = 0
    while True:
        batch = list(islice(source, _BATCH))
        waiting += batch
        is_wrong = outliers(np.array([time_s(each) for each in waiting]), behind_s)
        end = max(len(waiting) - _NEIGHBOURS, 0) if batch else len(waiting)
        for k in range(num_decided, end):
            yield waiting[k], bool(is_wrong[k])
        if not batch:
            return
        num_decided = min(_NEIGHBOURS, end)
        del waiting[: end - num_decided]

"""Latencies of sensors and durations of ticks of a running tracker."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.io.run import Node

__all__ = ["Lateness", "Receptions", "TickTimes", "TickTiming"]

#: Of so many newest values the quantiles are.
NEWEST = 1000


@dataclass(frozen=True, slots=True)
class Lateness:
    """Delays of the messages of one sensor, or of the ego: receipt minus stamp of the message."""

    messages: int
    """Received."""
    detections: int
    """In those messages; 0 for the ego."""
    too_late: int
    """Detections that ended as `too_old`."""
    delay_median_s: float | None
    """Median of the newest 1,000 messages; None before the first."""
    delay_p99_s: float | None
    """99th percentile of the same."""
    delay_worst_s: float | None
    """Longest of all."""
    last_receipt_ns: int | None
    """Newest receipt; None before the first message."""
    silent_s: float
    """From the last message (or the first tick, where there was none) to the last tick."""


@dataclass(frozen=True, slots=True)
class TickTiming:
    """Durations and missed deadlines of ticks."""

    ticks: int
    median_s: float | None
    """Median of the newest 1,000 ticks; None before the first."""
    p99_s: float | None
    """99th percentile of the same."""
    worst_s: float | None
    """Longest of all."""
    deadline_misses: int
    """Ticks that were not done when the next one was due, as in a replay; 0 where there is no `clock.node_hz`."""
    skipped: int
    """Periods of the node in which the host called no tick."""


def _summary_s(newest_ns: deque[int], worst_ns: int) -> tuple[float | None, float | None, float | None]:
    """Median, 99th percentile, longest; None before the first."""
    if not newest_ns:
        return None, None, None
    median_s, p99_s = (np.quantile(newest_ns, (0.5, 0.99)) / 1e9).tolist()
    return median_s, p99_s, seconds(worst_ns)


class Receptions:
    """Counts and delays of the messages of one sensor."""

    def __init__(self) -> None:
        self.messages = self.detections = 0
        self._last_receipt_ns: int | None = None
        self._delays_ns: deque[int] = deque(maxlen=NEWEST)
        self._worst_ns = 0

    def add(self, stamp_ns: int, receipt_ns: int, num_detections: int) -> None:
        """Count a message."""
        self.messages += 1
        self.detections += num_detections
        delay_ns = receipt_ns - stamp_ns
        self._worst_ns = max(self._worst_ns, delay_ns) if self._delays_ns else delay_ns
        self._delays_ns.append(delay_ns)
        self._last_receipt_ns = max(receipt_ns, self._last_receipt_ns or receipt_ns)

    def lateness(self, too_late: int, first_tick_ns: int, now_ns: int) -> Lateness:
        """Return the report at `now_ns`."""
        since_ns = first_tick_ns if self._last_receipt_ns is None else self._last_receipt_ns
        silent_s, delays_s = max(seconds(now_ns - since_ns), 0.0), _summary_s(self._delays_ns, self._worst_ns)
        return Lateness(self.messages, self.detections, too_late, *delays_s, self._last_receipt_ns, silent_s)


class TickTimes:
    """Durations of the ticks of a node; without `period_ns` there are no deadlines."""

    def __init__(self, period_ns: int | None) -> None:
        self._node = Node(period_ns)
        self._newest_ns: deque[int] = deque(maxlen=NEWEST)
        self._worst_ns = 0
        self._ticks = self._skipped = 0
        self._last_ns: int | None = None

    def add(self, now_ns: int, process_ns: int) -> None:
        """Count the tick at `now_ns`."""
        self._worst_ns = max(self._worst_ns, process_ns)
        self._newest_ns.append(process_ns)
        self._node.done_ns(now_ns, process_ns)
        self._ticks += 1
        if self._node.period_ns is not None and self._last_ns is not None:
            self._skipped += max(round((now_ns - self._last_ns) / self._node.period_ns) - 1, 0)
        self._last_ns = now_ns

    @property
    def timing(self) -> TickTiming:
        """Report so far."""
        return TickTiming(self._ticks, *_summary_s(self._newest_ns, self._worst_ns), self._node.misses, self._skipped)

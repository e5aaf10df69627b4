"""How late each sensor's messages come, and how long a tick takes: what a running tracker says of itself."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.io.run import Node

__all__ = ["Lateness", "Receptions", "TickTimes", "TickTiming"]

#: Of so many newest values the quantiles are.
NEWEST = 1000


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late the messages of one sensor, or of the ego, come. Delays are receipt minus the stamp of the message."""

    messages: int
    """Received."""
    detections: int
    """In those messages; 0 for the ego."""
    too_late: int
    """Detections that ended as `too_old`."""
    delay_median_s: float | None
    """Of the newest 1,000 messages; None before the first."""
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
    """How long ticks take, and whether they keep up."""

    ticks: int
    median_s: float | None
    """Of the newest 1,000 ticks; None before the first."""
    p99_s: float | None
    """99th percentile of the same."""
    worst_s: float | None
    """Longest of all."""
    deadline_misses: int
    """Ticks that were not done when the next one was due, as in a replay; 0 where there is no `clock.node_hz`."""
    skipped: int
    """Periods of the node in which the host called no tick."""


@dataclass
class _Spread:
    """Median and 99th percentile of the newest values in ns, largest of all."""

    _newest: deque[int] = field(default_factory=lambda: deque(maxlen=NEWEST), init=False)
    _worst: int | None = field(default=None, init=False)

    def add(self, value_ns: int) -> None:
        self._newest.append(value_ns)
        self._worst = value_ns if self._worst is None else max(self._worst, value_ns)

    def summary_s(self) -> tuple[float | None, float | None, float | None]:
        """Median, 99th percentile, largest."""
        if self._worst is None:
            return None, None, None
        median, p99 = (np.quantile(self._newest, (0.5, 0.99)) / 1e9).tolist()
        return median, p99, seconds(self._worst)


@dataclass
class Receptions:
    """What has been received from one sensor."""

    messages: int = field(default=0, init=False)
    detections: int = field(default=0, init=False)
    _last_receipt_ns: int | None = field(default=None, init=False)
    _delays: _Spread = field(default_factory=_Spread, init=False)

    def add(self, stamp_ns: int, receipt_ns: int, num_detections: int) -> None:
        """A message has come."""
        self.messages += 1
        self.detections += num_detections
        self._delays.add(receipt_ns - stamp_ns)
        self._last_receipt_ns = max(receipt_ns, self._last_receipt_ns or receipt_ns)

    def lateness(self, too_late: int, first_tick_ns: int, now_ns: int) -> Lateness:
        """What a running tracker says of this sensor at `now_ns`."""
        since_ns = first_tick_ns if self._last_receipt_ns is None else self._last_receipt_ns
        median_s, p99_s, worst_s = self._delays.summary_s()
        return Lateness(
            self.messages,
            self.detections,
            too_late,
            median_s,
            p99_s,
            worst_s,
            self._last_receipt_ns,
            max(seconds(now_ns - since_ns), 0.0),
        )


class TickTimes:
    """Times the ticks of a node.

    Parameters
    ----------
    clock_ns
        Tells the time of the machine.
    period_ns
        Between ticks; without one there are no deadlines.
    """

    def __init__(self, clock_ns: Callable[[], int], period_ns: int | None) -> None:
        self._clock_ns = clock_ns
        self._node = Node(period_ns)
        self._spread = _Spread()
        self._ticks = 0
        self._skipped = 0
        self._last_ns: int | None = None
        self._begun_ns = 0

    def begin(self) -> None:
        """A tick begins."""
        self._begun_ns = self._clock_ns()

    def end(self, now_ns: int) -> None:
        """The tick at `now_ns` is done."""
        process_ns = self._clock_ns() - self._begun_ns
        self._spread.add(process_ns)
        self._node.done_ns(now_ns, process_ns)
        self._ticks += 1
        if self._node.period_ns is not None and self._last_ns is not None:
            self._skipped += max(round((now_ns - self._last_ns) / self._node.period_ns) - 1, 0)
        self._last_ns = now_ns

    @property
    def timing(self) -> TickTiming:
        """So far."""
        return TickTiming(self._ticks, *self._spread.summary_s(), self._node.misses, self._skipped)

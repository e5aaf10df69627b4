"""Statistics of a running tracker: delays of its messages and durations of its ticks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import NS_PER_S

__all__ = ["Lateness", "TickTiming", "spread_s"]


@dataclass(frozen=True, slots=True)
class Lateness:
    """Delays of the newest 1,000 messages of a sensor or of the ego: receipt minus the oldest stamp in the message."""

    messages: int
    """Number of all received messages."""
    delay_median_s: float | None
    """Median delay; None before the first message."""
    delay_p99_s: float | None
    """99th percentile of the delay."""
    delay_worst_s: float | None
    """Longest delay."""
    silent_s: float
    """Time from the newest receipt, or from the first tick before any receipt, to the last tick."""


@dataclass(frozen=True, slots=True)
class TickTiming:
    """Durations of the newest 1,000 ticks, and missed deadlines."""

    ticks: int
    """Number of all ticks."""
    median_s: float | None
    """Median duration; None before the first tick."""
    p99_s: float | None
    """99th percentile of the duration."""
    worst_s: float | None
    """Longest duration."""
    deadline_misses: int
    """Ticks that were not finished when the next tick was due, as in a replay; 0 without `clock.node_hz`."""
    skipped: int
    """Node periods in which the host called no tick."""


def spread_s(
    newest_ns: Sequence[int],
) -> tuple[float | None, float | None, float | None]:
    """Return median, 99th percentile and maximum in s; None for each if there are no durations."""
    if not newest_ns:
        return None, None, None
    median_s, p99_s, worst_s = (
        np.quantile(newest_ns, (0.5, 0.99, 1.0)) / NS_PER_S
    ).tolist()
    return median_s, p99_s, worst_s

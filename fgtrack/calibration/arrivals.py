"""Stamps and receipts of the lists of each sensor: lateness and losses."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fgtrack.core.diagnostic import EGO
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, EgoState, FloatArray, IntArray, Message

__all__ = ["FEWEST", "Arrivals", "arrivals_of", "overtaken"]

FEWEST = 20
"""Messages of which something can be said."""
_REGULAR = 0.2  # of the period: stamps that scatter more have none
_LONGEST_LOSS = 40  # periods; what is silent for longer was switched off, or had nothing to say


@dataclass(frozen=True)
class Arrivals:
    """The messages of one sensor, or of the ego, in order of receipt."""

    name: str
    stamps_ns: IntArray
    """Shape (n,)."""
    receipts_ns: IntArray
    counts: IntArray
    """Detections of each, shape (n,)."""

    @cached_property
    def delays_s(self) -> FloatArray:
        """Shape (n,)."""
        return (self.receipts_ns - self.stamps_ns) / NS_PER_S

    @cached_property
    def duration_s(self) -> float:
        """From the first to the last receipt."""
        return float(self.receipts_ns[-1] - self.receipts_ns[0]) / NS_PER_S

    @cached_property
    def sensed_ns(self) -> IntArray:
        """Different stamps, rising."""
        return np.unique(self.stamps_ns)

    @cached_property
    def period_s(self) -> float | None:
        """Time between two lists; None of too few."""
        if len(self.sensed_ns) < 3:
            return None
        return float(np.median(np.diff(self.sensed_ns))) / NS_PER_S

    @property
    def has_stamps(self) -> bool:
        """Whether its stamps say anything: not all of them are 0, and the clock is that of the receipts."""
        return bool(self.stamps_ns.any()) and not self.is_other_clock

    @property
    def is_other_clock(self) -> bool:
        """Whether stamps and receipts are of clocks that have nothing to do with each other."""
        return bool(self.stamps_ns.any()) and abs(float(np.median(self.delays_s))) > 3600.0

    @property
    def is_receipt(self) -> bool:
        """Whether every stamp is the receipt."""
        return bool(np.all(np.abs(self.receipts_ns - self.stamps_ns) <= 1000))

    def quantile_s(self, share: float) -> float:
        """Delay that so many detections do not exceed; of lists where there are no detections."""
        weights = self.counts if self.counts.any() else np.ones(len(self.counts), dtype=np.int64)
        order = np.argsort(self.delays_s, kind="stable")
        reached = np.cumsum(weights[order])
        return float(self.delays_s[order][np.searchsorted(reached, share * reached[-1])])

    def beyond(self, lag_s: float) -> float:
        """Share of the detections with a longer delay."""
        total = int(self.counts.sum())
        return float(self.counts[self.delays_s > lag_s].sum()) / total if total else 0.0

    @cached_property
    def steps(self) -> IntArray:
        """Periods between neighbouring stamps, shape (stamps - 1,); empty where the stamps have no period."""
        none = np.zeros(0, dtype=np.int64)
        if self.period_s is None or len(self.sensed_ns) < FEWEST:
            return none
        periods = np.diff(self.sensed_ns) / (self.period_s * NS_PER_S)
        off = np.abs(periods - np.rint(periods))
        if float(np.median(off)) > _REGULAR / 4.0 or float(np.mean(off > _REGULAR)) > 0.1:
            return none
        return np.asarray(np.maximum(np.rint(periods), 1), dtype=np.int64)

    @cached_property
    def lost(self) -> float | None:
        """Share of the lists that never came, by gaps between stamps; None where the stamps have no period."""
        if not len(self.steps):
            return None
        missing = int((self.steps - 1)[self.steps <= _LONGEST_LOSS].sum())
        return missing / (missing + len(self.sensed_ns))

    @cached_property
    def longest_gap_s(self) -> float:
        """Longest time between two stamps."""
        gaps = np.diff(self.sensed_ns)
        return float(gaps.max()) / NS_PER_S if len(gaps) else 0.0


def arrivals_of(messages: Iterable[Message]) -> dict[str, Arrivals]:
    """The arrivals of every sensor, and of the ego under `ego`."""
    rows: dict[str, list[tuple[int, int, int]]] = {}
    for message in messages:
        if isinstance(message, EgoState):
            rows.setdefault(EGO, []).append((message.stamp_ns, message.receipt_ns, 0))
        elif isinstance(message, DetectionList):
            row = message.stamp_ns, message.receipt_ns, len(message.objects)
            rows.setdefault(message.sensor, []).append(row)
    return {name: Arrivals(name, *np.array(found, dtype=np.int64).T) for name, found in sorted(rows.items())}


def overtaken(arrivals: Mapping[str, Arrivals], sensors: Sequence[str]) -> dict[str, float]:
    """Share of the lists of each sensor that came after a newer one of any of `sensors`."""
    stamps_ns = np.concatenate([arrivals[name].stamps_ns for name in sensors])
    receipts_ns = np.concatenate([arrivals[name].receipts_ns for name in sensors])
    of = np.repeat(np.arange(len(sensors)), [len(arrivals[name].stamps_ns) for name in sensors])
    order = np.lexsort((stamps_ns, receipts_ns))
    newest_ns = np.maximum.accumulate(stamps_ns[order])
    late = stamps_ns[order] < newest_ns
    return {name: float(late[of[order] == place].mean()) for place, name in enumerate(sensors)}

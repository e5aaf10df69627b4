"""Stamps and receipts of the lists of each sensor: latency, losses, and the window that they need."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.diagnostic import EGO
from fgtrack.core.finding import Finding, milliseconds, nice_above, percent
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import (
    BoolArray,
    DetectionList,
    EgoState,
    FloatArray,
    IntArray,
    Message,
)
from fgtrack.inputs.info import OTHER_CLOCK_S, IdentityOrder
from fgtrack.tracking.lives.existence import ExistenceRules

__all__ = [
    "FEWEST",
    "LONGEST_STORAGE_S",
    "Arrivals",
    "arrivals_of",
    "overtaken",
    "window_findings",
]

FEWEST = 20
"""Messages below which nothing is concluded."""
_REGULAR = 0.2  # of the period: stamps that scatter more have none
_LONGEST_LOSS = (
    40  # periods; what is silent for longer was switched off, or had nothing to report
)
_LOST = 0.001  # share of detections that may fall beyond a window
_SPARE = 1.2
LONGEST_STORAGE_S = 60.0
_LISTS = 3.0  # of the slowest sensor that a window, and a track, should outlive


@dataclass(frozen=True)
class Arrivals:
    """The messages of one sensor, or of the ego, in order of receipt."""

    name: str
    stamps_ns: IntArray
    """Shape (n,)."""
    receipts_ns: IntArray
    counts: IntArray
    """Detections of each, shape (n,)."""
    object_late: float | None = None
    """Share of the detections with an identity that came after a newer one of it; None of fewer than two."""

    @cached_property
    def delays_s(self) -> FloatArray:
        """Shape (n,)."""
        return (self.receipts_ns - self.stamps_ns) / NS_PER_S

    @cached_property
    def usable(self) -> BoolArray:
        """True of stamps within an hour of their receipt, shape (n,); of all where the clocks are unrelated."""
        return np.asarray(
            (np.abs(self.delays_s) <= OTHER_CLOCK_S) | self.is_other_clock
        )

    @cached_property
    def steps_s(self) -> FloatArray:
        """Time between neighbouring different stamps."""
        return np.asarray(
            np.diff(np.unique(self.stamps_ns)) / NS_PER_S, dtype=np.float64
        )

    @property
    def period_s(self) -> float:
        """Usual time between two lists; 0 of too few."""
        return float(np.median(self.steps_s)) if len(self.steps_s) > 1 else 0.0

    @property
    def has_stamps(self) -> bool:
        """True if its stamps are usable: not all of them are 0, and the clock is that of the receipts."""
        return bool(self.stamps_ns.any()) and not self.is_other_clock

    @property
    def is_other_clock(self) -> bool:
        """True if stamps and receipts are of unrelated clocks."""
        return (
            bool(self.stamps_ns.any())
            and abs(float(np.median(self.delays_s))) > OTHER_CLOCK_S
        )

    @property
    def is_receipt(self) -> bool:
        """True if every stamp is the receipt."""
        return bool(np.all(np.abs(self.receipts_ns - self.stamps_ns) <= 1000))

    def quantile_s(self, share: float) -> float:
        """Return the delay that so many detections do not exceed; of lists where there are no detections."""
        weights = self.counts[self.usable] if self.counts[self.usable].any() else None
        return float(
            np.quantile(
                self.delays_s[self.usable],
                share,
                weights=weights,
                method="inverted_cdf",
            )
        )

    def beyond(self, lag_s: float) -> float:
        """Return the share of the detections with a longer delay."""
        return float(
            self.counts[(self.delays_s > lag_s) & self.usable].sum()
            / max(self.counts.sum(), 1)
        )

    @property
    def lost(self) -> float | None:
        """Share of the lists that never came, by gaps between stamps; None where the stamps have no period.
        Nor have those of lists of one object with an identity: each object reports by itself.
        """
        if len(self.steps_s) < FEWEST or (
            self.object_late is not None and self.counts.max() == 1
        ):
            return None
        periods = self.steps_s / self.period_s
        off = np.abs(periods - np.rint(periods))
        if (
            float(np.median(off)) > _REGULAR / 4.0
            or float(np.mean(off > _REGULAR)) > 0.1
        ):
            return None
        missing = float(
            (np.maximum(np.rint(periods), 1) - 1)[
                np.rint(periods) <= _LONGEST_LOSS
            ].sum()
        )
        return missing / (missing + len(periods) + 1)


def arrivals_of(messages: Iterable[Message]) -> dict[str, Arrivals]:
    """Return the arrivals of every sensor, and of the ego under `ego`."""
    rows: dict[str, list[tuple[int, int, int]]] = {}
    order, own = IdentityOrder(), defaultdict[str, list[bool]](list)
    for message in messages:
        if isinstance(message, EgoState):
            rows.setdefault(EGO, []).append((message.stamp_ns, message.receipt_ns, 0))
        elif isinstance(message, DetectionList):
            row = message.stamp_ns, message.receipt_ns, len(message.objects)
            rows.setdefault(message.sensor, []).append(row)
            own[message.sensor] += order.late(message)
    result = {
        name: Arrivals(name, *np.array(row, dtype=np.int64).T)
        for name, row in sorted(rows.items())
    }
    shares = {name: float(np.mean(late)) for name, late in own.items() if late}
    return {
        name: replace(one, object_late=shares.get(name)) for name, one in result.items()
    }


def overtaken(
    arrivals: Mapping[str, Arrivals], sensors: Sequence[str]
) -> dict[str, float]:
    """Return the share of the lists of each sensor that came after a newer one of any of `sensors`."""
    stamps_ns = np.concatenate([arrivals[name].stamps_ns for name in sensors])
    receipts_ns = np.concatenate([arrivals[name].receipts_ns for name in sensors])
    of = np.repeat(
        np.arange(len(sensors)), [len(arrivals[name].stamps_ns) for name in sensors]
    )
    order = np.lexsort((stamps_ns, receipts_ns))
    late = stamps_ns[order] < np.maximum.accumulate(stamps_ns[order])
    return {
        name: float(late[of[order] == row].mean()) for row, name in enumerate(sensors)
    }


def window_findings(arrivals: Sequence[Arrivals], config: Config) -> Iterator[Finding]:
    """Yield detections that are refused for their delay, or fall beyond the window, and times that are too short."""
    needed_s = 0.0
    for one in arrivals:
        most_s, limit_s = (
            one.quantile_s(1.0 - _LOST),
            config.sensors[one.name].max_delay_s,
        )
        if limit_s is not None and one.beyond(limit_s) > _LOST:
            text = (
                f"{percent(one.beyond(limit_s))} of its detections come later than max_delay_s {limit_s:g} s allows "
                f"and are refused; 99.9 % come within {milliseconds(most_s)}."
            )
            settings = {f"sensors.{one.name}.max_delay_s": nice_above(_SPARE * most_s)}
            yield Finding(
                "window", one.name, 50.0 + 40.0 * one.beyond(limit_s), text, settings
            )
        elif limit_s is not None:
            most_s = min(most_s, limit_s)
        needed_s = max(needed_s, most_s)
    yield from _too_short(arrivals, config, needed_s)


def _too_short(
    arrivals: Sequence[Arrivals], config: Config, needed_s: float
) -> Iterator[Finding]:
    """Yield a window shorter than the delays, or than the time between two lists, and a track that lives less long."""
    slowest = max(arrivals, key=lambda item: item.period_s, default=None)
    if slowest is None:
        return
    reach, between = (
        config.effective,
        "the time between two lists of {0.name}, {0.period_s:.3g} s".format,
    )
    worst = max(arrivals, key=lambda item: item.beyond(reach.reach_s))
    lost = worst.beyond(reach.reach_s)
    if needed_s > reach.reach_s or reach.lag_s < slowest.period_s:
        text = f"{between(slowest)}: too short."
        if needed_s > reach.reach_s:
            text = f"the delays: {percent(lost)} of the detections of {worst.name} fall beyond it."
        value = min(
            nice_above(_SPARE * max(needed_s, _LISTS * slowest.period_s)),
            LONGEST_STORAGE_S,
        )
        text = f"{reach.lag_key} {reach.lag_s:g} s is shorter than {text}"
        yield Finding(
            "window", "window", 55.0 + 35.0 * lost, text, {reach.lag_key: value}
        )
    key, limit_s = "lifecycle.forget_s", getattr(config.lifecycle, "forget_s", 0.0)
    placing = [item for item in arrivals if config.sensors[item.name].gives_position]
    if isinstance(config.lifecycle, ExistenceRules):
        key, limit_s = "lifecycle.out_of_view_s", config.lifecycle.out_of_view_s
        placing = (
            placing if len(placing) > 1 else []
        )  # only a list that could not show a track ends it
    slowest = max(placing, key=lambda item: item.period_s, default=None)
    if slowest is not None and slowest.period_s > limit_s:
        text = f"{key} {limit_s:g} s is shorter than {between(slowest)}: a track that it alone sees ends in between."
        yield Finding(
            "track",
            slowest.name,
            55.0,
            text,
            {key: nice_above(_LISTS * slowest.period_s)},
        )

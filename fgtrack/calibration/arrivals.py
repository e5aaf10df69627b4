"""Stamps and receipts of the lists of each sensor: latency, losses, and the window that they need."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fgtrack.calibration.finding import Finding, milliseconds, nice_above, percent
from fgtrack.core.diagnostic import EGO
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, EgoState, FloatArray, IntArray, Message
from fgtrack.pipeline.config import Config
from fgtrack.tracking.existence import ExistenceRules

__all__ = ["FEWEST", "Arrivals", "arrivals_of", "beyond_lags", "overtaken", "window_findings"]

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
        """True if its stamps are usable: not all of them are 0, and the clock is that of the receipts."""
        return bool(self.stamps_ns.any()) and not self.is_other_clock

    @property
    def is_other_clock(self) -> bool:
        """True if stamps and receipts are of unrelated clocks."""
        return bool(self.stamps_ns.any()) and abs(float(np.median(self.delays_s))) > 3600.0

    @property
    def is_receipt(self) -> bool:
        """True if every stamp is the receipt."""
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


_LAGS_S = (0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0)
_LOST = 0.001  # share of detections that may fall beyond
_ALL = 0.999  # share that a window should hold
_SPARE = 1.2
_LONGEST_STORAGE_S = 60.0
_LISTS = 3.0  # of the slowest sensor that a window, and a track, should outlive


def beyond_lags(arrivals: Sequence[Arrivals]) -> dict[float, dict[str, float]]:
    """Return shares of the detections of each sensor beyond each lag in s, up to the first that holds everything."""
    rows: dict[float, dict[str, float]] = {}
    for lag_s in _LAGS_S:
        rows[lag_s] = {one.name: one.beyond(lag_s) for one in arrivals}
        if not any(rows[lag_s].values()):
            break
    return rows


def window_findings(arrivals: Sequence[Arrivals], config: Config) -> Iterator[Finding]:
    """Detections that are refused for their delay, or fall beyond the window; settings that a slow sensor defeats."""
    needed_s = 0.0
    for one in arrivals:
        most_s, limit_s = one.quantile_s(_ALL), config.sensors[one.name].max_delay_s
        if limit_s is not None and one.beyond(limit_s) > _LOST:
            text = (
                f"{percent(one.beyond(limit_s))} of its detections come later than max_delay_s {limit_s:g} s allows "
                f"and are refused; 99.9 % come within {milliseconds(most_s)}."
            )
            settings = {f"sensors.{one.name}.max_delay_s": nice_above(_SPARE * most_s)}
            yield Finding("window", one.name, 50.0 + 40.0 * one.beyond(limit_s), text, settings)
        elif limit_s is not None:
            most_s = min(most_s, limit_s)
        needed_s = max(needed_s, most_s)
    yield from _window(arrivals, config, needed_s)
    yield from _life(arrivals, config)


def _window(arrivals: Sequence[Arrivals], config: Config, needed_s: float) -> Iterator[Finding]:
    found = config.effective
    shorter = f"{found.lag_key} {found.lag_s:g} s is shorter than"
    slowest = max(arrivals, key=lambda one: one.period_s or 0.0, default=None)
    if slowest is None:
        return
    period_s = slowest.period_s or 0.0
    if needed_s > found.reach_s:
        worst = max(arrivals, key=lambda one: one.beyond(found.reach_s))
        lost = worst.beyond(found.reach_s)
        text = f"{shorter} the delays: {percent(lost)} of the detections of {worst.name} fall beyond it."
        value = min(nice_above(_SPARE * max(needed_s, _LISTS * period_s)), _LONGEST_STORAGE_S)
        yield Finding("window", "window", 50.0 + 40.0 * lost, text, {found.lag_key: value})
    elif found.lag_s < period_s:
        text = (
            f"{shorter} the time between two lists of {slowest.name}, {period_s:.3g} s: nothing of it is ever smoothed "
            "together."
        )
        yield Finding("window", "window", 55.0, text, {found.lag_key: nice_above(_LISTS * period_s)})


def _life(arrivals: Sequence[Arrivals], config: Config) -> Iterator[Finding]:
    """A time after which a track ends, against how often it can be seen at all."""
    rules = config.lifecycle
    if isinstance(rules, ExistenceRules):
        key, limit_s = "lifecycle.out_of_view_s", rules.out_of_view_s
    else:
        key, limit_s = "lifecycle.forget_s", rules.forget_s
    placing = [one for one in arrivals if config.sensors[one.name].gives_position and one.period_s]
    if isinstance(rules, ExistenceRules) and len(placing) == 1:
        return  # only a list that could not show a track ends it
    fastest_s = min((one.period_s or math.inf for one in placing), default=math.inf)
    silent_s = {}
    for one in placing:
        period_s = one.period_s or 0.0
        alone = len(placing) == 1 or period_s > 2.0 * fastest_s
        if alone or fastest_s > limit_s:
            silent_s[one.name] = period_s
    name = max(silent_s, key=silent_s.__getitem__, default=None)
    if name is not None and silent_s[name] > limit_s:
        text = (
            f"{key} {limit_s:g} s is shorter than the time in which {name} may say nothing, {silent_s[name]:.3g} s: a "
            "track that it alone sees ends in between."
        )
        yield Finding("track", name, 55.0, text, {key: nice_above(_LISTS * silent_s[name])})

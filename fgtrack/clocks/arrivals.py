"""Delays and losses of each sensor's lists, and the smoothing window that they require."""

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
    "overtaken_shares",
    "window_findings",
]

FEWEST = 20
"""Least number of messages for a conclusion."""
# Largest scatter of stamps about a regular grid, as a share of the period.
_REGULAR = 0.2
# Longest gap that counts as lost lists, in periods. In a longer gap the sensor was off, or had nothing to report.
_LONGEST_LOSS = 40
# Share of detections that may arrive too late for a window.
_LOST = 0.001
# Safety factor on the delays.
_SPARE = 1.2
LONGEST_STORAGE_S = 60.0
"""Longest smoothing window that is advised."""
# A window, and a track out of view, should last for this number of lists of the slowest sensor.
_LISTS = 3.0


@dataclass(frozen=True)
class Arrivals:
    """Messages of one sensor, or of the ego, in order of receipt."""

    name: str
    stamps_ns: IntArray
    """Stamp of each message, shape (n,)."""
    receipts_ns: IntArray
    """Receipt time of each message, shape (n,)."""
    counts: IntArray
    """Number of detections in each message, shape (n,)."""
    object_late: float | None = None
    """Share of detections with an identity that arrived after a newer detection of the same object.

    None without two detections of one object.
    """

    @cached_property
    def delays_s(self) -> FloatArray:
        """Delay from stamp to receipt, shape (n,)."""
        return (self.receipts_ns - self.stamps_ns) / NS_PER_S

    @cached_property
    def usable(self) -> BoolArray:
        """Mask of the messages with a usable delay, shape (n,): within an hour.

        All are usable if stamps and receipts come from unrelated clocks.
        """
        return np.asarray(
            (np.abs(self.delays_s) <= OTHER_CLOCK_S) | self.is_other_clock
        )

    @cached_property
    def steps_s(self) -> FloatArray:
        """Times between successive distinct stamps, in ascending order of the stamps."""
        return np.asarray(
            np.diff(np.unique(self.stamps_ns)) / NS_PER_S, dtype=np.float64
        )

    @property
    def period_s(self) -> float:
        """Median time between two lists; 0 for too few lists."""
        return float(np.median(self.steps_s)) if len(self.steps_s) > 1 else 0.0

    @property
    def has_stamps(self) -> bool:
        """True if the stamps are usable: not all are 0, and they share the clock of the receipts."""
        return bool(self.stamps_ns.any()) and not self.is_other_clock

    @property
    def is_other_clock(self) -> bool:
        """True if stamps and receipts come from unrelated clocks."""
        return (
            bool(self.stamps_ns.any())
            and abs(float(np.median(self.delays_s))) > OTHER_CLOCK_S
        )

    @property
    def is_receipt(self) -> bool:
        """True if every stamp equals its receipt up to 1 us."""
        return bool(np.all(np.abs(self.receipts_ns - self.stamps_ns) <= 1000))

    def quantile_s(self, share: float) -> float:
        """Return the delay that the given `share` of the detections does not exceed.

        Without detections the lists are counted instead.
        """
        weights = self.counts[self.usable] if self.counts[self.usable].any() else None
        return float(
            np.quantile(
                self.delays_s[self.usable],
                share,
                weights=weights,
                method="inverted_cdf",
            )
        )

    def share_later_than(self, lag_s: float) -> float:
        """Return the share of all detections that have a usable delay above `lag_s`."""
        return float(
            self.counts[(self.delays_s > lag_s) & self.usable].sum()
            / max(self.counts.sum(), 1)
        )

    @property
    def lost_share(self) -> float | None:
        """Share of lists that never arrived, estimated from gaps between stamps.

        None if there are few lists, or if the stamps have no period. None also if each
        object sends its own list: each list has one detection, and its object has an identity.
        """
        if len(self.steps_s) < FEWEST or (
            self.object_late is not None and self.counts.max() == 1
        ):
            return None
        periods = self.steps_s / self.period_s
        whole = np.rint(periods)
        off = np.abs(periods - whole)
        if (
            float(np.median(off)) > _REGULAR / 4.0
            or float(np.mean(off > _REGULAR)) > 0.1
        ):
            return None
        missing = float((np.maximum(whole, 1) - 1)[whole <= _LONGEST_LOSS].sum())
        return missing / (missing + len(periods) + 1)


def arrivals_of(messages: Iterable[Message]) -> dict[str, Arrivals]:
    """Return the arrivals of every sensor by name, and of the ego under `ego`."""
    rows: dict[str, list[tuple[int, int, int]]] = {}
    order = IdentityOrder()
    own = defaultdict[str, list[bool]](list)
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


def overtaken_shares(
    arrivals: Mapping[str, Arrivals], sensors: Sequence[str]
) -> dict[str, float]:
    """Return for each of `sensors` the share of its lists that arrived after a newer list of any sensor."""
    stamps_ns = np.concatenate([arrivals[name].stamps_ns for name in sensors])
    receipts_ns = np.concatenate([arrivals[name].receipts_ns for name in sensors])
    sensor_rows = np.repeat(
        np.arange(len(sensors)), [len(arrivals[name].stamps_ns) for name in sensors]
    )
    order = np.lexsort((stamps_ns, receipts_ns))
    late = stamps_ns[order] < np.maximum.accumulate(stamps_ns[order])
    return {
        name: float(late[sensor_rows[order] == row].mean())
        for row, name in enumerate(sensors)
    }


def window_findings(arrivals: Sequence[Arrivals], config: Config) -> Iterator[Finding]:
    """Yield findings on delays: refused detections, too short a window, too short a life of tracks.

    Each finding proposes the setting that is long enough.
    """
    needed_s = 0.0
    for one in arrivals:
        most_s = one.quantile_s(1.0 - _LOST)
        limit_s = config.sensors[one.name].max_delay_s
        if limit_s is not None and one.share_later_than(limit_s) > _LOST:
            refused = percent(one.share_later_than(limit_s))
            text = (
                f"{refused} of its detections arrive later than max_delay_s {limit_s:g} s and are refused; "
                f"99.9 % arrive within {milliseconds(most_s)}."
            )
            settings = {f"sensors.{one.name}.max_delay_s": nice_above(_SPARE * most_s)}
            yield Finding(
                "window",
                one.name,
                50.0 + 40.0 * one.share_later_than(limit_s),
                text,
                settings,
            )
        elif limit_s is not None:
            most_s = min(most_s, limit_s)
        needed_s = max(needed_s, most_s)
    yield from _too_short(arrivals, config, needed_s)


def _too_short(
    arrivals: Sequence[Arrivals], config: Config, needed_s: float
) -> Iterator[Finding]:
    """Yield a finding on the estimator's window, and a finding on the life of tracks, if they are too short.

    The window must cover `needed_s`, within which the detections arrive, and the period of the slowest sensor. A track
    must live longer than this period.
    """
    slowest = max(arrivals, key=lambda item: item.period_s, default=None)
    if slowest is None:
        return
    reach = config.effective
    between = "the time between two lists of {0.name}, {0.period_s:.3g} s".format
    worst = max(arrivals, key=lambda item: item.share_later_than(reach.reach_s))
    lost = worst.share_later_than(reach.reach_s)
    if needed_s > reach.reach_s or reach.lag_s < slowest.period_s:
        text = f"{between(slowest)}."
        if needed_s > reach.reach_s:
            text = f"the delays: {percent(lost)} of the detections of {worst.name} arrive too late for the window."
        value = min(
            nice_above(_SPARE * max(needed_s, _LISTS * slowest.period_s)),
            LONGEST_STORAGE_S,
        )
        text = f"{reach.lag_key} {reach.lag_s:g} s is shorter than {text}"
        yield Finding(
            "window", "window", 55.0 + 35.0 * lost, text, {reach.lag_key: value}
        )
    key = "lifecycle.forget_s"
    limit_s = getattr(config.lifecycle, "forget_s", 0.0)
    placing = [item for item in arrivals if config.sensors[item.name].gives_position]
    if isinstance(config.lifecycle, ExistenceRules):
        key = "lifecycle.out_of_view_s"
        limit_s = config.lifecycle.out_of_view_s
        if len(placing) == 1:  # its next list ends a track out of view
            placing = []
    slowest = max(placing, key=lambda item: item.period_s, default=None)
    if slowest is not None and slowest.period_s > limit_s:
        text = f"{key} {limit_s:g} s is shorter than {between(slowest)}: a track that only this sensor sees ends early."
        yield Finding(
            "track",
            slowest.name,
            55.0,
            text,
            {key: nice_above(_LISTS * slowest.period_s)},
        )

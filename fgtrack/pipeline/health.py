"""Health of a running tracker: statistics of its sensors, and a state with reasons."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from enum import StrEnum
from typing import ClassVar

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.diagnostic import EGO
from fgtrack.core.settings import settings
from fgtrack.core.state import Snapshot, Stateful, copied
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Disposition, TickReport, UpdateRecord
from fgtrack.tracking.lives.latency import NEWEST

MINUTE_NS = 60 * NS_PER_S
"""Time over which revisions are counted."""
#: Probability that the mean NIS of a consistent sensor lies beyond its limits.
_RARE = 1e-3


class HealthState(StrEnum):
    """State of a tracker, or of a part."""

    OK = "ok"
    DEGRADED = "degraded"
    """Tracks are published, but a sensor, the noise or the time for a tick is not as configured."""
    STALE = "stale"
    """No sensor that starts tracks, or no ego that lists need, has sent anything lately: tracks are predictions."""


@settings
class HealthLimits:
    """Thresholds of `Tracker.health`."""

    silent_s: float = 1.0
    """Longest time without a message. A source that usually sends less often may be silent for five usual periods."""
    nis_ratio: tuple[float, float] = (0.25, 1.7)
    """Smallest and largest mean NIS per measured component; 1 for a consistent model.

    Detections outside the gate of the association have no NIS. So the mean hardly exceeds 2, however small `std` is.
    """
    bias: float = 1.0
    """Largest mean innovation, in standard deviations of the innovations."""
    failed_share: float = 0.05
    """Largest share of detections with the disposition `failed` or `invalid`."""
    late_share: float = 0.01
    """Largest share of messages whose delay is above a limit."""
    missed_share: float = 0.05
    """Largest share of ticks that miss their deadline, of the ticks that `TickTiming` counts."""
    fewest: int = 30
    """Fewest detections, messages or ticks from which a share or a mean is judged."""


@dataclass(frozen=True, slots=True)
class Nis:
    """Normalised innovation squared of the newest 1,000 fused detections of a sensor."""

    count: int
    mean_per_component: float
    """Mean NIS over the mean number of components; 1 for a consistent model."""
    limits: tuple[float, float]
    """Limits of `mean_per_component` that a consistent sensor with independent innovations leaves once in 1,000 times.

    Innovations of neighbouring lists are correlated if the model is wrong, so a small excess is usual.
    """


@dataclass(frozen=True, slots=True)
class SensorHealth:
    """Statistics of a sensor or of the ego, and its state."""

    state: HealthState
    reasons: tuple[str, ...]
    """Reasons of a state that is not `ok`, with the number and the threshold."""
    nis: Nis | None
    """None before the first detection with a NIS, and for the ego."""
    bias: Mapping[str, float]
    """Mean innovation of each component, measured minus predicted."""
    failed_share: float
    """Share of the newest 1,000 detections that are `failed` or `invalid`."""
    late_shares: Mapping[str, float]
    """Share of the newest 1,000 messages whose delay is above a limit, by the key of the limit."""
    silent_s: float
    """See `Lateness.silent_s`."""
    horizon_s: float
    """Time for which lists of the sensor may still be missing: its longest usual delay, at most the window.

    A decision that is older changes seldom. `late_shares` has the share of the messages beyond the window.
    """


@dataclass(frozen=True, slots=True)
class Revised:
    """Decisions of the last minute that late data has changed."""

    changes: int = 0
    """Number of changes of a detection's track in the last minute."""
    detections: int = 0
    """Number of detections in the last minute."""

    @property
    def share(self) -> float:
        """Number of changes over the number of detections; 0 without detections."""
        return self.changes / self.detections if self.detections else 0.0


@dataclass(frozen=True, slots=True)
class Health:
    """State of a tracker at its last tick."""

    state: HealthState
    """The worst state of the parts."""
    reasons: tuple[str, ...]
    """Reasons of a state that is not `ok`; each begins with the sensor, `ego`, `ticks` or `clock`."""
    sensors: Mapping[str, SensorHealth]
    """By sensor, and under `ego` for the ego."""
    revised: Revised
    """Decisions of the last minute that late data has changed."""


@dataclass
class Innovations(Stateful):
    """The newest fused detections, and outcomes, of one sensor."""

    STATE: ClassVar[tuple[str, ...]] = ("nis", "innovations", "is_failed")

    nis: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=NEWEST))
    """NIS and number of components."""
    innovations: deque[Mapping[str, float]] = field(
        default_factory=lambda: deque(maxlen=NEWEST)
    )
    is_failed: deque[bool] = field(default_factory=lambda: deque(maxlen=NEWEST))

    def add(self, record: UpdateRecord) -> None:
        """Add the record of a detection."""
        self.is_failed.append(record.disposition in _FAILED)
        if record.nis is not None and record.innovation:
            self.nis.append((record.nis, len(record.innovation)))
            self.innovations.append(record.innovation)

    def spread(self) -> dict[str, tuple[float, float, int]]:
        """Return mean, standard deviation and number of the innovations of each component."""
        values: dict[str, list[float]] = {}
        for each in self.innovations:
            for name, value in each.items():
                values.setdefault(name, []).append(value)
        return {
            name: (float(np.mean(each)), float(np.std(each)), len(each))
            for name, each in values.items()
        }

    def statistics(self) -> Nis | None:
        """Return the NIS with its limits; None without any."""
        if not self.nis:
            return None
        from scipy.special import gammaincinv

        freedom = sum(components for _, components in self.nis)
        low, high = (
            2.0 * float(gammaincinv(0.5 * freedom, probability)) / freedom
            for probability in (0.5 * _RARE, 1.0 - 0.5 * _RARE)
        )
        total = sum(nis for nis, _ in self.nis)
        return Nis(len(self.nis), total / freedom, (low, high))


#: Newest messages of which the usual time between two messages is computed.
_RECENT = 100
_FAILED = (Disposition.FAILED, Disposition.INVALID)


class Watch(Stateful):
    """Collects receipts and the records of all ticks for the health of a tracker."""

    STATE: ClassVar[tuple[str, ...]] = ("by_sensor", "_receipts_ns", "_decided")

    def __init__(self, sensors: Iterable[str]) -> None:
        self.by_sensor = {name: Innovations() for name in (*sensors, EGO)}
        """Outcomes of each configured sensor; the ego has none."""
        self._receipts_ns = {
            name: deque[int](maxlen=_RECENT) for name in self.by_sensor
        }
        self._decided = deque[tuple[int, int, int]]()
        """Time, number of changes and number of detections of the ticks of the last minute that have any."""

    def received(self, name: str, receipt_ns: int) -> None:
        """Note a message of a sensor or of the ego."""
        self._receipts_ns[name].append(receipt_ns)

    def usual_gap_s(self, name: str) -> float:
        """Return the median time between two messages; 0 before the second message."""
        gaps_ns = np.diff(self._receipts_ns[name])
        return float(np.median(gaps_ns)) / NS_PER_S if len(gaps_ns) else 0.0

    def add(self, report: TickReport) -> None:
        """Add the records and revisions of a tick; records of unknown sensors are left out."""
        for record in report.updates:
            of_sensor = self.by_sensor.get(record.sensor)
            if of_sensor is not None:
                of_sensor.add(record)
        changes, detections = len(report.revisions), len(report.updates)
        if changes or detections:
            self._decided.append((report.now_ns, changes, detections))
        while self._decided and self._decided[0][0] <= report.now_ns - MINUTE_NS:
            self._decided.popleft()

    def revised(self) -> Revised:
        """Return the decisions of the last minute that late data has changed."""
        _, changes, detections = zip((0, 0, 0), *self._decided, strict=True)
        return Revised(sum(changes), sum(detections))

    def restore(self, snapshot: Snapshot) -> None:
        """See `Stateful.restore`; the outcomes stay the same objects."""
        for name, of_sensor in self.by_sensor.items():
            of_sensor.restore(snapshot["by_sensor"][name])
        self._receipts_ns = copied(snapshot["_receipts_ns"])
        self._decided = copied(snapshot["_decided"])


def delay_limits_s(config: Config, sensor: str) -> dict[str, float]:
    """Return the times that a delay of a sensor must not exceed, by configuration key.

    A detection later than `max_delay_s` or the window is not used. A detection later than a time of the lifecycle comes
    when its track may have ended.
    """
    window, rules = config.effective, config.lifecycle
    limits = {f"sensors.{sensor}.max_delay_s": config.sensors[sensor].max_delay_s}
    limits[window.lag_key] = window.reach_s
    if is_dataclass(rules):
        limits |= {
            f"lifecycle.{each.name}": getattr(rules, each.name)
            for each in fields(rules)
            if each.name in _LIVES
        }
    return {key: limit_s for key, limit_s in limits.items() if limit_s is not None}


_LIVES = ("lifetime_s", "forget_s", "hidden_s", "out_of_view_s")


@dataclass(frozen=True)
class Source:
    """Delays and silence of a sensor or of the ego."""

    delays_s: Sequence[float]
    """Delays of the newest messages."""
    silent_s: float
    usual_gap_s: float
    """Usual time between two messages; 0 if unknown."""
    horizon_s: float
    """See `SensorHealth.horizon_s`."""


def sensor_health(
    source: Source,
    limits_s: Mapping[str, float],
    innovations: Innovations,
    limits: HealthLimits,
) -> SensorHealth:
    """Return the health of a sensor, or of the ego, whose `innovations` are empty."""
    nis, spread = innovations.statistics(), innovations.spread()
    num_outcomes = len(innovations.is_failed)
    failed_share = sum(innovations.is_failed) / max(num_outcomes, 1)
    delays_s = np.asarray(source.delays_s)
    late = {
        key: float(np.mean(delays_s > limit_s)) if len(delays_s) else 0.0
        for key, limit_s in limits_s.items()
    }
    reasons = list(_silence(source, limits))
    if num_outcomes >= limits.fewest and failed_share > limits.failed_share:
        reasons.append(f"{100.0 * failed_share:.3g} % failed or invalid")
    if nis is not None and nis.count >= limits.fewest:
        low, high = limits.nis_ratio
        if not low <= nis.mean_per_component <= high:
            reasons.append(
                f"NIS per component {nis.mean_per_component:.3g}, outside {low:g} to {high:g}"
            )
    for name, (mean, std, count) in spread.items():
        if count >= limits.fewest and abs(mean) > limits.bias * std:
            reasons.append(
                f"bias of {name} {mean:.3g}, innovations scatter by {std:.3g}"
            )
    if len(delays_s) >= limits.fewest:
        reasons += [
            f"{100.0 * share:.3g} % arrive later than {key} ({limits_s[key]:g} s)"
            for key, share in late.items()
            if share > limits.late_share
        ]
    return SensorHealth(
        HealthState.DEGRADED if reasons else HealthState.OK,
        tuple(reasons),
        nis,
        {name: mean for name, (mean, _, _) in spread.items()},
        failed_share,
        late,
        source.silent_s,
        source.horizon_s,
    )


def _silence(source: Source, limits: HealthLimits) -> Iterator[str]:
    """Yield the reason of a source that has sent nothing for too long."""
    most_s = max(limits.silent_s, 5.0 * source.usual_gap_s)
    if source.silent_s > most_s:
        yield f"silent for {source.silent_s:.3g} s, more than {most_s:.3g} s"


def is_silent(source: Source, limits: HealthLimits) -> bool:
    """True if the source has sent nothing for too long."""
    return any(_silence(source, limits))


def overall(
    sensors: Mapping[str, SensorHealth],
    stale: Sequence[str],
    ticks: Sequence[str],
    revised: Revised,
) -> Health:
    """Return the health of the tracker.

    `stale` contains the reasons why the tracks are stale; `ticks` contains the faults of the ticks. With any reason in
    `stale` the state is `STALE`, with any other reason `DEGRADED`.
    """
    own = [
        f"{name}: {reason}" for name, one in sensors.items() for reason in one.reasons
    ]
    reasons = (*stale, *ticks, *own)
    state = HealthState.DEGRADED if reasons else HealthState.OK
    return Health(HealthState.STALE if stale else state, reasons, sensors, revised)

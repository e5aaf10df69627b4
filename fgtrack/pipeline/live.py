"""The tracker in a running system: messages in as they arrive, tracks out when they are wanted."""

import threading
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from operator import index as integer
from pathlib import Path
from time import perf_counter_ns
from typing import Self

import numpy as np

from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import period_ns, seconds
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    SmoothedReport,
    TickReport,
    TrackReport,
    UpdateRecord,
)
from fgtrack.io.run import Node
from fgtrack.io.validation import InvalidMessageError, validated_detection
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import corrected
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.shipped import read_config
from fgtrack.tracking.inbox import records

__all__ = ["Lateness", "TickTiming", "TrackOutput", "Tracker", "TracksAt"]

#: Name of the ego among the sensors of `Tracker.lateness`.
EGO = "ego"
#: Number of newest values of which quantiles are calculated.
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


class _Receptions:
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


class _TickTimes:
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


class Tracker:
    """Tracks objects from object lists that arrive late, in a running system.

    `receive` takes messages in the order of their arrival, `tick` processes what came since the last one. What cannot
    be used never raises: it is counted in `refused`, and every detection ends in exactly one disposition of `counts`.
    What an estimator raises does not end the tracker: the track is reinitialised or ends, counted in `failures`.

    `receive` may be called by any thread, also while a tick runs, and never waits. Everything else may be called by any
    thread, too, and takes turns.

    Parameters
    ----------
    config
        Name of a shipped configuration, path of a YAML file, or a `Config`; None for the defaults. Raises `CallError`
        where it cannot be built.
    map, pit_map, estimator, set
        As of `fgtrack.replay`.
    """

    def __init__(
        self,
        config: str | Path | Config | None = None,
        *,
        map: str | Path | None = None,  # noqa: A002 - the name of the option
        pit_map: str | Path | None = None,
        estimator: str | None = None,
        set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    ) -> None:
        config = read_config(config, set, track_map=map, pit_map=pit_map, estimator=estimator)
        self.config = config
        self._tracker = build_tracker(config, lambda parts: replace(parts, propagated_exceptions=(DataError,)))
        self._refused: Counter[str] = Counter()
        self._records: list[UpdateRecord] = []
        self._counts: dict[str, Counter[Disposition]] = {}
        self._last = TickReport(-1, 0, (), ())
        self._first_tick_ns = 0
        self._arrivals: deque[EgoState | DetectionList] = deque()
        self._receptions = {name: _Receptions() for name in (*config.sensors, EGO)}
        node_hz = config.clock.node_hz
        self._times = _TickTimes(None if node_hz is None else period_ns(node_hz))
        self._turn = threading.RLock()

    @classmethod
    def from_config(
        cls,
        config: str | Path | Config | None = None,
        *,
        map: str | Path | None = None,  # noqa: A002 - the name of the option
        pit_map: str | Path | None = None,
        estimator: str | None = None,
        set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    ) -> Self:
        """Return `Tracker(config, ...)`."""
        return cls(config, map=map, pit_map=pit_map, estimator=estimator, set=set)

    @property
    def refused(self) -> Mapping[str, int]:
        """Messages, ticks and output stamps that were not used, by reason."""
        with self._turn:
            self._take_arrivals()
            return self._refused + self._tracker.refused_ego

    @property
    def counts(self) -> Mapping[str, Mapping[str, int]]:
        """Number of detections by sensor and disposition, of all ticks so far."""
        with self._turn:
            return {
                sensor: {str(disposition): count for disposition, count in counter.items()}
                for sensor, counter in self._counts.items()
            }

    @property
    def failures(self) -> Mapping[str, int]:
        """Number of failures inside, and of their consequences; see `Failure` for the kinds."""
        with self._turn:
            return {failure.value: count for failure, count in self._tracker.failures.counts.items()}

    @property
    def last_failure(self) -> str | None:
        """Traceback of the newest failure inside, to report it."""
        return self._tracker.failures.last

    @property
    def lateness(self) -> Mapping[str, Lateness]:
        """Delays of messages by sensor, and under `ego` for the ego, as of the last tick."""
        with self._turn:
            self._take_arrivals()
            first_ns, now_ns = self._first_tick_ns, self._last.now_ns
            none: Counter[Disposition] = Counter()
            return {
                sensor: one.lateness(self._counts.get(sensor, none)[Disposition.TOO_OLD], first_ns, now_ns)
                for sensor, one in self._receptions.items()
            }

    @property
    def timing(self) -> TickTiming:
        """Durations and missed deadlines of ticks."""
        with self._turn:
            return self._times.timing

    def receive(self, message: EgoState | DetectionList) -> None:
        """Take a message in the order of arrival.

        The detections of a sensor that the configuration does not know, and of a message that cannot be read, are
        `invalid` at the next tick; a sensor that is named in `ignore_sensors` is ignored.
        """
        self._arrivals.append(message)

    def _take_arrivals(self) -> None:
        """Give the tracker what has been received."""
        for _ in range(len(self._arrivals)):  # what comes meanwhile may wait
            message = self._arrivals.popleft()
            try:
                self._take(message)
            except Exception as error:
                self._refused[f"message cannot be read ({type(error).__name__})"] += 1
                if isinstance(message, DetectionList):
                    self._records += [
                        UpdateRecord(str(message.sensor), message.stamp_ns, message.receipt_ns, i, Disposition.INVALID)
                        for i in range(len(message.objects))
                    ]

    def _take(self, message: EgoState | DetectionList) -> None:
        if not isinstance(message, EgoState | DetectionList):
            self._refused["neither ego state nor object list"] += 1
            return
        stamp_ns, receipt_ns = integer(message.stamp_ns), integer(message.receipt_ns)
        if not (0 <= stamp_ns <= LARGEST_NS and 0 <= receipt_ns <= LARGEST_NS):
            raise OverflowError("stamps are nanoseconds since 1970")
        if isinstance(message, EgoState):
            self._receptions[EGO].add(message.stamp_ns, message.receipt_ns, 0)
        elif message.sensor in self.config.sensors:
            objects = tuple(map(self._usable, message.objects))
            message = corrected(replace(message, objects=objects), self.config.sensors)
            self._receptions[message.sensor].add(message.stamp_ns, message.receipt_ns, len(message.objects))
        else:
            if message.sensor not in self.config.ignore_sensors:
                self._refused[f"sensor {message.sensor!r} has no model"] += 1
                self._records += records(message, Disposition.INVALID)
            return
        self._tracker.receive(message)

    def _usable(self, item: Detection) -> Detection:
        """`item` as a reader of files would give it; where its values have wrong types one without any: it is invalid.

        A covariance may be a list or an array, of one or two dimensions.
        """
        try:
            if isinstance(item, Detection) and isinstance(item.covariance, list | np.ndarray):
                item = replace(item, covariance=tuple(np.ravel(item.covariance).tolist()))
            return validated_detection(item)
        except (InvalidMessageError, ValueError) as error:
            self._refused[f"detection: {str(error).partition(', not ')[0]}"] += 1
            return Detection()

    def tick(self, now_ns: int) -> TickReport:
        """Process everything received, and bring all tracks to `now_ns`. Raises `CallError` for what is no time.

        A tick before the last one is refused: it gives the tracks of the last one, without updates, and what was
        received waits for the next.
        """
        now_ns = _stamp("now_ns", now_ns)
        with self._turn:
            if self._last.tick >= 0 and now_ns < self._last.now_ns:
                self._refused["tick before the last one"] += 1
                return replace(self._last, updates=(), smoothed=())
            begun_ns = perf_counter_ns()
            self._take_arrivals()
            report = self._tracker.tick(now_ns)
            report = replace(report, updates=(*self._records, *report.updates))
            self._records = []
            self._times.add(now_ns, perf_counter_ns() - begun_ns)
            for update in report.updates:
                self._counts.setdefault(update.sensor, Counter())[update.disposition] += 1
            if self._last.tick < 0:
                self._first_tick_ns = now_ns
            self._last = report
            return report

    def state_at(self, track_id: int, stamp_ns: int) -> TrackReport:
        """A track at any stamp in or after its window; ahead of the last tick it is predicted.

        Raises `CallError` for a track that does not exist and a stamp before its window, or that is none.
        """
        stamp_ns = _stamp("stamp_ns", stamp_ns)
        with self._turn:
            return self._tracker.state_at(track_id, stamp_ns)

    def tracks_at(self, stamp_ns: int) -> tuple[TrackReport, ...]:
        """All tracks at any stamp, as `state_at` gives them; those whose window begins later are not among them."""
        stamp_ns = _stamp("stamp_ns", stamp_ns)
        with self._turn:
            return self._tracker.tracks_at(stamp_ns)

    def output(self) -> "TrackOutput":
        """A stream of published tracks, one for each topic, for a time of your choice."""
        return TrackOutput(self)

    def finish(self) -> tuple[SmoothedReport, ...]:
        """End all tracks; gives the smoothed states that were still inside a window."""
        with self._turn:
            return self._tracker.finish()


def _stamp(name: str, value: int) -> int:
    """`value` as an integer. Raises `CallError` for what is no time in nanoseconds since 1970."""
    try:
        stamp_ns = integer(value)
    except TypeError:
        stamp_ns = -1
    if not 0 <= stamp_ns <= LARGEST_NS:
        raise CallError(f"{name}: must be integer nanoseconds since 1970, is {value!r}")
    return stamp_ns


@dataclass(frozen=True, slots=True)
class TracksAt:
    """All tracks at one stamp."""

    stamp_ns: int
    tracks: tuple[TrackReport, ...]


class TrackOutput:
    """A stream of tracks whose stamps never go back.

    When to publish is up to the host; for which time, it says here: now, some time ago, the stamp of an odometry.

    Parameters
    ----------
    tracker
        Gives the tracks.
    """

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self._last_ns: int | None = None
        self._turn = threading.Lock()
        self.refused = 0
        """Stamps before the one that was published last."""

    def at(self, stamp_ns: int) -> TracksAt | None:
        """The tracks at `stamp_ns`, see `Tracker.tracks_at`; None, counted, before the stamp published last."""
        stamp_ns = _stamp("stamp_ns", stamp_ns)
        with self._turn:
            if self._last_ns is not None and stamp_ns < self._last_ns:
                self.refused += 1
                return None
            self._last_ns = stamp_ns
            return TracksAt(stamp_ns, self._tracker.tracks_at(stamp_ns))

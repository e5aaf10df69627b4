"""The tracker for a running system: messages are received as they arrive, and tracks are available at any time."""

import threading
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import index as integer
from pathlib import Path
from time import perf_counter_ns
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from fgtrack.config.reading import ConfigLike, read_config
from fgtrack.config.settings import Config
from fgtrack.core.checks import LARGEST_NS, check_paths
from fgtrack.core.diagnostic import EGO, late_ego, too_late
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.output import new_file
from fgtrack.core.state import (
    Snapshot,
    copied_attributes,
    from_bytes,
    put_back,
    to_bytes,
)
from fgtrack.core.time import NS_PER_S, nanoseconds, period_ns, seconds
from fgtrack.core.types import (
    DetectionList,
    Disposition,
    EgoState,
    Revision,
    SmoothedReport,
    TickReport,
    TrackReport,
    UpdateRecord,
)
from fgtrack.meaning.corrected import corrected, corrected_ego
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.health import (
    Health,
    HealthLimits,
    Source,
    Watch,
    delay_limits_s,
    is_silent,
    overall,
    sensor_health,
)
from fgtrack.pipeline.live_statistics import Lateness, TickTiming, spread_s
from fgtrack.pipeline.message_checks import MessageChecks, unreadable
from fgtrack.pipeline.rehearsal import rehearse
from fgtrack.runs import Node
from fgtrack.tracking.lives.latency import NEWEST
from fgtrack.tracking.tracker import MultiObjectTracker
from fgtrack.tracking.tracker_state import TrackerState

if TYPE_CHECKING:
    from fgtrack.estimation.smoothing.window import Window

__all__ = ["Checkpoint", "Tracker"]

#: First bytes of a file of a saved tracker, with the version of its contents.
_MAGIC = b"fgtrack tracker 4\n"
#: Largest lead of a receipt before the tick; a larger lead comes from a wrong clock. After a smaller lead the tracker
#: recovers by itself when the clock reaches the receipt.
MOST_AHEAD_NS = 60 * NS_PER_S
#: A tick that is earlier than the last one by more than this shows that the clock was set back, if it is not alone.
MOST_BACK_NS = NS_PER_S
#: Number of ticks in a row by which a clock that was set back is recognised.
NUM_BACK = 3


@dataclass(frozen=True)
class Checkpoint:
    """State of a `Tracker` between two ticks, with its configuration."""

    own: Snapshot
    """Counts, refused messages, timing and messages that wait for the next tick."""
    tracker: TrackerState
    config: Config


class Tracker:
    """Tracks objects in a running system, from object lists that may arrive late.

    `receive` accepts messages in the order of their arrival; `tick` processes the
    messages since the last tick. Messages that cannot be used are counted in `refused`.
    Every detection ends in exactly one disposition in `counts`. An exception in an
    estimator ends or reinitialises its track, and is counted in `failures`. A tick that
    is interrupted, or that has too little memory to publish, raises; the next tick
    continues, and no detection is lost.

    A tracker is ready when it is made: everything that a tick may need has been loaded
    and compiled. That takes seconds in a new process, and some 40 s of processor time in
    a new installation. The log of `fgtrack` has a line at the beginning and at the end.

    Any thread may call `receive`, which never waits. Other methods may be called by any
    thread too, and run one at a time.

    Parameters
    ----------
    config
        Name of a shipped configuration, path of a YAML file, a `Config`, or a mapping such as `run.config`. None stands
        for the defaults.
    map, pit_map, estimator, set
        As in `fgtrack.replay`.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_checks",
        "_records",
        "_revisions",
        "_counts",
        "_last",
        "_first_tick_ns",
        "_ready",
        "_due",
        "_ticks_ns",
        "_node",
        "_skipped",
        "_warnings",
        "_need_ego",
        "_watch",
        "_misses",
        "_num_back",
        "_newest_id",
        "_failed_before",
    )
    """Attributes that change beside the state of `_tracker` and the messages that have just arrived."""

    def __init__(
        self,
        config: ConfigLike | None = None,
        *,
        map: str | Path | None = None,  # noqa: A002 - the name of the option
        pit_map: str | Path | None = None,
        estimator: str | None = None,
        set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    ) -> None:
        config = read_config(
            config, set, track_map=map, pit_map=pit_map, estimator=estimator
        )
        rehearse(config)
        self.config = config
        self._tracker = self._built(0)
        self._checks = MessageChecks(config)
        self._records: list[UpdateRecord] = []
        self._revisions: list[Revision] = []
        self._counts: dict[str, Counter[str]] = {}
        self._last = TickReport(-1, 0, (), ())
        self._first_tick_ns = 0
        # Each message is in a tuple of its own, so that two receipts of one object differ.
        self._arrivals: deque[tuple[EgoState | DetectionList]] = deque()
        self._taken: tuple[object] | None = None  # the newest arrival that was taken
        # Validated messages for the next tick.
        self._ready: list[EgoState | DetectionList] = []
        # Those of this tick with corrected times; an interrupt leaves some for the next one.
        self._due: list[EgoState | DetectionList] = []
        self._ticks_ns: deque[int] = deque(maxlen=NEWEST)
        self._node = Node(
            None if config.clock.node_hz is None else period_ns(config.clock.node_hz)
        )
        self._skipped = 0
        self._warnings: dict[str, str] = {}  # by sensor
        # Sensors whose lists need the pose of the ego.
        self._need_ego: dict[str, None] = {}
        self._watch = Watch(config.sensors)
        self._misses: deque[bool] = deque(maxlen=NEWEST)
        # Number of ticks in a row, up to now, that lie far before the last one that was accepted.
        self._num_back = 0
        self._newest_id = -1
        # Failures before the clock was set back.
        self._failed_before: Counter[str] = Counter()
        self._turn = threading.RLock()

    def _built(self, first_track_id: int) -> MultiObjectTracker:
        """Return a tracker of the configuration without tracks."""
        return build_tracker(
            self.config,
            lambda parts: replace(
                parts,
                propagated_exceptions=(DataError,),
                first_track_id=first_track_id,
            ),
        )

    @classmethod
    def from_config(
        cls,
        config: ConfigLike | None = None,
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
        """Numbers of messages and ticks that were not used, by reason."""
        with self._turn:
            self._take_arrivals()
            return self._checks.refused + self._tracker.refused_ego

    @property
    def counts(self) -> Mapping[str, Mapping[str, int]]:
        """Numbers of detections of all ticks, by sensor and disposition."""
        with self._turn:
            return {sensor: dict(counts) for sensor, counts in self._counts.items()}

    @property
    def yaws(self) -> Mapping[str, Mapping[str, int]]:
        """Numbers of yaws by sensor: `yaws` of tracks, `flipped` by half a turn, and `unused` because they misfit."""
        with self._turn:
            return {
                sensor: dict(counts) for sensor, counts in self._tracker.yaws.items()
            }

    @property
    def failures(self) -> Mapping[str, int]:
        """Numbers of internal failures and of their consequences, by the kinds of `Failure`."""
        with self._turn:
            counts = Counter(
                {
                    failure.value: count
                    for failure, count in self._tracker.failures.counts.items()
                }
            )
            return self._failed_before + counts

    @property
    def last_failure(self) -> str | None:
        """Traceback of the newest internal failure, for a bug report."""
        return self._tracker.failures.last

    @property
    def lateness(self) -> Mapping[str, Lateness]:
        """Delays of messages by sensor, and under `ego` for the ego, up to the last tick."""
        with self._turn:
            self._take_arrivals()
            result = {}
            for name, one in self._tracker.delays.items():
                since_ns = (
                    self._first_tick_ns
                    if one.newest_receipt_ns is None
                    else one.newest_receipt_ns
                )
                silent_s = max(seconds(self._last.now_ns - since_ns), 0.0)
                result[name] = Lateness(
                    one.messages, *spread_s(one.newest_ns), silent_s
                )
            return result

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about sensors whose lists arrive later than the configuration allows, with the key to set.

        Each sensor has one warning. Another warning reports that the ego's states
        arrive later than lists that need them.
        """
        with self._turn:
            self._take_arrivals()
            window = self.config.effective
            for name, sensor in self.config.used_sensors.items():
                if name not in self._warnings:
                    delays_s = np.array(self._tracker.delays[name].newest_ns) / NS_PER_S
                    limits = [
                        (f"sensors.{name}.max_delay_s", sensor.max_delay_s),
                        (window.lag_key, window.reach_s),
                    ]
                    late = too_late(name, delays_s, limits)
                    if late is not None:
                        self._warnings[name] = str(late)
            return *self._warnings.values(), *self._late_ego()

    def _late_ego(self) -> Iterator[str]:
        """Yield the warning about a late ego, from the newest messages."""
        delays_s = {
            name: spread_s(self._tracker.delays[name].newest_ns)[0]
            for name in (EGO, *self._need_ego)
        }
        medians_s = {
            name: delay_s for name, delay_s in delays_s.items() if delay_s is not None
        }
        ego_s = medians_s.pop(EGO, None)
        late = None if ego_s is None else late_ego(ego_s, medians_s)
        if late is not None:
            yield str(late)

    def health(self, limits: HealthLimits | None = None) -> Health:
        """Return the state of the tracker with its reasons, and the statistics of each sensor and of the ego.

        `limits` are the thresholds; None stands for the defaults.
        """
        limits = limits or HealthLimits()
        reach_ns = nanoseconds(self.config.effective.reach_s)
        with self._turn:
            sources = {
                name: Source(
                    [
                        seconds(delay_ns)
                        for delay_ns in self._tracker.delays[name].newest_ns
                    ],
                    lateness.silent_s,
                    self._watch.usual_gap_s(name),
                    self._horizon_s(name, reach_ns),
                )
                for name, lateness in self.lateness.items()
            }
            used = self.config.used_sensors
            by_name = {
                name: sensor_health(
                    source,
                    delay_limits_s(self.config, name) if name in used else {},
                    self._watch.by_sensor[name],
                    limits,
                )
                for name, source in sources.items()
                if name in used or (name == EGO and self._need_ego)
            }
            silent = {name for name in by_name if is_silent(sources[name], limits)}
            stale = self._stale(silent)
            late_ticks = list(self._late_ticks(limits))
            return overall(by_name, stale, late_ticks, self._watch.revised())

    def _horizon_s(self, name: str, most_ns: int) -> float:
        """Return the longest usual delay of a sensor, at most `most_ns`; 0 before its first message."""
        delays = self._tracker.delays[name]
        return seconds(max(delays.usual_ns(most_ns), 0)) if delays.messages else 0.0

    def _stale(self, silent: Collection[str]) -> list[str]:
        """Return the reasons for which tracks are predictions alone; `silent` sources send nothing."""
        if self._last.tick < 0:
            return ["ticks: none yet"]
        reasons = []
        starting = {
            name
            for name, sensor in self.config.used_sensors.items()
            if sensor.births and sensor.gives_position
        }
        if starting and starting <= set(silent):
            reasons.append("sensors: no sensor that starts tracks sends anything")
        if EGO in silent:
            reasons.append("ego: lists need its pose, and it sends nothing")
        if self._num_back:
            reasons.append("clock: ticks are before the last one")
        return reasons

    def _late_ticks(self, limits: HealthLimits) -> Iterator[str]:
        """Yield the reason that too many ticks miss their deadline."""
        share = sum(self._misses) / max(len(self._misses), 1)
        if len(self._misses) >= limits.fewest and share > limits.missed_share:
            yield f"ticks: {100.0 * share:.3g} % miss the deadline"

    @property
    def timing(self) -> TickTiming:
        """Durations of ticks, and missed deadlines."""
        with self._turn:
            return TickTiming(
                self._last.tick + 1,
                *spread_s(self._ticks_ns),
                self._node.misses,
                self._skipped,
            )

    def receive(self, message: EgoState | DetectionList) -> None:
        """Accept a message; messages must be passed in the order of their arrival.

        Detections of an unknown sensor become `invalid` at the next tick. A receipt
        more than a minute ahead of this tick is replaced by the time of the tick.
        """
        self._arrivals.append((message,))

    def _take_arrivals(self) -> None:
        """Validate all received messages, and keep the valid ones for the next tick.

        An interrupt loses no message and takes none twice: one statement notes the outcome and the arrival.
        """
        for _ in range(len(self._arrivals)):  # messages that arrive meanwhile may wait
            arrival = self._arrivals[0]
            if arrival is not self._taken:
                ready, refused = self._checks.checked(arrival[0])
                all_ready, all_records = [*self._ready, *ready], self._records + refused
                self._ready, self._records, self._taken = (
                    all_ready,
                    all_records,
                    arrival,
                )
            self._arrivals.popleft()

    def _deliver(self, now_ns: int) -> None:
        """Pass all valid messages to the tracker; none may be received after the tick at `now_ns`.

        A receipt far ahead of the tick comes from a wrong clock, and is replaced by the
        time of the tick. Otherwise this message would count as recent, and later
        messages as old, until the clock reaches the receipt.
        """
        due, records = self._due.copy(), self._records.copy()
        for message in self._ready:
            try:
                due.append(self._corrected(message, now_ns))
            except Exception as error:
                records += self._checks.refuse(message, unreadable(error))
        self._ready, self._due, self._records = [], due, records
        tracker = self._tracker
        # An interrupt may have left messages here that the tracker has received.
        received = [row for row, each in enumerate(due) if each is tracker.received]
        for message in due[received[-1] + 1 :] if received else due:
            try:
                tracker.receive(message)
            except Exception as error:
                refused = self._checks.refuse(message, unreadable(error))
                records = self._records + refused
                self._records, tracker.received = records, message
        self._due = []

    def _corrected(
        self, message: EgoState | DetectionList, now_ns: int
    ) -> EgoState | DetectionList:
        """Return a copy of a message with corrected times."""
        is_ahead = message.receipt_ns - now_ns > MOST_AHEAD_NS
        message = replace(
            message, receipt_ns=now_ns if is_ahead else message.receipt_ns
        )
        if isinstance(message, EgoState):
            self._watch.received(EGO, message.receipt_ns)
            return corrected_ego(message, self.config.ego.clock_offset_s)
        self._watch.received(message.sensor, message.receipt_ns)
        message = corrected(message, self.config.sensors)
        if message.frame != "map":
            self._need_ego[message.sensor] = None
        return message

    def tick(self, now_ns: int) -> TickReport:
        """Process all received messages, and predict all tracks to `now_ns`; raises `CallError` for an invalid time.

        A tick before the last tick is refused: it returns the tracks of the last tick,
        and messages wait for the next tick. The third such tick in a row that is more than
        a second early shows that the clock was set back: all tracks end, and new ones
        start with the messages of the new time.
        """
        now_ns = _stamp("now_ns", now_ns)
        with self._turn:
            if self._last.tick >= 0 and now_ns < self._last.now_ns:
                is_far = self._last.now_ns - now_ns > MOST_BACK_NS
                self._num_back = self._num_back + 1 if is_far else 0
                if self._num_back < NUM_BACK:
                    self._checks.refused["tick before the last one"] += 1
                    return replace(self._last, updates=(), smoothed=(), revisions=())
                self._start_over(now_ns)
            begun_ns = perf_counter_ns()
            self._take_arrivals()
            self._deliver(now_ns)
            self._read_report()
            report = self._tracker.tick(now_ns)
            number = self._last.tick + 1
            report = replace(
                report,
                tick=number,
                updates=(*self._records, *report.updates),
                revisions=tuple(
                    replace(each, tick=number)
                    for each in (*self._revisions, *report.revisions)
                ),
            )
            counts = self._counts_plus(report.updates)
            # One statement, so that an interrupt comes before or after it.
            self._counts, self._records, self._revisions, self._tracker.unread = (
                counts,
                [],
                [],
                None,
            )
            self._ticks_ns.append(perf_counter_ns() - begun_ns)
            misses = self._node.misses
            self._node.done_ns(now_ns, self._ticks_ns[-1])
            self._misses.append(self._node.misses > misses)
            self._watch.add(report)
            self._newest_id = max(self._newest_id, _newest_id(report.updates))
            self._num_back = 0
            if self._last.tick < 0:
                self._first_tick_ns = now_ns
            elif self._node.period_ns is not None:
                self._skipped += max(
                    round((now_ns - self._last.now_ns) / self._node.period_ns) - 1, 0
                )
            self._last = report
            return report

    def _start_over(self, now_ns: int) -> None:
        """End all tracks, because the clock was set back to `now_ns`; messages of the former time are refused."""
        self._take_arrivals()
        self._read_report()
        former = self._tracker
        former.finish()
        records = [*self._records, *former.last_updates]
        self._records, former.last_updates = records, ()
        kept: list[EgoState | DetectionList] = []
        for message in (*self._due, *self._ready):
            if message.receipt_ns - now_ns <= MOST_BACK_NS // 2:
                kept.append(message)
            else:
                reason = "received before the clock was set back"
                self._records += self._checks.refuse(message, reason)
        self._due, self._ready = [], kept
        self._checks.refused["clock was set back, tracks ended"] += 1
        self._checks.refused += former.refused_ego
        self._failed_before = Counter(self.failures)
        self._tracker = self._built(self._newest_id + 1)
        self._watch = Watch(self.config.sensors)
        node = Node(self._node.period_ns)
        node.misses = self._node.misses
        self._node, self._first_tick_ns = node, now_ns

    def _read_report(self) -> None:
        """Keep the records of a tick that was interrupted when it was done, for the next report."""
        report = self._tracker.unread
        if report is not None:
            records = [*self._records, *report.updates]
            revisions = [*self._revisions, *report.revisions]
            self._records, self._revisions, self._tracker.unread = (
                records,
                revisions,
                None,
            )

    def checkpoint(self) -> Checkpoint:
        """Return a copy of all that changes, from which `restore` goes on with the same bits.

        Messages that were received and not processed are part of it. Raises `CallError` for an estimator of a plug-in
        that has no checkpoint.
        """
        with self._turn:
            self._take_arrivals()
            own = copied_attributes(self, self.STATE)
            return Checkpoint(own, self._tracker.checkpoint(), self.config)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Put back a checkpoint, which can be put back again; messages that were received later are dropped.

        Raises `CallError` for a checkpoint of another configuration.
        """
        if checkpoint.config != self.config:
            raise CallError(
                "checkpoint: belongs to another configuration, make a tracker with the configuration of the checkpoint"
            )
        with self._turn:
            self._arrivals.clear()
            put_back(self, self.STATE, checkpoint.own)
            self._tracker.restore(checkpoint.tracker)

    def save(self, path: str | Path, *, overwrite: bool = True) -> None:
        """Write the configuration and the state to a file, from which `Tracker.load` goes on.

        Raises `CallError` where the file cannot be written.
        """
        check_paths(path=path)
        data = to_bytes(self.checkpoint())
        with new_file(Path(path), overwrite) as file:
            file.write(_MAGIC + data)

    def __getstate__(self) -> Checkpoint:
        return self.checkpoint()

    def __setstate__(self, checkpoint: Checkpoint) -> None:
        self.__init__(checkpoint.config)  # type: ignore[misc]  # an empty tracker, to which the state is given
        self.restore(checkpoint)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return a tracker with the configuration and state of a file that `save` wrote, also in a new process.

        The next ticks are those of the saved tracker, bit for bit. The map is read again. Raises
        `DataError` for a file that is not a saved tracker of this version.
        """
        check_paths(path=path)
        try:
            data = Path(path).read_bytes()
        except OSError as error:
            raise CallError(f"{path}: cannot be read ({error.strerror})") from error
        if not data.startswith(_MAGIC):
            raise DataError(f"{path}: is not a tracker that this version saved")
        checkpoint = from_bytes(data[len(_MAGIC) :])
        if not isinstance(checkpoint, Checkpoint):
            raise DataError(f"{path}: contains no tracker")
        tracker = cls(checkpoint.config)
        tracker.restore(checkpoint)
        return tracker

    def state_at(self, track_id: int, stamp_ns: int) -> TrackReport:
        """Return the state of a track at any stamp in or after its window; it is predicted beyond the last tick.

        Raises `CallError` for an unknown track, a stamp before its window, and an
        invalid stamp.
        """
        track_id = _track_id(track_id)
        stamp_ns = _stamp("stamp_ns", stamp_ns)
        with self._turn:
            return self._tracker.state_at(track_id, stamp_ns)

    def window(self, track_id: int) -> "Window":
        """Return a copy of a track's window: states, prior and measurements, which can be converted to a gtsam graph.

        Raises `CallError` for an unknown track, and if the estimator is no smoother.
        """
        track_id = _track_id(track_id)
        with self._turn:
            return self._tracker.window(track_id)

    def tracks_at(self, stamp_ns: int) -> tuple[TrackReport, ...]:
        """Return the states at `stamp_ns` of all tracks whose window reaches back to this stamp, as `state_at`."""
        stamp_ns = _stamp("stamp_ns", stamp_ns)
        with self._turn:
            return self._tracker.tracks_at(stamp_ns)

    def finish(self) -> tuple[SmoothedReport, ...]:
        """End all tracks, and return the smoothed states that were still inside a window.

        Lists that wait for an ego message are processed first, and `counts` contains
        their detections.
        """
        with self._turn:
            self._read_report()
            final = self._tracker.finish()
            counts = self._counts_plus((*self._records, *self._tracker.last_updates))
            self._counts, self._records, self._tracker.last_updates = counts, [], ()
            return final

    def _counts_plus(self, updates: Sequence[UpdateRecord]) -> dict[str, Counter[str]]:
        """Return the numbers of detections by sensor and disposition, including new `updates`."""
        counts = Counter((update.sensor, str(update.disposition)) for update in updates)
        result = {sensor: counter.copy() for sensor, counter in self._counts.items()}
        for (sensor, disposition), count in counts.items():
            name = self._checks.name_for_counts(sensor)
            result.setdefault(name, Counter())[disposition] += count
        return result


def _newest_id(records: Iterable[UpdateRecord]) -> int:
    """Return the largest number of a track that one of `records` has started; -1 without any."""
    return max(
        (
            record.track_id
            for record in records
            if record.disposition is Disposition.BIRTH and record.track_id is not None
        ),
        default=-1,
    )


def _track_id(value: int) -> int:
    """Return `value` as an integer; raises `CallError` for another type."""
    try:
        return integer(value)
    except TypeError as error:
        raise CallError(f"track_id: must be an integer, is {value!r:.60}") from error


def _stamp(name: str, value: int) -> int:
    """Return `value` as an integer; raises `CallError` for an invalid time."""
    try:
        stamp_ns = -1 if isinstance(value, bool | np.bool_) else integer(value)
    except TypeError:
        stamp_ns = -1
    if not 0 <= stamp_ns <= LARGEST_NS:
        raise CallError(
            f"{name}: must be integer nanoseconds since 1970, is {value!r:.60}"
        )
    return stamp_ns

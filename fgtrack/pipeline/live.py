"""The tracker in a running system: messages in as they arrive, tracks out at any time."""

import threading
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import index as integer
from pathlib import Path
from time import perf_counter_ns
from typing import TYPE_CHECKING, Self

import numpy as np

from fgtrack.config.reading import ConfigLike, read_config
from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.diagnostic import EGO, late_ego, too_late
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import NS_PER_S, period_ns, seconds
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
from fgtrack.inputs.validation import (
    InvalidMessageError,
    validated_detection,
    validated_head,
)
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import corrected
from fgtrack.runs import Node
from fgtrack.tracking.lives.latency import NEWEST

if TYPE_CHECKING:
    from fgtrack.estimation.smoothing.window import Window

__all__ = ["Lateness", "TickTiming", "Tracker"]

#: Number of sensors without a model that are counted by name; all further ones are counted as `OTHERS`.
MOST_UNKNOWN = 100
OTHERS = "other sensors"
#: A receipt that is further ahead of the tick is of a wrong clock; from a smaller error the tracker recovers by itself,
#: when the time has come.
MOST_AHEAD_NS = 60 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Lateness:
    """Delays of the newest 1,000 messages of a sensor, or of the ego: receipt minus the oldest stamp of the message."""

    messages: int
    """All that were received."""
    delay_median_s: float | None
    """None before the first message."""
    delay_p99_s: float | None
    """99th percentile."""
    delay_worst_s: float | None
    """Longest."""
    silent_s: float
    """From the newest receipt (or the first tick, where there was none) to the last tick."""


@dataclass(frozen=True, slots=True)
class TickTiming:
    """Durations of the newest 1,000 ticks, and missed deadlines."""

    ticks: int
    """All."""
    median_s: float | None
    """None before the first tick."""
    p99_s: float | None
    """99th percentile."""
    worst_s: float | None
    """Longest."""
    deadline_misses: int
    """Ticks that were not done when the next one was due, as in a replay; 0 where there is no `clock.node_hz`."""
    skipped: int
    """Periods of the node in which the host called no tick."""


def _spread_s(
    newest_ns: Sequence[int],
) -> tuple[float | None, float | None, float | None]:
    """Return median, 99th percentile, maximum; None where there is no duration."""
    if not newest_ns:
        return None, None, None
    median_s, p99_s, worst_s = (
        np.quantile(newest_ns, (0.5, 0.99, 1.0)) / NS_PER_S
    ).tolist()
    return median_s, p99_s, worst_s


class Tracker:
    """Tracks objects from object lists that arrive late, in a running system.

    `receive` takes messages in the order of their arrival, `tick` processes those since the last one. Messages that
    cannot be used are counted in `refused`, and every detection ends in exactly one disposition of `counts`. An
    exception of an estimator ends or reinitialises its track, counted in `failures`. A tick that is interrupted, or
    that has not enough memory to publish, raises; the next one goes on, and no detection is lost.

    `receive` may be called by any thread and never waits; other calls, by any thread as well, take turns.

    Parameters
    ----------
    config
        Name of a shipped configuration, path of a YAML file, a `Config` or a mapping as `run.config`; None for the
        defaults.
    map, pit_map, estimator, set
        As of `fgtrack.replay`.
    """

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
        self.config = config
        self._tracker = build_tracker(
            config, lambda parts: replace(parts, propagated_exceptions=(DataError,))
        )
        self._refused: Counter[str] = Counter()
        self._unknown: dict[str, None] = {}
        self._records: list[UpdateRecord] = []
        self._uncounted: TickReport | None = None  # of a tick that was interrupted
        self._counts: dict[str, Counter[str]] = {}
        self._last = TickReport(-1, 0, (), ())
        self._first_tick_ns = 0
        self._arrivals: deque[EgoState | DetectionList] = deque()
        self._ready: deque[EgoState | DetectionList] = (
            deque()
        )  # checked, for the next tick
        self._ticks_ns: deque[int] = deque(maxlen=NEWEST)
        self._node = Node(
            None if config.clock.node_hz is None else period_ns(config.clock.node_hz)
        )
        self._skipped = 0
        self._warnings: dict[str, str] = {}  # by sensor
        self._placed: dict[
            str, None
        ] = {}  # sensors with lists in the frame of the ego or their own
        self._turn = threading.RLock()

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
        """Messages and ticks that were not used, by reason."""
        with self._turn:
            self._take_arrivals()
            return self._refused + self._tracker.refused_ego

    @property
    def counts(self) -> Mapping[str, Mapping[str, int]]:
        """Number of detections by sensor and disposition, of all ticks so far."""
        with self._turn:
            return {sensor: dict(counts) for sensor, counts in self._counts.items()}

    @property
    def yaws(self) -> Mapping[str, Mapping[str, int]]:
        """Numbers by sensor: `yaws` of tracks, `flipped` ones by half a turn, and `unused` ones that misfit."""
        with self._turn:
            return {
                sensor: dict(counts) for sensor, counts in self._tracker.yaws.items()
            }

    @property
    def failures(self) -> Mapping[str, int]:
        """Number of failures inside, and of their consequences; see `Failure` for the kinds."""
        with self._turn:
            return {
                failure.value: count
                for failure, count in self._tracker.failures.counts.items()
            }

    @property
    def last_failure(self) -> str | None:
        """Traceback of the newest failure inside, to report it."""
        return self._tracker.failures.last

    @property
    def lateness(self) -> Mapping[str, Lateness]:
        """Delays of messages by sensor, and under `ego` for the ego, as of the last tick."""
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
                    one.messages, *_spread_s(one.newest_ns), silent_s
                )
            return result

    @property
    def warnings(self) -> tuple[str, ...]:
        """Lines on sensors whose lists come later than the configuration allows, each once, with the key to set.

        Another line names an ego whose states are later than the lists that need them.
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
        """Yield the line on an ego that is late by the newest messages."""
        delays_s = {
            name: _spread_s(self._tracker.delays[name].newest_ns)[0]
            for name in (EGO, *self._placed)
        }
        known_s = {
            name: delay_s for name, delay_s in delays_s.items() if delay_s is not None
        }
        ego_s = known_s.pop(EGO, None)
        late = None if ego_s is None else late_ego(ego_s, known_s)
        if late is not None:
            yield str(late)

    @property
    def timing(self) -> TickTiming:
        """Durations and missed deadlines of ticks."""
        with self._turn:
            return TickTiming(
                self._last.tick + 1,
                *_spread_s(self._ticks_ns),
                self._node.misses,
                self._skipped,
            )

    def receive(self, message: EgoState | DetectionList) -> None:
        """Take a message in the order of arrival; detections of an unknown sensor are `invalid` at the next tick.

        A receipt that lies more than a minute ahead of that tick is replaced by its time.
        """
        self._arrivals.append(message)

    def _take_arrivals(self) -> None:
        """Check all received messages, and keep those that can be used for the next tick."""
        for _ in range(len(self._arrivals)):  # messages that come meanwhile may wait
            message = self._arrivals[0]  # it stays there if an interrupt comes
            try:
                self._take(message)
            except InvalidMessageError as error:
                kind = (
                    "object list" if isinstance(message, DetectionList) else "ego state"
                )
                self._refuse(message, f"{kind}: {_rule(error)}")
            except Exception as error:
                self._refuse(
                    message, f"message cannot be read ({type(error).__name__})"
                )
            self._arrivals.popleft()

    def _refuse(self, message: EgoState | DetectionList, reason: str) -> None:
        """Count a message that is not used, and its detections as invalid."""
        self._refused[reason] += 1
        if isinstance(message, DetectionList):
            sensor = message.sensor if isinstance(message.sensor, str) else OTHERS
            times_ns = _recorded_ns(message.stamp_ns), _recorded_ns(message.receipt_ns)
            rows = range(len(message.objects))
            self._records += [
                UpdateRecord(sensor, *times_ns, row, Disposition.INVALID)
                for row in rows
            ]

    def _take(self, message: EgoState | DetectionList) -> None:
        if not isinstance(message, EgoState | DetectionList):
            self._refused["neither ego state nor object list"] += 1
            return
        message = validated_head(message)
        for what in ("stamp_ns", "receipt_ns"):
            if not 0 <= getattr(message, what) <= LARGEST_NS:
                raise InvalidMessageError(f"{what}: nanoseconds since 1970 expected")
        if isinstance(message, DetectionList):
            name = message.sensor
            if name not in self.config.sensors:
                if name not in self.config.ignore_sensors:
                    self._refuse(
                        message, f"sensor {self._counted(name)!r} has no model"
                    )
                return
            message = replace(
                message, objects=tuple(map(self._usable, message.objects))
            )
        self._ready.append(message)

    def _deliver(self, now_ns: int) -> None:
        """Give the tracker all messages that can be used. None was received after the tick at `now_ns`.

        A receipt far ahead of the tick is of a wrong clock. The tick is taken instead: else the message would pass for
        a recent one, and those that come later for old ones, until the clock has caught up.
        """
        while self._ready:
            message = self._ready[0]  # it stays there if an interrupt comes
            if message.receipt_ns - now_ns > MOST_AHEAD_NS:
                message = replace(message, receipt_ns=now_ns)
            try:
                if isinstance(message, DetectionList):
                    message = corrected(message, self.config.sensors)
                    if message.frame != "map":
                        self._placed[message.sensor] = None
                self._tracker.receive(message)
            except Exception as error:
                self._refuse(
                    message, f"message cannot be read ({type(error).__name__})"
                )
            self._ready.popleft()

    def _counted(self, sensor: str) -> str:
        """Return the name under which a sensor is counted: of the unknown ones, the first have their own."""
        if sensor in self.config.sensors or sensor in self._unknown:
            return sensor
        if len(self._unknown) == MOST_UNKNOWN:
            return OTHERS
        self._unknown[sensor] = None
        return sensor

    def _usable(self, item: Detection) -> Detection:
        """Return `item` with plain values; an invalid one for wrong types."""
        try:
            return validated_detection(item)
        except InvalidMessageError as error:
            self._refused[f"detection: {_rule(error)}"] += 1
            return Detection()

    def tick(self, now_ns: int) -> TickReport:
        """Process everything received, and bring all tracks to `now_ns`. Raises `CallError` for an invalid time.
        A tick before the last one is refused: it gives the tracks of that one, and messages wait for the next.
        """
        now_ns = _stamp("now_ns", now_ns)
        with self._turn:
            if self._last.tick >= 0 and now_ns < self._last.now_ns:
                self._refused["tick before the last one"] += 1
                return replace(self._last, updates=(), smoothed=())
            begun_ns = perf_counter_ns()
            self._take_arrivals()
            self._deliver(now_ns)
            if self._uncounted is not None:
                self._records += self._uncounted.updates
            self._uncounted = report = self._tracker.tick(now_ns)
            report = replace(report, updates=(*self._records, *report.updates))
            counts = Counter(
                (update.sensor, str(update.disposition)) for update in report.updates
            )
            # One statement, so that an interrupt comes before or after it.
            self._counts, self._records, self._uncounted = self._with(counts), [], None
            self._ticks_ns.append(perf_counter_ns() - begun_ns)
            self._node.done_ns(now_ns, self._ticks_ns[-1])
            if self._last.tick < 0:
                self._first_tick_ns = now_ns
            elif self._node.period_ns is not None:
                self._skipped += max(
                    round((now_ns - self._last.now_ns) / self._node.period_ns) - 1, 0
                )
            self._last = report
            return report

    def state_at(self, track_id: int, stamp_ns: int) -> TrackReport:
        """Return a track at any stamp in or after its window; ahead of the last tick it is predicted.

        Raises `CallError` for a track that does not exist, a stamp before its window and an invalid one.
        """
        track_id, stamp_ns = _track_id(track_id), _stamp("stamp_ns", stamp_ns)
        with self._turn:
            return self._tracker.state_at(track_id, stamp_ns)

    def window(self, track_id: int) -> "Window":
        """Return a copy of the window of a track: states, prior and measurements, also as a graph of gtsam.

        Raises `CallError` for a track that does not exist, and unless the estimator is a smoother.
        """
        track_id = _track_id(track_id)
        with self._turn:
            return self._tracker.window(track_id)

    def tracks_at(self, stamp_ns: int) -> tuple[TrackReport, ...]:
        """Return all tracks whose window reaches back to the stamp, as `state_at` gives them."""
        stamp_ns = _stamp("stamp_ns", stamp_ns)
        with self._turn:
            return self._tracker.tracks_at(stamp_ns)

    def finish(self) -> tuple[SmoothedReport, ...]:
        """End all tracks; return the smoothed states that were still inside a window.

        Lists that still wait for an ego message are processed first, and `counts` has their detections.
        """
        with self._turn:
            final = self._tracker.finish()
            updates = self._tracker.last_updates
            self._counts = self._with(
                Counter((update.sensor, str(update.disposition)) for update in updates)
            )
            return final

    def _with(self, counts: Mapping[tuple[str, str], int]) -> dict[str, Counter[str]]:
        """Return the numbers of detections by sensor and disposition with the `counts` of a tick."""
        result = {sensor: own.copy() for sensor, own in self._counts.items()}
        for (sensor, disposition), count in counts.items():
            result.setdefault(self._counted(sensor), Counter())[disposition] += count
        return result


def _rule(error: InvalidMessageError) -> str:
    """Return what was expected; the value is left out, because every value would be a reason of its own."""
    return str(error).partition(", not ")[0]


def _recorded_ns(value: object) -> int:
    """Return a time of a refused message for its records; 0 where it is not an integer."""
    try:
        return integer(value)  # type: ignore[arg-type]  # whatever was received
    except Exception:
        return 0


def _track_id(value: int) -> int:
    """Return `value` as an integer. Raises `CallError` for other types."""
    try:
        return integer(value)
    except TypeError as error:
        raise CallError(f"track_id: must be an integer, is {value!r:.60}") from error


def _stamp(name: str, value: int) -> int:
    """Return `value` as an integer. Raises `CallError` for an invalid time."""
    try:
        stamp_ns = -1 if isinstance(value, bool | np.bool_) else integer(value)
    except TypeError:
        stamp_ns = -1
    if not 0 <= stamp_ns <= LARGEST_NS:
        raise CallError(
            f"{name}: must be integer nanoseconds since 1970, is {value!r:.60}"
        )
    return stamp_ns

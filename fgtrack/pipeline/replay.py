"""Replay: messages in receipt order through a tracker into a run folder."""

import importlib.metadata
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import count
from pathlib import Path
from time import perf_counter_ns

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import DetectionList, EgoState, Message, TruthState
from fgtrack.io.errors import UntilBreak
from fgtrack.io.run import MemoryRun, Run, RunWriter, path_from_run
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.assumptions.assumed import assumed, is_open, source_of
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import Delivered, Tick, corrected, message_ticks, node_ticks
from fgtrack.pipeline.config import ClockConfig, Config
from fgtrack.pipeline.ego_clock import EgoClock
from fgtrack.pipeline.load import dump, plain
from fgtrack.tracking.tracker import Tracker, TrackerParts, check_sensor

#: Ticks go on while nothing is received: a few messages must not make a recording of days.
_LONGEST_SILENCE_S = 3600.0
_TICKS = 50  # between two signs of progress
_PACKAGES = ("fgtrack", "gtsam", "numpy", "scipy", "rosbags")


@dataclass(frozen=True)
class ReplayResult:
    """A finished run."""

    path: Path
    meta: dict[str, object]
    broken: str | None
    """Why the input broke off, where it did; the run holds everything before."""


@dataclass
class _Feed:
    """The input on its way to the tracker: sets truth and ignored sensors apart, and ends where the input breaks, or
    has a list of a sensor that has no model."""

    messages: Iterable[Message]
    sensors: Mapping[str, SensorModel]
    ignored_sensors: frozenset[str]
    on_truth: Callable[[TruthState], None]
    on_ego: Callable[[EgoState], None]
    on_detections: Callable[[DetectionList], None]
    broken: str | None = None
    ignored_detections: int = 0
    received_detections: int = 0
    num_messages: int = 0
    _ego_clock: EgoClock = field(default_factory=EgoClock, init=False)
    first_receipt_ns: int | None = field(default=None, init=False)
    last_receipt_ns: int | None = field(default=None, init=False)

    def __iter__(self) -> Iterator[Delivered]:
        for message in self._until_break():
            if isinstance(message, TruthState):
                self.on_truth(message)
                continue
            if isinstance(message, DetectionList):
                self.received_detections += len(message.objects)
                self.on_detections(message)
            else:
                self.on_ego(message)
            yield message
        if self.last_receipt_ns is None and self.broken is None:
            self.broken = "holds neither ego states nor detections"

    def _until_break(self) -> Iterator[Message]:
        """Yield the input up to its break; an error of a receiver of messages is no break."""
        try:
            for message in self.messages:
                self.num_messages += 1
                if isinstance(message, DetectionList):
                    if message.sensor in self.ignored_sensors:
                        self.ignored_detections += len(message.objects)
                        continue
                    check_sensor(message.sensor, self.sensors)
                if not isinstance(message, TruthState):
                    self._check_time(message)
                if isinstance(message, DetectionList):
                    message = corrected(message, self.sensors)
                yield message
        except DataError as error:
            self.broken = str(error)

    def _check_time(self, message: Delivered) -> None:
        """Receipts never go back and leave no gap of hours; ego stamps keep to one clock."""
        gap_s = 0.0 if self.last_receipt_ns is None else seconds(message.receipt_ns - self.last_receipt_ns)
        if gap_s < 0.0:
            raise DataError(
                f"receipt time goes back by {-gap_s:g} s at {message.receipt_ns} ns: sort the input by receipt"
            )
        if gap_s > _LONGEST_SILENCE_S:
            raise DataError(
                f"nothing was received for {gap_s:.0f} s before {message.receipt_ns} ns: cut the recording there"
            )
        self.last_receipt_ns = message.receipt_ns
        if self.first_receipt_ns is None:
            self.first_receipt_ns = message.receipt_ns
        if isinstance(message, EgoState):
            self._ego_clock.check(message)


def replay(
    messages: Iterable[Message],
    config: Config,
    out: Path,
    *,
    origin: str = "",
    kind: str = "",
    on_tick: Callable[[int, int], None] | None = None,
    overwrite: bool = False,
) -> ReplayResult:
    """Run the tracker that `config` describes over `messages` and write the run folder `out`.

    Parameters
    ----------
    messages
        In receipt order. Where they end in a `DataError`, the run ends there in good order and says so.
    origin, kind
        What the input is, for meta.json.
    on_tick
        Called after each tick with its time in ns and its number of tracks.
    overwrite
        Replace a run at `out`, once the first tick is done.

    Raises
    ------
    CallError
        The configuration cannot be built, something is at `out`, or it cannot be written to.
    DataError
        A sensor of the input has no model, or the input gives the tracker nothing.
    """
    runs = replay_each(
        again(messages, config),
        config,
        {config.estimator: out},
        origin=origin,
        kind=kind,
        on_tick=on_tick,
        overwrite=overwrite,
    )
    return runs[0]


def replay_in_memory(
    messages: Iterable[Message],
    config: Config,
    *,
    origin: str = "",
    kind: str = "",
    observed: Callable[[TrackerParts], TrackerParts] | None = None,
) -> tuple[Run, str | None]:
    """The run that `replay` would write and `load_run` read, and why the input broke off, where it did.

    Without files it takes less time. `observed` is that of `build_tracker`. Raises as `replay`.
    """
    repeated = again(messages, config)
    config = assumed(config, source_of(repeated)).config
    tracker = build_tracker(config, observed)
    memory = MemoryRun(*_opening(config, origin, kind))
    _, broken = _drive(tracker, repeated(), config, memory, origin=origin)
    return memory.run, broken


def again(messages: Iterable[Message], config: Config) -> Callable[[], Iterable[Message]]:
    """Gives `messages`; kept where they are needed twice, to find what `config` leaves open."""
    if not is_open(config):
        return lambda: messages
    readable = UntilBreak(messages)
    kept = list(readable)

    def repeated() -> Iterator[Message]:
        yield from kept
        readable.raise_error()

    return repeated


def _drive(
    tracker: Tracker,
    messages: Iterable[Message],
    config: Config,
    writer: RunWriter | MemoryRun,
    on_tick: Callable[[int, int], None] | None = None,
    origin: str = "",
) -> tuple[dict[str, object], str | None]:
    """Run `tracker` over `messages` into `writer`; return meta and why the input broke off.

    Only here the wall clock is read: the ticks are those of the recording, however long they take.
    """
    started_ns = perf_counter_ns()
    ignored = frozenset(config.ignore_sensors)
    feed = _Feed(messages, config.sensors, ignored, writer.write_truth, writer.write_ego, writer.write_detections)
    for tick in _ticks(feed, config.clock):
        before_ns = perf_counter_ns()
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns)
        process_ns = perf_counter_ns() - before_ns
        num_detections = sum(len(one.objects) for one in tick.messages if isinstance(one, DetectionList))
        writer.write_tick(report, process_ns, num_detections)
        if on_tick is not None:
            on_tick(tick.now_ns, len(report.tracks))
    if feed.broken is not None and feed.last_receipt_ns is None:
        raise DataError(located(feed.broken, origin))
    writer.write_smoothed(tracker.finish())
    meta = {
        "wall_s": (perf_counter_ns() - started_ns) / NS_PER_S,
        "messages_received": feed.num_messages,
        "first_receipt_ns": feed.first_receipt_ns,
        "last_receipt_ns": feed.last_receipt_ns,
        "detections_received": feed.received_detections,
        "detections_ignored": feed.ignored_detections,
        "ego_refused": dict(tracker.refused_ego),
        "ego_jumps": tracker.ego_jumps,
        **tracker.failures.as_meta(),
        "broken_off": feed.broken,
    }
    return writer.finish(meta), feed.broken


def _opening(
    config: Config, origin: str, kind: str, folder: Path | None = None
) -> tuple[str, dict[str, object], float | None]:
    """Return the beginning of a run in `folder`: text of its configuration, meta data, lag of its smoothed states."""
    source = {"path": origin, "kind": kind}
    if folder is not None and (place := path_from_run(origin, folder)) is not None:
        source["path_from_run"] = place
    meta: dict[str, object] = {"input": source, "estimator": config.estimator, "versions": versions(), "seed": None}
    meta["effective"] = plain(config.effective)
    return dump(config), meta, next(iter(config.smoother.lagged_s), None)


def replay_each(
    messages: Callable[[], Iterable[Message]],
    config: Config,
    folders: Mapping[str, Path],
    *,
    origin: str = "",
    kind: str = "",
    on_tick: Callable[[int, int], None] | None = None,
    overwrite: bool = False,
) -> list[ReplayResult]:
    """A `replay` for every estimator of `folders` into its folder; all are built and claimed before the first one."""
    results = []
    config = assumed(config, source_of(messages)).config
    with ExitStack() as claims:
        runs = []
        for estimator, folder in folders.items():
            chosen = replace(config, estimator=estimator)
            tracker = build_tracker(chosen)
            writer = RunWriter(folder, *_opening(chosen, origin, kind, folder), overwrite)
            runs.append((chosen, tracker, claims.enter_context(writer)))
        for chosen, tracker, writer in runs:
            finished = _drive(tracker, messages(), chosen, writer, on_tick, origin)
            results.append(ReplayResult(writer.path, *finished))
    return results


def tick_progress(
    tell: Callable[[str, float | None], None], end_ns: int | None, names: Sequence[str]
) -> Callable[[int, int], None]:
    """Return the `on_tick` of replays by the estimators `names`: it gives `tell` the share that is done now and then.

    `end_ns` is when the recording ends, where that is known.
    """
    ticks = count()
    first_ns, last_ns, passed = 0, 0, -1

    def moved(now_ns: int, num_tracks: int) -> None:
        nonlocal first_ns, last_ns, passed
        if passed < 0 or now_ns < last_ns:  # the next estimator begins
            first_ns, passed = now_ns, passed + 1
        last_ns = now_ns
        if next(ticks) % _TICKS == 0:
            done_ns = now_ns - first_ns
            share = None if end_ns is None else (passed + min(done_ns / max(end_ns - first_ns, 1), 1.0)) / len(names)
            tell(f"{names[passed]}, {done_ns / NS_PER_S:.1f} s of data, {num_tracks} tracks", share)

    return moved


def located(problem: str, origin: str) -> str:
    """A line that says what is wrong with the input `origin`, and names it."""
    line = " ".join(problem.split())
    return line if origin in line else f"{origin}: {line}"


def delivered(messages: Iterable[Message], config: Config) -> Iterator[Tick]:
    """The ticks of a replay of `messages` with `config`, and what the tracker gets at each."""
    feed = _Feed(messages, config.sensors, frozenset(config.ignore_sensors), *3 * (lambda _: None,))
    return _ticks(feed, config.clock)


def _ticks(messages: Iterable[Delivered], clock: ClockConfig) -> Iterator[Tick]:
    if clock.node_hz is None:
        return message_ticks(messages)
    return node_ticks(messages, clock.node_hz)


@cache
def versions() -> dict[str, str]:
    """Versions of what a result depends on, by name."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in _PACKAGES}

"""Replay: runs messages in receipt order through a tracker, into a run."""

import importlib.metadata
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from time import perf_counter_ns
from typing import get_args

from fgtrack.config.settings import ClockConfig, Config
from fgtrack.config.yaml_file import dump, plain
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import DetectionList, EgoState, Message, TickReport, TruthState
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.formats import STREAM
from fgtrack.meaning.assumed import assumed, is_open, source_of
from fgtrack.meaning.corrected import corrected, corrected_ego
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import Delivered, Tick, busy_ticks, clock_ticks, with_last
from fgtrack.runs import (
    MemoryRun,
    Run,
    RunWriter,
    TableFormat,
    TruthStorage,
    path_from_run,
)
from fgtrack.tracking.parts import TrackerParts, check_sensor
from fgtrack.tracking.tracker import MultiObjectTracker

#: Longest gap between receipts. Ticks continue during a gap, so a wrong receipt could cause ticks for days.
_LONGEST_SILENCE_S = 3600.0
_PACKAGES = ("fgtrack", "gtsam", "numpy", "scipy", "rosbags")


class Feed:
    """Iterator over the messages for the tracker: stamps are corrected, and ignored sensors left out.

    It ends at a break of the input or at an invalid message; `broken` then contains the
    reason. The attributes count the messages up to now.
    """

    def __init__(self, messages: Iterable[Message], config: Config) -> None:
        self._messages = messages
        self._config = config
        self.broken: str | None = None
        self.num_messages = 0
        self.ignored_detections = 0
        self.first_receipt_ns: int | None = None
        self.last_receipt_ns: int | None = None

    def __iter__(self) -> Iterator[Message]:
        ignored = frozenset(self._config.ignore_sensors)
        sensors = self._config.sensors
        try:
            for message in self._messages:
                self.num_messages += 1
                if isinstance(message, DetectionList):
                    if message.sensor in ignored:
                        self.ignored_detections += len(message.objects)
                        continue
                    check_sensor(message.sensor, sensors)
                    message = corrected(message, sensors)
                elif isinstance(message, EgoState):
                    message = corrected_ego(message, self._config.ego.clock_offset_s)
                if not isinstance(message, TruthState):
                    self._check_receipt(message.receipt_ns)
                yield message
        except DataError as error:
            self.broken = str(error)

    def _check_receipt(self, receipt_ns: int) -> None:
        """Raise `DataError` if the receipt goes back, or follows after a gap of more than an hour."""
        if self.first_receipt_ns is None or self.last_receipt_ns is None:
            self.first_receipt_ns = self.last_receipt_ns = receipt_ns
        gap_s = seconds(receipt_ns - self.last_receipt_ns)
        if gap_s < 0.0:
            raise DataError(
                f"receipt time goes back by {-gap_s:g} s at {receipt_ns} ns: sort the input by receipt"
            )
        if gap_s > _LONGEST_SILENCE_S:
            raise DataError(
                f"nothing was received for {gap_s:.0f} s before {receipt_ns} ns: cut the recording there"
            )
        self.last_receipt_ns = receipt_ns


def replay(
    messages: Callable[[], Iterable[Message]],
    config: Config,
    folders: Mapping[str, Path],
    *,
    origin: str = "",
    kind: str = "",
    on_tick: Callable[[TickReport], None] = lambda report: None,
    overwrite: bool = False,
    observed: Mapping[str, Callable[[TrackerParts], TrackerParts]] | None = None,
    table_format: TableFormat = "csv",
    truth: TruthStorage | None = None,
) -> list[dict[str, object]]:
    """Run each estimator in `folders` over the messages into its run folder; return the contents of each meta.json.

    `messages` returns an iterator in receipt order. If the iterator raises `DataError`,
    the run ends there, and `broken_off` in the meta data contains the reason. `origin`
    and `kind` are path and format of the input. `observed` is the argument of
    `build_tracker`, by estimator. `table_format` is the format of the tables in the run
    folders. `truth` is `copy` or `recording`, as in `truth_storage`.

    Raises `CallError` if the truth cannot stay in the recording, and `DataError` for an
    input without messages for the tracker.
    """
    storage = truth_storage(truth, table_format, kind)
    config = assumed(config, source_of(messages)).config
    with ExitStack() as stack:
        runs = []
        for estimator, folder in folders.items():
            chosen = replace(config, estimator=estimator)
            tracker = build_tracker(chosen, (observed or {}).get(estimator))
            head = _head(chosen, origin, kind, folder)
            writer = RunWriter(folder, *head, overwrite, table_format, storage)
            runs.append((chosen, tracker, stack.enter_context(writer)))
        return [
            _drive(tracker, messages(), chosen, writer, origin, on_tick)
            for chosen, tracker, writer in runs
        ]


def truth_storage(
    given: TruthStorage | None, table_format: TableFormat, kind: str
) -> TruthStorage:
    """Return where the truth of a run is: a `copy` in the run folder, or only in the `recording`.

    The default is `recording` for Parquet tables of an fgtrack stream, and `copy`
    otherwise. Raises `CallError` if the truth shall stay in a recording of another format.
    """
    if given is None:
        return "recording" if (table_format, kind) == ("parquet", STREAM) else "copy"
    if given == "recording" and kind != STREAM:
        raise CallError(
            f"truth: can stay only in an fgtrack stream, the recording is {kind!r}; give copy, "
            "or make a stream with `fgtrack convert`"
        )
    if given not in get_args(TruthStorage):
        raise CallError(f"truth: give copy or recording, not {given!r}")
    return given


def replay_in_memory(
    messages: Iterable[Message],
    config: Config,
    *,
    origin: str = "",
    kind: str = "",
    observed: Callable[[TrackerParts], TrackerParts] | None = None,
) -> Run:
    """Return the run that `replay` would write, without writing files; `observed` as in `build_tracker`.

    Raises the exceptions of `replay`.
    """
    repeated = repeatable(messages, config)
    config = assumed(config, source_of(repeated)).config
    tracker = build_tracker(config, observed)
    memory = MemoryRun(*_head(config, origin, kind))
    _drive(tracker, repeated(), config, memory, origin)
    return memory.run


def repeatable(
    messages: Iterable[Message], config: Config
) -> Callable[[], Iterable[Message]]:
    """Return a function that returns `messages`.

    The messages are kept in memory if assumptions must be made about them before the
    replay (`is_open`).
    """
    if not is_open(config):
        return lambda: messages
    readable = UntilBreak(messages)
    kept = list(readable)

    def repeated() -> Iterator[Message]:
        yield from kept
        readable.raise_error()

    return repeated


def _drive(
    tracker: MultiObjectTracker,
    messages: Iterable[Message],
    config: Config,
    writer: RunWriter | MemoryRun,
    origin: str,
    on_tick: Callable[[TickReport], None] = lambda report: None,
) -> dict[str, object]:
    """Run `tracker` over `messages` tick by tick, with the results to `writer`; return the contents of meta.json."""
    started_ns = perf_counter_ns()
    feed = Feed(messages, config)
    detections_received = 0

    def written() -> Iterator[Delivered]:
        for message in feed:
            if isinstance(message, TruthState):
                writer.write_truth(message)
                continue
            if isinstance(message, DetectionList):
                writer.write_detections(message)
            yield message

    for tick, is_last in with_last(_ticks(written(), config.clock)):
        before_ns = perf_counter_ns()
        for message in tick.messages:
            tracker.receive(message)
            if isinstance(message, EgoState):
                writer.write_ego(tracker.located(message))
        report = tracker.tick(tick.now_ns, is_last)
        process_ns = perf_counter_ns() - before_ns
        num_detections = sum(
            len(item.objects)
            for item in tick.messages
            if isinstance(item, DetectionList)
        )
        detections_received += num_detections
        writer.write_tick(report, process_ns, num_detections)
        writer.write_decisions(report.revisions, report.final_tracks)
        on_tick(report)
    if feed.last_receipt_ns is None:
        raise DataError(
            with_origin(
                feed.broken or "contains neither ego states nor detections", origin
            )
        )
    writer.write_smoothed(tracker.finish())
    last = [*tracker.settled_tracks(), *tracker.final_tracks()]
    writer.write_decisions(tracker.revised(), last)
    meta = {
        "wall_s": (perf_counter_ns() - started_ns) / NS_PER_S,
        "messages_received": feed.num_messages,
        "first_receipt_ns": feed.first_receipt_ns,
        "last_receipt_ns": feed.last_receipt_ns,
        "detections_received": detections_received,
        "detections_ignored": feed.ignored_detections,
        "ego_refused": dict(tracker.refused_ego),
        "ego_jumps": tracker.ego_jumps,
        "id_conflicts": dict(tracker.id_conflicts),
        "yaws": {
            sensor: dict(counts) for sensor, counts in sorted(tracker.yaws.items())
        },
        **tracker.failures.as_meta(),
        "broken_off": feed.broken,
    }
    return writer.finish(meta)


def _head(
    config: Config, origin: str, kind: str, folder: Path | None = None
) -> tuple[str, dict[str, object], float | None]:
    """Return the configuration as text, the meta data, and the lag of the smoothed states, for the start of a run."""
    source = {"path": origin, "kind": kind}
    if folder is not None and (relative := path_from_run(origin, folder)) is not None:
        source["path_from_run"] = relative
    meta: dict[str, object] = {
        "input": source,
        "estimator": config.estimator,
        "versions": versions(),
        "seed": None,
    }
    meta["effective"] = plain(config.effective)
    if config.lifecycle.kind == "existence":
        meta["is_scored"] = True
    return dump(config), meta, next(iter(config.smoother.lagged_s), None)


def with_origin(problem: str, origin: str) -> str:
    """Return `problem` on one line, with the name of the input in front unless the problem contains the name."""
    line = " ".join(problem.split())
    return line if origin in line else f"{origin}: {line}"


def delivered(messages: Iterable[Message], config: Config) -> Iterator[Tick]:
    """Yield the ticks of a replay of `messages` with `config`, with the messages of each tick."""
    of_tracker = (
        message
        for message in Feed(messages, config)
        if not isinstance(message, TruthState)
    )
    return _ticks(of_tracker, config.clock)


def _ticks(messages: Iterable[Delivered], clock: ClockConfig) -> Iterator[Tick]:
    """Yield the ticks of `messages`, with or without the idle ticks."""
    ticks = clock_ticks(messages, clock.node_hz)
    return ticks if clock.idle_ticks else busy_ticks(ticks)


@cache
def versions() -> dict[str, str]:
    """Return the version of each package that influences results."""
    return {"python": platform.python_version()} | {
        name: importlib.metadata.version(name) for name in _PACKAGES
    }

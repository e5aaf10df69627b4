"""What is in an input: its topics or sensors with counts, rates and delays."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.time import seconds
from fgtrack.core.types import DetectionList, EgoState
from fgtrack.io.adapters import ADAPTERS
from fgtrack.io.adapters.ego import ODOMETRY
from fgtrack.io.config import InputConfig
from fgtrack.io.errors import TruncatedInput, UntilBreak
from fgtrack.io.ros.bag import Bag, BagTopic
from fgtrack.io.ros.topics import topic_uses
from fgtrack.io.source import input_kind, open_input

OTHER_CLOCK_S = 3600.0
"""Nothing is that late: the stamps and the recorder have different clocks."""


@dataclass(frozen=True)
class DelayInfo:
    """Delay of the receipts behind the stamps."""

    mean_s: float
    p50_s: float
    p90_s: float
    max_s: float


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a recording, or the messages of one kind in another input."""

    name: str
    type: str
    count: int
    rate_hz: float | None
    """None of fewer than two messages, or of messages all at one time."""
    delay: DelayInfo | None
    """None where the type has no header."""
    used_as: str | None
    """What a replay with the configuration takes it as."""
    note: str | None
    """Why it cannot be decoded, what is odd, or what a configuration could name it as."""


@dataclass(frozen=True)
class InputInfo:
    """What `fgtrack info` shows."""

    path: Path
    kind: str
    start_ns: int | None
    """First receipt; None of an empty input."""
    duration_s: float
    """From the first receipt to the last."""
    topics: tuple[TopicInfo, ...]
    problem: str | None
    """Where the input breaks off, or why a replay with the configuration would refuse it."""


def describe(path: Path | str, config: InputConfig | None = None) -> InputInfo:
    """What is in the input at `path`, and what a replay with `config` would make of it.

    Raises
    ------
    CallError
        Nothing is there.
    DataError
        It is nothing that fgtrack reads, or damaged from the start.
    """
    path = Path(path)
    kind = input_kind(path)
    times: dict[_Key, _Times] = defaultdict(_Times)
    read = _read_bag if kind == "recording" else _read_messages
    used, notes, problem = read(path, config, times)
    topics = tuple(
        TopicInfo(
            *(*key, len(times[key].receipts_ns), times[key].rate_hz(), times[key].delay()),
            used_as=used.get(key),
            note=notes.get(key),
        )
        for key in sorted(times)
    )
    receipts_ns = [receipt for item in times.values() for receipt in item.receipts_ns]
    start_ns = min(receipts_ns, default=None)
    duration_s = 0.0 if start_ns is None else seconds(max(receipts_ns) - start_ns)
    return InputInfo(path, kind, start_ns, duration_s, topics, problem)


_Key = tuple[str, str]  # name and type of a topic
_Found = tuple[dict[_Key, str], dict[_Key, str | None], str | None]  # uses, notes, what is wrong with the input


class _Times:
    """Receipts and delays of one topic."""

    def __init__(self) -> None:
        self.receipts_ns: list[int] = []
        self.delays_ns: list[int] = []

    def add(self, receipt_ns: int, stamp_ns: int | None) -> None:
        self.receipts_ns.append(receipt_ns)
        if stamp_ns is not None:
            self.delays_ns.append(receipt_ns - stamp_ns)

    def rate_hz(self) -> float | None:
        if not self.receipts_ns:
            return None
        span_s = seconds(max(self.receipts_ns) - min(self.receipts_ns))
        return (len(self.receipts_ns) - 1) / span_s if span_s > 0.0 else None

    def delay(self) -> DelayInfo | None:
        if not self.delays_ns:
            return None
        delays_s = np.array(self.delays_ns) * 1e-9
        p50, p90 = np.quantile(delays_s, [0.5, 0.9]).tolist()
        return DelayInfo(float(delays_s.mean()), p50, p90, float(delays_s.max()))


def _read_bag(path: Path, config: InputConfig | None, times: dict[_Key, _Times]) -> _Found:
    given = config or InputConfig()
    bag = Bag(path, given.message_definitions, given.largest_bytes, given.most_objects)
    used: dict[_Key, str] = {}
    problem: str | None = None
    try:
        used = {(use.topic.name, use.topic.type): use.role for use in topic_uses(bag, given)}
    except DataError as error:
        problem = str(error) if config else None
    for topic in bag.topics:
        times[topic.name, topic.type] = _Times()
    try:
        for topic, log_ns, stamp_ns in bag.stamps():
            times[topic.name, topic.type].add(log_ns, stamp_ns)
    except TruncatedInput as error:
        problem = str(error)
    return used, {(topic.name, topic.type): _note(topic, times) for topic in bag.topics}, problem


def _note(topic: BagTopic, times: dict[_Key, _Times]) -> str | None:
    delay = times[topic.name, topic.type].delay()
    if topic.problem:
        return topic.problem
    if delay and abs(delay.p50_s) > OTHER_CLOCK_S:
        return "its stamps are of another clock than the recorder's (simulated time?)"
    if topic.type == ODOMETRY:
        return "could be the ego"
    return "could be detections or truth" if topic.type in ADAPTERS else None


def _read_messages(path: Path, config: InputConfig | None, times: dict[_Key, _Times]) -> _Found:
    used: dict[_Key, str] = {}
    messages = UntilBreak(open_input(path, config).messages())
    for message in messages:
        if isinstance(message, DetectionList):
            key, use = (message.sensor, "detections"), f"detections {message.sensor}"
        else:
            use = "ego" if isinstance(message, EgoState) else "truth"
            key = (use, use)
        used[key] = use
        times[key].add(message.receipt_ns, message.stamp_ns)
    return used, {}, None if messages.error is None else str(messages.error)

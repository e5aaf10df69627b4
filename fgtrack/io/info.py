"""Contents of an input: its topics or sensors with counts, rates and delays."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.time import seconds, wrong_unit
from fgtrack.core.types import DetectionList, EgoState
from fgtrack.io.adapters import ADAPTERS
from fgtrack.io.adapters.objects import ODOMETRY
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
    """Of times with a message; None of fewer than two."""
    delay: DelayInfo | None
    """None where the type has no header."""
    used_as: str | None
    """Its use in a replay with the configuration."""
    note: str | None
    """Why it cannot be decoded, what is unusual, or what a configuration could name it as."""


@dataclass(frozen=True)
class InputInfo:
    """Contents of an input, as `fgtrack info` shows them."""

    path: Path
    kind: str
    start_ns: int | None
    """First receipt; None of an empty input."""
    duration_s: float
    """From the first receipt to the last."""
    topics: tuple[TopicInfo, ...]
    problem: str | None
    """Where the input breaks off, why a replay with the configuration would refuse it, or a wrong unit of its times."""


_Key = tuple[str, str]  # name and type of a topic
_Times = dict[_Key, list[tuple[int, int | None]]]  # receipt and stamp of every message
_Uses = tuple[dict[_Key, str], dict[_Key, str | None], str | None]  # uses, notes, problem of the input


def describe(path: Path | str, config: InputConfig | None = None) -> InputInfo:
    """Return the contents of the input at `path`, and their use in a replay with `config`.

    Raises `CallError` where nothing is there, and `DataError` where it is not an input, or damaged from the start.
    """
    path = Path(path)
    kind = input_kind(path)
    times: _Times = defaultdict(list)
    used, notes, problem = (_read_bag if kind == "recording" else _read_messages)(path, config, times)
    topics = tuple(_topic(key, times[key], used.get(key), notes.get(key)) for key in sorted(times))
    receipts_ns = [receipt_ns for every in times.values() for receipt_ns, _ in every]
    if not receipts_ns:
        return InputInfo(path, kind, None, 0.0, topics, problem)
    start_ns, end_ns = min(receipts_ns), max(receipts_ns)
    if kind != "recording":  # whose log times are in ns
        problem = problem or wrong_unit(len(receipts_ns), start_ns, end_ns)
    return InputInfo(path, kind, start_ns, seconds(end_ns - start_ns), topics, problem)


def _topic(key: _Key, times: list[tuple[int, int | None]], used_as: str | None, note: str | None) -> TopicInfo:
    delays_s = np.array([receipt_ns - stamp_ns for receipt_ns, stamp_ns in times if stamp_ns is not None]) * 1e-9
    delay, rate_hz = None, None
    if delays_s.size:
        delay = DelayInfo(float(delays_s.mean()), *np.quantile(delays_s, [0.5, 0.9, 1.0]).tolist())
        if abs(delay.p50_s) > OTHER_CLOCK_S:
            note = "its stamps are of another clock than the recorder's (simulated time?)"
    receipts_ns = {receipt_ns for receipt_ns, _ in times}
    if len(receipts_ns) > 1:
        rate_hz = (len(receipts_ns) - 1) / seconds(max(receipts_ns) - min(receipts_ns))
    return TopicInfo(*key, len(times), rate_hz, delay, used_as, note)


def _read_bag(path: Path, config: InputConfig | None, times: _Times) -> _Uses:
    given = config or InputConfig()
    bag = Bag(path, given.message_definitions)
    used: dict[_Key, str] = {}
    problem: str | None = None
    try:
        used = {(use.topic.name, use.topic.type): use.role for use in topic_uses(bag, given)}
    except DataError as error:
        problem = str(error) if config else None
    times |= {(topic.name, topic.type): [] for topic in bag.topics}
    try:
        for topic, log_ns, stamp_ns in bag.stamps():
            times[topic.name, topic.type].append((log_ns, stamp_ns))
    except TruncatedInput as error:
        problem = str(error)
    return used, {(topic.name, topic.type): _note(topic) for topic in bag.topics}, problem


def _note(topic: BagTopic) -> str | None:
    if topic.problem or topic.type == ODOMETRY:
        return topic.problem or "could be the ego"
    return "could be detections or truth" if topic.type in ADAPTERS else None


def _read_messages(path: Path, config: InputConfig | None, times: _Times) -> _Uses:
    used: dict[_Key, str] = {}
    messages = UntilBreak(open_input(path, config).messages())
    for message in messages:
        if isinstance(message, DetectionList):
            key, use = (message.sensor, "detections"), f"detections {message.sensor}"
        else:
            use = "ego" if isinstance(message, EgoState) else "truth"
            key = use, use
        used[key] = use
        times[key].append((message.receipt_ns, message.stamp_ns))
    return used, {}, None if messages.error is None else str(messages.error)

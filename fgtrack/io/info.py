"""Contents of an input: its topics or sensors with counts, rates and delays."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from fgtrack.core.diagnostic import Diagnostic, in_degrees
from fgtrack.core.errors import DataError
from fgtrack.core.time import seconds, wrong_unit
from fgtrack.core.types import Detection, DetectionList, EgoState, TruthState
from fgtrack.io.adapters import ADAPTERS
from fgtrack.io.adapters.ego import ODOMETRY
from fgtrack.io.adapters.native import TRUTH
from fgtrack.io.config import InputConfig
from fgtrack.io.errors import TruncatedInput, UntilBreak
from fgtrack.io.ros.bag import Bag, BagTopic
from fgtrack.io.ros.topics import topic_uses
from fgtrack.io.source import input_kind, open_input
from fgtrack.models.measurement import ANGULAR

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
    """Where the input breaks off, or why a replay with the configuration would refuse it."""
    cautions: tuple[Diagnostic, ...] = ()
    """Times and angles that are probably in another unit."""


def describe(path: Path | str, config: InputConfig | None = None) -> InputInfo:
    """Return the contents of the input at `path`, and their use in a replay with `config`.

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
    topics = tuple(times[key].topic(key, used.get(key), notes.get(key)) for key in sorted(times))
    spans = [span for item in times.values() for span in item.spans()]
    start_ns = min((first for _, first, _ in spans), default=None)
    end_ns = max((last for _, _, last in spans), default=0)
    duration_s = 0.0 if start_ns is None else seconds(end_ns - start_ns)
    found = [one for (name, _), item in sorted(times.items()) for one in item.cautions(name)]
    if start_ns is not None and not found and (text := wrong_unit(2, start_ns, end_ns)):
        found = [Diagnostic(str(path), text)]
    return InputInfo(path, kind, start_ns, duration_s, topics, problem, tuple(found))


_Key = tuple[str, str]  # name and type of a topic
_Found = tuple[dict[_Key, str], dict[_Key, str | None], str | None]  # uses, notes, what is wrong with the input


@dataclass
class _Times:
    """Receipts, delays and angles of one topic."""

    receipts_ns: dict[int | None, list[int]] = field(default_factory=lambda: defaultdict(list))
    """By object, of truth."""
    delays_ns: list[int] = field(default_factory=list)
    angles: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Least and largest by name."""
    newest: tuple[int | None, int] = (None, 0)
    """Newest stamp, and number of messages of it in a row before the newest."""

    def add(
        self,
        receipt_ns: int,
        stamp_ns: int | None,
        object_id: int | None = None,
        states: Sequence[EgoState | TruthState | Detection] = (),
    ) -> None:
        self.receipts_ns[object_id].append(receipt_ns)
        if stamp_ns is not None:
            self.delays_ns.append(receipt_ns - stamp_ns)
        for state, name in product(states, ANGULAR):
            value = getattr(state, name, None)
            if value is not None and math.isfinite(value):
                least, most = self.angles.get(name, (value, value))
                self.angles[name] = min(least, value), max(most, value)

    def spans(self) -> list[tuple[int, int, int]]:
        """Number, first and last of the receipts of every object."""
        return [(len(receipts), min(receipts), max(receipts)) for receipts in self.receipts_ns.values()]

    def topic(self, key: _Key, used_as: str | None, note: str | None) -> TopicInfo:
        count = sum(map(len, self.receipts_ns.values()))
        length_s = sum(seconds(last - first) for _, first, last in self.spans())
        rate_hz = (count - len(self.receipts_ns)) / length_s if length_s > 0.0 else None
        return TopicInfo(*key, count, rate_hz, self.delay(), used_as, note)

    def cautions(self, name: str) -> Iterator[Diagnostic]:
        texts = (wrong_unit(*span) for span in self.spans())
        yield from [Diagnostic(name, text) for text in texts if text is not None][:1]
        yield from filter(None, (in_degrees(name, angle, *span) for angle, span in self.angles.items()))

    def delay(self) -> DelayInfo | None:
        if not self.delays_ns:
            return None
        delays_s = np.array(self.delays_ns) * 1e-9
        return DelayInfo(float(delays_s.mean()), *np.quantile(delays_s, [0.5, 0.9, 1.0]).tolist())


def _read_bag(path: Path, config: InputConfig | None, times: dict[_Key, _Times]) -> _Found:
    given = config or InputConfig()
    bag = Bag(path, given.message_definitions)
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
            own = times[topic.name, topic.type]
            own.newest = (stamp_ns, own.newest[1] + 1) if stamp_ns == own.newest[0] else (stamp_ns, 0)
            # true states of one stamp are of as many objects
            own.add(log_ns, stamp_ns, own.newest[1] if topic.type == TRUTH else None)
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
            key = message.sensor, "detections"
            used[key] = f"detections {message.sensor}"
            times[key].add(message.receipt_ns, message.stamp_ns, states=message.objects)
        else:
            use = "ego" if isinstance(message, EgoState) else "truth"
            used[use, use] = use
            object_id = message.object_id if isinstance(message, TruthState) else None
            times[use, use].add(message.receipt_ns, message.stamp_ns, object_id, [message])
    return used, {}, None if messages.error is None else str(messages.error)

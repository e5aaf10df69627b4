"""Contents of an input: topics or sensors with counts, rates and delays."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from operator import attrgetter, itemgetter
from pathlib import Path

import numpy as np

from fgtrack.core.diagnostic import late_ego, reasons
from fgtrack.core.errors import DataError
from fgtrack.core.time import seconds, wrong_unit
from fgtrack.core.types import DetectionList, EgoState, Message
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.receipts import WRONG_RECEIPT, sorted_out
from fgtrack.inputs.ros.bag import Bag, BagTopic
from fgtrack.inputs.ros.topics import topic_uses
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.source import input_kind, open_input

OTHER_CLOCK_S = 3600.0
"""Delay in s above which stamps and receipts must come from different clocks."""


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a recording; for an input without topics, the messages of one sensor or kind."""

    name: str
    type: str
    count: int
    rate_hz: float | None
    """Rate of distinct receipts; None for fewer than two receipts."""
    delay: Mapping[str, float] | None
    """Delay from stamp to receipt: `mean_s`, `p50_s`, `p90_s` and `max_s`; None if the type has no header."""
    used_as: str | None
    """Role of the topic in a replay with the configuration; None if the topic is not used."""
    note: str | None
    """Reason why the topic cannot be decoded, or a problem of its messages; None if there is no problem."""
    late: Mapping[str, float | None]
    """Shares of messages and detections that are out of sequence; None if there are fewer than two.

    `stream_share`: share of the messages with an older stamp than an earlier received
    message of the topic. `object_share`: share of the detections with an identity that
    are older than an earlier received detection of this identity.
    """


@dataclass(frozen=True)
class InputInfo:
    """Contents of an input, as `fgtrack info` prints them."""

    path: Path
    kind: str
    start_ns: int | None
    """First receipt; None for an empty input."""
    duration_s: float
    """Time from the first receipt to the last."""
    topics: tuple[TopicInfo, ...]
    problem: str | None
    """Break of the input, reason why a replay with the configuration would be refused, or wrong unit of the times."""


_Times = tuple[int, int | None]
"""Receipt and stamp of a message."""


def describe(path: Path | str, config: InputConfig | None = None) -> InputInfo:
    """Return the contents of the input at `path`, and their use in a replay with `config`.

    Raises the exceptions of `open_input`.
    """
    path = Path(path)
    given = config or InputConfig()
    kind = input_kind(path)
    used: dict[BagTopic, str] = {}
    times: dict[BagTopic, list[_Times]] = defaultdict(list)
    object_is_late: dict[BagTopic, list[bool]] = defaultdict(list)
    left_out: dict[str, Counter[str]] = defaultdict(Counter)
    in_map = set[str]()
    problem: str | None = None
    if kind == "recording":
        bag = Bag(path, given.message_definitions)
        times |= {topic: [] for topic in bag.topics}
        try:
            used = {topic: role for topic, role, _ in topic_uses(bag, given)}
        except DataError as error:
            problem = str(error) if config else None
        readable = UntilBreak(_right(bag.stamps(), left_out))
    else:
        messages = open_input(path, given).messages()
        readable = UntilBreak(_stamps(messages, object_is_late, in_map, left_out))
    for topic, receipt_ns, stamp_ns in readable:
        times[topic].append((receipt_ns, stamp_ns))
    if readable.error is not None:
        problem = str(readable.error)
    if kind != "recording":
        used = {
            topic: topic.type.replace("detections", f"detections {topic.name}")
            for topic in times
        }
    topics = _with_left_out(
        _with_late_ego(
            [
                _topic(
                    topic, times[topic], used.get(topic), object_is_late.get(topic, ())
                )
                for topic in sorted(times, key=attrgetter("name"))
            ],
            in_map,
        ),
        left_out,
    )
    receipts_ns = [receipt_ns for every in times.values() for receipt_ns, _ in every]
    if not receipts_ns:
        return InputInfo(path, kind, None, 0.0, topics, problem)
    start_ns = min(receipts_ns)
    end_ns = max(receipts_ns)
    if kind != "recording":  # a recording's log times are certainly in ns
        problem = problem or wrong_unit(len(receipts_ns), start_ns, end_ns)
    return InputInfo(path, kind, start_ns, seconds(end_ns - start_ns), topics, problem)


def _topic(
    topic: BagTopic,
    times: Sequence[_Times],
    used_as: str | None,
    object_is_late: Sequence[bool],
) -> TopicInfo:
    delays_ns = [
        receipt_ns - stamp_ns for receipt_ns, stamp_ns in times if stamp_ns is not None
    ]
    delays_s = np.array(delays_ns) * 1e-9
    delay = None
    rate_hz = None
    note = topic.problem
    if delays_s.size:
        p50_s, p90_s, max_s = np.quantile(delays_s, [0.5, 0.9, 1.0]).tolist()
        delay = {
            "mean_s": float(delays_s.mean()),
            "p50_s": p50_s,
            "p90_s": p90_s,
            "max_s": max_s,
        }
        if abs(p50_s) > OTHER_CLOCK_S:
            note = (
                "its stamps and its log times come from different clocks "
                "(is one of them simulated time?)"
            )
        elif (wrong := np.abs(delays_s) > OTHER_CLOCK_S).any():
            plausible_s = delays_s[~wrong]
            delay |= {
                "mean_s": float(plausible_s.mean()),
                "max_s": float(plausible_s.max()),
            }
            note = f"{wrong.sum()} stamps differ from their receipt by more than an hour, and the delays exclude them"
    receipts_ns = {receipt_ns for receipt_ns, _ in times}
    if len(receipts_ns) > 1:
        rate_hz = (len(receipts_ns) - 1) / seconds(max(receipts_ns) - min(receipts_ns))
    ordered_ns = np.array(
        [
            stamp_ns
            for _, stamp_ns in sorted(each for each in times if each[1] is not None)
        ]
    )
    stream = None
    if len(ordered_ns) > 1:
        stream = float(np.mean(ordered_ns[1:] < np.maximum.accumulate(ordered_ns)[:-1]))
    late = {
        "stream_share": stream,
        "object_share": float(np.mean(object_is_late)) if object_is_late else None,
    }
    return TopicInfo(
        topic.name, topic.type, len(times), rate_hz, delay, used_as, note, late
    )


def _with_late_ego(
    topics: Sequence[TopicInfo], in_map: Set[str]
) -> tuple[TopicInfo, ...]:
    """Return `topics` with a note at the ego if its messages arrive later than lists that need its pose.

    The sensors `in_map` measure in the map, and need no pose of the ego.
    """
    delays_s = {
        topic.name: topic.delay["p50_s"]
        for topic in topics
        if topic.delay is not None and topic.note is None
    }
    lists = {
        each.name for each in topics if (each.used_as or "").startswith("detections")
    } - in_map
    need_ego_s = {name: delay_s for name, delay_s in delays_s.items() if name in lists}
    noted = []
    for topic in topics:
        late = (
            late_ego(delays_s[topic.name], need_ego_s)
            if topic.used_as == "ego" and topic.name in delays_s
            else None
        )
        noted.append(topic if late is None else replace(topic, note=late.text))
    return tuple(noted)


def _with_left_out(
    topics: Sequence[TopicInfo], left_out: Mapping[str, Counter[str]]
) -> tuple[TopicInfo, ...]:
    """Return `topics` with a note on what the reader leaves out, by the name of the topic."""
    noted = []
    for topic in topics:
        if counts := left_out.get(topic.name):
            text = f"{counts.total()} left out by the reader ({reasons(counts)})"
            note = text if topic.note is None else f"{topic.note}; {text}"
            topic = replace(topic, note=note)
        noted.append(topic)
    return tuple(noted)


def _right(
    stamps: Iterable[tuple[BagTopic, int, int | None]],
    left_out: Mapping[str, Counter[str]],
) -> Iterator[tuple[BagTopic, int, int | None]]:
    """Yield the `stamps` of messages with a plausible log time.

    Messages with a wrong log time are left out, and counted by topic in `left_out`.
    """
    for each, is_wrong in sorted_out(stamps, itemgetter(1)):
        if is_wrong:
            left_out[each[0].name][WRONG_RECEIPT] += 1
        else:
            yield each


def _stamps(
    messages: Iterator[Message],
    object_is_late: Mapping[BagTopic, list[bool]],
    in_map: set[str],
    left_out: Mapping[str, Counter[str]],
) -> Iterator[tuple[BagTopic, int, int | None]]:
    """Yield topic, receipt and stamp of each message, as if the input were a recording with a topic for each sensor.

    Appends the lateness of detections with an identity (`IdentityOrder.late`) to
    `object_is_late`, adds the sensors with detections in the map to `in_map`, and the
    counts of what the reader leaves out to `left_out`.
    """
    order = IdentityOrder()
    for message in messages:
        kind = "ego" if isinstance(message, EgoState) else "truth"
        name, kind = (
            (message.sensor, "detections")
            if isinstance(message, DetectionList)
            else (kind, kind)
        )
        topic = BagTopic(name, kind, None)
        if isinstance(message, DetectionList):
            object_is_late[topic] += order.late(message)
            left_out[message.sensor].update(message.left_out)
            if message.frame == "map":
                in_map.add(message.sensor)
        yield topic, message.receipt_ns, message.stamp_ns


class IdentityOrder:
    """Newest stamp of each identity that objects report, by sensor."""

    def __init__(self) -> None:
        self._newest_ns: dict[tuple[str, str], int] = {}

    def late(self, message: DetectionList) -> list[bool]:
        """Return, for each detection with a repeated identity, True if it is older than the newest detection of the
        identity.
        """
        late = list[bool]()
        for item in message.objects:
            if item.id is not None:
                stamp_ns = message.stamp_ns if item.stamp_ns is None else item.stamp_ns
                key = (message.sensor, item.id)
                newest_ns = self._newest_ns.get(key)
                if newest_ns is not None:
                    late.append(stamp_ns < newest_ns)
                self._newest_ns[key] = (
                    stamp_ns if newest_ns is None else max(stamp_ns, newest_ns)
                )
        return late

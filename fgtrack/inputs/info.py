"""Contents of an input: its topics or sensors with counts, rates and delays."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from fgtrack.core.diagnostic import late_ego
from fgtrack.core.errors import DataError
from fgtrack.core.time import seconds, wrong_unit
from fgtrack.core.types import DetectionList, EgoState, Message
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.ros.bag import Bag, BagTopic
from fgtrack.inputs.ros.topics import topic_uses
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.source import input_kind, open_input

OTHER_CLOCK_S = 3600.0
"""Nothing is that late: the stamps and the recorder have different clocks."""


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a recording, or the messages of one kind in another input."""

    name: str
    type: str
    count: int
    rate_hz: float | None
    """Of times with a message; None of fewer than two."""
    delay: Mapping[str, float] | None
    """`mean_s`, `p50_s`, `p90_s` and `max_s` of the receipts behind the stamps; None where the type has no header."""
    used_as: str | None
    """Its use in a replay with the configuration."""
    note: str | None
    """Why it cannot be decoded, or what is unusual."""
    late: Mapping[str, float | None]
    """Shares that are out of sequence: `stream_share` of the messages, with an older stamp than one of the topic that
    was received earlier, and `object_share` of the detections with an identity, older than one of it before; None of
    fewer than two."""


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


_Times = tuple[int, int | None]  # receipt and stamp


def describe(path: Path | str, config: InputConfig | None = None) -> InputInfo:
    """Return the contents of the input at `path`, and their use in a replay with `config`; raises as `open_input`."""
    path, given = Path(path), config or InputConfig()
    kind = input_kind(path)
    used: dict[BagTopic, str] = {}
    times: dict[BagTopic, list[_Times]] = defaultdict(list)
    own: dict[BagTopic, list[bool]] = defaultdict(list)
    still = set[str]()
    problem: str | None = None
    if kind == "recording":
        bag = Bag(path, given.message_definitions)
        times |= {topic: [] for topic in bag.topics}
        try:
            used = {topic: role for topic, role, _ in topic_uses(bag, given)}
        except DataError as error:
            problem = str(error) if config else None
        readable = UntilBreak(bag.stamps())
    else:
        readable = UntilBreak(_stamps(open_input(path, given).messages(), own, still))
    for topic, receipt_ns, stamp_ns in readable:
        times[topic].append((receipt_ns, stamp_ns))
    if readable.error is not None:
        problem = str(readable.error)
    if kind != "recording":
        used = {
            topic: topic.type.replace("detections", f"detections {topic.name}")
            for topic in times
        }
    topics = _with_late_ego(
        [
            _topic(topic, times[topic], used.get(topic), own.get(topic, ()))
            for topic in sorted(times, key=attrgetter("name"))
        ],
        still,
    )
    receipts_ns = [receipt_ns for every in times.values() for receipt_ns, _ in every]
    if not receipts_ns:
        return InputInfo(path, kind, None, 0.0, topics, problem)
    start_ns, end_ns = min(receipts_ns), max(receipts_ns)
    if kind != "recording":  # whose log times are in ns
        problem = problem or wrong_unit(len(receipts_ns), start_ns, end_ns)
    return InputInfo(path, kind, start_ns, seconds(end_ns - start_ns), topics, problem)


def _topic(
    topic: BagTopic, times: Sequence[_Times], used_as: str | None, own: Sequence[bool]
) -> TopicInfo:
    delays_s = (
        np.array(
            [
                receipt_ns - stamp_ns
                for receipt_ns, stamp_ns in times
                if stamp_ns is not None
            ]
        )
        * 1e-9
    )
    delay, rate_hz, note = None, None, topic.problem
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
                "its stamps are of another clock than the recorder's (simulated time?)"
            )
        elif (wrong := np.abs(delays_s) > OTHER_CLOCK_S).any():
            own_s = delays_s[~wrong]
            delay |= {"mean_s": float(own_s.mean()), "max_s": float(own_s.max())}
            note = f"{wrong.sum()} stamps are more than an hour from their receipt, and left out of the delays"
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
        "object_share": float(np.mean(own)) if own else None,
    }
    return TopicInfo(
        topic.name, topic.type, len(times), rate_hz, delay, used_as, note, late
    )


def _with_late_ego(
    topics: Sequence[TopicInfo], still: Set[str]
) -> tuple[TopicInfo, ...]:
    """Return `topics`. The topic of the ego gets a note if the ego is later than the sensors that are not `still`."""
    delays_s = {
        topic.name: topic.delay["p50_s"]
        for topic in topics
        if topic.delay is not None and topic.note is None
    }
    lists = {
        each.name for each in topics if (each.used_as or "").startswith("detections")
    } - still
    placed_s = {name: delay_s for name, delay_s in delays_s.items() if name in lists}
    noted = []
    for topic in topics:
        late = (
            late_ego(delays_s[topic.name], placed_s)
            if topic.used_as == "ego" and topic.name in delays_s
            else None
        )
        noted.append(topic if late is None else replace(topic, note=late.text))
    return tuple(noted)


def _stamps(
    messages: Iterator[Message], own: Mapping[BagTopic, list[bool]], still: set[str]
) -> Iterator[tuple[BagTopic, int, int | None]]:
    """Sensor or kind, receipt and stamp of `messages`, as of a recording with a topic for each.
    `own` gets for each detection whose identity came before, True if it is older than the newest of these. `still` gets
    the sensors with detections in the map, which need no ego.
    """
    order = OwnOrder()
    for message in messages:
        kind = "ego" if isinstance(message, EgoState) else "truth"
        name, kind = (
            (message.sensor, "detections")
            if isinstance(message, DetectionList)
            else (kind, kind)
        )
        topic = BagTopic(name, kind, None)
        if isinstance(message, DetectionList):
            own[topic] += order.late(message)
            if message.frame == "map":
                still.add(message.sensor)
        yield topic, message.receipt_ns, message.stamp_ns


class OwnOrder:
    """Order of the detections of each identity, by sensor."""

    def __init__(self) -> None:
        self._newest_ns: dict[tuple[str, str], int] = {}

    def late(self, message: DetectionList) -> list[bool]:
        """Return for each detection whose identity came before, True if it is older than the newest of these."""
        late = list[bool]()
        for item in message.objects:
            if item.id is not None:
                stamp_ns, key = (
                    message.stamp_ns if item.stamp_ns is None else item.stamp_ns,
                    (message.sensor, item.id),
                )
                newest_ns = self._newest_ns.get(key)
                if newest_ns is not None:
                    late.append(stamp_ns < newest_ns)
                self._newest_ns[key] = (
                    stamp_ns if newest_ns is None else max(stamp_ns, newest_ns)
                )
        return late

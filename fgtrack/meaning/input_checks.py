"""Checks of the first seconds of an input: probable errors in its configuration, and the first messages."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import takewhile

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.diagnostic import EGO, Diagnostic, in_degrees
from fgtrack.core.types import (
    DESCRIBING,
    MEASURABLE,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.evaluation.diagnostics import excluded_lines
from fgtrack.models.measurement import ANGULAR
from fgtrack.models.sensors import SensorModel

__all__ = [
    "TRIAL_S",
    "messages_within",
    "counted_lines",
    "first_contents",
    "input_checks",
]

TRIAL_S = 5.0
_SHOWN = (*MEASURABLE, "yaw_rate_radps", *DESCRIBING, "object_id")
# Detections at a larger distance, which are nearer by this factor in the other frame, are in the other frame.
_FAR_M = 250.0
_NEARER = 0.3


def messages_within(messages: Iterable[Message], duration_ns: int) -> Iterator[Message]:
    """Yield the messages that are received within `duration_ns` of the first one."""
    iterator = iter(messages)
    first = next(iterator, None)
    if first is not None:
        yield first
        yield from takewhile(
            lambda message: message.receipt_ns - first.receipt_ns <= duration_ns,
            iterator,
        )


def input_checks(messages: Sequence[Message], config: Config) -> Iterator[Diagnostic]:
    """Yield probable errors in the reading of `messages`, with the setting to change."""
    egos = [message for message in messages if isinstance(message, EgoState)]
    lists: dict[str, list[DetectionList]] = {}
    for message in messages:
        if (
            isinstance(message, DetectionList)
            and message.sensor not in config.ignore_sensors
        ):
            lists.setdefault(message.sensor, []).append(message)
    relative = sorted(
        name
        for name, result in lists.items()
        if any(each.frame != "map" for each in result)
    )
    if relative and not egos:
        text = f"no ego state is read, but {relative[0]} is relative to the ego: set its topic (input.ego)"
        yield Diagnostic(EGO, text, is_blocking=True)
    if egos and not any(ego.stamp_ns for ego in egos):
        yield Diagnostic(
            EGO,
            "all stamps are 0: set `stamp_from: receipt` on its topic",
            is_blocking=True,
        )
    yield from _degrees(EGO, egos)
    yield from _degrees(
        "truth", [message for message in messages if isinstance(message, TruthState)]
    )
    for name in sorted(set(config.sensors) - set(lists)):
        if name in (config.input.detections or config.input.csv.detections):
            yield Diagnostic(name, "no message in the first seconds")
    for name, result in sorted(lists.items()):
        sensor = config.sensors.get(name)
        objects = [item for each in result for item in each.objects]
        if not any(each.stamp_ns for each in result) and (
            sensor is None or sensor.stamp_from != "receipt"
        ):
            key = f"sensors.{name}.stamp_from"
            text = f"all stamps are 0: set `stamp_from: receipt` on its topic, or {key}; its delay is unknown"
            yield Diagnostic(name, text, {key: "receipt"}, is_blocking=True)
        yield from _degrees(name, objects)
        yield from _frames(name, result, egos)
        if sensor is not None and objects:
            yield from _measured(name, objects, sensor)


def _degrees(
    name: str, states: Sequence[EgoState | TruthState | Detection]
) -> Iterator[Diagnostic]:
    for angle in ANGULAR:
        values = [
            value
            for state in states
            if (value := getattr(state, angle, None)) is not None
        ]
        finite = [value for value in values if math.isfinite(value)]
        if (
            result := in_degrees(
                name, angle, min(finite, default=0.0), max(finite, default=0.0)
            )
        ) is not None:
            yield result


def _frames(
    name: str, lists: Sequence[DetectionList], egos: Sequence[EgoState]
) -> Iterator[Diagnostic]:
    """Yield an error if positions are far away in the configured frame, but near in the other frame."""
    points = [
        (each.stamp_ns, item.x_m, item.y_m)
        for each in lists
        for item in each.objects
        if item.x_m is not None and item.y_m is not None
    ]
    if not points or not egos:
        return
    stamps = np.array([ego.stamp_ns for ego in egos])
    nearest = [
        egos[int(np.abs(stamps - stamp_ns).argmin())] for stamp_ns, _, _ in points
    ]
    bare_m = float(np.median([math.hypot(x_m, y_m) for _, x_m, y_m in points]))
    offsets = [
        math.hypot(x_m - ego.x_m, y_m - ego.y_m)
        for (_, x_m, y_m), ego in zip(points, nearest, strict=True)
    ]
    from_ego_m = float(np.median(offsets))
    frame = lists[0].frame
    own_m, other_m = (from_ego_m, bare_m) if frame == "map" else (bare_m, from_ego_m)
    if own_m > _FAR_M and other_m < _NEARER * own_m:
        text = (
            f"detections are read in the frame {frame}, {bare_m:.0f} m away; as map coordinates they are "
            f"{from_ego_m:.0f} m from the ego: set `frame: map`"
        )
        if frame == "map":
            text = (
                f"detections are read in the map, {from_ego_m:.0f} m from the ego, but their coordinates are small "
                f"({bare_m:.0f} m): set `frame: ego` (or sensor)"
            )
        yield Diagnostic(name, text, is_blocking=True)


def _measured(
    name: str, objects: Sequence[Detection], sensor: SensorModel
) -> Iterator[Diagnostic]:
    given = {component for item in objects for component in item.measured}
    missing = [component for component in sensor.std if component not in given]
    if missing:
        has = (
            ", ".join(component for component in MEASURABLE if component in given)
            or "nothing"
        )
        text = f"never measures {', '.join(missing)} in its std, only {has}: change sensors.{name}.std or the fields"
        yield Diagnostic(name, text)


def counted_lines(messages: Iterable[Message], config: Config) -> Iterator[str]:
    """Yield a line on the number of detections of each sensor, and lines on the detections that filters exclude."""
    counts = defaultdict[str, Counter[str]](Counter)
    filtered = defaultdict[str, Counter[str]](Counter)
    left_out = defaultdict[str, Counter[str]](Counter)
    for message in messages:
        if isinstance(message, DetectionList):
            sensor = config.sensors[message.sensor]
            counts[message.sensor] += Counter(lists=1, detections=len(message.objects))
            filtered[message.sensor].update(
                f"filters.{name}"
                for item in message.objects
                if (name := sensor.refusing_filter(item))
            )
            left_out[message.sensor].update(message.left_out)
    for name, count in counts.items():
        yield f"{name}: {count['detections']} detections in {count['lists']} lists"
    detections = {
        name: {"detections": count["detections"]} for name, count in counts.items()
    }
    yield from excluded_lines(
        {
            "counts": detections,
            "out_of_bounds": _any(filtered),
            "left_out": _any(left_out),
        }
    )


def _any(counts: Mapping[str, Counter[str]]) -> dict[str, Counter[str]]:
    return {name: count for name, count in counts.items() if count}


def first_contents(messages: Sequence[Message]) -> dict[str, str]:
    """Return the content of the first message of the ego, the truth and each sensor, as text by name."""
    result: dict[str, str] = {}
    for message in messages:
        name = "truth" if isinstance(message, TruthState) else "ego"
        items = list[Message | Detection]([message])
        if isinstance(message, DetectionList):
            name = f"{message.sensor} (in the frame {message.frame})"
            items = list(message.objects)
        if items and name not in result:
            values = {
                key: value
                for key in _SHOWN
                if (value := getattr(items[0], key, None)) is not None
            }
            texts = (
                f"{key} {one:.6g}" if isinstance(one, float) else f"{key} {one}"
                for key, one in values.items()
            )
            result[name] = ", ".join(texts)
    return result

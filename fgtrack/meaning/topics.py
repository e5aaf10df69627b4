"""Roles and fields of the topics of an unknown recording, guessed from names, types and values."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import Any

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.types import DESCRIBING, MEASURABLE, STATE_NAMES
from fgtrack.inputs.formats import ADAPTERS
from fgtrack.inputs.formats.fields import fields_of
from fgtrack.inputs.formats.objects import ODOMETRY
from fgtrack.inputs.info import OTHER_CLOCK_S, TopicInfo
from fgtrack.inputs.ros.bag import Bag
from fgtrack.inputs.ros.ego import EGO_TYPES
from fgtrack.inputs.settings import TopicInput
from fgtrack.meaning.guess import guesses, words_of
from fgtrack.meaning.parts import (
    EGO_WORDS,
    NEEDED,
    POSITIONS,
    TRUTH_WORDS,
    InputPart,
    sensor_name,
    spreads,
    unused,
)
from fgtrack.meaning.times import clock_constant

__all__ = ["topic_part"]

#: Number of messages of a topic on which a guess is based.
_MESSAGES = 20
#: Words of poses that are not the ego's.
_OF_GOALS = frozenset(
    (
        "goal",
        "initialpose",
        "initial",
        "clicked",
        "setpoint",
        "waypoint",
        "desired",
        "simple",
    )
)
_OTHER_PACKAGES = (
    "sensor_msgs",
    "tf2_msgs",
    "tf/",
    "visualization_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "std_msgs",
)


def topic_part(bag: Bag, topic: TopicInfo, parts: Sequence[InputPart]) -> InputPart:
    """Return the guess for `topic` in addition to the other `parts`.

    Raises `DataError` with the reason if the topic cannot be used.
    """
    words = set(words_of(topic.name))
    is_truth = bool(words & TRUTH_WORDS and not words & EGO_WORDS)
    has_clock = (
        topic.delay is None
        or abs(topic.delay["p50_s"]) < OTHER_CLOCK_S
        or clock_constant(np.array([topic.delay["p50_s"]])) is not None
    )
    item = TopicInput(topic.name, stamp_from="message" if has_clock else "receipt")
    reasons = {
        "stamp_from": "its stamps come from another clock than the recorder's, or are not set"
    }
    problem = next(
        (
            entry.problem
            for entry in bag.topics
            if (entry.name, entry.type) == (topic.name, topic.type)
        ),
        None,
    )
    if problem is not None or not topic.count:
        raise DataError(problem or "no messages")
    sensor = sensor_name(topic.name, parts)
    if topic.type in EGO_TYPES and topic.type != ODOMETRY and not is_truth:
        if words & _OF_GOALS:
            raise DataError("a pose that is not the ego's")
        reasons["topic"] = "its poses are taken for the ego's, and give its speed"
        rank = EGO_TYPES.index(topic.type)
        return InputPart("ego", item, reasons, rank=rank)
    if topic.type == ODOMETRY or topic.type in ADAPTERS:
        return InputPart(
            "truth" if is_truth else "ego" if topic.type == ODOMETRY else sensor,
            item,
            reasons,
        )
    if topic.type.startswith(_OTHER_PACKAGES):
        raise DataError("no objects")
    part = _mapped(bag, item, topic.type, sensor)
    return replace(part, reasons={**reasons, **part.reasons})


def _mapped(bag: Bag, item: TopicInput, type_name: str, sensor: str) -> InputPart:
    """Return the guess for a topic of an unknown message type.

    Raises `DataError` if the type has no position (with the ranges of its fields), or a
    single pose (with a guess of the mapping).
    """
    messages = [
        one
        for topic, _, one in islice(bag.messages({item.topic}), _MESSAGES)
        if topic.type == type_name
    ]
    result: list[Mapping[str, Any]] = [fields_of(message) for message in messages]
    lists = _lists_in(result)
    for outer, items in list(lists.items()):
        lists |= {f"{outer}.{path}": one for path, one in _lists_in(items).items()}
    lists[""] = result  # the message itself is tried last
    for path, samples in lists.items():
        values = _columns(samples)
        own = guesses(values)
        if not any(wanted <= own.keys() for wanted in POSITIONS):
            continue
        is_ego = (
            not path
            and NEEDED["ego"] <= own.keys()
            and bool(set(words_of(item.topic)) & EGO_WORDS)
        )
        known = STATE_NAMES if is_ego else (*MEASURABLE, *DESCRIBING, "object_id")
        used = {key: one for key, one in own.items() if key in known}
        if not (path or is_ego or "range_m" in own):
            mapping = ", ".join(f"{key}: {one.path}" for key, one in used.items())
            raise DataError(
                f"one pose per message: the ego, truth or one object; fields: {{{mapping}}}"
            )
        fields = {
            **({"objects": path} if path else {}),
            **{key: one.path for key, one in used.items()},
        }
        reasons = {
            "objects": "the list in the message",
            **{key: one.reason for key, one in used.items()},
        }
        notes = unused(values, used)
        if not (path or is_ego):
            notes += (
                "one object per message: set scan_s to combine the objects of a scan",
            )
        return InputPart(
            "ego" if is_ego else sensor, replace(item, fields=fields), reasons, notes
        )
    raise DataError(f"no position among {spreads(_columns(lists[''])) or 'its fields'}")


def _lists_in(
    samples: Sequence[Mapping[str, Any]],
) -> dict[str, list[Mapping[str, Any]]]:
    """Return the fields of the objects in all lists of `samples`, by the path of the list."""
    lists: dict[str, list[Mapping[str, Any]]] = {}
    for path, items in chain.from_iterable(each.items() for each in samples):
        if isinstance(items, list):
            lists.setdefault(path, []).extend(map(fields_of, items))
    return lists


def _columns(samples: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    """Return the numbers of the samples by field name; empty for a text field."""
    names = dict.fromkeys(
        name
        for item in samples
        for name, value in item.items()
        if not isinstance(value, list)
    )
    return {
        name: [
            float(item[name])
            for item in samples
            if not isinstance(item.get(name), str | None)
        ]
        for name in names
    }

"""Validation behind every reader: all that comes out of an input has the types and ranges that the rest requires.

A wrong input is a `DataError` with its position, after everything before it. Measured numbers that are not finite pass:
the tracker counts them. Describing ones (size, score) become None.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from math import isfinite
from operator import is_
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.core.checks import LARGEST_NS, is_stamp
from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.types import (
    DESCRIBING,
    EGO_COVARIANCE_STATES,
    FRAMES,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.io.errors import one_line

__all__ = ["InvalidMessageError", "validated", "validated_detection", "validated_message"]

_MOST_OBJECTS = 100_000
_INT64 = range(-(1 << 63), 1 << 63)


class InvalidMessageError(Exception):
    """Problem of a message; the reader adds where it is."""


def validated(path: Path, messages: Callable[[], Iterator[Message]], done: bool = False) -> Iterator[Message]:
    """Messages of the input at `path` (those of a validating reader are `done`), then `DataError` where it failed."""
    count = 0
    try:
        for message in messages():
            yield message if done else validated_message(message)
            count += 1
    except InvalidMessageError as error:
        raise DataError(f"{path}: message {count + 1}: {error}") from error
    except (FgtrackError, MemoryError):
        raise
    except Exception as error:  # whatever a foreign input makes a reader raise
        what = f"{type(error).__name__}: {one_line(error)}"
        raise DataError(f"{path}: cannot be read beyond message {count} ({what}): repair or convert it") from error


def validated_message(message: Message) -> Message:
    """Return `message`, its detections as of `validated_detection`. Raises `InvalidMessageError`."""
    if not isinstance(message, DetectionList | EgoState | TruthState):
        raise InvalidMessageError(f"a {type(message).__name__} is not a message")
    _check_fields(message)
    if not is_stamp(message.receipt_ns):  # all windows are counted from it
        raise _invalid("receipt_ns", f"at most {LARGEST_NS:.0g} ns from 0", message.receipt_ns)
    if isinstance(message, DetectionList):
        if len(message.objects) > _MOST_OBJECTS:
            many = f"a list of {len(message.objects)} objects"
            raise InvalidMessageError(f"{message.sensor}: {many}, at most {_MOST_OBJECTS} are read")
        objects = []
        for index, item in enumerate(message.objects):
            try:
                objects.append(validated_detection(item))
            except InvalidMessageError as error:
                raise InvalidMessageError(f"{message.sensor}: objects[{index}]: {error}") from error
        return message if all(map(is_, objects, message.objects)) else replace(message, objects=tuple(objects))
    if isinstance(message, EgoState) and message.covariance is not None:
        size = len(EGO_COVARIANCE_STATES)
        if len(message.covariance) != size**2:
            raise InvalidMessageError(f"covariance: a list of {size} x {size} numbers expected")
    return message


def validated_detection(item: Detection) -> Detection:
    """`item`, describing numbers that are not finite replaced by None; `InvalidMessageError` for a wrong type."""
    if not isinstance(item, Detection):
        raise InvalidMessageError(f"a {type(item).__name__} is not a detection")
    _check_fields(item)
    undefined = dict[str, None]()
    for name in _NUMBERS:
        value = getattr(item, name)
        if value is not None and not isfinite(value):
            undefined[name] = None
    return replace(item, **undefined) if undefined else item


def _check_fields(item: Message | Detection) -> None:
    for name, (holds, expected), is_optional in _FIELDS[type(item)]:
        value = getattr(item, name)
        if type(value) is float and holds is _is_number:  # as nearly always
            continue
        if not (is_optional if value is None else holds(value)):
            raise _invalid(name, expected, value)


def _is_integer(value: object) -> bool:
    return value in _INT64 if type(value) is int else isinstance(value, np.integer)


def _is_number(value: object) -> bool:
    if type(value) is int:
        return value.bit_length() <= 1000
    return isinstance(value, (float, np.floating, np.integer))


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.encode(errors="replace").decode() == value


def _are_numbers(value: object) -> bool:
    return isinstance(value, tuple) and all(type(each) is float or each is None or _is_number(each) for each in value)


def _is_outline(value: object) -> bool:
    return isinstance(value, tuple) and _are_numbers(value) and len(value) >= 6 and len(value) % 2 == 0


def _is_position(value: Any) -> bool:  # Any: whatever a reader gives
    return _are_numbers(value) and len(value) == 2 and None not in value


_INTEGER = (_is_integer, "a 64 bit integer")
_FLAG = (lambda value: isinstance(value, bool | np.bool_), "true or false")
#: By field its rule and what it expects; all others are numbers.
_RULES: dict[str, tuple[Callable[[object], bool], str]] = {
    **dict.fromkeys(("stamp_ns", "receipt_ns", "object_id"), _INTEGER),
    **dict.fromkeys(("in_pit", "ignored"), _FLAG),
    "sensor": (lambda value: value != "" and _is_text(value), "a name"),
    **dict.fromkeys(("class_name", "id"), (_is_text, "a text")),
    "origin_deg": (_is_position, "two numbers"),
    "covariance": (_are_numbers, "a list of numbers"),
    "outline_m": (_is_outline, "x and y of at least three corners"),
    "frame": (lambda value: value in FRAMES, f"one of {', '.join(sorted(FRAMES))}"),
}
_NUMBERS = tuple(name for name in DESCRIBING if name not in _RULES)
_FIELDS = {
    kind: [
        (each.name, _RULES.get(each.name, (_is_number, "a number")), each.default is None)
        for each in fields(kind)
        if each.name not in ("objects", "left_out")
    ]
    for kind in (EgoState, DetectionList, TruthState, Detection)
}


def _invalid(name: str, expected: str, value: object) -> InvalidMessageError:
    return InvalidMessageError(f"{name}: {expected} expected, not {value!a:.60}")

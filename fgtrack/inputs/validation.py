"""Validation of all messages of a reader: types and ranges are as the rest of the package requires.

An invalid message raises `DataError` with its position, after all messages before it.
Measured numbers that are not finite pass, because the tracker counts them. Describing
numbers (size, score) that are not finite become None.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from itertools import chain
from math import isfinite
from numbers import Real
from operator import index, is_
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

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
from fgtrack.inputs.errors import cause

__all__ = [
    "InvalidMessageError",
    "validated",
    "validated_detection",
    "validated_head",
    "validated_message",
]

_MOST_OBJECTS = 100_000
_INT64 = range(-(1 << 63), 1 << 63)
_Item = TypeVar("_Item", bound=Message | Detection)
_Message = TypeVar("_Message", bound=Message)


class InvalidMessageError(Exception):
    """Problem of a message; the reader adds the position of the message in the recording."""


def validated(
    path: Path, messages: Callable[[], Iterator[Message]], done: bool = False
) -> Iterator[Message]:
    """Yield the messages of the input at `path` after validation; raises `DataError` at the first fault.

    `done`: the reader has validated the messages already.
    """
    count = 0
    try:
        for message in messages():
            yield message if done else validated_message(message)
            count += 1
    except InvalidMessageError as error:
        raise DataError(f"{path}: message {count + 1}: {error}") from error
    except (FgtrackError, MemoryError):
        raise
    except Exception as error:  # a corrupted input may cause any exception in a reader
        raise DataError(
            f"{path}: cannot be read beyond message {count} ({cause(error)}): repair or convert the file"
        ) from error


def validated_message(message: Message) -> Message:
    """Return `message` with plain values; the same object if all values are plain already.

    Plain values are `int`, `float`, `bool`, `str` and tuples of `float`. NumPy numbers
    are converted. A covariance may be a list or an array, flat or square. Detections
    are validated by `validated_detection`.

    Raises `InvalidMessageError`.
    """
    if not isinstance(message, DetectionList | EgoState | TruthState):
        raise InvalidMessageError(f"a {type(message).__name__} is not a message")
    message = validated_head(message)
    if isinstance(message, DetectionList):
        objects = []
        for number, item in enumerate(message.objects):
            try:
                objects.append(validated_detection(item))
            except InvalidMessageError as error:
                raise InvalidMessageError(
                    f"{message.sensor}: objects[{number}]: {error}"
                ) from error
        return (
            message
            if all(map(is_, objects, message.objects))
            else replace(message, objects=tuple(objects))
        )
    return message


def validated_head(message: _Message) -> _Message:
    """Return `message` with plain values in all fields except `objects`; raises `InvalidMessageError`."""
    message = _with_plain_values(message)
    if not is_stamp(message.receipt_ns):  # ages of messages are computed from it
        raise _invalid(
            "receipt_ns", f"at most {LARGEST_NS:.0g} ns from 0", message.receipt_ns
        )
    if isinstance(message, DetectionList) and len(message.objects) > _MOST_OBJECTS:
        raise InvalidMessageError(
            f"{message.sensor}: a list has {len(message.objects)} objects, at most {_MOST_OBJECTS} are read"
        )
    if isinstance(message, EgoState) and message.covariance is not None:
        size = len(EGO_COVARIANCE_STATES)
        if len(message.covariance) != size**2:
            raise InvalidMessageError(
                f"covariance: a list of {size} x {size} numbers expected"
            )
    return message


def validated_detection(item: Detection) -> Detection:
    """Return `item` with plain values; describing numbers that are not finite become None.

    A null in a covariance becomes NaN: the tracker counts the detection as invalid.
    Raises `InvalidMessageError` for a value of a wrong type.
    """
    if not isinstance(item, Detection):
        raise InvalidMessageError(f"a {type(item).__name__} is not a detection")
    item = _with_plain_values(item)
    undefined = dict[str, None]()
    for name in _NUMBERS:
        value = getattr(item, name)
        if value is not None and not isfinite(value):
            undefined[name] = None
    return replace(item, **undefined) if undefined else item


def _with_plain_values(item: _Item) -> _Item:
    """Return `item` with plain values; the same object if all are plain. Raises `InvalidMessageError`."""
    changed = dict[str, Any]()
    for name, (convert, expected), is_optional in _FIELDS[type(item)]:
        value = getattr(item, name)
        if type(value) is float and convert is _number:  # the usual case
            continue
        if value is None and is_optional:
            continue
        try:
            converted = convert(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise _invalid(name, expected, value) from error
        if converted is not value:
            changed[name] = converted
    return replace(item, **changed) if changed else item


def _integer(value: Any) -> int:
    if isinstance(value, bool | np.bool_):
        raise TypeError
    number: int = value if type(value) is int else index(value)
    if number not in _INT64:
        raise OverflowError
    return number


def _number(value: Any) -> float:
    if isinstance(value, float):
        return value if type(value) is float else float(value)
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError
    return float(value)


def _flag(value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise TypeError
    return bool(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    if value.encode(errors="replace").decode() != value:
        raise ValueError
    return value if type(value) is str else str(value)


def _name(value: Any) -> str:
    if not (text := _text(value)):
        raise ValueError
    return text


def _frame(value: Any) -> str:
    if (text := _text(value)) not in FRAMES:
        raise ValueError
    return text


def _is_plain(value: Any) -> TypeGuard[tuple[float, ...]]:
    """True for a tuple of floats, the usual case."""
    return type(value) is tuple and all(type(each) is float for each in value)


def _numbers(value: Any) -> tuple[float, ...]:
    """Return the numbers of a sequence as a tuple of floats."""
    if _is_plain(value):
        return value
    return tuple(map(_number, _items(value)))


def _items(value: Any) -> Sequence[Any]:
    """Return the entries of a list, a tuple, an array or another sequence; raises `TypeError` for other values."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, Sequence) or isinstance(value, str | bytes | bytearray):
        raise TypeError
    return value


def _covariance(value: Any) -> tuple[float, ...]:
    """Return the numbers of a flat or square matrix, row by row; None becomes NaN.

    Raises `ValueError` for a matrix that is not square.
    """
    if _is_plain(value):
        return value
    entries = _items(value)
    if entries and not any(each is None or isinstance(each, Real) for each in entries):
        rows = [_items(row) for row in entries]
        if any(len(row) != len(rows) for row in rows):
            raise ValueError
        entries = list(chain.from_iterable(rows))
    return tuple(math.nan if each is None else _number(each) for each in entries)


def _outline(value: Any) -> tuple[float, ...]:
    numbers = _numbers(value)
    if len(numbers) < 6 or len(numbers) % 2:
        raise ValueError
    return numbers


def _position(value: Any) -> tuple[float, ...]:
    numbers = _numbers(value)
    if len(numbers) != 2:
        raise ValueError
    return numbers


_Rule = tuple[Callable[[Any], object], str]
"""Function that converts a value or raises, and the expected value in words."""
_INTEGER: _Rule = (_integer, "a 64 bit integer")
_FLAG: _Rule = (_flag, "true or false")
#: Rule by field; all other fields are numbers.
_RULES: dict[str, _Rule] = {
    **dict.fromkeys(("stamp_ns", "receipt_ns", "object_id"), _INTEGER),
    **dict.fromkeys(("in_pit", "ignored"), _FLAG),
    "sensor": (_name, "a name"),
    **dict.fromkeys(("class_name", "id"), (_text, "a text")),
    "origin_deg": (_position, "two numbers"),
    "covariance": (_covariance, "a list of numbers"),
    "outline_m": (_outline, "x and y of at least three corners"),
    "frame": (_frame, f"one of {', '.join(sorted(FRAMES))}"),
}
_NUMBERS = tuple(name for name in DESCRIBING if name not in _RULES)
_FIELDS: dict[type, list[tuple[str, _Rule, bool]]] = {
    kind: [
        (each.name, _RULES.get(each.name, (_number, "a number")), each.default is None)
        for each in fields(kind)
        if each.name not in ("objects", "left_out")
    ]
    for kind in (EgoState, DetectionList, TruthState, Detection)
}


def _invalid(name: str, expected: str, value: object) -> InvalidMessageError:
    return InvalidMessageError(f"{name}: {expected} expected, not {value!a:.60}")

"""The gate behind every reader: all that comes out of an input has the types and ranges that the rest relies on.

A reader may meet anything. What is wrong with its input is a `DataError` that names the place, whatever the reader
raised itself; everything before has been given, so a run is complete up to there. Measured numbers that are not
finite pass: what becomes of them is counted, one by one, where they are used. Describing ones (size, score) become
None. Detections of a running system pass the same check one by one, see `checked_detection`.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import isfinite
from operator import attrgetter, is_
from pathlib import Path

import numpy as np

from fgtrack.core.checks import LARGEST_NS, is_stamp
from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.types import (
    DESCRIBING,
    FRAMES,
    MEASURABLE,
    STATE_NAMES,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.io.errors import MOST_OBJECTS, MOST_SENSORS

__all__ = ["WrongError", "checked", "checked_detection"]

_LONGEST_NAME = 200
_FAR_M = 1e9
_INT64 = range(-(1 << 63), 1 << 63)
_PLAIN = {float, type(None)}
_DESCRIBING = tuple(name for name in DESCRIBING if name != "class_name")
_NOTHING = (None,) * len(_DESCRIBING)
_state_numbers = attrgetter(*STATE_NAMES)
_measured = attrgetter(*MEASURABLE)
_described = attrgetter(*_DESCRIBING)


def checked(
    path: Path, messages: Callable[[], Iterator[Message]], most_objects: int = MOST_OBJECTS
) -> Iterator[Message]:
    """The messages of the input at `path`.

    A list with more than `most_objects` is refused, and one of a sensor beyond `MOST_SENSORS`.

    Raises
    ------
    DataError
        The reader failed, or gave what is no message; raised after everything before that.
    """
    count, sensors = 0, set[str]()
    try:
        for message in messages():
            message = _checked(message)
            if isinstance(message, DetectionList):
                sensors.add(message.sensor)
                if len(sensors) > MOST_SENSORS:
                    raise WrongError(f"{message.sensor}: the lists before it are of {MOST_SENSORS} other sensors")
                if len(message.objects) > most_objects:
                    raise WrongError(
                        f"{message.sensor}: a list of {len(message.objects)} objects, more than input.most_objects "
                        "allows"
                    )
            yield message
            count += 1
    except WrongError as error:
        raise DataError(f"{path}: message {count + 1}: {error}") from error
    except (FgtrackError, MemoryError):
        raise
    except Exception as error:  # whatever a foreign input makes a reader raise
        what = " ".join(f"{type(error).__name__}: {error}".split())[:_LONGEST_NAME]
        raise DataError(f"{path}: cannot be read beyond message {count} ({what}): repair or convert it") from error


class WrongError(Exception):
    """What is wrong with a message."""


def _checked(message: Message) -> Message:
    match message:
        case DetectionList():
            return _checked_list(message)
        case EgoState() | TruthState():
            _check_times(message)
            _check_numbers(STATE_NAMES, _state_numbers(message))
            _check_integer("object_id", message.object_id if isinstance(message, TruthState) else 0)
            _check_several("covariance" if isinstance(message, EgoState) else "outline_m", message)
        case _:
            raise WrongError(f"a {type(message).__name__} is no message")
    return message


def _checked_list(message: DetectionList) -> DetectionList:
    _check_name("sensor", message.sensor)
    _check_times(message)
    if message.frame not in FRAMES:
        raise WrongError(f"frame: one of {', '.join(sorted(FRAMES))} expected, not {_shown(message.frame)}")
    objects = []
    for index, item in enumerate(message.objects):
        try:
            objects.append(checked_detection(item))
        except WrongError as error:
            raise WrongError(f"{message.sensor}: objects[{index}]: {error}") from error
    if all(map(is_, objects, message.objects)):
        return message
    return replace(message, objects=tuple(objects))


def checked_detection(item: Detection) -> Detection:
    """Return `item` with None for describing numbers that are not finite and for class names that are too long.

    Raises `WrongError` for a value of a wrong type.
    """
    if not isinstance(item, Detection):
        raise WrongError(f"a {type(item).__name__} is no detection")
    _check_numbers(MEASURABLE, _measured(item))
    for name in ("stamp_ns", "object_id"):
        if (value := getattr(item, name)) is not None:
            _check_integer(name, value)
    if isinstance(item.class_name, str) and len(item.class_name) > _LONGEST_NAME:
        item = replace(item, class_name=None)
    if item.class_name not in (None, ""):
        _check_name("class_name", item.class_name)
    _check_several("covariance", item)
    described = _described(item)
    if described == _NOTHING:
        return item
    _check_numbers(_DESCRIBING, described)
    lost = [
        name for name, value in zip(_DESCRIBING, described, strict=True) if value is not None and not isfinite(value)
    ]
    return replace(item, **dict.fromkeys(lost)) if lost else item


def _check_times(message: Message) -> None:
    _check_integer("stamp_ns", message.stamp_ns)
    _check_integer("receipt_ns", message.receipt_ns)
    if not is_stamp(message.receipt_ns):  # all windows are counted from it
        raise WrongError(f"receipt_ns: at most {LARGEST_NS:.0g} ns from 0 expected, not {_shown(message.receipt_ns)}")


def _check_integer(name: str, value: object) -> None:
    if type(value) is int:
        if value in _INT64:
            return
    elif isinstance(value, np.integer):
        return
    raise WrongError(f"{name}: a 64 bit integer expected, not {_shown(value)}")


def _check_numbers(names: tuple[str, ...], values: tuple[object, ...]) -> None:
    if _PLAIN.issuperset(map(type, values)):
        return
    for name, value in zip(names, values, strict=True):
        _check_number(name, value)


def _check_number(name: str, value: object) -> None:
    if value is None or isinstance(value, (float, np.floating, np.integer)):
        return
    if type(value) is not int:
        raise WrongError(f"{name}: a number expected, not {_shown(value)}")
    try:
        float(value)
    except OverflowError as error:
        raise WrongError(f"{name}: {_shown(value)} is too large for a number") from error


def _check_several(name: str, message: EgoState | TruthState | Detection) -> None:
    values = getattr(message, name)
    if values is None:
        return
    if not isinstance(values, tuple):
        raise WrongError(f"{name}: a tuple of numbers expected, not {_shown(values)}")
    for value in values:
        _check_number(name, value)
    if name == "outline_m" and (len(values) < 6 or len(values) % 2 or not all(abs(each) <= _FAR_M for each in values)):
        raise WrongError(f"outline_m: x and y of at least three corners expected, not {_shown(values)}")


def _check_name(name: str, value: object) -> None:
    if not isinstance(value, str) or not 0 < len(value) <= _LONGEST_NAME:
        raise WrongError(f"{name}: a name of up to {_LONGEST_NAME} characters expected, not {_shown(value)}")
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise WrongError(f"{name}: {_shown(value)} is no text") from error


def _shown(value: object) -> str:
    try:
        text = ascii(value)
    except ValueError:  # an integer of more digits than Python writes
        text = f"an integer of {getattr(value, 'bit_length', int)()} bits"
    return text if len(text) <= 60 else f"{text[:57]}..."

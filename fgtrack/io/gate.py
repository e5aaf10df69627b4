"""Validation behind every reader: all that comes out of an input has the types and ranges that the rest relies on.

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
    EGO_COVARIANCE_STATES,
    FRAMES,
    MEASURABLE,
    STATE_NAMES,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.io.errors import MOST_OBJECTS, MOST_SENSORS, one_line

__all__ = ["WrongError", "checked", "checked_detection", "checked_message"]

_LONGEST_NAME = 200
_FAR_M = 1e9
_INT64 = range(-(1 << 63), 1 << 63)
_PLAIN = {float, type(None)}
_DESCRIBING = tuple(name for name in DESCRIBING if name != "class_name")
_state_numbers = attrgetter(*STATE_NAMES)
_measured = attrgetter(*MEASURABLE)
_described = attrgetter(*_DESCRIBING)


class WrongError(Exception):
    """What is wrong with a message."""


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
            message = checked_message(message)
            if isinstance(message, DetectionList):
                sensors.add(message.sensor)
                if len(sensors) > MOST_SENSORS:
                    raise WrongError(f"{message.sensor}: the lists before it are of {MOST_SENSORS} other sensors")
                if len(message.objects) > most_objects:
                    many = f"a list of {len(message.objects)} objects"
                    raise WrongError(f"{message.sensor}: {many}, more than input.most_objects allows")
            yield message
            count += 1
    except WrongError as error:
        raise DataError(f"{path}: message {count + 1}: {error}") from error
    except (FgtrackError, MemoryError):
        raise
    except Exception as error:  # whatever a foreign input makes a reader raise
        what = f"{type(error).__name__}: {one_line(error)}"
        raise DataError(f"{path}: cannot be read beyond message {count} ({what}): repair or convert it") from error


def checked_message(message: Message) -> Message:
    """Return `message`, its detections as of `checked_detection`. Raises `WrongError`."""
    if not isinstance(message, DetectionList | EgoState | TruthState):
        raise WrongError(f"a {type(message).__name__} is no message")
    _check_integer("stamp_ns", message.stamp_ns)
    _check_integer("receipt_ns", message.receipt_ns)
    if not is_stamp(message.receipt_ns):  # all windows are counted from it
        raise WrongError(f"receipt_ns: at most {LARGEST_NS:.0g} ns from 0 expected, not {_shown(message.receipt_ns)}")
    if isinstance(message, DetectionList):
        return _checked_list(message)
    _check_numbers(STATE_NAMES, _state_numbers(message))
    if isinstance(message, EgoState):
        size = len(EGO_COVARIANCE_STATES)
        if message.covariance is not None and len(_several("covariance", message.covariance)) != size**2:
            raise WrongError(f"covariance: a list of {size} x {size} numbers expected")
        if message.in_pit is not None:
            _check_flag("in_pit", message.in_pit)
        return message
    _check_integer("object_id", message.object_id)
    _check_flag("ignored", message.ignored)
    corners = _several("outline_m", () if message.outline_m is None else message.outline_m)
    is_ring = len(corners) >= 6 and len(corners) % 2 == 0 and all(abs(each) <= _FAR_M for each in corners)
    if message.outline_m is not None and not is_ring:
        raise WrongError(f"outline_m: x and y of at least three corners expected, not {_shown(corners)}")
    return message


def _checked_list(message: DetectionList) -> DetectionList:
    _check_name("sensor", message.sensor)
    if message.frame not in FRAMES:
        raise WrongError(f"frame: one of {', '.join(sorted(FRAMES))} expected, not {_shown(message.frame)}")
    objects = []
    for index, item in enumerate(message.objects):
        try:
            objects.append(checked_detection(item))
        except WrongError as error:
            raise WrongError(f"{message.sensor}: objects[{index}]: {error}") from error
    return message if all(map(is_, objects, message.objects)) else replace(message, objects=tuple(objects))


def checked_detection(item: Detection) -> Detection:
    """Return `item` with None for describing numbers that are not finite and for class names that are too long.

    Raises `WrongError` for a value of a wrong type.
    """
    if not isinstance(item, Detection):
        raise WrongError(f"a {type(item).__name__} is no detection")
    described = _described(item)
    _check_numbers(MEASURABLE, _measured(item))
    _check_numbers(_DESCRIBING, described)
    for name in ("stamp_ns", "object_id"):
        if (value := getattr(item, name)) is not None:
            _check_integer(name, value)
    if item.covariance is not None:  # one of another size makes the detection invalid
        _several("covariance", item.covariance)
    lost = [
        name for name, value in zip(_DESCRIBING, described, strict=True) if value is not None and not isfinite(value)
    ]
    if isinstance(item.class_name, str) and len(item.class_name) > _LONGEST_NAME:
        lost.append("class_name")
    elif item.class_name not in (None, ""):
        _check_name("class_name", item.class_name)
    return replace(item, **dict.fromkeys(lost)) if lost else item


def _check_integer(name: str, value: object) -> None:
    if not (value in _INT64 if type(value) is int else isinstance(value, np.integer)):
        raise WrongError(f"{name}: a 64 bit integer expected, not {_shown(value)}")


def _check_flag(name: str, value: object) -> None:
    if not isinstance(value, bool | np.bool_):
        raise WrongError(f"{name}: true or false expected, not {_shown(value)}")


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
    if value.bit_length() > 1000:
        raise WrongError(f"{name}: {_shown(value)} is too large for a number")


def _several(name: str, values: object) -> tuple[float, ...]:
    if not isinstance(values, tuple):
        raise WrongError(f"{name}: a list of numbers expected, not {_shown(values)}")
    for value in values:
        _check_number(name, value)
    return values


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

"""Messages of any type, read by the paths that the configuration gives to their fields."""

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import MEASURABLE, STATE_NAMES, Detection, EgoState
from fgtrack.io.adapters.common import ObjectList, RosMessage, frame_of, stamp_ns, yaw_rad

Path = str | Sequence[str]
"""Attribute names with dots between; several paths are the components of a vector, whose length is meant."""

OBJECT_FIELDS = frozenset({"objects", "stamp", "object_stamp", "object_id", *MEASURABLE})
"""What the `fields` of an object list may name: `objects` is the path of the list, `stamp` that of the
message's time (default `header.stamp`); the others are paths in one object."""
EGO_FIELDS = frozenset({"stamp", "in_pit", *STATE_NAMES})
"""What the `fields` of the ego may name."""


class FieldError(Exception):
    """A path does not lead to what is needed; the reader of the recording adds where."""


def objects_by_fields(message: RosMessage, fields: Mapping[str, Path]) -> ObjectList:
    """Object list of `message`; without `objects` in `fields` the message itself is the one object."""
    path = fields.get("objects")
    items = [message] if path is None else _follow(message, path)
    try:
        objects = tuple(_object(item, fields) for item in items)
    except TypeError as error:
        raise FieldError(f"{path}: is not a list") from error
    header = getattr(message, "header", None)
    return ObjectList(_message_stamp(message, fields), None if header is None else frame_of(header), objects)


def ego_by_fields(message: RosMessage, fields: Mapping[str, Path], receipt_ns: int) -> EgoState:
    """The ego's state; `x_m`, `y_m`, `yaw_rad` and `speed_mps` must be among `fields`."""
    stamp = _message_stamp(message, fields)
    values = {name: _number(message, path) for name, path in fields.items() if name in STATE_NAMES}
    in_pit = _follow(message, fields["in_pit"]) if "in_pit" in fields else None
    return EgoState(
        receipt_ns if stamp is None else stamp,
        receipt_ns,
        **values,
        in_pit=None if in_pit is None else bool(in_pit),
        covariance=None,
    )


def _object(item: RosMessage, fields: Mapping[str, Path]) -> Detection:
    measured: dict[str, Any] = {name: _number(item, fields[name]) for name in MEASURABLE if name in fields}
    return Detection(
        **measured,
        covariance=None,
        stamp_ns=_time(item, fields["object_stamp"]) if "object_stamp" in fields else None,
        object_id=int(_follow(item, fields["object_id"])) if "object_id" in fields else None,
    )


def _message_stamp(message: RosMessage, fields: Mapping[str, Path]) -> int | None:
    if "stamp" in fields:
        return _time(message, fields["stamp"])
    header = getattr(message, "header", None)
    return None if header is None else stamp_ns(header.stamp)


def _follow(message: RosMessage, path: Path) -> RosMessage:
    try:
        return reduce(getattr, str(path).split("."), message)
    except AttributeError as error:
        raise FieldError(f"{path}: leads nowhere ({error})") from error


def _number(message: RosMessage, path: Path) -> float:
    if not isinstance(path, str):
        return math.hypot(*[_number(message, part) for part in path])
    value = _follow(message, path)
    if hasattr(value, "w"):  # a quaternion; what names it wants the yaw
        yaw = yaw_rad(value)
        return math.nan if yaw is None else yaw
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise FieldError(f"{path}: is not a number") from error


def _time(message: RosMessage, path: Path) -> int:
    """A ROS time, integer nanoseconds or float seconds."""
    value = _follow(message, path)
    if hasattr(value, "nanosec"):
        return stamp_ns(value)
    return round(value * NS_PER_S) if isinstance(value, float) else int(value)

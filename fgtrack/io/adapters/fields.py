"""Messages of any type, read by the paths that the configuration gives to their fields."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DESCRIBING, MEASURABLE, STATE_NAMES, Detection, EgoState
from fgtrack.io.adapters.common import ObjectList, RosMessage, frame_of, stamp_ns, yaw_rad
from fgtrack.io.adapters.ids import object_id
from fgtrack.io.config import Field, FieldPath, Path
from fgtrack.models.measurement import ANGULAR

OBJECT_FIELDS = frozenset({"objects", "stamp", "object_stamp", "object_id", *MEASURABLE, *DESCRIBING})
"""Names in the `fields` of an object list: `objects` is the path of the list, `stamp` that of the
message's time (default `header.stamp`); the others are paths in one object."""
EGO_FIELDS = frozenset({"stamp", "in_pit", *STATE_NAMES})
"""Names in the `fields` of the ego."""

_MOST_NAMES = 12  # of fields that a message about a wrong path lists


class FieldError(Exception):
    """A path does not lead to what is needed; the reader of the recording adds where."""


def objects_by_fields(message: RosMessage, fields: Mapping[str, FieldPath]) -> ObjectList:
    """Object list of `message`; without `objects` in `fields` the message itself is the one object."""
    objects = tuple(_object(item, fields) for item in items_by_fields(message, fields))
    header = getattr(message, "header", None)
    return ObjectList(_message_stamp(message, fields), None if header is None else frame_of(header), objects)


def items_by_fields(message: RosMessage, fields: Mapping[str, FieldPath]) -> list[RosMessage]:
    """The objects of `message` as they are in it, in the order of `objects_by_fields`."""
    path = fields.get("objects")
    if path is None:
        return [message]
    found = value_at(message, _single(path))
    if not isinstance(found, list | tuple):  # numbers in a row are no objects, nor are the letters of a text
        raise FieldError(f"{path}: is not a list of objects")
    return list(found)


def ego_by_fields(message: RosMessage, fields: Mapping[str, FieldPath], receipt_ns: int) -> EgoState:
    """The ego's state; `x_m`, `y_m`, `yaw_rad` and `speed_mps` must be among `fields`."""
    stamp = _message_stamp(message, fields)
    values = {name: _number(message, path, name) for name, path in fields.items() if name in STATE_NAMES}
    in_pit = value_at(message, _single(fields["in_pit"])) if "in_pit" in fields else None
    return EgoState(
        receipt_ns if stamp is None else stamp,
        receipt_ns,
        **values,
        in_pit=None if in_pit is None else bool(in_pit),
        covariance=None,
    )


def value_at(message: RosMessage, path: str) -> RosMessage:
    """Return the value at `path`: attributes, or indices of a list, with dots between. Raises `FieldError`."""
    value = message
    for part in path.split("."):
        try:
            value = value[int(part)] if part.isdigit() else getattr(value, part)
        except (AttributeError, LookupError, TypeError) as error:
            raise FieldError(f"{path}: leads nowhere, there is no {part!r}{_known(value)}") from error
    return value


def _known(value: RosMessage) -> str:
    names = [name for name in getattr(value, "__dataclass_fields__", ()) if not name.startswith("_")]
    shown = ", ".join(names[:_MOST_NAMES]) + (", ..." if len(names) > _MOST_NAMES else "")
    return f", but {shown}" if names else ""


def _object(item: RosMessage, fields: Mapping[str, FieldPath]) -> Detection:
    values: dict[str, Any] = {
        name: _number(item, fields[name], name)
        for name in (*MEASURABLE, *DESCRIBING)
        if name in fields and name != "class_name"
    }
    return Detection(
        **values,
        class_name=_text(item, _single(fields["class_name"])) if "class_name" in fields else None,
        stamp_ns=_time(item, _single(fields["object_stamp"])) if "object_stamp" in fields else None,
        object_id=object_id(value_at(item, _single(fields["object_id"]))) if "object_id" in fields else None,
    )


def _text(item: RosMessage, path: str) -> str:
    value = value_at(item, path)
    if not isinstance(value, str | int | float | np.generic):
        raise FieldError(f"{path}: is no text and no number")
    return str(value)


def _message_stamp(message: RosMessage, fields: Mapping[str, FieldPath]) -> int | None:
    if "stamp" in fields:
        return _time(message, _single(fields["stamp"]))
    header = getattr(message, "header", None)
    return None if header is None else stamp_ns(header.stamp)


def _single(path: FieldPath) -> str:
    path = path.path if isinstance(path, Field) else path
    if not isinstance(path, str):
        raise FieldError(f"{path}: one path is needed, not several")
    return path


def _number(message: RosMessage, path: FieldPath, name: str) -> float:
    return converted(_raw(message, path.path if isinstance(path, Field) else path), path, name)


def converted(raw: float, path: FieldPath, name: str) -> float:
    """Value of the component `name` where `path` leads to `raw`; an angle in degrees or with an offset is wrapped.

    More than 1.5 turns of radians stay as they are: they may be degrees, which wrapping would hide.
    """
    if not isinstance(path, Field):
        return raw
    value = path.value(raw)
    wraps = path.degrees or (path.offset != 0.0 and abs(value) <= 3.0 * math.pi)
    return wrap_angle(value) if wraps and name in ANGULAR and math.isfinite(value) else value


def _raw(message: RosMessage, path: Path) -> float:
    if not isinstance(path, str):
        return math.hypot(*[_raw(message, part) for part in path])
    value = value_at(message, path)
    if hasattr(value, "w"):  # a quaternion; what names it wants the yaw
        yaw = yaw_rad(value)
        return math.nan if yaw is None else yaw
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise FieldError(f"{path}: is not a number") from error


def _time(message: RosMessage, path: str) -> int:
    """A ROS time, integer nanoseconds or float seconds."""
    value = value_at(message, path)
    if hasattr(value, "nanosec"):
        return stamp_ns(value)
    return round(value * NS_PER_S) if isinstance(value, float) else int(value)


def fields_of(message: RosMessage) -> tuple[dict[str, Any], dict[str, list[RosMessage]]]:
    """Values of the fields of `message` by path, and its lists of objects by path.

    Numbers and texts as they are, a quaternion as its yaw, a time in seconds; arrays of numbers and headers are left
    out.
    """
    values: dict[str, Any] = {}
    lists: dict[str, list[RosMessage]] = {}
    for name in getattr(message, "__dataclass_fields__", ()):
        value = getattr(message, name)
        if name.startswith("__") or name == "header":
            continue
        if isinstance(value, bool | int | float | str | np.number):
            values[name] = value
        elif hasattr(value, "nanosec"):
            values[name] = stamp_ns(value) / NS_PER_S
        elif hasattr(value, "w") and hasattr(value, "z"):
            values[name] = yaw_rad(value)
        elif isinstance(value, list | tuple) and all(hasattr(item, "__dataclass_fields__") for item in value):
            lists[name] = list(value)
        else:
            inner_values, inner_lists = fields_of(value)
            values |= {f"{name}.{path}": inner for path, inner in inner_values.items()}
            lists |= {f"{name}.{path}": inner for path, inner in inner_lists.items()}
    return values, lists

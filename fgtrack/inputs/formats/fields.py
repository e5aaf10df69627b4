"""Mapped fields: values of messages and tables, read at the paths in the configuration."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DESCRIBING, MEASURABLE, STATE_NAMES, Detection, EgoState
from fgtrack.inputs.formats.common import (
    ObjectList,
    RosMessage,
    frame_of,
    identity,
    object_id,
    stamp_ns,
    yaw_rad,
)
from fgtrack.inputs.geodetic import GEODETIC, LocalPlane
from fgtrack.inputs.settings import Field, FieldPath
from fgtrack.models.measurement import ANGULAR

COMPONENTS = ("object_id", *MEASURABLE, *GEODETIC, *DESCRIBING)
"""Components of a detection that can be mapped."""
OBJECT_FIELDS = frozenset({"objects", "stamp", "object_stamp", *COMPONENTS})
"""Names in the `fields` of an object list.

`objects` is the path of the list, `stamp` the path of the message's time (default
`header.stamp`). The other names map paths in one object.
"""
EGO_FIELDS = frozenset({"stamp", "in_pit", *STATE_NAMES, *GEODETIC})
"""Names in the `fields` of the ego."""

#: Conversion by component, for components that are not real numbers.
_CONVERSIONS: Mapping[str, Callable[[Any], Any]] = {
    "object_id": object_id,
    "id": identity,
    "class_name": str,
    "in_pit": bool,
}


RELATIVE_IN_MAP = (
    "range_rate_mps: a relative velocity needs positions in the frame ego or sensor, "
    "not map: remove it from the mapping"
)
_RANGE_RATE = "range_rate_mps"


class FieldError(Exception):
    """A path leads to no valid value. The reader of the recording adds its position."""


def mapped(
    fields: Mapping[str, FieldPath], names: Iterable[str], read: Callable[[str], Any]
) -> dict[str, Any]:  # Any: arguments of `EgoState`, `Detection` and `TruthState`
    """Return the values of the components in `names` that `fields` maps to recorded fields, by name.

    `read` returns the recorded value at a path, or None if it is missing.
    """
    values = {
        name: _component(name, fields[name], read)
        for name in names
        if name in fields and not (name == _RANGE_RATE and is_relative_velocity(fields))
    }
    if _RANGE_RATE in names and is_relative_velocity(fields):
        values[_RANGE_RATE] = _along_sight(fields[_RANGE_RATE], values, read)
    return values


def is_relative_velocity(fields: Mapping[str, FieldPath]) -> bool:
    """True if the range rate is computed from the two components of a relative velocity."""
    return _RANGE_RATE in fields and len(paths_of(fields[_RANGE_RATE])) > 1


def _along_sight(
    path: FieldPath, values: Mapping[str, Any], read: Callable[[str], Any]
) -> float | None:
    """Return the component of a relative velocity along the line of sight, positive away from the sensor.

    `path` names the two components of the velocity, and `values` contain position or bearing. None if the velocity or
    the direction is missing.

    Raises `FieldError` unless `path` names two fields.
    """
    paths = paths_of(path)
    if len(paths) != 2:
        raise FieldError(f"{paths}: range_rate_mps needs one path, or two for x and y")
    velocity = [_float(read(each), each) for each in paths]
    x_m, y_m = values.get("x_m"), values.get("y_m")
    bearing_rad = values.get("bearing_rad")
    if x_m is not None and y_m is not None:
        bearing_rad = math.atan2(y_m, x_m)
    if bearing_rad is None or velocity[0] is None or velocity[1] is None:
        return None
    converted = path if isinstance(path, Field) else Field(paths)
    if any(each in converted.unknown for each in velocity):
        return None
    along = velocity[0] * math.cos(bearing_rad) + velocity[1] * math.sin(bearing_rad)
    return converted.value(along)


def paths_of(path: FieldPath) -> list[str]:
    """Return the paths of all recorded fields that `path` names; a component may be computed from several fields."""
    path = path.path if isinstance(path, Field) else path
    return [path] if isinstance(path, str) else list(path)


def single_path(path: FieldPath) -> str:
    """Return the path of a component that is read from one field; raises `FieldError` for several paths."""
    paths = paths_of(path)
    if len(paths) != 1:
        raise FieldError(f"{paths}: a single field is needed, name one of them")
    return paths[0]


def _component(name: str, path: FieldPath, read: Callable[[str], Any]) -> Any:
    """Return the component `name` of the value at `path`, converted; None if the value is missing or unknown.

    An angle is wrapped only if it was converted. If only an offset was added, an angle above 1.5 turns is not wrapped,
    because it may be in degrees.
    """
    if name in _CONVERSIONS:
        value = read(single_path(path))
        return None if value is None else _CONVERSIONS[name](value)
    numbers = [_float(read(each), each) for each in paths_of(path)]
    present = [value for value in numbers if value is not None]
    if len(present) < len(numbers):
        return None
    if isinstance(path, Field) and not _counts(path, present, read):
        return None
    if name == "yaw_rad" and len(present) == 4:
        raw = yaw_of(*present)
    else:
        raw = present[0] if len(present) == 1 else math.hypot(*present)
    if not isinstance(path, Field):
        return raw
    value = path.value(raw)
    wraps = path.degrees or (path.offset != 0.0 and abs(value) <= 3.0 * math.pi)
    if wraps and name in ANGULAR and math.isfinite(value):
        return wrap_angle(value)
    return value


def _counts(path: Field, numbers: Sequence[float], read: Callable[[str], Any]) -> bool:
    """True if the `numbers` at `path` are known, and its other fields have their least numbers."""
    if any(each in path.unknown for each in numbers):
        return False
    others = {name: _float(read(name), name) for name in path.least}
    return all(
        value is not None and value >= path.least[name]
        for name, value in others.items()
    )


def _float(value: Any, path: str) -> float | None:
    if hasattr(value, "w"):  # a quaternion
        return yaw_of(value.x, value.y, value.z, value.w)
    try:
        return None if value is None else float(value)
    except (TypeError, ValueError) as error:
        raise FieldError(f"{path}: {str(value)[:40]!r} is not a number") from error


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Return the yaw of a quaternion of any norm; NaN for the quaternion 0."""
    yaw = yaw_rad(SimpleNamespace(x=x, y=y, z=z, w=w))
    return math.nan if yaw is None else yaw


def objects_by_fields(
    message: RosMessage,
    fields: Mapping[str, FieldPath],
    plane: LocalPlane | None = None,
) -> ObjectList:
    """Return the object list of `message`. If `fields` lacks `objects`, the message itself is the only object."""
    objects = []
    plane = plane or LocalPlane()
    for item in items_by_fields(message, fields):
        stamp = (
            _time(item, fields["object_stamp"]) if "object_stamp" in fields else None
        )
        values = plane.in_plane(mapped(fields, COMPONENTS, partial(value_at, item)))
        objects.append(Detection(**values, stamp_ns=stamp))
    frame = frame_of(message.header) if hasattr(message, "header") else None
    frame = "map" if GEODETIC[0] in fields else frame
    return ObjectList(_message_stamp(message, fields), frame, tuple(objects))


def items_by_fields(
    message: RosMessage, fields: Mapping[str, FieldPath]
) -> list[RosMessage]:
    """Return the recorded objects of `message`, in the order of `objects_by_fields`.

    The path of the objects may lead through lists. Then the objects in all items of these lists are returned.

    Raises `FieldError` if the path ends at no list.
    """
    if "objects" not in fields:
        return [message]
    path = single_path(fields["objects"])
    items = _items_at(message, path.split("."))
    if items is None:
        raise FieldError(f"{path}: is not a list of objects, give the path of a list")
    return items


def _items_at(message: RosMessage, parts: Sequence[str]) -> list[RosMessage] | None:
    """Return the items of the list at the path `parts`; None if the path ends at no list.

    A list on the path stands for each of its items, unless an index follows. An item whose path ends at no list then
    adds nothing.
    """
    value = message
    for number, part in enumerate(parts):
        value = value_at(value, part)
        rest = parts[number + 1 :]
        if isinstance(value, list | tuple) and rest and not rest[0].isdigit():
            found = [_items_at(item, rest) for item in value]
            return [each for items in found for each in items or ()]
    return list(value) if isinstance(value, list | tuple) else None


def ego_by_fields(
    message: RosMessage,
    fields: Mapping[str, FieldPath],
    receipt_ns: int,
    plane: LocalPlane | None = None,
) -> EgoState:
    """Return the state of the ego; heading and speed are NaN if `fields` does not contain them."""
    stamp = _message_stamp(message, fields)
    plane = plane or LocalPlane()
    values = plane.in_plane(
        mapped(fields, (*STATE_NAMES, "in_pit", *GEODETIC), partial(value_at, message))
    )
    values = {"yaw_rad": math.nan, "speed_mps": math.nan} | values
    return EgoState(receipt_ns if stamp is None else stamp, receipt_ns, **values)


def value_at(message: RosMessage, path: str) -> RosMessage:
    """Return the value at `path`: names of attributes or indices of lists, joined by dots. Raises `FieldError`."""
    value = message
    for part in path.split("."):
        try:
            value = value[int(part)] if part.isdigit() else getattr(value, part)
        except (AttributeError, LookupError, TypeError) as error:
            names = [
                name
                for name in getattr(value, "__dataclass_fields__", ())
                if not name.startswith("_")
            ]
            raise FieldError(
                f"{path}: there is no field {part!r}; there are {', '.join(names) or 'no fields'}"
            ) from error
    return value


def _message_stamp(message: RosMessage, fields: Mapping[str, FieldPath]) -> int | None:
    if "stamp" in fields:
        return _time(message, fields["stamp"])
    return stamp_ns(message.header.stamp) if hasattr(message, "header") else None


def _time(message: RosMessage, path: FieldPath) -> int:
    """Convert a ROS time, integer nanoseconds or float seconds to integer nanoseconds."""
    value = value_at(message, single_path(path))
    if hasattr(value, "nanosec"):
        return stamp_ns(value)
    return round(value * NS_PER_S) if isinstance(value, float) else int(value)


def fields_of(message: RosMessage) -> dict[str, Any]:
    """Return the values of the fields of `message`, by path.

    Numbers, texts, yaws of quaternions, times in s, and lists of objects.
    """
    values: dict[str, Any] = {}
    for name in getattr(message, "__dataclass_fields__", ()):
        value = getattr(message, name)
        if name.startswith("__") or name == "header":
            continue
        if hasattr(value, "nanosec"):
            value = stamp_ns(value) / NS_PER_S
        elif hasattr(value, "w") and hasattr(value, "z"):
            value = yaw_rad(value)
        is_list = isinstance(value, list) and all(
            hasattr(item, "__dataclass_fields__") for item in value
        )
        if is_list or isinstance(value, bool | int | float | str | np.number | None):
            values[name] = value
        else:
            values |= {
                f"{name}.{path}": inner for path, inner in fields_of(value).items()
            }
    return values

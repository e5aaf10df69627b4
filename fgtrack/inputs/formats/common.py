"""Common parts of the adapters: headers, quaternions, speeds and covariances of ROS messages."""

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Context, Decimal
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.core.checks import is_stamp
from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.files import read_whole
from fgtrack.core.time import NS_PER_S, NS_PER_UNIT
from fgtrack.core.types import MEASURABLE, Detection, FloatArray, Frame
from fgtrack.inputs.errors import cause

PLANAR = [0, 1, 5]
"""Indices of x, y and the rotation about z in a covariance of ROS."""

_DECIMAL = Context(Emax=40)  # no exponent makes a number of a million digits
_LARGEST_MB = 2000.0
_A_LIST, _BETWEEN = re.compile(r"\s*\[\s*"), re.compile(r"[\s,:]*")
_INT64 = range(-(1 << 63), 1 << 63)
# A message is known by its attributes only: its class is made when a recording is read.
RosMessage = Any
MAP_FRAMES = frozenset({"map", "world", "odom"})
"""Header frames that are taken as the map frame where the configuration names none."""


@dataclass(frozen=True, slots=True)
class ObjectList:
    """Content of one message, as an adapter reads it."""

    stamp_ns: int | None
    """None where the message has no stamp; then it is the receipt."""
    frame: Frame | None
    """None where the message does not contain it."""
    objects: tuple[Detection, ...]
    left_out: tuple[str, ...] = ()
    """As of a `DetectionList`."""


@contextmanager
def reported_as(text: str) -> Iterator[None]:
    """Raise `DataError` of `text` and the cause for whatever values of another form raise in the block."""
    try:
        yield
    except FgtrackError:
        raise
    except (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        RecursionError,
    ) as error:
        raise DataError(f"{text} ({cause(error)})") from error


def json_values(
    file: Path, begin: re.Pattern[str] = _A_LIST, **form: Any
) -> Iterator[Any]:  # Any: parsed JSON
    """Yield values of the list that follows `begin` in the JSON `file`, or keys and values of the object.
    The text of a table may have a gigabyte. `form` is that of a `JSONDecoder`. Raises `DataError` in other files.
    """
    with reported_as(
        f"{file}: is not JSON of the expected form, download it once more"
    ):
        text = read_whole(file, _LARGEST_MB).decode()
        gap = begin.match(text)
        if gap is None:
            raise ValueError("another beginning")
        while gap is not None and text[gap.end()] not in "]}":
            value, end = json.JSONDecoder(**form).raw_decode(text, gap.end())
            yield value
            gap = _BETWEEN.match(text, end)


def split(
    items: Iterable[Detection | str],
) -> tuple[tuple[Detection, ...], tuple[str, ...]]:
    """The detections among `items`, and for each other object the setting that excludes it."""
    every = list(items)
    return tuple(i for i in every if not isinstance(i, str)), tuple(
        i for i in every if isinstance(i, str)
    )


def object_id(value: object) -> int | None:
    """An integer (or its text) `value` as it is, of other text a reproducible number < 2^53, of an empty one None."""
    text = str(value).strip()
    if (
        text.removeprefix("-").isdecimal()
        and text.isascii()
        and len(text) < 20
        and int(text) in _INT64
    ):
        return int(text)
    return (
        int.from_bytes(
            blake2b(text.encode(errors="replace"), digest_size=6).digest(), "big"
        )
        if text
        else None
    )


def identity(value: object) -> str | None:
    """The identity `value` in one spelling, 4CA911 of 0x4ca911; None of an empty one."""
    return str(value).strip().upper().removeprefix("0X") or None


def exact_ns(time: Decimal | int | str, unit: str = "s") -> int:
    """Integer nanoseconds of a decimal text, to the last one; `ArithmeticError` or `ValueError` if it is not a time."""
    time_ns = round(_DECIMAL.create_decimal(time) * NS_PER_UNIT[unit])
    if not is_stamp(time_ns):
        raise ValueError("beyond the year 2096")
    return time_ns


def stamp_ns(time: RosMessage) -> int:
    """Integer nanoseconds of a `builtin_interfaces/Time`."""
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def frame_of(header: RosMessage) -> Frame:
    """Frame that a header names: `map` for the usual names of a fixed frame, else `ego`."""
    return "map" if header.frame_id.lstrip("/") in MAP_FRAMES else "ego"


def object_list(
    header: RosMessage, objects: Iterable[Detection], frame: Frame | None = None
) -> ObjectList:
    """An object list with the stamp of `header`, and its frame where none is given."""
    return ObjectList(stamp_ns(header.stamp), frame or frame_of(header), tuple(objects))


def yaw_rad(orientation: RosMessage) -> float | None:
    """Yaw of a quaternion of any norm; None where it is all zero, which means "not known"."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    if x == y == z == w == 0.0:
        return None
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def signed_speed_mps(vx_mps: float, vy_mps: float, heading_rad: float | None) -> float:
    """Length of the velocity, negative where it points against the heading (of the same frame)."""
    speed = math.hypot(vx_mps, vy_mps)
    if heading_rad is None:
        return speed
    forward = vx_mps * math.cos(heading_rad) + vy_mps * math.sin(heading_rad)
    return -speed if forward < 0.0 else speed


@np.errstate(all="ignore")  # the tracker counts what is not finite
def speed_gradient(vx_mps: float, vy_mps: float) -> FloatArray:
    """Derivative, shape (2,), of the length of the velocity; along x where that is 0."""
    speed = math.hypot(vx_mps, vy_mps)
    return np.array([vx_mps, vy_mps]) / speed if speed > 0.0 else np.array([1.0, 0.0])


@np.errstate(all="ignore")  # as above
def covariance(
    values: Mapping[str, float | None],
    pose: FloatArray | None,
    twist: FloatArray | None = None,
    velocity: Any = None,
) -> tuple[float, ...] | None:
    """Covariance of the measured `values` (position, yaw, speed), row-major; None where it does not cover them all.
    `pose` is the covariance of x, y and yaw, shape (3, 3), `twist` begins with that of `velocity`; None is "not known".
    The variance of the speed is to first order.
    """
    if pose is None:
        return None
    from scipy.linalg import (
        block_diag,
    )  # takes a tenth of a second to import, and most recordings do not need it

    variance = 0.0
    if twist is not None:
        direction = speed_gradient(velocity.x, velocity.y)
        variance = float(direction @ twist[:2, :2] @ direction)
    index = [row for row, name in enumerate(MEASURABLE) if values.get(name) is not None]
    chosen = block_diag(pose, [variance])[np.ix_(index, index)]
    return (
        None if (np.diag(chosen) <= 0.0).any() else tuple(chosen.ravel().tolist())
    )  # 0 and -1 are "not known" in ROS


def planar(covariance36: Sequence[float]) -> FloatArray:
    """Covariance of x, y and their rotation, shape (3, 3), from the 36 values of a pose's or twist's covariance."""
    return np.asarray(covariance36, dtype=float).reshape(6, 6)[np.ix_(PLANAR, PLANAR)]

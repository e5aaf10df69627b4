"""Functions that the adapters share: JSON lists, stamps, identities, quaternions, speeds and covariances."""

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
"""Indices of x, y and the rotation about z in a 6 x 6 covariance of ROS."""

#: Context that limits the exponent, so that no text becomes an integer of a million digits.
_DECIMAL = Context(Emax=40)
_LARGEST_MB = 2000.0
_LIST_START = re.compile(r"\s*\[\s*")
_BETWEEN = re.compile(r"[\s,:]*")
_INT64 = range(-(1 << 63), 1 << 63)
RosMessage = Any
"""A ROS message. Its class is created when a recording is read, so only its attributes are known."""
MAP_FRAMES = frozenset({"map", "world", "odom"})
"""Header frames that count as the map frame if the configuration names no frame."""


@dataclass(frozen=True, slots=True)
class ObjectList:
    """Content of one message, as an adapter returns it."""

    stamp_ns: int | None
    """None if the message has no stamp; the receipt is then used."""
    frame: Frame | None
    """None if the message does not contain its frame."""
    objects: tuple[Detection, ...]
    left_out: tuple[str, ...] = ()
    """As in `DetectionList`."""


@contextmanager
def reported_as(text: str) -> Iterator[None]:
    """Convert exceptions of the block that malformed values cause into `DataError` with `text` and the cause."""
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
    file: Path, begin: re.Pattern[str] = _LIST_START, **form: Any
) -> Iterator[Any]:  # Any: parsed JSON
    """Yield the values of the list that follows `begin` in the JSON `file`; for an object, keys and values in turn.

    The file is read piece by piece, because a table may have a gigabyte. `form` contains arguments of `JSONDecoder`.
    Raises `DataError` for a file of another form.
    """
    with reported_as(
        f"{file}: is not JSON of the expected form, download the file once more"
    ):
        text = read_whole(file, _LARGEST_MB).decode()
        gap = begin.match(text)
        if gap is None:
            raise ValueError("the file begins with another text")
        while gap is not None and text[gap.end()] not in "]}":
            value, end = json.JSONDecoder(**form).raw_decode(text, gap.end())
            yield value
            gap = _BETWEEN.match(text, end)


def split(
    items: Iterable[Detection | str],
) -> tuple[tuple[Detection, ...], tuple[str, ...]]:
    """Separate `items` into detections, and the excluding settings of the objects that are left out."""
    detections = list[Detection]()
    settings = list[str]()
    for item in items:
        if isinstance(item, str):
            settings.append(item)
        else:
            detections.append(item)
    return tuple(detections), tuple(settings)


def object_id(value: object) -> int | None:
    """Return an integer id for `value`: itself if it is an integer, None for an empty text, a hash below 2^48 for
    another text.
    """
    text = str(value).strip()
    if (
        text.removeprefix("-").isdecimal()
        and text.isascii()
        and len(text) < 20
        and int(text) in _INT64
    ):
        return int(text)
    if not text:
        return None
    digest = blake2b(text.encode(errors="replace"), digest_size=6).digest()
    return int.from_bytes(digest, "big")


def identity(value: object) -> str | None:
    """Return the identity `value` in a uniform spelling (0x4ca911 becomes 4CA911); None if it is empty."""
    return str(value).strip().upper().removeprefix("0X") or None


def exact_ns(time: Decimal | int | str, unit: str = "s") -> int:
    """Convert the decimal number `time` in `unit` to integer nanoseconds, exact to the last digit.

    Raises `ArithmeticError` or `ValueError` if it is not a time.
    """
    time_ns = round(_DECIMAL.create_decimal(time) * NS_PER_UNIT[unit])
    if not is_stamp(time_ns):
        raise ValueError("the time is beyond the year 2096")
    return time_ns


def stamp_ns(time: RosMessage) -> int:
    """Convert a `builtin_interfaces/Time` to integer nanoseconds."""
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def frame_of(header: RosMessage) -> Frame:
    """Return the frame of a header: `map` for the usual names of a fixed frame (`MAP_FRAMES`), else `ego`."""
    return "map" if header.frame_id.lstrip("/") in MAP_FRAMES else "ego"


def object_list(
    header: RosMessage, objects: Iterable[Detection], frame: Frame | None = None
) -> ObjectList:
    """Return an object list with the stamp of `header`, in `frame` or else in the frame of `header`."""
    return ObjectList(stamp_ns(header.stamp), frame or frame_of(header), tuple(objects))


def yaw_rad(orientation: RosMessage) -> float | None:
    """Return the yaw of a quaternion of any norm; None for the quaternion 0, which means that the orientation is
    unknown.
    """
    x = orientation.x
    y = orientation.y
    z = orientation.z
    w = orientation.w
    if x == y == z == w == 0.0:
        return None
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def signed_speed_mps(vx_mps: float, vy_mps: float, heading_rad: float | None) -> float:
    """Return the length of the velocity, negative if the velocity points against the heading.

    Velocity and heading are in the same frame. Without a heading the speed is positive.
    """
    speed = math.hypot(vx_mps, vy_mps)
    if heading_rad is None:
        return speed
    forward = vx_mps * math.cos(heading_rad) + vy_mps * math.sin(heading_rad)
    return -speed if forward < 0.0 else speed


@np.errstate(all="ignore")  # the tracker counts values that are not finite
def speed_gradient(vx_mps: float, vy_mps: float) -> FloatArray:
    """Return the gradient, shape (2,), of the speed by the velocity; (1, 0) at velocity 0."""
    speed = math.hypot(vx_mps, vy_mps)
    return np.array([vx_mps, vy_mps]) / speed if speed > 0.0 else np.array([1.0, 0.0])


@np.errstate(all="ignore")  # as above
def covariance(
    values: Mapping[str, float | None],
    pose: FloatArray | None,
    twist: FloatArray | None = None,
    velocity: Any = None,
) -> tuple[float, ...] | None:
    """Return the row-major covariance of the measured components, in the order of `MEASURABLE`.

    `values` are the measured position, yaw and speed; a component that is None is not measured. `pose` is the
    covariance of x, y and yaw, shape (3, 3). `twist` begins with the covariance of `velocity`; the variance of the
    speed follows to first order. `pose` and `twist` are None if unknown. Returns None if a variance is unknown: 0 or
    less.
    """
    if pose is None:
        return None
    # The import takes a tenth of a second, and most recordings do not need it.
    from scipy.linalg import block_diag

    variance = 0.0
    if twist is not None:
        direction = speed_gradient(velocity.x, velocity.y)
        variance = float(direction @ twist[:2, :2] @ direction)
    index = [row for row, name in enumerate(MEASURABLE) if values.get(name) is not None]
    chosen = block_diag(pose, [variance])[np.ix_(index, index)]
    # The variances 0 and -1 mean unknown in ROS.
    if (np.diag(chosen) <= 0.0).any():
        return None
    return tuple(chosen.ravel().tolist())


def planar(covariance36: Sequence[float]) -> FloatArray:
    """Return the covariance of x, y and the rotation about z, shape (3, 3), from the 36 values of a ROS covariance."""
    return np.asarray(covariance36, dtype=float).reshape(6, 6)[np.ix_(PLANAR, PLANAR)]

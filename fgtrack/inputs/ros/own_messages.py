"""Decodes fgtrack's own messages from their bytes; other layouts are decoded by the recording's definitions.

Bytes are little-endian CDR (OMG DDS-XTypes 1.3, section 7.4). A value is aligned to its
size. A text and a list follow their length of 4 bytes. An empty list is not aligned.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from struct import Struct
from typing import Any

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import get_types_from_msg

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import (
    MEASURABLE,
    Detection,
    DetectionList,
    EgoState,
    Message,
    TruthState,
)
from fgtrack.inputs.formats.native import DETECTIONS, EGO, TRUTH
from fgtrack.inputs.ros.definitions import DEFINITIONS

LITTLE_ENDIAN = b"\0\1"
"""First two bytes of a little-endian message; the next two have no meaning."""
_TIME = Struct("<iI")
_LENGTH = Struct("<I")
_EGO = Struct("<6d??")
_TRUTH = Struct("<qdd?xH4x4d")
#: Fields of a detection before its covariance, and the numbers after it.
_MEASURED = Struct(f"<{len(MEASURABLE)}d")
_DESCRIBED = Struct("<qq5d")
_numbers = lru_cache(maxsize=64)(lambda count: Struct(f"<{count}d"))


class _Values:
    """Reads the values of a message in turn; raises `struct.error` or `ValueError` if the message ends before them."""

    def __init__(self, data: bytes) -> None:
        self._data = data[4:]
        self._at = 0

    def take(self, form: Struct, size: int) -> tuple[Any, ...]:
        """Read the values of `form`; the first value has the size `size` and is aligned to it."""
        begin = -(-self._at // size) * size
        self._at = begin + form.size
        return form.unpack_from(self._data, begin)

    def text(self) -> str:
        """Read a text, which ends in a zero byte. Raises `ValueError` for an incomplete text."""
        (length,) = self.take(_LENGTH, 4)
        text = self._data[self._at : self._at + length]
        self._at += length
        if len(text) != length or text[-1:] != b"\0":
            raise ValueError("a text is incomplete")
        return text[:-1].decode()

    def numbers(self) -> tuple[float, ...]:
        """Read a list of numbers."""
        (count,) = self.take(_LENGTH, 4)
        return self.take(_numbers(count), 8) if count else ()

    def header(self) -> tuple[int, str]:
        """Read stamp and frame."""
        sec, nanosec = self.take(_TIME, 4)
        return sec * NS_PER_S + nanosec, self.text()

    def detection(self) -> Detection:
        """Read a `fgtrack_msgs/Detection`; its fields have the order of `Detection`."""
        (present,) = self.take(_LENGTH, 4)
        measured = self.take(_MEASURED, 8)
        covariance = self.numbers()
        values = (
            *measured,
            covariance,
            *self.take(_DESCRIBED, 8),
            self.text(),
            self.text(),
        )
        return Detection(*_given(values, present))

    def check_end(self) -> None:
        """Raise `ValueError` if more bytes than padding follow the values."""
        if self._at + 3 < len(self._data):
            raise ValueError("it has more bytes than its type")


def _ego(values: _Values, receipt_ns: int) -> EgoState:
    stamp_ns, _ = values.header()
    x, y, yaw, speed, yaw_rate, accel, has_in_pit, in_pit = values.take(_EGO, 8)
    in_pit = in_pit if has_in_pit else None
    return EgoState(
        stamp_ns,
        receipt_ns,
        x,
        y,
        yaw,
        speed,
        yaw_rate,
        accel,
        in_pit,
        values.numbers() or None,
    )


def _detections(values: _Values, receipt_ns: int) -> DetectionList:
    stamp_ns, frame = values.header()
    sensor = values.text()
    (count,) = values.take(_LENGTH, 4)
    objects = tuple([values.detection() for _ in range(count)])
    return DetectionList(
        sensor,
        stamp_ns,
        receipt_ns,
        objects,
        frame,  # type: ignore[arg-type]  # validated later
        (),
        values.numbers() or None,  # type: ignore[arg-type]  # validated later
    )


def _truth(values: _Values, receipt_ns: int) -> TruthState:
    stamp_ns, _ = values.header()
    object_id, x, y, ignored, present, *optional = values.take(_TRUTH, 8)
    yaw, speed, yaw_rate, accel, outline = _given(
        (*optional, values.numbers()), present
    )
    return TruthState(
        stamp_ns,
        receipt_ns,
        object_id,
        x,
        y,
        yaw,
        speed,
        yaw_rate,
        accel,
        ignored,
        outline,
    )


def _given(values: Sequence[Any], present: int) -> list[Any]:
    """Return `values` with None where the bit of `present` is not set."""
    return [value if present >> bit & 1 else None for bit, value in enumerate(values)]


_READERS: Mapping[str, Callable[[_Values, int], Message]] = {
    EGO: _ego,
    DETECTIONS: _detections,
    TRUTH: _truth,
}


def own_message(name: str, data: bytes, receipt_ns: int) -> Message:
    """Decode a message of the type `name`, whose layout must be fgtrack's (`has_own_layout`)."""
    values = _Values(data)
    message = _READERS[name](values, receipt_ns)
    values.check_end()
    return message


def has_own_layout(name: str, types: Typesdict) -> bool:
    """True if `name` is a type of fgtrack, and its definition and parts in `types` are the present ones."""
    texts = {**_HEADER, **DEFINITIONS}
    return name in _READERS and all(
        types[part] == get_types_from_msg(texts[part], part)[part] for part in types
    )


_HEADER = {
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
}

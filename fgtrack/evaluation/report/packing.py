"""Columns of numbers as text that a page can hold: little-endian arrays, deflated, in base64, equal ones once.

Before an array is deflated, the first bytes of all its numbers are put together, then the second ones, and so on: the
high bytes of neighbours are alike.
"""

import base64
import math
import zlib
from collections.abc import Mapping, Sized
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

_DTYPES = {"u8": "<u1", "u16": "<u2", "i16": "<i2", "i32": "<i4", "f32": "<f4", "f64": "<f8"}

_LEVEL = 9  # of zlib: the smallest

Packed = dict[str, Any]
"""JSON values of a column: `blob` (its place among the blobs), `type`, and `scale` and `missing` where it has them."""


@dataclass(frozen=True)
class Form:
    """How the numbers of a column are written."""

    type: str
    """`u8`, `u16`, `i16`, `i32`, `f32` or `f64`."""
    scale: float = 1.0
    """What is written times this is the number."""
    missing: int | None = None
    """What is written for NaN."""


_MISSING_I32 = -(2**31)

#: A position or length in millimetres, up to 2,100 km.
POSITION_M = Form("i32", 1e-3, _MISSING_I32)
#: In tenths of a milliradian, wrapped angles.
ANGLE_RAD = Form("i16", 1e-4, -(2**15))


def code_form(names: Sized) -> Form:
    """Of places among `names`."""
    return Form("u8" if len(names) <= 1 << 8 else "u16" if len(names) <= 1 << 16 else "i32")


def identity_form(numbers: npt.NDArray[np.int64]) -> Form:
    """Of numbers of tracks or objects: four bytes where all of `numbers` fit."""
    limits = np.iinfo(np.int32)
    fits = ((numbers >= limits.min) & (numbers <= limits.max)).all()
    return Form("i32" if fits else "f64")


def time_form(duration_s: float) -> Form:
    """In tenths of a millisecond up to two days, coarser for more; missing far outside, as for a clock that says 0."""
    step_s = 1e-4
    while duration_s / step_s >= 2**31 - 1:
        step_s *= 10.0
    return Form("i32", step_s, _MISSING_I32)


@dataclass
class Packer:
    """Collects blobs."""

    blobs: list[str] = field(default_factory=list)
    """Base64, in the order in which they were first packed."""
    _places: dict[tuple[str, bytes], int] = field(default_factory=dict)

    def column(self, values: npt.ArrayLike, form: Form) -> Packed:
        """`values`, shape (n,), as `form` says; one that does not fit is written as missing."""
        content = _written(np.asarray(values), form).tobytes()
        place = self._places.setdefault((form.type, content), len(self.blobs))
        if place == len(self.blobs):
            planes = np.frombuffer(content, np.uint8).reshape(-1, np.dtype(_DTYPES[form.type]).itemsize).T
            self.blobs.append(base64.b64encode(zlib.compress(planes.tobytes(), _LEVEL)).decode("ascii"))
        packed: Packed = {"blob": place, "type": form.type}
        if form.scale != 1.0:
            packed["scale"] = form.scale
        if form.missing is not None:
            packed["missing"] = form.missing
        return packed


def unpacked(column: Mapping[str, Any], blobs: list[str]) -> npt.NDArray[np.float64]:
    """The numbers of a packed column, shape (n,): what the page's own decoder gives."""
    dtype = np.dtype(_DTYPES[column["type"]])
    planes = np.frombuffer(zlib.decompress(base64.b64decode(blobs[column["blob"]])), np.uint8)
    written = np.frombuffer(planes.reshape(dtype.itemsize, -1).T.tobytes(), dtype)
    found = np.asarray(written.astype(np.float64) * float(column.get("scale", 1.0)))
    if "missing" in column:
        found[written == column["missing"]] = math.nan
    return found


def _written(values: npt.NDArray[Any], form: Form) -> npt.NDArray[Any]:  # Any: of the type that the form says
    dtype = np.dtype(_DTYPES[form.type])
    if dtype.kind == "f":
        return values.astype(dtype)
    steps = np.rint(values.astype(np.float64) / form.scale)
    limits = np.iinfo(dtype)
    fits = (steps > limits.min if form.missing is not None else steps >= limits.min) & (steps <= limits.max)
    if not fits.all():
        if form.missing is None:
            raise ValueError(f"a value does not fit into {form.type}")
        steps = np.where(fits, steps, form.missing)
    return steps.astype(dtype)

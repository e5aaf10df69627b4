"""Limits of numbers, and checks that many functions apply to their arguments."""

import math
import os

import numpy as np

from fgtrack.core.errors import CallError

LARGEST = 1e9
"""Largest magnitude of a measured, mapped or configured value, in any unit; the square stays finite."""

LARGEST_NS = 4 * 10**18
"""Largest magnitude of a stamp in ns: the years 1843 to 2096. A difference of two stamps fits into 64 bits."""

STAMP = f"an integer of at most {LARGEST_NS:.0g}"
"""Rule for stamps in error messages."""


def is_number(value: object, least: float = -LARGEST, most: float = LARGEST) -> bool:
    """True if `value` is a real number between `least` and `most`; a boolean is not a number."""
    is_real = isinstance(
        value, (float, int, np.floating, np.integer)
    ) and not isinstance(value, bool)
    return is_real and bool(least <= value <= most)  # type: ignore[operator]


def is_stamp(value: object) -> bool:
    """True if `value` is an integer of magnitude `LARGEST_NS` at most; a boolean is not an integer."""
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return is_integer and bool(-LARGEST_NS <= value <= LARGEST_NS)  # type: ignore[operator]


def as_stamp(name: str, value: object) -> int:
    """Return the stamp `value` as a Python integer.

    NumPy integers are converted because their sums and differences wrap.

    Raises `CallError`, which contains the argument's `name`, unless `value` is an
    integer of magnitude `LARGEST_NS` at most.
    """
    if not is_stamp(value):
        raise CallError(f"{name}: must be {STAMP}, is {value!r}")
    return int(value)  # type: ignore[call-overload,no-any-return]  # checked above


def check_paths(**values: object) -> None:
    """Raise `CallError` with the argument's name for a value that is neither a string nor a path; None passes."""
    for name, value in values.items():
        if value is not None and not isinstance(value, (str, os.PathLike)):
            raise CallError(
                f"{name}: must be a name or a path, is a {type(value).__name__}"
            )


def not_negative(**values: float) -> None:
    """Raise `ValueError` with the argument's name for a value that is negative, infinite or NaN."""
    for name, value in values.items():
        if not 0.0 <= value < math.inf:
            raise ValueError(f"{name}: must be finite and not negative, is {value}")


def positive(**values: float) -> None:
    """Raise `ValueError` with the argument's name for a value that is not above 0; infinity passes."""
    for name, value in values.items():
        if not value > 0.0:
            raise ValueError(f"{name}: must be positive, is {value}")

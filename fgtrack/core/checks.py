"""Limits of numbers, and rules that many arguments have in common."""

import math
import os

import numpy as np

from fgtrack.core.errors import CallError

LARGEST = 1e9
"""Largest magnitude of a measured, mapped or configured value, in any unit: its square stays finite."""

LARGEST_NS = 4 * 10**18
"""No clock is further from 0, which in times since 1970 are the years 1843 and 2096: differences have 64 bits too."""

STAMP = f"an integer of at most {LARGEST_NS:.0g}"
"""Rule for stamps, in error messages."""


def is_number(value: object, least: float = -LARGEST, most: float = LARGEST) -> bool:
    """True if it is a real number between `least` and `most`; a truth value is not a number."""
    is_real = isinstance(
        value, (float, int, np.floating, np.integer)
    ) and not isinstance(value, bool)
    return is_real and bool(least <= value <= most)  # type: ignore[operator]


def is_stamp(value: object) -> bool:
    """True if it is an integer of at most `LARGEST_NS`; a truth value is not an integer."""
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return is_integer and bool(-LARGEST_NS <= value <= LARGEST_NS)  # type: ignore[operator]


def as_stamp(name: str, value: object) -> int:
    """Return a stamp as a plain integer: those of NumPy wrap in sums and differences.

    Raises `CallError`, which has the `name` of the argument, for anything else than an integer of at most `LARGEST_NS`.
    """
    if not is_stamp(value):
        raise CallError(f"{name}: must be {STAMP}, is {value!r}")
    return int(value)  # type: ignore[call-overload,no-any-return]  # checked above


def check_paths(**values: object) -> None:
    """Raise `CallError`, which names it, for an argument that is neither a text nor a path; None passes."""
    for name, value in values.items():
        if value is not None and not isinstance(value, (str, os.PathLike)):
            raise CallError(
                f"{name}: must be a name or a path, is a {type(value).__name__}"
            )


def not_negative(**values: float) -> None:
    """Raise a `ValueError` that names the value unless it is finite, and 0 or above."""
    for name, value in values.items():
        if not 0.0 <= value < math.inf:
            raise ValueError(f"{name}: must be finite and not negative, is {value}")


def positive(**values: float) -> None:
    """Raise a `ValueError` that names the value unless it is above 0; it may be infinite."""
    for name, value in values.items():
        if not value > 0.0:
            raise ValueError(f"{name}: must be positive, is {value}")

"""Rules that many settings have in common, checked where they are made; None is no value and passes.

All raise a `ValueError` that names the setting, its rule and its value.
"""

import math
import os
from collections.abc import Callable, Mapping

import numpy as np

from fgtrack.core.errors import CallError

__all__ = [
    "LARGEST",
    "LARGEST_NS",
    "between_0_and_1",
    "check_paths",
    "is_number",
    "is_stamp",
    "not_negative",
    "positive",
]

LARGEST = 1e9
"""Largest magnitude of a measured, mapped or configured value, in any unit: its square stays finite."""


LARGEST_NS = 4 * 10**18
"""No clock is further from 0, which in times since 1970 are the years 1843 and 2096: differences have 64 bits too."""


def is_number(value: object, least: float = -LARGEST, most: float = LARGEST) -> bool:
    """True if it is a real number between `least` and `most`."""
    return isinstance(value, (float, int, np.floating, np.integer)) and bool(least <= value <= most)


def is_stamp(value: object) -> bool:
    """True if it is an integer of at most `LARGEST_NS`."""
    return isinstance(value, (int, np.integer)) and bool(-LARGEST_NS <= value <= LARGEST_NS)


def check_paths(**values: object) -> None:
    """Raise `CallError`, which names it, for an argument that is neither a text nor a path; None passes."""
    for name, value in values.items():
        if value is not None and not isinstance(value, (str, os.PathLike)):
            raise CallError(f"{name}: must be a name or a path, is a {type(value).__name__}")


def positive(**values: float | None) -> None:
    """Finite and above 0."""
    _check(values, "must be positive and finite", lambda value: 0.0 < value < math.inf)


def not_negative(**values: float | None) -> None:
    """Finite, 0 or above."""
    _check(values, "must be finite and not negative", lambda value: 0.0 <= value < math.inf)


def between_0_and_1(**values: float | None) -> None:
    """Strictly between 0 and 1."""
    _check(values, "must lie between 0 and 1", lambda value: 0.0 < value < 1.0)


def _check(values: Mapping[str, float | None], rule: str, holds: Callable[[float], bool]) -> None:
    for name, value in values.items():
        if value is not None and not holds(value):
            raise ValueError(f"{name}: {rule}, is {value}")

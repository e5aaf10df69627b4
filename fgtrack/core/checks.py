"""Rules that many settings have in common, checked where they are made; None is no value and passes.

All raise a `ValueError` that names the setting, its rule and its value.
"""

import math
from collections.abc import Callable, Mapping

__all__ = ["LARGEST", "between_0_and_1", "not_negative", "positive"]

LARGEST = 1e9
"""What is measured, mapped or configured is no larger, in any unit: its square is still far from the largest float."""


def positive(**values: float | None) -> None:
    """Finite and above 0."""
    _check(values, "must be positive and finite", lambda value: 0.0 < value < math.inf)


def not_negative(**values: float | None) -> None:
    """Finite, 0 or above."""
    _check(values, "must be finite and not negative", lambda value: 0.0 <= value < math.inf)


def between_0_and_1(**values: float | None) -> None:
    """Between 0 and 1, neither of them."""
    _check(values, "must lie between 0 and 1", lambda value: 0.0 < value < 1.0)


def _check(values: Mapping[str, float | None], rule: str, holds: Callable[[float], bool]) -> None:
    for name, value in values.items():
        if value is not None and not holds(value):
            raise ValueError(f"{name}: {rule}, is {value}")

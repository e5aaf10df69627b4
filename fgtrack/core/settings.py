"""Base of all settings: frozen dataclasses whose types and ranges are checked at creation."""

from dataclasses import field
from typing import Annotated, TypeVar, dataclass_transform

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

T = TypeVar("T")
Rate = Annotated[float, Field(gt=0.0, le=10_000.0)]
"""Frequency in Hz."""
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
"""Between 0 and 1, both included."""
OpenProbability = Annotated[float, Field(gt=0.0, lt=1.0)]
"""Strictly between 0 and 1."""


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def settings(cls: type[T]) -> type[T]:
    """Make the class a frozen dataclass whose types and ranges pydantic checks at creation.

    A wrong type, a value out of range, NaN and infinity raise pydantic's
    `ValidationError`, a `ValueError`.
    """
    return dataclass(
        cls, frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
    )  # type: ignore[return-value]  # it is `cls` itself


def require(condition: bool, key: str, rule: str, value: object) -> None:
    """Raise `ValueError` with `key`, `rule` and `value` unless `condition` holds; for rules between settings."""
    if not condition:
        raise ValueError(f"{key}: {rule}, is {value}")

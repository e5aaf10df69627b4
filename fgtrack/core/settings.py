"""Settings: frozen, finite, in their range, checked wherever they are made."""

from dataclasses import field
from typing import Annotated, TypeVar, dataclass_transform

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

T = TypeVar("T")
Rate = Annotated[float, Field(gt=0.0, le=10_000.0)]
"""In Hz."""
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
OpenProbability = Annotated[float, Field(gt=0.0, lt=1.0)]
"""Strictly between 0 and 1."""


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def settings(cls: type[T]) -> type[T]:
    """A frozen dataclass; to make one of a wrong type or range raises pydantic's `ValidationError`, a `ValueError`."""
    return dataclass(
        cls, frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
    )  # type: ignore[return-value]  # it is `cls` itself


def require(condition: bool, key: str, rule: str, value: object) -> None:
    """Raise a `ValueError` that names `key` unless `condition` holds: for rules between several settings."""
    if not condition:
        raise ValueError(f"{key}: {rule}, is {value}")

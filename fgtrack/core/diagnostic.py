"""Warnings about a recording or a run."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from fgtrack.core.geometry import may_be_radians

__all__ = ["EGO", "Diagnostic", "in_degrees"]

EGO = "ego"
"""Subject of a diagnostic about the ego."""


@dataclass(frozen=True)
class Diagnostic:
    """Something that is wrong; `str` is a line of it."""

    about: str
    """Sensor, `ego`, or what else it concerns."""
    text: str
    """Problem, cause and cure, without the full stop."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """Values of keys of the configuration that correct it; empty where none does for certain."""
    spoils: bool = False
    """True if nothing can be judged before it is corrected."""

    def __str__(self) -> str:
        return f"{self.about}: {self.text}"


def in_degrees(about: str, name: str, least: float, most: float) -> Diagnostic | None:
    """Diagnostic that the angle `name` between `least` and `most` is in degrees; None where it may be in radians."""
    if may_be_radians(least, most):
        return None
    text = f"{name} goes up to {max(-least, most):.4g}: degrees? Convert it by `{{path: ..., degrees: true}}`"
    return Diagnostic(about, text, spoils=True)

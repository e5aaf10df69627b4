"""Findings of `advise`: a problem of a recording or its configuration, with the settings that correct it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["Finding", "milliseconds", "nice_above", "percent"]

#: Mantissas of round numbers.
_NICE = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


@dataclass(frozen=True)
class Finding:
    """A problem in a sentence or two with numbers, and settings; `str` gives both."""

    kind: str
    """Subject: `input`, `model`, `clock`, `late`, `window`, `ego`, `mount`, `noise`, `change`, `tune`, `track`."""
    about: str
    """Name of a sensor, `ego`, or another subject."""
    weight: float
    """Importance: above 80 the run is useless without the change, below 30 the finding is a remark."""
    text: str
    """Problem, cause and remedy."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """Configuration keys and the values that correct the problem; empty if no setting does."""
    effect: str = ""
    """Clause with numbers on the result that improves in a replay with the settings."""

    def __str__(self) -> str:
        settings = ", ".join(
            f"{key}: {value:g}" if isinstance(value, float) else f"{key}: {value}"
            for key, value in self.settings.items()
        ).replace("'", "")
        change = f" Set {settings}." if settings else ""
        effect = f" Replayed: {self.effect}." if self.effect else ""
        return f"{self.about}: {self.text}{change}{effect}"


def nice_above(value: float) -> float:
    """Round `value`, which is positive, up to a mantissa of `_NICE` times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    mantissa = next(nice for nice in _NICE if nice * power >= value * (1.0 - 1e-9))
    return float(f"{mantissa * power:.3g}")


def percent(share: float) -> str:
    """Text of a share (0 to 1) in percent."""
    if 0.0 < share < 0.0005:
        return "below 0.1 %"
    return f"{100.0 * share:.{0 if share >= 0.0995 else 1}f} %"


def milliseconds(time_s: float) -> str:
    """Text of a time in milliseconds; in seconds if it is 1 s or longer."""
    return f"{1e3 * time_s:.0f} ms" if abs(time_s) < 1.0 else f"{time_s:.3g} s"

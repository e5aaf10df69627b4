"""Warnings about a recording or a run."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.geometry import may_be_radians
from fgtrack.core.types import BoolArray, FloatArray

__all__ = ["EGO", "Diagnostic", "in_degrees", "late_ego", "too_late"]

EGO = "ego"
"""Subject of a diagnostic about the ego."""
_LATE_S = 0.05  # two or three states of an ego at 50 Hz


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


_LATE_SHARE, _FEWEST_LATE = 0.01, 3  # less is chance


def too_late(
    sensor: str,
    delays_s: FloatArray,
    limits: Iterable[tuple[str, float | None]],
    refused: BoolArray | None = None,
) -> Diagnostic | None:
    """Return the diagnostic of a sensor whose delays, shape (n,), are longer than a configured time; None if few are.

    `limits` are keys of the configuration and their times in seconds, None where there is no limit. `refused` is true
    of what was not used, shape (n,); None if everything too late was not.
    """
    for key, limit_s in limits:
        if limit_s is None or not len(delays_s):
            continue
        late = int(
            np.count_nonzero(
                (delays_s > limit_s) & (True if refused is None else refused)
            )
        )
        if late >= max(_FEWEST_LATE, _LATE_SHARE * len(delays_s)):
            share, most_s = (
                100.0 * late / len(delays_s),
                float(np.quantile(delays_s, 0.99)),
            )
            text = (
                f"{share:.3g} % come later than {key} {limit_s:g} s allows and are not used; 99 % come within "
                f"{most_s:.3g} s: raise {key} above it, or correct the clock"
            )
            return Diagnostic(sensor, text)
    return None


def late_ego(ego_delay_s: float, delays_s: Mapping[str, float]) -> Diagnostic | None:
    """Return the diagnostic that the ego's messages come later than those of sensors; None where they do not.

    `ego_delay_s` is the usual time from stamp to receipt of the ego's messages, `delays_s` that of the lists of each
    sensor whose lists need the ego's pose.
    """
    sooner = {
        name: delay_s
        for name, delay_s in delays_s.items()
        if ego_delay_s - delay_s > _LATE_S
    }
    if not sooner:
        return None
    later_ms = 1e3 * (ego_delay_s - min(sooner.values()))
    own = ", ".join(
        f"{name} {1e3 * delay_s:.0f} ms" for name, delay_s in sooner.items()
    )
    text = (
        f"its states come up to {later_ms:.0f} ms later than the lists that need them (delay {1e3 * ego_delay_s:.0f} "
        f"ms, {own}): these wait up to ego.wait_s, or are placed by an extrapolated pose and count as less certain; "
        "send the ego's states sooner, or correct their clock"
    )
    return Diagnostic(EGO, text)

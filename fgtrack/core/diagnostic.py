"""Warnings about a recording or a run."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.geometry import may_be_radians
from fgtrack.core.types import BoolArray, FloatArray

__all__ = ["EGO", "Diagnostic", "in_degrees", "late_ego", "reasons", "too_late"]

EGO = "ego"
"""`Diagnostic.about` of a problem of the ego."""
#: Smallest delay of the ego behind a sensor that is reported: two or three ego states at 50 Hz.
_LATE_S = 0.05


@dataclass(frozen=True)
class Diagnostic:
    """A problem of a recording or a run; `str` gives it as one line."""

    about: str
    """Name of a sensor, `ego`, or another subject."""
    text: str
    """Problem, cause and remedy, without a full stop."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """Configuration keys and the values that correct the problem; empty if it is not certain that a setting does."""
    is_blocking: bool = False
    """True if the recording cannot be judged until this problem is corrected."""

    def __str__(self) -> str:
        return f"{self.about}: {self.text}"


def reasons(counts: Mapping[str, int]) -> str:
    """Text of `counts` by setting or reason, the largest first: `40 by filters.score, 2 by max_range_m`."""
    return ", ".join(
        f"{count} by {name}"
        for name, count in sorted(counts.items(), key=lambda item: -item[1])
    )


def in_degrees(about: str, name: str, least: float, most: float) -> Diagnostic | None:
    """Return the diagnostic that the angle `name` is in degrees, from its smallest and largest recorded value.

    None if the values may be radians. `about` is the sensor, or another subject.
    """
    if may_be_radians(least, most):
        return None
    text = (
        f"{name} reaches {max(-least, most):.4g}, so it is probably in degrees: "
        "convert it by `{path: ..., degrees: true}`"
    )
    return Diagnostic(about, text, is_blocking=True)


#: Share and number of late lists from which they are reported: fewer may be chance.
_LATE_SHARE = 0.01
_FEWEST_LATE = 3


def too_late(
    sensor: str,
    delays_s: FloatArray,
    limits: Iterable[tuple[str, float | None]],
    refused: BoolArray | None = None,
) -> Diagnostic | None:
    """Diagnostic of a sensor with delays longer than a configured time; None if few delays are longer.

    `delays_s` has shape (n,). `limits` contains pairs of a configuration key and its
    time in seconds; a time of None means no limit. The first exceeded limit is
    reported. `refused`, shape (n,), is true for lists that were not used; without it,
    all lists beyond the limit count as not used.
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
            share = 100.0 * late / len(delays_s)
            most_s = float(np.quantile(delays_s, 0.99))
            text = (
                f"{share:.3g} % arrive later than {key} ({limit_s:g} s) allows and are not used; 99 % arrive within "
                f"{most_s:.3g} s: set {key} above this time, or correct the clock"
            )
            return Diagnostic(sensor, text)
    return None


def late_ego(ego_delay_s: float, delays_s: Mapping[str, float]) -> Diagnostic | None:
    """Return the diagnostic that the ego's messages arrive later than lists that need its pose; None if they do not.

    `ego_delay_s` is the usual time from stamp to receipt of the ego's messages. `delays_s` contains this time for each
    sensor whose lists need the ego's pose.
    """
    sooner = {
        name: delay_s
        for name, delay_s in delays_s.items()
        if ego_delay_s - max(delay_s, 0.0)
        > _LATE_S  # a negative delay is an error of the sensor's clock
    }
    if not sooner:
        return None
    later_ms = 1e3 * (ego_delay_s - max(min(sooner.values()), 0.0))
    own = ", ".join(
        f"{name} {1e3 * delay_s:.0f} ms" for name, delay_s in sooner.items()
    )
    text = (
        f"its states arrive up to {later_ms:.0f} ms later than the lists that need them (delay {1e3 * ego_delay_s:.0f} "
        f"ms, {own}): the lists wait up to ego.wait_s, or use an extrapolated pose and a larger covariance; "
        "send the ego's states sooner, or correct their clock"
    )
    return Diagnostic(EGO, text)

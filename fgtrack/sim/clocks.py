"""Errors of the stamps that a sensor reports: error = reported stamp - the time at which it measured.

A sensor has a list of clock models; each reads what the one before it reported.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Discriminator, Field

from fgtrack.core.settings import settings
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import IntArray

_LARGEST_ERROR_S = 86_400.0  # a day


@settings
class OffsetClock:
    """Every stamp is off by the same duration: a clock that was never set, a latency that was left out."""

    offset_s: Annotated[float, Field(ge=-_LARGEST_ERROR_S, le=_LARGEST_ERROR_S)]
    """Positive: stamps are later than the measurement."""
    kind: Literal["offset"] = "offset"


@settings
class DriftClock:
    """A clock that is right at the first message and runs too fast (or, below 0, too slow)."""

    drift_ppm: Annotated[float, Field(ge=-1e6, le=1e6)]
    """Microseconds gained per second; a quartz has some tens."""
    kind: Literal["drift"] = "drift"


@settings
class JitterClock:
    """Every stamp is off by a normal error of its own."""

    std_s: Annotated[float, Field(ge=0.0, le=_LARGEST_ERROR_S)]
    kind: Literal["jitter"] = "jitter"


@settings
class QuantisedClock:
    """A clock that moves in steps: a stamp is the last multiple of the step, up to a step too early."""

    step_s: Annotated[float, Field(ge=1e-9, le=_LARGEST_ERROR_S)]
    kind: Literal["quantised"] = "quantised"


@settings
class ArrivalClock:
    """The sensor gives no stamp: its receipt is used instead. An offset after it is a guess of the delay."""

    kind: Literal["arrival"] = "arrival"


#: Every clock model, chosen by `kind`.
AnyClock = Annotated[
    OffsetClock | DriftClock | JitterClock | QuantisedClock | ArrivalClock,
    Discriminator("kind"),
]


def reported_stamps(
    clocks: Sequence[AnyClock],
    rng: np.random.Generator,
    stamps_ns: IntArray,
    receipts_ns: IntArray,
) -> IntArray:
    """Stamps that a sensor with `clocks` reports of messages in the order of measurement, shape (n,) as all others.
    Each entry of the list has a generator of its own: other clocks before or after one leave what it draws.
    """
    for clock, child in zip(clocks, rng.spawn(len(clocks)), strict=True):
        match clock:
            case OffsetClock():
                stamps_ns = stamps_ns + nanoseconds(clock.offset_s)
            case DriftClock():
                elapsed_ns = (stamps_ns - stamps_ns[:1]).astype(np.float64)
                stamps_ns = stamps_ns + np.rint(
                    elapsed_ns * (clock.drift_ppm * 1e-6)
                ).astype(np.int64)
            case JitterClock():
                errors_ns = child.standard_normal(len(stamps_ns)) * (
                    clock.std_s * NS_PER_S
                )
                stamps_ns = stamps_ns + np.rint(errors_ns).astype(np.int64)
            case QuantisedClock():
                stamps_ns = stamps_ns - stamps_ns % nanoseconds(clock.step_s)
            case ArrivalClock():
                stamps_ns = receipts_ns.copy()
    return stamps_ns

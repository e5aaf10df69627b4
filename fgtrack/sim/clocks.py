"""Errors of the stamps that a sensor reports: error = reported stamp - time of measurement.

A sensor has a list of clock models. Each model changes the stamps that the previous
model reported.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Discriminator, Field

from fgtrack.core.settings import settings
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import IntArray

#: Largest error: one day.
_LARGEST_ERROR_S = 86_400.0


@settings
class OffsetClock:
    """All stamps have the same error, for example because the clock was never set."""

    offset_s: Annotated[float, Field(ge=-_LARGEST_ERROR_S, le=_LARGEST_ERROR_S)]
    """Positive if stamps are later than the measurement."""
    kind: Literal["offset"] = "offset"


@settings
class DriftClock:
    """A clock without error at the first message that runs too fast (positive drift) or too slow."""

    drift_ppm: Annotated[float, Field(ge=-1e6, le=1e6)]
    """Microseconds gained in a second; a quartz clock gains some tens."""
    kind: Literal["drift"] = "drift"


@settings
class JitterClock:
    """Each stamp has an independent normal error."""

    std_s: Annotated[float, Field(ge=0.0, le=_LARGEST_ERROR_S)]
    """Standard deviation of the error of a stamp."""
    kind: Literal["jitter"] = "jitter"


@settings
class QuantisedClock:
    """A clock with a coarse resolution: stamps are rounded down to a multiple of the step."""

    step_s: Annotated[float, Field(ge=1e-9, le=_LARGEST_ERROR_S)]
    """Resolution of the clock."""
    kind: Literal["quantised"] = "quantised"


@settings
class ArrivalClock:
    """The sensor sends no stamps, so the receipt is used as the stamp.

    An `offset` after this model is a guess of the delay.
    """

    kind: Literal["arrival"] = "arrival"


#: Any clock model, selected by its kind.
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
    """Return the stamps that a sensor with `clocks` reports, shape (n,).

    `stamps_ns` and `receipts_ns`, shape (n,), belong to messages in the order of
    measurement. Each clock has its own random generator, so a change of one clock does
    not change the draws of the others.
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

"""What is wrong with the stamps that a sensor reports: error = reported stamp - the time at which it sensed.

A sensor has a list of clock models; each reads what the one before it reported. A model reads all messages of one
sensor at once, in the order in which it sensed, and is an immutable value.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

import numpy as np
from pydantic import Discriminator

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.sim.require import require

_LARGEST_ERROR_S = 86_400.0


class ClockModel(Protocol):
    """A way in which stamps are wrong."""

    def read(self, rng: np.random.Generator, stamps_ns: IntArray, receipts_ns: IntArray) -> IntArray:
        """Stamps reported for `stamps_ns` of messages received at `receipts_ns`; all shapes (n,)."""


@dataclass(frozen=True)
class OffsetClock:
    """Every stamp is off by the same duration: a clock that was never set, a latency that was left out."""

    offset_s: float
    """Positive: stamps are later than the world was sensed."""
    kind: Literal["offset"] = "offset"

    def __post_init__(self) -> None:
        require(abs(self.offset_s) <= _LARGEST_ERROR_S, "offset_s", "must be at most a day", self.offset_s)

    def read(self, rng: np.random.Generator, stamps_ns: IntArray, receipts_ns: IntArray) -> IntArray:
        """See `ClockModel`."""
        return stamps_ns + nanoseconds(self.offset_s)


@dataclass(frozen=True)
class DriftClock:
    """A clock that is right at the first message and runs too fast (or, below 0, too slow)."""

    drift_ppm: float
    """Microseconds gained per second; a quartz has some tens."""
    kind: Literal["drift"] = "drift"

    def __post_init__(self) -> None:
        require(abs(self.drift_ppm) <= 1e6, "drift_ppm", "must be at most a million", self.drift_ppm)

    def read(self, rng: np.random.Generator, stamps_ns: IntArray, receipts_ns: IntArray) -> IntArray:
        """See `ClockModel`."""
        elapsed_ns = (stamps_ns - stamps_ns[:1]).astype(np.float64)
        return stamps_ns + _whole(elapsed_ns * (self.drift_ppm * 1e-6))


@dataclass(frozen=True)
class JitterClock:
    """Every stamp is off by a normal error of its own."""

    std_s: float
    kind: Literal["jitter"] = "jitter"

    def __post_init__(self) -> None:
        require(0.0 <= self.std_s <= _LARGEST_ERROR_S, "std_s", "must lie between 0 and a day", self.std_s)

    def read(self, rng: np.random.Generator, stamps_ns: IntArray, receipts_ns: IntArray) -> IntArray:
        """See `ClockModel`."""
        return stamps_ns + _whole(rng.standard_normal(len(stamps_ns)) * (self.std_s * NS_PER_S))


@dataclass(frozen=True)
class QuantisedClock:
    """A clock that moves in steps: a stamp is the last multiple of the step, up to a step too early."""

    step_s: float
    kind: Literal["quantised"] = "quantised"

    def __post_init__(self) -> None:
        require(1e-9 <= self.step_s <= _LARGEST_ERROR_S, "step_s", "must lie between 1 ns and a day", self.step_s)

    def read(self, rng: np.random.Generator, stamps_ns: IntArray, receipts_ns: IntArray) -> IntArray:
        """See `ClockModel`."""
        return stamps_ns - stamps_ns % nanoseconds(self.step_s)


@dataclass(frozen=True)
class ArrivalClock:
    """The sensor gives no stamp: its receipt is used instead. An offset after it is a guess of the delay."""

    kind: Literal["arrival"] = "arrival"

    def read(self, rng: np.random.Generator, stamps_ns: IntArray, receipts_ns: IntArray) -> IntArray:
        """See `ClockModel`."""
        return receipts_ns.copy()


#: Every clock model, chosen by `kind`.
AnyClock = Annotated[
    OffsetClock | DriftClock | JitterClock | QuantisedClock | ArrivalClock,
    Discriminator("kind"),
]


def reported_stamps(
    clocks: Sequence[ClockModel], rng: np.random.Generator, stamps_ns: IntArray, receipts_ns: IntArray
) -> IntArray:
    """Stamps that a sensor with `clocks` reports; all shapes (n,).

    Each place in the list has a generator of its own: other clocks before or after one leave what it draws.
    """
    for clock, child in zip(clocks, rng.spawn(len(clocks)), strict=True):
        stamps_ns = clock.read(child, stamps_ns, receipts_ns)
    return stamps_ns


def _whole(errors_ns: FloatArray) -> IntArray:
    return np.rint(errors_ns).astype(np.int64)

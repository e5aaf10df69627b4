"""Random streams for the contract: stamps, orders of arrival, measurements."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from estimators import LAG_S, START_NS
from hypothesis import strategies as st

from fgtrack.core.time import NS_PER_S
from fgtrack.estimation.base import Measurement
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import MotionModel

MS = 1_000_000
US = 1_000
_GRID_NS = 2 * MS
_NONLINEAR = (("x_m", "y_m"), ("x_m", "y_m", "speed_mps"), ("x_m", "y_m", "yaw_rad"), ("x_m", "y_m", "range_m"))


@dataclass(frozen=True)
class Arrivals:
    """Stamps, as offsets from the first node, in the order of arrival."""

    offsets_ns: tuple[int, ...]
    seed: int

    @property
    def stamps_ns(self) -> list[int]:
        return [START_NS + offset for offset in self.offsets_ns]

    def measurements(self, motion: MotionModel) -> list[Measurement]:
        rng = np.random.default_rng(self.seed)
        return [measured(stamp_ns, motion, rng) for stamp_ns in self.stamps_ns]


def measured(stamp_ns: int, motion: MotionModel, rng: np.random.Generator) -> Measurement:
    """Of an object at 20 m/s on a straight line; in a nonlinear model of this or that component."""
    names = ("x_m", "y_m") if motion.linear else _NONLINEAR[rng.integers(len(_NONLINEAR))]
    travelled_m = 20.0 * (stamp_ns - START_NS) / NS_PER_S
    x_m, y_m = 3.0 + travelled_m * np.cos(0.4), -2.0 + travelled_m * np.sin(0.4)
    truth = {"x_m": x_m, "y_m": y_m, "yaw_rad": 0.4, "speed_mps": 20.0, "range_m": np.hypot(x_m, y_m)}
    std = np.where(np.array(names) == "yaw_rad", 0.1, 0.5)
    z = np.array([truth[name] for name in names]) + std * rng.standard_normal(len(names))
    return Measurement(stamp_ns, measurement_model(names, motion), z, np.diag(std**2))


def in_time_order(measurements: list[Measurement]) -> list[Measurement]:
    """By stamp; those of one stamp the other way round, because their order must not matter either."""
    order = sorted(range(len(measurements)), key=lambda k: (measurements[k].stamp_ns, -k))
    return [measurements[k] for k in order]


def middles(stamps_ns: list[int]) -> list[int]:
    """Halfway between neighbours that are not close together."""
    stamps = sorted({START_NS, *stamps_ns})
    return [(a + b) // 2 for a, b in pairwise(stamps) if b - a >= MS]


@st.composite
def arrivals(
    draw: st.DrawFn,
    span_s: float = LAG_S,
    max_size: int = 10,
    close: bool = False,
    min_size: int = 2,
) -> Arrivals:
    """Stamps less than `span_s` after the first node in any order; some equal, and some 1 us apart where `close`."""
    last = round(span_s * NS_PER_S) // _GRID_NS - 1
    offsets = [_GRID_NS * k for k in draw(st.lists(st.integers(1, last), min_size=min_size, max_size=max_size))]
    equal = [offset for offset in offsets if draw(st.integers(0, 3)) == 0]
    near = [offset + US for offset in offsets if close and draw(st.booleans())]
    order = draw(st.permutations(offsets + equal + near))
    return Arrivals(tuple(order), draw(st.integers(0, 2**31)))

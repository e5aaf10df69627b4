"""Statistics of the lists of a sensor: scans or single reports, clutter, and revisit intervals of objects."""

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import Any  # of sections of the configuration

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import DetectionList, FloatArray
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.pipeline.config import NOISE_HZ, ClockConfig, Config, FilterConfig, MotionConfig

__all__ = ["ListStatistics", "for_slow_revisits"]

#: No vehicle is faster than an airliner [m/s], and no position of one is worse than this [m].
_FASTEST_MPS, _POSITION_M = 300.0, 10.0
#: How far back one looks for an object, of how many detections, and how many are too few.
_MEMORY_S, _MOST, _FEWEST = 60.0, 5000, 20

#: Standard deviation per step at 100 Hz, hence a density of 225 m^2/s^3. Singer's model (Estimating optimal tracking
#: filter performance for manned maneuvering targets, IEEE T-AES 1970) has 2 sigma^2 tau: an aircraft that banks by at
#: most 25 degrees accelerates by 4.6 m/s^2, evenly distributed sigma = 2.6 m/s^2, for some 17 s. Ships do less.
_MANOEUVRES = {"velocity": 150.0}
_NODE_HZ, _LONGEST_S = 1.0, 60.0
_REPORTS_SHARE = 0.75
"""Share of lists with one object from which on a sensor reports objects one by one, if none of its lists is empty."""
_FEWEST_LISTS = 10
"""Lists that say nothing of their kind if there are fewer."""


@dataclass
class ListStatistics:
    """Counts of the lists of one sensor."""

    num_objects: Counter[int] = field(default_factory=Counter)
    """Number of lists by the number of their objects."""
    low_m: tuple[float, float] = (math.inf, math.inf)
    """Smallest x and y of a detection, in its frame."""
    high_m: tuple[float, float] = (-math.inf, -math.inf)
    """Largest x and y."""
    revisits_s: list[float] = field(default_factory=list)
    """Time since the last one, of each detection that an earlier one could be of, within reach of the fastest
    vehicle."""
    _recent: deque[tuple[int, FloatArray]] = field(default_factory=deque)

    def add(self, message: DetectionList) -> None:
        """Count a list; lists come in order of receipt."""
        self.num_objects[len(message.objects)] += 1
        points_m = np.array(list(positions_m(message)), dtype=np.float64).reshape(-1, 2)
        for x_m, y_m in points_m.tolist():
            self.low_m = min(self.low_m[0], x_m), min(self.low_m[1], y_m)
            self.high_m = max(self.high_m[0], x_m), max(self.high_m[1], y_m)
        if len(self.revisits_s) < _MOST:
            self._add_revisits(message.stamp_ns, points_m)

    def _add_revisits(self, stamp_ns: int, points_m: FloatArray) -> None:
        while self._recent and self._recent[0][0] < stamp_ns - round(_MEMORY_S * 1e9):
            self._recent.popleft()
        for position_m in points_m:
            for earlier_ns, earlier_m in reversed(self._recent):
                elapsed_s = seconds(stamp_ns - earlier_ns)
                reach_m = _FASTEST_MPS * elapsed_s + _POSITION_M
                if elapsed_s > 0.0 and (np.abs(earlier_m - position_m).max(axis=1) <= reach_m).any():
                    self.revisits_s.append(elapsed_s)
                    break
        if len(points_m):
            self._recent.append((stamp_ns, points_m))

    @property
    def revisit_s(self) -> float | None:
        """Median time between two detections of an object; None of a sensor that gives no positions, or too few."""
        return median(self.revisits_s) if len(self.revisits_s) >= _FEWEST else None

    @property
    def scans(self) -> bool:
        """False if the sensor reports objects one by one, as ADS-B, AIS and V2X do: a list misses nobody.

        Its lists hold one object, now and then several by coincidence, and none is empty.
        """
        lists = self.num_objects.total()
        return lists < _FEWEST_LISTS or 0 in self.num_objects or self.num_objects[1] < _REPORTS_SHARE * lists

    @property
    def largest_clutter_per_m2(self) -> float:
        """Density of all detections, objects or not, over the rectangle that holds them; infinite if it has no area."""
        lists, sides_m = self.num_objects.total(), (self.high_m[0] - self.low_m[0], self.high_m[1] - self.low_m[1])
        if lists < _FEWEST_LISTS or min(sides_m) <= 0.0:
            return math.inf
        return sum(size * count for size, count in self.num_objects.items()) / lists / math.prod(sides_m)


def for_slow_revisits(config: Config, lists: Iterable[ListStatistics]) -> tuple[dict[str, Any], str]:
    """Sections of `config` for objects that every sensor measures too seldom for the defaults, by name, and the reason.

    The default motion model is linearised along the heading, whose standard deviation after a time t without a
    measurement is sqrt(q t^3 / 3), q the density of the yaw rate. Where it exceeds 1 rad the heading is unknown, and a
    straight line with the noise of `_MANOEUVRES`, which is linear, predicts better. Windows then hold two
    measurements of an object, and ticks are as many times rarer. Sections that are not the default stay as they are.
    """
    typical_s = [one.revisit_s for one in lists]
    known_s = [each for each in typical_s if each is not None]
    default = MotionConfig()
    density = default.std_per_s["yaw_rate"] ** 2 / NOISE_HZ
    limit_s = math.cbrt(3.0 / density)
    if len(known_s) < len(typical_s) or not known_s or min(known_s) <= limit_s:
        return {}, ""
    window_s = min(float(math.ceil(2.0 * min(known_s))), _LONGEST_S)
    sections = {
        "motion": MotionConfig(kind="cv", std_per_s=_MANOEUVRES),
        "clock": ClockConfig(node_hz=_NODE_HZ),
        "filter": FilterConfig(storage_s=window_s),
        "smoother": SmootherSettings(lag_s=window_s),
    }
    reason = f"an object is measured every {min(known_s):.2g} s, the default model loses its heading in {limit_s:.2g} s"
    open_ones = {name: section for name, section in sections.items() if getattr(config, name) == type(section)()}
    return open_ones, reason


def positions_m(message: DetectionList) -> Iterator[tuple[float, float]]:
    """Yield x and y of the detections that have a position, in the frame of their list."""
    for one in message.objects:
        if one.x_m is not None and one.y_m is not None:
            yield one.x_m, one.y_m
        elif one.range_m is not None and one.bearing_rad is not None:
            yield one.range_m * math.cos(one.bearing_rad), one.range_m * math.sin(one.bearing_rad)

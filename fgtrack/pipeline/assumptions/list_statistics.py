"""Statistics of the lists of a sensor: scans or single reports, and the largest density of clutter."""

import math
from collections import Counter
from dataclasses import dataclass, field

from fgtrack.core.types import DetectionList
from fgtrack.pipeline.assumptions.revisits import Revisits, positions_m

REPORTS_SHARE = 0.75
"""Share of lists with one object from which on a sensor reports objects one by one, if none of its lists is empty."""
FEWEST_LISTS = 10
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
    revisits: Revisits = field(default_factory=Revisits)
    """Intervals at which an object is measured."""

    def add(self, message: DetectionList) -> None:
        """Count a list."""
        self.num_objects[len(message.objects)] += 1
        self.revisits.add(message)
        for x_m, y_m in positions_m(message):
            self.low_m = min(self.low_m[0], x_m), min(self.low_m[1], y_m)
            self.high_m = max(self.high_m[0], x_m), max(self.high_m[1], y_m)

    @property
    def scans(self) -> bool:
        """False if the sensor reports objects one by one, as ADS-B, AIS and V2X do: a list misses nobody.

        Its lists hold one object, now and then several by coincidence, and none is empty.
        """
        lists = self.num_objects.total()
        return lists < FEWEST_LISTS or 0 in self.num_objects or self.num_objects[1] < REPORTS_SHARE * lists

    @property
    def largest_clutter_per_m2(self) -> float:
        """Density of all detections, objects or not, over the rectangle that holds them; infinite if it has no area."""
        lists, sides_m = self.num_objects.total(), (self.high_m[0] - self.low_m[0], self.high_m[1] - self.low_m[1])
        if lists < FEWEST_LISTS or min(sides_m) <= 0.0:
            return math.inf
        return sum(size * count for size, count in self.num_objects.items()) / lists / math.prod(sides_m)

"""The map at a position: the heading of the traffic, its curvature, and whether an object can be there."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.track_map import RoadView

OPEN_SPACE = "none"
"""Name of open space instead of the file of a track."""


class RoadLine(Protocol):
    """The map of one closed road: `TrackMap`, or the map of the published implementation."""

    def view(
        self, points_m: FloatArray, inner_buffer_m: float, outer_buffer_m: float
    ) -> RoadView:
        """Return the map at `points_m`, shape (n, 2). Objects may lie beyond the bounds by the buffers."""


@dataclass(frozen=True)
class Road:
    """Maps of track and pit lane, open space without a track; objects may lie beyond the bounds by the buffers."""

    track: RoadLine | None = None
    pit: RoadLine | None = None
    inner_buffer_m: float = 0.0
    outer_buffer_m: float = 0.0
    pit_buffer_m: float = 0.0

    @cached_property
    def known(self) -> bool:
        """False in open space, where headings mean nothing."""
        return self.track is not None

    def view(self, points_m: FloatArray) -> RoadView:
        """The map at `points_m`, shape (n, 2); outside is what lies on neither track nor pit lane."""
        if self.track is None:
            zeros = np.zeros(len(points_m))
            return RoadView(zeros, zeros, np.zeros(len(points_m), dtype=bool))
        track = self.track.view(points_m, self.inner_buffer_m, self.outer_buffer_m)
        if self.pit is None or not any(track.outside.tolist()):
            return track
        outside = track.outside.copy()
        strays = np.flatnonzero(outside)
        outside[strays] = self.pit.view(
            points_m[strays], self.pit_buffer_m, self.pit_buffer_m
        ).outside
        return track._replace(outside=outside)

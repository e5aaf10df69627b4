"""What the map says about a place: the heading of the traffic, its curvature, and whether an object can be there."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.models.track_map import TrackMap


class RoadView(NamedTuple):
    """The map at n places."""

    yaw_rad: FloatArray
    """Heading of the traffic, shape (n,)."""
    curvature_radpm: FloatArray
    """Left turn positive, shape (n,)."""
    outside: BoolArray
    """True where no object can be, shape (n,)."""


class Road(Protocol):
    """A map, or its absence."""

    known: bool
    """False where there is no map and headings mean nothing."""

    def view(self, points_m: FloatArray) -> RoadView:
        """The map at `points_m`, shape (n, 2)."""


class OpenSpace:
    """No map: objects may be anywhere, and no heading is known."""

    known = False

    def view(self, points_m: FloatArray) -> RoadView:
        """See `Road.view`; headings and curvatures are zero."""
        zeros = np.zeros(len(points_m))
        return RoadView(zeros, zeros, np.zeros(len(points_m), dtype=bool))


@dataclass(frozen=True)
class FrenetRoad:
    """Track and pit lane by projection on their reference lines.

    A buffer is how far (in metres) an object may lie beyond the bound; a negative one keeps away from the wall.
    """

    track: TrackMap
    pit: TrackMap | None
    inner_buffer_m: float
    outer_buffer_m: float
    pit_buffer_m: float
    known = True

    def view(self, points_m: FloatArray) -> RoadView:
        """See `Road.view`; outside is what lies on neither track nor pit lane."""
        track = RoadView(*self.track.view(points_m, self.inner_buffer_m, self.outer_buffer_m))
        if self.pit is None or not any(track.outside.tolist()):
            return track
        outside = track.outside.copy()
        strays = np.flatnonzero(outside)
        outside[strays] = self.pit.outside(points_m[strays], self.pit_buffer_m, self.pit_buffer_m)
        return RoadView(track.yaw_rad, track.curvature_radpm, outside)

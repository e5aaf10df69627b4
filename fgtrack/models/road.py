"""The map at a position: the heading of the traffic, its curvature, and whether an object can be there."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.published_map import PublishedMap
from fgtrack.models.track_map import RoadView, TrackMap


class Road(Protocol):
    """A map, or its absence."""

    known: bool
    """False where there is no map and headings mean nothing."""

    def view(self, points_m: FloatArray) -> RoadView:
        """The map at `points_m`, shape (n, 2)."""


OPEN_SPACE = "none"
"""Name of open space in the place of the file of a track."""


class OpenSpace:
    """No map: objects may be anywhere, and no heading is known."""

    known = False

    def view(self, points_m: FloatArray) -> RoadView:
        """See `Road.view`; headings and curvatures are zero."""
        zeros = np.zeros(len(points_m))
        return RoadView(zeros, zeros, np.zeros(len(points_m), dtype=bool))


@dataclass(frozen=True)
class MappedRoad:
    """Track and pit lane, by their maps.

    A buffer is how far (in metres) an object may lie beyond the bound; a negative one keeps away from the wall.
    """

    track: TrackMap | PublishedMap
    pit: TrackMap | PublishedMap | None
    inner_buffer_m: float
    outer_buffer_m: float
    pit_buffer_m: float
    known = True

    def view(self, points_m: FloatArray) -> RoadView:
        """See `Road.view`; outside is what lies on neither track nor pit lane."""
        track = self.track.view(points_m, self.inner_buffer_m, self.outer_buffer_m)
        if self.pit is None or not any(track.outside.tolist()):
            return track
        outside = track.outside.copy()
        strays = np.flatnonzero(outside)
        outside[strays] = self.pit.view(points_m[strays], self.pit_buffer_m, self.pit_buffer_m).outside
        return track._replace(outside=outside)

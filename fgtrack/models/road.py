"""The map as the tracker uses it: heading and curvature of the road, and where objects can be."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.track_map import RoadView

OPEN_SPACE = "none"
"""Setting for open space, used instead of the file name of a track map."""


class RoadLine(Protocol):
    """Map of one closed road: `TrackMap`, or the map of the published implementation."""

    def view(
        self, points_m: FloatArray, inner_buffer_m: float, outer_buffer_m: float
    ) -> RoadView:
        """Return the map at `points_m`, shape (n, 2). The buffers move the bounds outwards."""


@dataclass(frozen=True)
class Road:
    """Map of the track and the pit lane, or open space without a track.

    The buffers move the bounds outwards.
    """

    track: RoadLine | None = None
    pit: RoadLine | None = None
    inner_buffer_m: float = 0.0
    outer_buffer_m: float = 0.0
    pit_buffer_m: float = 0.0

    @cached_property
    def has_track(self) -> bool:
        """True if there is a track. In open space the headings have no meaning."""
        return self.track is not None

    def view(self, points_m: FloatArray) -> RoadView:
        """Return the map at `points_m`, shape (n, 2).

        A point is outside if it lies neither on the track nor in the pit lane. In open
        space headings and curvatures are 0, and no point is outside.
        """
        if self.track is None:
            zeros = np.zeros(len(points_m))
            return RoadView(zeros, zeros, np.zeros(len(points_m), dtype=bool))
        track = self.track.view(points_m, self.inner_buffer_m, self.outer_buffer_m)
        if self.pit is None or not any(track.outside.tolist()):
            return track
        outside = track.outside.copy()
        beside_track = np.flatnonzero(outside)
        outside[beside_track] = self.pit.view(
            points_m[beside_track], self.pit_buffer_m, self.pit_buffer_m
        ).outside
        return track._replace(outside=outside)

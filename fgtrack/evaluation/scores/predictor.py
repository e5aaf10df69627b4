"""Positions ahead of states: on their arc, or on their arc at first and then along the track.

The second is the "rail" of the published node of Karle et al. 2023, without its defects: constant turn rate and speed
for a fifth of a second, then along the track, at the same share of the way from one bound to the other.
"""

import math

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.motion import CTRV
from fgtrack.models.track_map import TrackMap

_ARC = CTRV(yaw_rate_std_radps=math.inf)
ARC_S = 0.2
"""Time for which `rail_positions` are on the arc before they follow the track."""


def arc_positions(states: FloatArray, ahead_s: FloatArray) -> FloatArray:
    """Positions (n, m, 2) of states x, y, yaw, speed, yaw rate (n, 5) after `ahead_s` (m,), on arcs."""
    return np.asarray(_ARC.predict(states[:, None], ahead_s)[..., :2])


def rail_positions(
    track: TrackMap, states: FloatArray, ahead_s: FloatArray
) -> FloatArray:
    """As `arc_positions` for `ARC_S`, then along `track`; the times rise by some 0.1 s.
    An object beyond a bound goes on along that bound, one with a negative speed stops.
    """
    positions = arc_positions(states, ahead_s)
    s_m, lateral_m = track.frenet(arc_positions(states, np.array([ARC_S]))[:, 0])
    left_m, right_m = track.bounds(s_m)
    share = np.clip((lateral_m + right_m) / (left_m + right_m), 0.0, 1.0)

    def at(s_m: FloatArray) -> FloatArray:
        """Points at `s_m` along the line and at `share` of the way from the right bound to the left, shape (n, 2)."""
        left_m, right_m = track.bounds(s_m)
        return track.position(s_m, share * (left_m + right_m) - right_m)

    here, speed_mps, at_s = at(s_m), np.maximum(states[:, 3], 0.0), ARC_S
    for column in np.flatnonzero(ahead_s > ARC_S).tolist():
        way_m = speed_mps * (float(ahead_s[column]) - at_s)
        chord_m = np.linalg.norm(at(s_m + way_m) - here, axis=1)
        # The way beside the line is longer or shorter than along it, where it turns.
        s_m = s_m + way_m * np.divide(
            way_m, chord_m, out=np.ones_like(way_m), where=chord_m > 0.0
        )
        here, at_s = at(s_m), float(ahead_s[column])
        positions[:, column] = here
    return positions

"""Predicted positions: on an arc, or first on an arc and then along the track.

The second is the "rail" predictor of the published node of Karle et al. 2023, without
its defects. It keeps turn rate and speed for a fifth of a second. Then it follows the
track at a constant share of the width between the bounds.
"""

import math

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.motion import CTRV
from fgtrack.models.track_map import TrackMap

_ARC = CTRV(yaw_rate_std_radps=math.inf)
ARC_S = 0.2
"""Time after which `rail_positions` follows the track instead of the arc."""


def arc_positions(states: FloatArray, ahead_s: FloatArray) -> FloatArray:
    """Positions (n, m, 2) on arcs, `ahead_s` (m,) after the states x, y, yaw, speed, yaw rate (n, 5)."""
    return np.asarray(_ARC.predict(states[:, None], ahead_s)[..., :2])


def rail_positions(
    track: TrackMap, states: FloatArray, ahead_s: FloatArray
) -> FloatArray:
    """Positions (n, m, 2): on arcs up to `ARC_S`, then along `track`.

    The times in `ahead_s` must increase in steps of about 0.1 s. An object beyond a
    bound continues along this bound. An object with a negative speed stops.
    """
    positions = arc_positions(states, ahead_s)
    s_m, lateral_m = track.frenet(arc_positions(states, np.array([ARC_S]))[:, 0])
    left_m, right_m = track.bounds(s_m)
    share = np.clip((lateral_m + right_m) / (left_m + right_m), 0.0, 1.0)

    def at(s_m: FloatArray) -> FloatArray:
        """Points at arc length `s_m` and at `share` of the width from right to left bound, shape (n, 2)."""
        left_m, right_m = track.bounds(s_m)
        return track.position(s_m, share * (left_m + right_m) - right_m)

    here = at(s_m)
    speed_mps = np.maximum(states[:, 3], 0.0)
    at_s = ARC_S
    for column in np.flatnonzero(ahead_s > ARC_S).tolist():
        way_m = speed_mps * (float(ahead_s[column]) - at_s)
        chord_m = np.linalg.norm(at(s_m + way_m) - here, axis=1)
        # In a turn, the way beside the line is longer or shorter than along the line.
        s_m = s_m + way_m * np.divide(
            way_m, chord_m, out=np.ones_like(way_m), where=chord_m > 0.0
        )
        here = at(s_m)
        at_s = float(ahead_s[column])
        positions[:, column] = here
    return positions

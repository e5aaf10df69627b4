"""Where an object will be: on its arc, or on its arc at first and then along the track.

The second is the "rail" of the published node of Karle et al. 2023: constant turn rate and speed for a fifth of a
second; from there on at that speed along the track, at the same share of the way from one bound to the other. Without
that node's defects: a place is projected on the line with its sign, and a metre is a metre where the track turns,
while the node counts along the raceline.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.motion import CTRV
from fgtrack.models.track_map import TrackMap

__all__ = ["ARC_S", "ArcPredictor", "Predictor", "RailPredictor"]

ARC_S = 0.2
"""Time for which `RailPredictor` follows the arc before it follows the track."""


class Predictor(Protocol):
    """Positions ahead of states."""

    def positions(self, states: FloatArray, ahead_s: FloatArray) -> FloatArray:
        """Positions of n objects after each of m rising times, shape (n, m, 2) in metres.

        Parameters
        ----------
        states
            x, y, yaw, speed and yaw rate of each object, shape (n, 5).
        ahead_s
            Positive times from those of the states, shape (m,), rising.
        """


@dataclass(frozen=True)
class ArcPredictor:
    """Constant turn rate and speed all the way (`CTRV`)."""

    def positions(self, states: FloatArray, ahead_s: FloatArray) -> FloatArray:
        """See `Predictor`."""
        return np.asarray(CTRV().predict(states[:, None], ahead_s)[..., :2])


@dataclass(frozen=True)
class RailPredictor:
    """Constant turn rate and speed for `ARC_S`, then along `track`.

    An object beyond a bound goes on along that bound, one with a negative speed stays where it is then. The way is
    measured from time to time along chords, so the times should be some 0.1 s apart.
    """

    track: TrackMap

    def positions(self, states: FloatArray, ahead_s: FloatArray) -> FloatArray:
        """See `Predictor`."""
        arc = ArcPredictor()
        positions = arc.positions(states, ahead_s)
        if not len(states):
            return positions
        s_m, lateral_m = self.track.frenet(arc.positions(states, np.array([ARC_S]))[:, 0])
        left_m, right_m = self.track.bounds(s_m)
        share = np.clip((lateral_m + right_m) / (left_m + right_m), 0.0, 1.0)
        here, speed_mps, at_s = self._at(s_m, share), np.maximum(states[:, 3], 0.0), ARC_S
        for column in np.flatnonzero(ahead_s > ARC_S).tolist():
            way_m = speed_mps * (float(ahead_s[column]) - at_s)
            there = self._at(s_m + way_m, share)
            chord_m = np.linalg.norm(there - here, axis=1)
            # The way beside the line is longer or shorter than along it, where it turns.
            s_m = s_m + way_m * np.divide(way_m, chord_m, out=np.ones_like(way_m), where=chord_m > 0.0)
            here, at_s = self._at(s_m, share), float(ahead_s[column])
            positions[:, column] = here
        return positions

    def _at(self, s_m: FloatArray, share: FloatArray) -> FloatArray:
        """Points at `s_m` along the line and at `share` of the way from the right bound to the left, shape (n, 2)."""
        left_m, right_m = self.track.bounds(s_m)
        return self.track.position(s_m, share * (left_m + right_m) - right_m)

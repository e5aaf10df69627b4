"""How long tracks live, and how often one breaks off and goes on under another id: without truth."""

import math
from dataclasses import dataclass

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import confirmed
from fgtrack.io.run import Run

__all__ = ["MOST_BREAKS_PER_MINUTE", "Lives"]

MOST_BREAKS_PER_MINUTE = 2.0
"""More breaks per object and minute than these are bad tracking."""
#: A track continues another one that ended at most so long before, or after, it began.
_GAP_S, _OVERLAP_S = 5.0, 2.0
#: It begins within this distance of where the other one would be: noise, and a turn of 0.3 rad or 30 % of its speed.
_NEAR_M, _DEPARTURE = 3.0, 0.3


@dataclass(frozen=True)
class Lives:
    """The tracks of a run that were ever confirmed."""

    lives_s: FloatArray
    """From birth to end, shape (tracks,)."""
    breaks: int
    """Tracks that begin where and when another one ends, within the distance that the object can have travelled."""

    @classmethod
    def of(cls, run: Run) -> "Lives":
        """Return the lives of `run`."""
        tracks = run.tables["tracks"]
        ids = np.unique(tracks["track_id"][confirmed(tracks)])
        rows = np.flatnonzero(np.isin(tracks["track_id"], ids))
        rows = rows[np.argsort(tracks["track_id"][rows], kind="stable")]
        first = np.searchsorted(tracks["track_id"][rows], ids)
        births, ends = rows[first], rows[np.append(first[1:], len(rows))[: len(first)] - 1]
        born_s, ended_s = ((tracks["now_ns"][each] - tracks["now_ns"][:1]) / NS_PER_S for each in (births, ends))
        positions_m = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
        yaw_rad, speed_mps = tracks["yaw_rad"][ends], tracks["speed_mps"][ends]
        velocities_mps = speed_mps[:, None] * np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=-1)
        free, breaks = np.ones(len(ids), dtype=bool), 0
        for k in np.argsort(born_s, kind="stable").tolist():
            gap_s = born_s[k] - ended_s
            late = (born_s < born_s[k]) & (ended_s < ended_s[k]) & (gap_s >= -_OVERLAP_S) & (gap_s <= _GAP_S)
            before = np.flatnonzero(free & late)
            expected_m = positions_m[ends[before]] + velocities_mps[before] * gap_s[before, None]
            apart_m = np.linalg.norm(positions_m[births[k]] - expected_m, axis=-1)
            near = apart_m <= _NEAR_M + _DEPARTURE * np.abs(speed_mps[before] * gap_s[before])
            if near.any():
                free[before[near][apart_m[near].argmin()]] = False
                breaks += 1
        return cls(ended_s - born_s, breaks)

    @property
    def median_s(self) -> float:
        """Median life; NaN without tracks."""
        return float(np.median(self.lives_s)) if len(self.lives_s) else math.nan

    @property
    def breaks_per_minute(self) -> float:
        """Breaks per minute of all lives together; NaN without lives."""
        minutes = float(self.lives_s.sum()) / 60.0
        return self.breaks / minutes if minutes else math.nan

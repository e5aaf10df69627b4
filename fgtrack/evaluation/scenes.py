"""What there is at every tick: the tracks, the true objects, and how far apart they are."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.evaluation.matching import Matching
from fgtrack.io.run import Run


@dataclass(frozen=True)
class Scenes:
    """Tracks and true objects at t ticks; rows are those of the tracks, r in all, by rising tick."""

    tick_index: IntArray
    """Tick of each row, shape (r,), rising."""
    track_ids: IntArray
    """Shape (r,)."""
    distances_m: FloatArray
    """Distance of each row from every object, shape (r, objects); infinite from what is not there."""
    present: BoolArray
    """Whether an object is there, shape (t, objects)."""

    @property
    def num_ticks(self) -> int:
        """Number of ticks t."""
        return len(self.present)

    def per_tick(self, values: FloatArray | IntArray) -> FloatArray:
        """Sum of `values`, one of each row, over the rows of every tick, shape (t,)."""
        return np.bincount(self.tick_index, values, self.num_ticks).astype(np.float64)

    def __iter__(self) -> Iterator[slice]:
        """The rows of every tick."""
        edges = np.searchsorted(self.tick_index, np.arange(self.num_ticks + 1)).tolist()
        return map(slice, edges[:-1], edges[1:])


def scenes(run: Run, matching: Matching) -> Scenes:
    """The ticks of `run` between the first and the last stamp of its truth, with the judged rows there.

    An object is there where its truth is known at the tick. A row is as far from it as it is at the row's own stamp.
    """
    truth_ns = run.truth["stamp_ns"]
    recorded = (matching.now_ns >= truth_ns.min()) & (matching.now_ns <= truth_ns.max())
    number = np.cumsum(recorded) - 1
    rows = np.flatnonzero(recorded[matching.tick_index])
    rows = rows[np.argsort(matching.tick_index[rows], kind="stable")]
    tick_index, present = number[matching.tick_index[rows]], matching.present[recorded]
    distances_m = matching.distances_m[rows]
    known = present[tick_index] & np.isfinite(distances_m)
    return Scenes(tick_index, matching.tracks["track_id"][rows], np.where(known, distances_m, np.inf), present)

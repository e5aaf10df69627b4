"""CLEAR: how well tracks cover the true objects (Bernardin and Stiefelhagen 2008), as TrackEval counts.

motrics 0.3 has CLEAR, too, but not that of TrackEval: it charges 1e18 for a pair outside the gate, in whose rounding
the similarities of the other pairs are lost, and it keeps to the last track an object ever had.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.optimize import linear_sum_assignment

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.identity import AT_GATE, similarities
from fgtrack.evaluation.matching import NO_OBJECT, contested
from fgtrack.evaluation.scenes import Scenes
from fgtrack.io.run import NO_TRACK

_CONTINUATION = 1000.0  # a pair of the tick before weighs more than the similarities of all pairs together


@dataclass(frozen=True)
class Clear:
    """Counts are sums over the ticks."""

    mota: float
    """1 - (misses + false positives + switches) / number of objects; NaN without any object."""
    motp_m: float
    """Mean distance of the pairs; NaN without a pair."""
    pairs: int
    """Objects with a track (TP)."""
    misses: int
    """Objects without one (FN)."""
    false_positives: int
    """Tracks without an object (FP)."""
    id_switches: int
    """Pairs with another track than the object's last one (IDSW)."""

    @classmethod
    def of(cls, scenes: Scenes, gate_m: float) -> Self:
        """CLEAR of `scenes`; a pair is not farther apart than `gate_m`."""
        columns = _pair(scenes, similarities(scenes.distances_m, gate_m))
        paired = np.flatnonzero(columns != NO_OBJECT)
        pairs, objects = len(paired), int(scenes.present.sum())
        track_ids = np.full(scenes.present.shape, NO_TRACK)
        track_ids[scenes.tick_index[paired], columns[paired]] = scenes.track_ids[paired]
        misses, false_positives, switches = objects - pairs, len(columns) - pairs, _switches(track_ids)
        return cls(
            mota=1.0 - (misses + false_positives + switches) / objects if objects else math.nan,
            motp_m=float(scenes.distances_m[paired, columns[paired]].mean()) if pairs else math.nan,
            pairs=pairs,
            misses=misses,
            false_positives=false_positives,
            id_switches=switches,
        )


def _pair(scenes: Scenes, similarity: FloatArray) -> IntArray:
    """Object of every row, shape (r,); `NO_OBJECT` where none.

    Pairs of the last tick with objects and tracks stay, the others have the largest sum of similarities.
    """
    inside = similarity >= AT_GATE - np.finfo(np.float64).eps
    found = np.full(len(similarity), NO_OBJECT)
    unclear = contested(inside, scenes.tick_index, scenes.num_ticks)
    clear_rows, columns = np.nonzero(inside & ~unclear[scenes.tick_index, None])
    found[clear_rows] = columns
    rows_of, ids = list(scenes), scenes.track_ids
    used = scenes.present.any(axis=1) & (scenes.per_tick(np.ones(len(ids))) > 0)
    last = np.maximum.accumulate(np.where(used, np.arange(scenes.num_ticks), 0))
    for tick in np.flatnonzero(unclear).tolist():
        rows = rows_of[tick]
        previous = np.full(similarity.shape[1], NO_TRACK)
        if tick:
            before = np.arange(len(ids))[rows_of[last[tick - 1]]]
            before = before[found[before] != NO_OBJECT]
            previous[found[before]] = ids[before]
        score = similarity[rows] + _CONTINUATION * (ids[rows, None] == previous)
        score[~inside[rows]] = 0.0
        chosen, columns = linear_sum_assignment(score, maximize=True)
        found[rows][chosen] = np.where(inside[rows][chosen, columns], columns, NO_OBJECT)
    return found


def _switches(track_ids: IntArray) -> int:
    """How often an object has another track than its last one; `track_ids` has shape (t, objects)."""
    sequences = (column[column != NO_TRACK] for column in track_ids.T)
    return sum(int((sequence[1:] != sequence[:-1]).sum()) for sequence in sequences)

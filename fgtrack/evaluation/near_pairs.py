"""Tracks and true objects at ticks, their near pairs, and the assignment of tracks to objects."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.runs import NO_TRACK


@dataclass(frozen=True)
class NearPairs:
    """The k pairs of a row of tracks and an object that are near each other, by ascending row and object.

    Only near pairs are stored, so the memory does not grow with the number of objects
    that are far away.
    """

    rows: IntArray
    """Row of each pair, shape (k,)."""
    objects: IntArray
    """Object of each pair, shape (k,)."""
    distances_m: FloatArray
    """Distance of each pair, shape (k,); below `limit_m`."""
    limit_m: float
    """Pairs at this distance or farther are left out."""

    @classmethod
    def of(cls, distances_m: FloatArray, limit_m: float = np.inf) -> Self:
        """Return the pairs below `limit_m` in `distances_m`, shape (rows, objects)."""
        rows, objects = np.nonzero(distances_m < limit_m)
        return cls(rows, objects, distances_m[rows, objects], limit_m)

    def where(self, chosen: BoolArray | IntArray) -> Self:
        """Return the pairs selected by a mask, shape (k,), or by indices."""
        return replace(
            self,
            rows=self.rows[chosen],
            objects=self.objects[chosen],
            distances_m=self.distances_m[chosen],
        )

    def nearest(self) -> Self:
        """Return the nearest pair of each row; the first object wins a tie."""
        pairs = self.where(np.lexsort((self.objects, self.distances_m, self.rows)))
        return pairs.where(np.unique(pairs.rows, return_index=True)[1])

    def check(self, needed_m: float) -> None:
        """Raise `ValueError` if pairs below `needed_m` may be missing."""
        if needed_m > self.limit_m:
            raise ValueError(
                f"pairs up to {needed_m:g} m are needed, but only those below {self.limit_m:g} m are known: "
                "match the run with a larger gate_m"
            )


@dataclass(frozen=True)
class Scenes:
    """Tracks and true objects at t ticks; r rows of tracks by ascending tick."""

    tick_index: IntArray
    """Tick of each row in ascending order, shape (r,)."""
    track_ids: IntArray
    """Track of each row, shape (r,)."""
    near: NearPairs
    """Pairs of a row and a present object."""
    present: BoolArray
    """Mask of present objects, shape (t, objects)."""
    in_view: BoolArray
    """Mask of present objects that some sensor could detect, shape (t, objects)."""

    @classmethod
    def of(
        cls,
        tick_index: IntArray,
        track_ids: IntArray,
        distances_m: FloatArray,
        present: BoolArray,
        in_view: BoolArray,
    ) -> Self:
        """Return scenes from the distances of every row from every object, shape (r, objects).

        The distance from an absent object is infinity.
        """
        return cls(tick_index, track_ids, NearPairs.of(distances_m), present, in_view)

    @property
    def distances_m(self) -> FloatArray:
        """Distance of each row from every object, shape (r, objects).

        Infinity for an absent object, and for an object at `near.limit_m` or farther.
        The array is made at each use, and is large for a long run.
        """
        distances_m = np.full((len(self.tick_index), self.present.shape[1]), np.inf)
        distances_m[self.near.rows, self.near.objects] = self.near.distances_m
        return distances_m

    def assigned(self, scores: FloatArray, previous: IntArray) -> NearPairs:
        """Return the pairs with the largest sum of `scores` at each tick, see `assigned`."""
        return self.near.where(self.assigned_indices(scores, previous))

    def assigned_indices(self, scores: FloatArray, previous: IntArray) -> IntArray:
        """Return the indices of these pairs in `near`."""
        return assigned(
            self.near,
            scores,
            self.track_ids,
            self.tick_index,
            previous,
            self.present.shape[1],
        )


def assigned(
    near: NearPairs,
    scores: FloatArray,
    ids: IntArray,
    tick_index: IntArray,
    previous: IntArray,
    num_objects: int,
) -> IntArray:
    """Return the indices of the pairs with the largest sum of scores at each tick, by ascending row.

    Every row and every object has at most one pair at a tick. `scores` (k,) are 0 for
    pairs that are not allowed. `ids` and `tick_index` (rows,) are the track and the
    tick of each row. Allowed pairs of the tick `previous` (ticks,) stay.
    """
    num_ticks = len(previous)
    allowed = np.flatnonzero(scores > 0.0)
    rows = near.rows[allowed]
    objects = near.objects[allowed]
    ticks = tick_index[rows]
    # A tick is clear if each row has at most one allowed object, and each object one allowed row.
    unclear = np.zeros(num_ticks, dtype=np.bool_)
    per_row = np.bincount(rows, minlength=len(ids))
    unclear[tick_index[per_row > 1]] = True
    codes, times = np.unique(ticks * num_objects + objects, return_counts=True)
    unclear[codes[times > 1] // max(num_objects, 1)] = True
    pair_of_row = np.full(len(ids), -1)
    clear = ~unclear[ticks]
    pair_of_row[rows[clear]] = allowed[clear]
    in_order = np.argsort(tick_index, kind="stable")
    edges = np.searchsorted(tick_index[in_order], np.arange(num_ticks + 1)).tolist()
    by_tick = np.argsort(ticks, kind="stable")
    pair_edges = np.searchsorted(ticks[by_tick], np.arange(num_ticks + 1)).tolist()
    for k in np.flatnonzero(unclear).tolist():
        last = int(previous[k])
        before = in_order[edges[last] : edges[last + 1]] if last >= 0 else in_order[:0]
        before = before[pair_of_row[before] >= 0]
        track_of = np.full(num_objects, NO_TRACK)
        track_of[near.objects[pair_of_row[before]]] = ids[before]
        mine = allowed[by_tick[pair_edges[k] : pair_edges[k + 1]]]
        of_tick = in_order[edges[k] : edges[k + 1]]
        chosen = _best(near.where(mine), scores[mine], ids, of_tick, track_of)
        pair_of_row[near.rows[mine[chosen]]] = mine[chosen]
    return pair_of_row[pair_of_row >= 0]


def _best(
    near: NearPairs,
    scores: FloatArray,
    ids: IntArray,
    rows: IntArray,
    track_of: IntArray,
) -> IntArray:
    """Return the indices of the pairs of one tick with the largest sum of scores.

    `rows` are the rows of the tick in ascending order. `track_of` (objects,) is the
    track of each object before; its pair stays.
    """
    from scipy.optimize import linear_sum_assignment

    at = np.searchsorted(rows, near.rows), near.objects
    pair = np.full((len(rows), len(track_of)), -1)
    pair[at] = np.arange(len(scores))
    gains = np.zeros(pair.shape)
    gains[at] = scores
    stays = (pair >= 0) & (ids[rows, None] == track_of)
    best = linear_sum_assignment(gains + (1.0 + gains.sum()) * stays, maximize=True)
    chosen = pair[best]
    return np.asarray(chosen[chosen >= 0])

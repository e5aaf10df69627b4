"""Tracks and true objects at ticks, their near pairs, and the assignment of tracks to objects."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.runs import NO_TRACK

# Number of ticks whose pairs are processed together.
_BLOCK_TICKS = 1 << 13


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

    def where(self, chosen: BoolArray | IntArray | slice) -> Self:
        """Return the pairs selected by a mask, shape (k,), by indices or by a slice."""
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

    def blocks(self, length: int = _BLOCK_TICKS) -> Iterator[slice]:
        """Yield the indices of the near pairs of every `length` ticks."""
        first_ticks = np.arange(0, len(self.present), length)
        first_rows = np.searchsorted(self.tick_index, first_ticks)
        edges = np.searchsorted(self.near.rows, first_rows).tolist()
        for first, last in pairwise([*edges, len(self.near.rows)]):
            yield slice(first, last)

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
    pair_of_row = np.full(len(ids), -1)
    rows, row_edges = _by_tick(tick_index, len(previous))
    pairs, pair_edges = _by_tick(tick_index[near.rows], len(previous))
    for first in range(0, len(previous), _BLOCK_TICKS):
        last = min(first + _BLOCK_TICKS, len(previous))
        mine = np.sort(pairs[pair_edges[first] : pair_edges[last]])
        allowed = mine[scores[mine] > 0.0]
        ticks = tick_index[near.rows[allowed]] - first
        unclear = _unclear(near.where(allowed), ticks, num_objects)
        clear = allowed[~unclear[ticks]]
        pair_of_row[near.rows[clear]] = clear
        for k in (first + np.flatnonzero(unclear)).tolist():
            before = rows[:0]
            if previous[k] >= 0:
                at = int(previous[k])
                before = rows[row_edges[at] : row_edges[at + 1]]
            before = before[pair_of_row[before] >= 0]
            track_of = np.full(num_objects, NO_TRACK)
            track_of[near.objects[pair_of_row[before]]] = ids[before]
            mine = allowed[ticks == k - first]
            of_tick = rows[row_edges[k] : row_edges[k + 1]]
            chosen = _best(near.where(mine), scores[mine], ids, of_tick, track_of)
            pair_of_row[near.rows[mine[chosen]]] = mine[chosen]
    return pair_of_row[pair_of_row >= 0]


def _by_tick(tick_index: IntArray, num_ticks: int) -> tuple[IntArray, IntArray]:
    """Return indices by ascending tick, shape (n,), and the first of each tick, shape (num_ticks + 1,)."""
    order = np.argsort(tick_index, kind="stable")
    return order, np.searchsorted(tick_index[order], np.arange(num_ticks + 1))


def _unclear(near: NearPairs, ticks: IntArray, num_objects: int) -> BoolArray:
    """Mask of the ticks in which a row or an object has several pairs of `near`, shape (_BLOCK_TICKS,).

    `ticks` (k,) is the tick of each pair.
    """
    unclear = np.zeros(_BLOCK_TICKS, dtype=np.bool_)
    order = np.argsort(near.rows, kind="stable")
    again = near.rows[order][1:] == near.rows[order][:-1]
    unclear[ticks[order][1:][again]] = True
    codes, times = np.unique(ticks * num_objects + near.objects, return_counts=True)
    unclear[codes[times > 1] // max(num_objects, 1)] = True
    return unclear


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

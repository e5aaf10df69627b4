"""The assignment problem of candidates and tracks, solved where they are linked by pairs inside their gates."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.tracking.gating import MOST_PAIRS, Pairs

_REFUSED = 1e9  # cost of a pair outside its gate: any number of good pairs is cheaper
_FEW_COSTS = 1 << 12  # so many are solved at once sooner than they are taken apart
_MOST_COSTS = 1 << 22  # of more, as of 2,100 candidates that 2,100 tracks share, the cheapest go first
_MOST_LINKS = 1 << 24  # of tracks by a candidate, to be counted


class Assignment(NamedTuple):
    """Outcome of an association."""

    pairs: list[tuple[int, int]]
    """(candidate, track) as positions in the lists that were associated, candidates ascending."""
    new: list[int]
    """Candidates without a track, in the order of their birth."""
    missed: list[int]
    """Tracks without a candidate, ascending."""
    refused: tuple[int, ...] = ()
    """Candidates that neither belong to a track nor may start one."""


def assigned(pairs: Pairs, num_candidates: int, num_tracks: int) -> Assignment:
    """Of `pairs`, whose values are costs, as many as possible at least cost; each candidate and track once.

    Those linked by pairs are a problem of their own: its size is what memory and time depend on, not that of all. In
    one with more than `_MOST_COSTS` costs the cheapest pair goes first, and so on.
    """
    rows, columns = _solved(pairs, num_candidates, num_tracks)
    return _outcome(rows, columns, num_candidates, num_tracks)


def assigned_densely(cost: FloatArray, inside: BoolArray) -> Assignment:
    """`assigned` of all pairs `inside` their gates, both arguments of shape (candidates, tracks)."""
    rows, columns = _least_cost(np.where(inside, cost, _REFUSED))
    good = inside[rows, columns]
    return _outcome(rows[good], columns[good], *cost.shape)


def _outcome(rows: IntArray, columns: IntArray, num_candidates: int, num_tracks: int) -> Assignment:
    pairs = sorted(zip(rows.tolist(), columns.tolist(), strict=True))
    paired, seen = {i for i, _ in pairs}, {j for _, j in pairs}
    new = [] if len(pairs) == num_candidates else [i for i in range(num_candidates) if i not in paired]
    missed = [] if len(pairs) == num_tracks else [j for j in range(num_tracks) if j not in seen]
    return Assignment(pairs, new, missed)


def cheapest(pairs: Pairs, numbers: IntArray) -> Pairs:
    """Of each track the so many pairs of least cost, `numbers` of shape (tracks,); of equal ones the first candidates.

    So many as there are tracks to compete for the same candidates, itself included, are enough: where a track has a
    dearer one, one of these is free.
    """
    counts = np.bincount(pairs.columns, minlength=len(numbers))
    if not (counts > numbers).any():
        return pairs
    order = np.lexsort((pairs.rows, pairs.values, pairs.columns))
    columns = pairs.columns[order]
    rank = np.arange(len(columns)) - (np.cumsum(counts) - counts)[columns]
    return pairs.at(np.sort(order[rank < numbers[columns]]))


class _Table(NamedTuple):
    """Pairs, and their places in a table of the candidates and tracks that they have."""

    pairs: Pairs
    rows: IntArray
    columns: IntArray
    i: IntArray
    j: IntArray

    @classmethod
    def of(cls, pairs: Pairs) -> "_Table":
        """The table of `pairs`."""
        rows, i = np.unique(pairs.rows, return_inverse=True)
        columns, j = np.unique(pairs.columns, return_inverse=True)
        return cls(pairs, rows, columns, i, j)

    @property
    def size(self) -> int:
        return len(self.rows) * len(self.columns)


def _solved(pairs: Pairs, num_candidates: int, num_tracks: int) -> tuple[IntArray, IntArray]:
    """Candidates and tracks of the best pairs."""
    if len(pairs.rows) < 2:
        return pairs.rows, pairs.columns
    alone = np.bincount(pairs.rows, minlength=num_candidates)[pairs.rows] == 1
    alone &= np.bincount(pairs.columns, minlength=num_tracks)[pairs.columns] == 1
    if alone.all():
        return pairs.rows, pairs.columns
    rows, columns = [pairs.rows[alone]], [pairs.columns[alone]]
    linked = pairs.at(~alone)
    few = _Table.of(linked)
    for part in [few] if few.size <= _FEW_COSTS else map(_Table.of, _components(linked, num_candidates, num_tracks)):
        if part.size > MOST_PAIRS:
            smaller = cheapest(part.pairs, _rivals(part.pairs, num_candidates, num_tracks))
            if len(smaller.rows) < len(part.pairs.rows):
                found = _solved(smaller, num_candidates, num_tracks)
                rows.append(found[0])
                columns.append(found[1])
                continue
        if part.size > _MOST_COSTS:
            found = _cheapest_first(part.pairs)
            rows.append(found[0])
            columns.append(found[1])
            continue
        cost = np.full((len(part.rows), len(part.columns)), _REFUSED)
        inside = np.zeros(cost.shape, dtype=bool)
        cost[part.i, part.j], inside[part.i, part.j] = part.pairs.values, True
        first, second = _least_cost(cost)
        good = inside[first, second]
        rows.append(part.rows[first[good]])
        columns.append(part.columns[second[good]])
    return np.concatenate(rows), np.concatenate(columns)


def _cheapest_first(pairs: Pairs) -> tuple[IntArray, IntArray]:
    """Candidates and tracks of the cheapest pair, of the cheapest of the rest, and so on."""
    order = np.lexsort((pairs.columns, pairs.rows, pairs.values))
    of_row, taken = dict[int, int](), set[int]()
    for row, column in zip(pairs.rows[order].tolist(), pairs.columns[order].tolist(), strict=True):
        if row not in of_row and column not in taken:
            of_row[row] = column
            taken.add(column)
    return np.array(list(of_row)), np.array(list(of_row.values()))


def _least_cost(cost: FloatArray) -> tuple[IntArray, IntArray]:
    rows, columns = linear_sum_assignment(cost)
    return np.asarray(rows), np.asarray(columns)


def _components(pairs: Pairs, num_candidates: int, num_tracks: int) -> list[Pairs]:
    """`pairs` in groups that share neither candidates nor tracks."""
    count = num_candidates + num_tracks
    graph = csr_array((np.ones(len(pairs.rows), np.int8), (pairs.rows, pairs.columns + num_candidates)), (count, count))
    _, labels = connected_components(graph, directed=False)
    of_pair = labels[pairs.rows]
    order = np.argsort(of_pair, kind="stable")
    starts = np.flatnonzero(np.diff(of_pair[order], prepend=-1))
    return [pairs.at(part) for part in np.split(order, starts[1:])]


def _rivals(pairs: Pairs, num_candidates: int, num_tracks: int) -> IntArray:
    """How many tracks share a candidate with each track, itself included, shape (tracks,); 0 of one without pairs.

    Where there are too many to be counted, a number that is not smaller.
    """
    shared = np.bincount(pairs.rows, minlength=num_candidates)
    if float(shared.dot(shared)) > _MOST_LINKS:
        at_most = np.bincount(pairs.columns, shared[pairs.rows], num_tracks).astype(np.int64)
        return np.minimum(at_most, np.count_nonzero(at_most))
    links = csr_array((np.ones(len(pairs.rows), np.int32), (pairs.rows, pairs.columns)), (num_candidates, num_tracks))
    return np.diff((links.T @ links).tocsr().indptr).astype(np.int64)

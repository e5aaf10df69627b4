"""The assignment problem of candidates and tracks over the pairs inside their gates."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.tracking.gating import Pairs

_OUTSIDE = 1e9  # cost outside the gate: any number of pairs inside is cheaper
_DENSE = 1 << 12  # a matrix of so many costs is solved faster than its pairs


class Assignment(NamedTuple):
    """Outcome of an association."""

    pairs: list[tuple[int, int]]
    """(candidate, track) as indices into the associated lists, candidates ascending."""
    new: list[int]
    """Candidates without a track, in the order of their birth."""
    missed: list[int]
    """Tracks without a candidate, ascending."""
    refused: tuple[int, ...] = ()
    """Candidates that neither belong to a track nor may start one."""


def assigned(pairs: Pairs, num_candidates: int, num_tracks: int) -> Assignment:
    """Assignment of as many of `pairs` as possible at least total cost, which are their values."""
    if len(pairs.rows) < 2:
        rows, columns = pairs.rows, pairs.columns
    elif num_candidates * num_tracks <= _DENSE:
        cost = np.full((num_candidates, num_tracks), _OUTSIDE)
        cost[pairs.rows, pairs.columns] = pairs.values
        inside = np.zeros(cost.shape, dtype=bool)
        inside[pairs.rows, pairs.columns] = True
        return assigned_densely(cost, inside)
    elif num_candidates > num_tracks:
        columns, rows = _least_cost(pairs.columns, pairs.rows, pairs.values, (num_tracks, num_candidates))
    else:
        rows, columns = _least_cost(pairs.rows, pairs.columns, pairs.values, (num_candidates, num_tracks))
    return _outcome(rows, columns, num_candidates, num_tracks)


def assigned_densely(cost: FloatArray, inside: BoolArray) -> Assignment:
    """Assignment of all pairs `inside` their gates, both arguments of shape (candidates, tracks)."""
    rows, columns = (np.asarray(part) for part in linear_sum_assignment(np.where(inside, cost, _OUTSIDE)))
    good = inside[rows, columns]
    return _outcome(rows[good], columns[good], *cost.shape)


def _least_cost(i: IntArray, j: IntArray, cost: FloatArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """Rows and columns of the best pairs: each row may take a column of its own instead, outside every gate."""
    num_rows, num_columns = shape
    own = np.arange(num_rows)
    shifted = cost + (1.0 - cost.min())  # a sparse graph has no edges of weight 0
    costs = np.concatenate([shifted, np.full(num_rows, _OUTSIDE)])
    edges = np.concatenate([i, own]), np.concatenate([j, num_columns + own])
    rows, columns = min_weight_full_bipartite_matching(csr_array((costs, edges), (num_rows, num_columns + num_rows)))
    inside = columns < num_columns
    return np.asarray(rows[inside], dtype=np.int64), np.asarray(columns[inside], dtype=np.int64)


def _outcome(rows: IntArray, columns: IntArray, num_candidates: int, num_tracks: int) -> Assignment:
    pairs = sorted(zip(rows.tolist(), columns.tolist(), strict=True))
    paired, matched = {i for i, _ in pairs}, {j for _, j in pairs}
    new = [i for i in range(num_candidates) if i not in paired]
    return Assignment(pairs, new, [j for j in range(num_tracks) if j not in matched])

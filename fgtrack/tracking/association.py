"""Association of candidates with tracks (Karle et al. 2023, section III-D)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple, Protocol

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.special import gammaincinv

from fgtrack.core.checks import between_0_and_1, not_negative, positive
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import StatesAt
from fgtrack.tracking.gating import Pairs, grouped, innovations, near, reaches_m
from fgtrack.tracking.objects import Apart
from fgtrack.tracking.preprocess import Candidate

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


class Association(Protocol):
    """Assigns candidates to tracks at least cost."""

    def __call__(self, candidates: Sequence[Candidate], states: StatesAt, apart: Apart | None = None) -> Assignment:
        """The states are those of the tracks at the candidates' stamp; pairs that are `apart` are not made."""


@dataclass(frozen=True)
class GatedEuclidean:
    """Hungarian assignment on distances; pairs further apart than the gate are out before the assignment.

    `max_nis` is for what the distance does not show, as a ghost that crosses a track at another speed: a pair whose
    innovation is larger is out as well, and the candidate starts no track, which would compete for the next detections.
    Without it, as in the paper, every pair inside the gate is accepted.
    """

    kind: Literal["euclidean"] = "euclidean"
    gate_m: float = 5.0
    """Largest distance of a pair."""
    max_nis: float | None = None
    """Largest NIS of a pair; null for no limit."""

    def __post_init__(self) -> None:
        positive(gate_m=self.gate_m, max_nis=self.max_nis)

    def __call__(self, candidates: Sequence[Candidate], states: StatesAt, apart: Apart | None = None) -> Assignment:
        """See `Association`."""
        return self.within(self.gate_m, candidates, states, apart)

    def within(
        self, gates_m: float | FloatArray, candidates: Sequence[Candidate], states: StatesAt, apart: Apart | None = None
    ) -> Assignment:
        """Return the assignment with other gates; `gates_m` broadcasts to (candidates, tracks)."""
        is_one = isinstance(gates_m, float)
        pairs = _near(candidates, states, gates_m if is_one else float(np.max(gates_m, initial=0.0)), apart)
        if not is_one:
            limits_m = np.broadcast_to(gates_m, (len(candidates), len(states.means)))
            pairs = pairs.at(pairs.values <= limits_m[pairs.rows, pairs.columns])
        suspects = set[int]()
        if self.max_nis is not None and len(pairs.rows):
            suspects = set(pairs.rows.tolist())
            nis = np.empty(len(pairs.rows))
            for chosen, found, _, _ in innovations(pairs, grouped(candidates), len(candidates), states):
                nis[chosen] = found
            pairs = pairs.at(nis <= self.max_nis)
        return _refusing(suspects, assigned(pairs, len(candidates), len(states.means)))


@dataclass(frozen=True)
class GatedMahalanobis:
    """Hungarian assignment on squared Mahalanobis distances of the innovation, gated by the chi-square quantile.

    The gate widens with the time since the last detection and the speed that is possible, so that it serves sensors of
    any rate; the log-determinant in the cost keeps a track of wide covariance from taking what fits another.
    """

    kind: Literal["mahalanobis"] = "mahalanobis"
    gate_probability: float = 0.999
    """Probability with which a true pair passes the gate."""
    max_distance_m: float = 5000.0
    """Largest distance of a pair: as far as an airliner flies in 20 s. The chi-square gate decides below it."""
    claim_m: float = 0.0
    """A candidate that belongs to no track starts none nearer than this to one: it is the other end of a long hull."""

    def __post_init__(self) -> None:
        not_negative(claim_m=self.claim_m)
        between_0_and_1(gate_probability=self.gate_probability)
        positive(max_distance_m=self.max_distance_m)

    def __call__(self, candidates: Sequence[Candidate], states: StatesAt, apart: Apart | None = None) -> Assignment:
        """See `Association`; the cost adds log det S, so that a vague track does not win by being vague."""
        groups = grouped(candidates)
        quantiles = [chi_square_quantile(self.gate_probability, group.z.shape[-1]) for group in groups]
        reach_m = reaches_m(groups, states, quantiles, self.max_distance_m)
        pairs = _near(candidates, states, reach_m, apart)
        cost, inside = np.empty(len(pairs.rows)), np.empty(len(pairs.rows), dtype=bool)
        for chosen, nis, logdet, k in innovations(pairs, groups, len(candidates), states) if len(cost) else ():
            cost[chosen] = nis + logdet
            inside[chosen] = nis <= chi_square_quantile(self.gate_probability, k)
        result = assigned(pairs._replace(values=cost).at(inside), len(candidates), len(states.means))
        if not (self.claim_m and result.new):
            return result
        loose = np.array(result.new)
        claimed = _near(candidates, states, self.claim_m, apart).rows
        return _refusing(set(loose[np.isin(loose, claimed)].tolist()), result)


def _near(candidates: Sequence[Candidate], states: StatesAt, reach_m: float | FloatArray, apart: Apart | None) -> Pairs:
    """Return the pairs at most `reach_m` apart that are not `apart`."""
    pairs = near(candidates, states.means, reach_m)
    return pairs if apart is None else pairs.at(~apart(pairs.rows, pairs.columns))


def _refusing(suspects: set[int], assignment: Assignment) -> Assignment:
    """Return `assignment` in which those of `suspects` without a track start none."""
    if suspects.isdisjoint(assignment.new):
        return assignment
    refused = tuple([i for i in assignment.new if i in suspects])
    return assignment._replace(new=[i for i in assignment.new if i not in suspects], refused=refused)


@cache
def chi_square_quantile(probability: float, freedom: int) -> float:
    """Quantile of the chi-square distribution; importing `scipy.stats` for it would take a second."""
    return float(2.0 * gammaincinv(0.5 * freedom, probability))


def assigned(pairs: Pairs, num_candidates: int, num_tracks: int) -> Assignment:
    """Assignment of as many of `pairs` as possible at least total cost, which are their values."""
    one, other = pairs.rows.tolist(), pairs.columns.tolist()
    if len(set(one)) == len(one) and len(set(other)) == len(other):  # nothing competes, as nearly always
        return _outcome(pairs.rows, pairs.columns, num_candidates, num_tracks)
    if num_candidates * num_tracks <= _DENSE:
        cost = np.full((num_candidates, num_tracks), _OUTSIDE)
        cost[pairs.rows, pairs.columns] = pairs.values
        inside = np.zeros(cost.shape, dtype=bool)
        inside[pairs.rows, pairs.columns] = True
        return assigned_densely(cost, inside)
    if num_candidates > num_tracks:
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
    new = set(range(num_candidates)).difference(rows.tolist())
    missed = set(range(num_tracks)).difference(columns.tolist())
    return Assignment(pairs, sorted(new), sorted(missed))

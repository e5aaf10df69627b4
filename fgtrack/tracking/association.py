"""Gates, and association of candidates with tracks (Karle et al. 2023, section III-D)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Literal, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from fgtrack.core.linalg import kernels, stacked
from fgtrack.core.settings import OpenProbability, settings
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import StatesAt
from fgtrack.tracking.facing import Facings, Readings, is_read, read
from fgtrack.tracking.objects import Apart, Evidence
from fgtrack.tracking.preprocess import Candidates, Group

_OUTSIDE = 1e9  # cost outside the gate: any number of pairs inside is cheaper
MOST_NEAR = 128
"""Tracks, the nearest ones, that a candidate is compared with: no real scene has as many inside one gate."""
_MARGIN = 1.0 + 1e-9  # a tree rounds differently


class Pairs(NamedTuple):
    """Candidates and tracks that may belong together."""

    rows: IntArray
    """Indices of candidates, ascending, shape (m,)."""
    columns: IntArray
    """Indices of tracks, shape (m,)."""
    values: FloatArray
    """Distance or cost, shape (m,)."""

    def at(self, chosen: BoolArray | IntArray) -> "Pairs":
        """Return the pairs with the indices or the mask `chosen`."""
        return Pairs(self.rows[chosen], self.columns[chosen], self.values[chosen])


#: True of some pairs, shape (m,).
Likely = Callable[[Pairs], BoolArray]


class Assignment(NamedTuple):
    """Outcome of an association."""

    pairs: list[tuple[int, int]]
    """Pairs (candidate, track) as indices into the associated candidates and tracks, candidates ascending."""
    new: list[int]
    """Candidates without a track, in the order of their birth."""
    missed: list[int]
    """Tracks without a candidate, ascending."""
    refused: tuple[int, ...] = ()
    """Candidates that neither belong to a track nor may start one."""
    readings: tuple[Readings, ...] = ()
    """Readings of the pairs that were compared, for groups whose detections may be read in several ways."""


class AssociationProblem(NamedTuple):
    """Candidates of one stamp and the tracks that they may belong to, with the states of the tracks at this stamp."""

    candidates: Candidates
    states: StatesAt
    apart: Apart | None = None
    """Excludes pairs that cannot be the same object."""
    likely: Likely | None = None
    """Selects pairs by their costs NIS + log det S; an association by distance ignores it."""
    facings: Facings | None = None
    """Log-odds of the fronts and shares of wrong yaws, by which yaws are read; None if every yaw is used as
    measured.
    """


class Association(ABC):
    """Base of the associations, which assign candidates to tracks at least cost."""

    @property
    @abstractmethod
    def reads_yaws(self) -> bool:
        """True if the gate is a likelihood; only such a gate can read a yaw that is half a turn off."""

    def __call__(
        self,
        candidates: Candidates,
        states: StatesAt,
        apart: Apart | None = None,
        likely: Likely | None = None,
        facings: Facings | None = None,
    ) -> Assignment:
        """Assign candidates to tracks. The arguments are the fields of `AssociationProblem`."""
        return self.assign(
            AssociationProblem(candidates, states, apart, likely, facings)
        )

    @abstractmethod
    def assign(self, problem: AssociationProblem) -> Assignment:
        """Assign the candidates of a problem to its tracks."""


@settings
class GatedEuclidean(Association):
    """Hungarian assignment on distances; the gate excludes pairs before the assignment.

    `max_nis` excludes pairs by their innovation as well, for instance a ghost that crosses a track at another speed. An
    excluded candidate starts no track, because that track would compete for the next detections. Without `max_nis`
    every pair inside the gate is accepted, as in the paper.
    """

    kind: Literal["euclidean"] = "euclidean"
    gate_m: PositiveFloat = 5.0
    """Largest distance of a pair."""
    max_nis: PositiveFloat | None = None
    """Largest NIS of a pair; null for no limit."""

    @property
    def reads_yaws(self) -> bool:
        """See `Association`. Without `max_nis` every pair inside the gate is fused as it was measured."""
        return self.max_nis is not None

    def assign(self, problem: AssociationProblem) -> Assignment:
        """See `Association.assign`."""
        candidates, states, apart, _, facings = problem
        return self.within(self.gate_m, candidates, states, apart, facings)

    def within(
        self,
        gates_m: float | FloatArray,
        candidates: Candidates,
        states: StatesAt,
        apart: Apart | None = None,
        facings: Facings | None = None,
    ) -> Assignment:
        """Return the assignment with the gates `gates_m` instead of `gate_m`. They broadcast to (candidates,
        tracks).
        """
        is_one = isinstance(gates_m, float)
        pairs = near(
            candidates,
            states.means,
            gates_m if is_one else float(np.max(gates_m, initial=0.0)),
            apart,
        )
        has_direction = ~np.isinf(candidates.lines[pairs.rows, 2])
        if not all(has_direction.tolist()):
            pairs = pairs.at(has_direction)  # no distance shows what these belong to
        if not is_one:
            limits_m = np.broadcast_to(gates_m, (len(candidates), len(states.means)))
            pairs = pairs.at(pairs.values <= limits_m[pairs.rows, pairs.columns])
        inside, readings = pairs, list[Readings]()
        if self.max_nis is not None and len(pairs.rows):
            _, is_inside, readings = weighed(
                pairs, candidates, states, facings, partial(_same_limits, self.max_nis)
            )
            inside = pairs if all(is_inside.tolist()) else pairs.at(is_inside)
        assignment = assigned(inside, len(candidates), len(states.means))
        if readings:
            assignment = assignment._replace(readings=tuple(readings))
        if self.max_nis is None or not assignment.new:
            return assignment
        return _refusing(set(pairs.rows.tolist()), assignment)


@settings
class GatedMahalanobis(Association):
    """Hungarian assignment on squared Mahalanobis distances of the innovation, gated by the chi-square quantile.

    The gate grows with the predicted covariance, so it serves sensors of any rate. The cost contains the
    log-determinant. So a track with a large covariance does not take a detection that fits another track better.
    """

    kind: Literal["mahalanobis"] = "mahalanobis"
    gate_probability: OpenProbability = 0.999
    """Probability with which a true pair passes the gate."""
    max_distance_m: PositiveFloat = 5000.0
    """Largest distance of a pair: as far as an airliner flies in 20 s. The chi-square gate decides below it."""
    claim_m: NonNegativeFloat = 0.0
    """A candidate that belongs to no track starts none nearer than this to a confirmed one: it is the other end of a
    long hull. What is near to clutter may well be an object."""
    joint_from: PositiveInt | None = None
    """Detections from which on a track is updated by all those in its gate, each with the probability that it belongs
    to the track and to no other one (JPDA, of positions); null: by the assigned one alone. A first state is too
    uncertain for it. Statuses and dispositions are always those of the assignment."""

    @property
    def reads_yaws(self) -> bool:
        """See `Association`."""
        return True

    def assign(self, problem: AssociationProblem) -> Assignment:
        """See `Association.assign`. The tracker itself applies `claim_m`."""
        candidates, states, apart, likely, facings = problem
        pairs, readings = self._gated(candidates, states, apart, facings)
        if likely is not None and len(pairs.rows):
            pairs = pairs.at(likely(pairs))
        assignment = assigned(pairs, len(candidates), len(states.means))
        return assignment._replace(readings=tuple(readings)) if readings else assignment

    def gated(
        self,
        candidates: Candidates,
        states: StatesAt,
        apart: Apart | None = None,
        facings: Facings | None = None,
    ) -> Pairs:
        """Return the pairs inside the gate with their cost NIS + log det S.

        The determinant prevents that a track with a large covariance has the least cost.
        """
        return self._gated(candidates, states, apart, facings)[0]

    def _gated(
        self,
        candidates: Candidates,
        states: StatesAt,
        apart: Apart | None,
        facings: Facings | None,
    ) -> tuple[Pairs, list[Readings]]:
        reach_m: float | FloatArray = self.max_distance_m
        if len(candidates) * len(states.means) > MOST_NEAR:
            weight = apart.weight if isinstance(apart, Evidence) else 0.0
            reach_m = reaches_m(
                candidates.groups,
                states,
                self.gate_probability,
                self.max_distance_m,
                weight,
            )
        pairs = near(
            candidates,
            states.means,
            reach_m,
            apart.differ if isinstance(apart, Evidence) else apart,
        )
        more = None
        if isinstance(apart, Evidence):
            more = apart.nis(pairs.rows, pairs.columns)
            largest = max(
                len(group.stack.model.components) for group in candidates.groups
            )
            likely = more <= chi_square_quantile(self.gate_probability, largest)
            pairs, more = pairs.at(likely), more[likely]
        limits = partial(quantiles, self.gate_probability)
        cost, inside, readings = weighed(
            pairs, candidates, states, facings, limits, more
        )
        return pairs._replace(values=cost).at(inside), readings


@settings
class Hypotheses(Association):
    """Decisions by the likeliest of a few hypotheses about all detections inside the horizon.

    Each hypothesis assigns every detection to an object or to clutter (a Poisson multi-Bernoulli mixture). Lists count
    in the order of their stamps: a late list changes the decisions about newer ones. The association needs
    `lifecycle.kind: existence`.
    """

    kind: Literal["hypotheses"] = "hypotheses"
    most: PositiveInt = 8
    """Largest number of hypotheses."""
    revise: bool = True
    """True if late lists change decisions. Otherwise a list that is older than the newest list is too old, as it always
    is for the estimator `drop` and for smoothers with `smoother.late: drop`.
    """

    @property
    def reads_yaws(self) -> bool:
        """See `Association`."""
        return True

    def assign(self, problem: AssociationProblem) -> Assignment:
        """Not used: the tracker decides about lists, see `fgtrack.tracking.decisions`."""
        raise NotImplementedError


def claimed(
    assignment: Assignment,
    candidates: Candidates,
    states: StatesAt,
    claims_m: float | FloatArray,
    apart: Apart | None,
) -> Assignment:
    """Return `assignment` in which a candidate at most `claims_m` from a track starts no track; see `near`."""
    rows = (
        near(candidates, states.means, claims_m, apart).rows
        if assignment.new
        else np.zeros(0)
    )
    return _refusing(set(rows.tolist()).intersection(assignment.new), assignment)


def _refusing(suspects: set[int], assignment: Assignment) -> Assignment:
    """Return `assignment` in which candidates of `suspects` without a track start no track."""
    if suspects.isdisjoint(assignment.new):
        return assignment
    refused = tuple([i for i in assignment.new if i in suspects])
    return assignment._replace(
        new=[i for i in assignment.new if i not in suspects], refused=refused
    )


@cache
def chi_square_quantile(probability: float, freedom: int) -> float:
    """Quantile of the chi-square distribution; importing `scipy.stats` for it would take a second."""
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(0.5 * freedom, probability))


@cache
def quantiles(probability: float, most: int) -> FloatArray:
    """Return `chi_square_quantile` for 0 to `most` degrees of freedom, shape (most + 1,)."""
    return np.array(
        [
            0.0,
            *(
                chi_square_quantile(probability, freedom)
                for freedom in range(1, most + 1)
            ),
        ]
    )


@cache
def _same_limits(limit: float, most: int) -> FloatArray:
    """Return the same limit for 0 to `most` components, shape (most + 1,)."""
    return np.full(most + 1, limit)


def assigned(pairs: Pairs, num_candidates: int, num_tracks: int) -> Assignment:
    """Return the assignment with as many of `pairs` as possible, and with the least sum of their values."""
    i, j = pairs.rows.tolist(), pairs.columns.tolist()
    if _compete(i, j):
        pairs = pairs.at(_uncontested(pairs.rows, pairs.columns, pairs.values))
        pairs = pairs.at(_uncontested(pairs.columns, pairs.rows, pairs.values))
        contested = (np.bincount(pairs.rows)[pairs.rows] > 1) | (
            np.bincount(pairs.columns)[pairs.columns] > 1
        )
        chosen = ~contested
        if contested.any():
            chosen[contested.nonzero()[0][_least_cost(pairs.at(contested))]] = True
        i, j = pairs.rows[chosen].tolist(), pairs.columns[chosen].tolist()
    new = (
        sorted(set(range(num_candidates)).difference(i))
        if len(i) < num_candidates
        else []
    )
    missed = sorted(set(range(num_tracks)).difference(j)) if len(j) < num_tracks else []
    return Assignment(list(zip(i, j, strict=True)), new, missed)


def _compete(i: list[int], j: list[int]) -> bool:
    return len(i) > 1 and not len(set(i)) == len(set(j)) == len(i)


def _uncontested(i: IntArray, j: IntArray, cost: FloatArray) -> BoolArray:
    """Mask (m,) of the pairs that an assignment may need.

    A candidate i may have several tracks j that no other candidate can take. Of these pairs the cheapest is kept.
    """
    shared, order = np.bincount(j)[j] > 1, np.lexsort((cost, i))
    cheapest = np.ones(len(i), dtype=bool)
    cheapest[order[1:]] = i[order[1:]] != i[order[:-1]]
    return cheapest | (np.bincount(i, shared)[i] > 0.0)


def _least_cost(pairs: Pairs) -> IntArray:
    """Return the indices of the pairs of the assignment with the least sum of values.

    Each row may stay without a column; this costs more than any pair.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    (rows, i), (columns, j) = (
        np.unique(each, return_inverse=True) for each in pairs[:2]
    )
    if len(rows) > len(columns):
        rows, i, columns, j = columns, j, rows, i
    own, shape = np.arange(len(rows)), (len(rows), len(columns) + len(rows))
    shifted = pairs.values + (
        1.0 - pairs.values.min()
    )  # a sparse graph has no edges of weight 0
    costs = np.concatenate([shifted, np.full(len(rows), _OUTSIDE)])
    edges = np.concatenate([i, own]), np.concatenate([j, len(columns) + own])
    of, taken = min_weight_full_bipartite_matching(csr_array((costs, edges), shape))
    inside, width, order = taken < len(columns), len(columns), np.lexsort((j, i))
    return order[
        (i * width + j)[order].searchsorted(of[inside] * width + taken[inside])
    ]


def near(
    candidates: Candidates,
    means: FloatArray,
    reach_m: float | FloatArray,
    excluded: Apart | None = None,
) -> Pairs:
    """Return the pairs of candidates and tracks that are at most `reach_m` apart, with their distances.

    `reach_m` is a number, or a number for each track. Pairs in `excluded` are left out. A candidate keeps its
    `MOST_NEAR` nearest tracks. Distances are in the map; the distance of a bearing is from the track to the line of
    sight.
    """
    limits_m = np.empty(len(means))
    limits_m[:] = reach_m
    tracks = np.ascontiguousarray(means), means[:, 0].argsort()
    pairs = Pairs(
        *kernels("fgtrack.tracking.kernels").near(
            candidates.lines, *tracks, limits_m, MOST_NEAR
        )
    )
    return pairs if excluded is None else pairs.at(~excluded(pairs.rows, pairs.columns))


def _innovations_of(
    group: Group, members: IntArray, columns: IntArray, states: StatesAt
) -> tuple[FloatArray, FloatArray]:
    """Return NIS and log det S of `members` of `group` with the tracks `columns`, all (p,).

    Both are NaN if S is not positive definite.
    """
    P, own = np.ascontiguousarray(states.covariances), group.stack
    x = states.means.take(columns, axis=0)
    y, H = own.model.linearised(own.z.take(members, axis=0), x, own.pose)
    R, every = group.noise(members, x, P, columns), np.arange(y.shape[1])
    _, nis, logdet = kernels("fgtrack.estimation.kernels.kalman").innovations(
        y, stacked(H), P, columns, R, every
    )
    return nis, logdet


def weighed(
    pairs: Pairs,
    candidates: Candidates,
    states: StatesAt,
    facings: Facings | None,
    limits: Callable[[int], FloatArray],
    more: FloatArray | None = None,
) -> tuple[FloatArray, BoolArray, list[Readings]]:
    """Return the costs NIS + log det S of `pairs` (m,), a mask of the pairs inside the gate (m,), and readings.

    `limits` returns the largest NIS for 0 to k components, shape (k + 1,). `more` (m,) is added to the NIS. With
    `facings` the cost belongs to the likeliest reading of a yaw, see `fgtrack.tracking.facing`. A pair is inside if one
    of its readings is inside.
    """
    cost, inside, readings = (
        np.empty(len(pairs.rows)),
        np.empty(len(pairs.rows), dtype=bool),
        list[Readings](),
    )
    for group, members, chosen in candidates.split(pairs.rows) if len(cost) else ():
        columns = pairs.columns.take(chosen)
        own_more = None if more is None else more[chosen]
        own_limits = limits(len(group.stack.model.components))
        if facings is not None and is_read(group):
            found = read(group, members, columns, states, facings, own_limits, own_more)
            cost[chosen], inside[chosen] = found.costs, found.codes >= 0
            readings.append(found)
            continue
        nis, logdet = _innovations_of(group, members, columns, states)
        nis = nis if own_more is None else nis + own_more
        cost[chosen] = nis + logdet
        inside[chosen] = nis <= own_limits[-1]
    return cost, inside, readings


def reaches_m(
    groups: Sequence[Group],
    states: StatesAt,
    probability: float,
    limit_m: float,
    more_nis: float = 0.0,
) -> FloatArray:
    """Return the largest distance from each track at which a candidate can lie inside the gate, shape (tracks,).

    Inside the gate the NIS is at most the quantile of `probability` plus `more_nis`. The NIS is at least the NIS of the
    position alone, which is at least the squared distance over the largest variance of S = P + R in any direction. The
    distance is at most `limit_m`. It is `limit_m` if the position is not measured.
    """
    squared_m2 = np.zeros(len(states.means))
    none, P = np.zeros(len(squared_m2)), np.ascontiguousarray(states.covariances)
    for group in groups:
        if not _shows_position(group, states.means):
            return np.full(len(states.means), limit_m)
        model, late_m2 = group.stack.model, none
        if group.stamp_error is not None:
            late = group.stamp_error.noise(
                model, group.stack.pose, states.means, states.covariances
            )
            late_m2 = late[:, :2, :2].trace(axis1=1, axis2=2)
        quantile = chi_square_quantile(probability, len(model.components)) + more_nis
        kernels("fgtrack.tracking.kernels").widen(
            P, np.ascontiguousarray(group.stack.R), late_m2, quantile, squared_m2
        )
    return np.minimum(np.sqrt(squared_m2) * _MARGIN, limit_m)


def _shows_position(group: Group, means: FloatArray) -> bool:
    """True if the first two measured components are the position in the states."""
    model = group.stack.model
    if model.components[:2] != ("x_m", "y_m"):
        return False
    if model.is_compiled:
        return True
    seen = model.predict(means, group.stack.pose)
    return np.array_equal(seen[:, :2], means[:, :2])

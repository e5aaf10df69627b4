"""Which candidate belongs to which track (Karle et al. 2023, section III-D)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, Protocol

import numpy as np
from scipy.special import gammaincinv

from fgtrack.core.checks import between_0_and_1, not_negative, positive
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import StatesAt
from fgtrack.tracking.assignment import Assignment, assigned, cheapest
from fgtrack.tracking.gating import NO_PAIRS, Pairs, alike, innovations, near, nis_of, reaches_m
from fgtrack.tracking.objects import Apart
from fgtrack.tracking.preprocess import Candidate

_FEW_PAIRS = 2  # so many are judged faster one by one


class Association(Protocol):
    """Assigns candidates to tracks at least cost."""

    def __call__(self, candidates: Sequence[Candidate], states: StatesAt, apart: Apart | None = None) -> Assignment:
        """The states are those of the tracks at the candidates' stamp; pairs that are `apart` are not made."""


@dataclass(frozen=True)
class GatedEuclidean:
    """Hungarian assignment on distances; pairs further apart than the gate are out before the assignment.

    `max_nis` is for what the distance does not show, as a ghost that crosses a track at another speed: a pair whose
    innovation is larger is out as well, and the candidate starts no track, which would compete for the next detections.
    Without it, as in the paper, every pair inside the gate is believed.
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
        self,
        gates_m: float | FloatArray,
        candidates: Sequence[Candidate],
        states: StatesAt,
        apart: Apart | None = None,
    ) -> Assignment:
        """The same with other gates; `gates_m` has a shape that goes with (candidates, tracks)."""
        limits_m, reach_m = None, gates_m
        if isinstance(gates_m, np.ndarray):
            limits_m = np.broadcast_to(gates_m, (len(candidates), len(states.means)))
            reach_m = float(gates_m.max(initial=0.0))
        few = self.max_nis is None or len(candidates) * len(states.means) <= _FEW_PAIRS
        groups = [] if few else alike(candidates)
        near_any = set[int]()

        def believed(pairs: Pairs) -> Pairs:
            if limits_m is not None:
                pairs = pairs.at(pairs.values <= limits_m[pairs.rows, pairs.columns])
            if self.max_nis is None:
                return pairs
            near_any.update(pairs.rows.tolist())
            return pairs.at(nis_of(pairs, groups, candidates, states) <= self.max_nis)

        found = _assigned(candidates, states, reach_m, believed, apart)
        refused = tuple([i for i in found.new if i in near_any])
        return found._replace(new=[i for i in found.new if i not in near_any], refused=refused) if refused else found


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
        groups = alike(candidates)
        quantiles = [chi_square_quantile(self.gate_probability, group.z.shape[-1]) for group in groups]

        def inside(pairs: Pairs) -> Pairs:
            nis, S_all = innovations(pairs, groups, len(candidates), states)
            cost, good = nis.copy(), np.zeros(len(nis), dtype=bool)
            for chosen, S in S_all:
                cost[chosen] += np.linalg.slogdet(S)[1]
                good[chosen] = nis[chosen] <= chi_square_quantile(self.gate_probability, S.shape[-1])
            return pairs._replace(values=cost).at(good)

        found = _assigned(candidates, states, reaches_m(groups, states, quantiles, self.max_distance_m), inside, apart)
        if not (self.claim_m and found.new and len(states.means)):
            return found
        loose, claimed = np.array(found.new), set[int]()
        for part in near([candidates[i] for i in found.new], states.means, self.claim_m):
            rows = loose[part.rows]
            claimed.update((rows if apart is None else rows[~apart(rows, part.columns)]).tolist())
        return found._replace(
            new=[i for i in found.new if i not in claimed], refused=tuple([i for i in found.new if i in claimed])
        )


def _assigned(
    candidates: Sequence[Candidate],
    states: StatesAt,
    reach_m: float | FloatArray,
    judged: Callable[[Pairs], Pairs],
    apart: Apart | None,
) -> Assignment:
    """The best of the pairs at most `reach_m` apart that `judged` leaves, which gives them their costs."""
    num_tracks = len(states.means)
    pairs = NO_PAIRS
    for part in near(candidates, states.means, reach_m):
        if apart is not None:
            part = part.at(~apart(part.rows, part.columns))
        pairs = Pairs.joined([pairs, judged(part)]) if len(pairs.rows) else judged(part)
        if len(pairs.rows) > num_tracks:
            pairs = cheapest(pairs, np.full(num_tracks, num_tracks))
    return assigned(pairs, len(candidates), num_tracks)


@cache
def chi_square_quantile(probability: float, freedom: int) -> float:
    """Quantile of the chi-square distribution; `scipy.stats` says the same and takes a second to import."""
    return float(2.0 * gammaincinv(0.5 * freedom, probability))

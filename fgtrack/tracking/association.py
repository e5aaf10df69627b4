"""Which candidate belongs to which track (Karle et al. 2023, section III-D)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import gammaincinv

from fgtrack.core.linalg import congruence, mahalanobis_squared
from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.estimation.base import StatesAt
from fgtrack.estimation.ekf import linearised
from fgtrack.tracking.preprocess import Candidate

_NOWHERE = np.zeros(2)  # in place of a position that a bearing does not give
_REFUSED = 1e9  # cost of a pair outside its gate: any number of good pairs is cheaper


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


#: Assigns candidates to tracks at least cost; the states are those of the tracks at the candidates' stamp.
Association = Callable[[Sequence[Candidate], StatesAt], Assignment]


def euclidean_distances(candidates: Sequence[Candidate], means: FloatArray) -> FloatArray:
    """Distances, shape (candidates, tracks), in the map; of a bearing, from the track to the line of sight."""
    points = [_NOWHERE if candidate.position_m is None else candidate.position_m for candidate in candidates]
    offsets = np.array(points).reshape(-1, 1, 2) - means[:, :2]
    distances = np.sqrt(np.vecdot(offsets, offsets))
    for row, candidate in enumerate(candidates):
        if candidate.position_m is None:
            distances[row] = _distances_to_ray(candidate, means)
    return np.asarray(distances)


def _distances_to_ray(candidate: Candidate, means: FloatArray) -> FloatArray:
    pose = candidate.measurement.pose
    offsets = means[:, :2] - np.array([pose.x_m, pose.y_m])
    ranges = np.hypot(offsets[:, 0], offsets[:, 1])
    angle = np.arctan2(offsets[:, 1], offsets[:, 0]) - pose.yaw_rad - candidate.values["bearing_rad"]
    across = np.abs(ranges * np.sin(angle))
    return np.asarray(np.where(np.cos(angle) > 0.0, across, ranges))


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
        if not self.gate_m > 0.0:
            raise ValueError(f"gate_m: must be positive, is {self.gate_m}")
        if self.max_nis is not None and not self.max_nis > 0.0:
            raise ValueError(f"max_nis: must be positive, is {self.max_nis}")

    def __call__(self, candidates: Sequence[Candidate], states: StatesAt) -> Assignment:
        """See `Association`."""
        return self.within(self.gate_m, candidates, states)

    def within(self, gates_m: float | FloatArray, candidates: Sequence[Candidate], states: StatesAt) -> Assignment:
        """The same with other gates; `gates_m` has a shape that goes with (candidates, tracks)."""
        cost = euclidean_distances(candidates, states.means)
        near = cost <= gates_m
        if self.max_nis is None:
            return assigned(cost, near)
        believed = near & (_innovations(candidates, states)[0] <= self.max_nis)
        found = assigned(cost, believed)
        refused = tuple(i for i in found.new if near[i].any())
        return found._replace(new=[i for i in found.new if not near[i].any()], refused=refused)


@dataclass(frozen=True)
class GatedMahalanobis:
    """Hungarian assignment on squared Mahalanobis distances of the innovation, gated by the chi-square quantile.

    `max_distance_m` keeps a track of wide covariance from taking every detection.
    """

    kind: Literal["mahalanobis"] = "mahalanobis"
    gate_probability: float = 0.99
    """Probability with which a true pair passes the gate."""
    max_distance_m: float = 50.0
    """Largest distance of a pair."""

    def __post_init__(self) -> None:
        if not 0.0 < self.gate_probability < 1.0:
            raise ValueError(f"gate_probability: must lie between 0 and 1, is {self.gate_probability}")
        if not self.max_distance_m > 0.0:
            raise ValueError(f"max_distance_m: must be positive, is {self.max_distance_m}")

    def __call__(self, candidates: Sequence[Candidate], states: StatesAt) -> Assignment:
        """See `Association`; the cost adds log det S, so that a vague track does not win by being vague."""
        nis, log_volume = _innovations(candidates, states)
        inside = euclidean_distances(candidates, states.means) <= self.max_distance_m
        for row, candidate in enumerate(candidates):
            inside[row] &= nis[row] <= chi_square_quantile(self.gate_probability, len(candidate.measurement.z))
        return assigned(nis + log_volume, inside)


def _innovations(candidates: Sequence[Candidate], states: StatesAt) -> tuple[FloatArray, FloatArray]:
    """NIS and log det S of every candidate and track, shape (candidates, tracks).

    Of all components, what is assumed too: a gate judges what would be done to the track.
    """
    nis, log_volume = np.empty((2, len(candidates), len(states.track_ids)))
    for row, candidate in enumerate(candidates):
        measurement = candidate.measurement
        y, H = linearised(measurement.z, states.means, measurement.model, measurement.pose)
        S = congruence(H, states.covariances) + candidate.noise_at(states.means)
        nis[row] = mahalanobis_squared(y, S)
        log_volume[row] = np.linalg.slogdet(S)[1]
    return nis, log_volume


@cache
def chi_square_quantile(probability: float, freedom: int) -> float:
    """Quantile of the chi-square distribution; `scipy.stats` says the same and takes a second to import."""
    return float(2.0 * gammaincinv(0.5 * freedom, probability))


def assigned(cost: FloatArray, inside: BoolArray) -> Assignment:
    """Of all pairs `inside` their gates as many as possible, at least `cost`, both of shape (candidates, tracks)."""
    cost[~inside] = _REFUSED
    rows, columns = linear_sum_assignment(cost)
    pairs = [(i, j) for i, j in zip(rows.tolist(), columns.tolist(), strict=True) if inside[i, j]]
    paired = {i for i, _ in pairs}
    seen = {j for _, j in pairs}
    return Assignment(
        pairs,
        [i for i in range(cost.shape[0]) if i not in paired],
        [j for j in range(cost.shape[1]) if j not in seen],
    )

"""Existence probability of tracks: integrated probabilistic data association.

Musicki, Evans, Stankovic: Integrated probabilistic data association, IEEE Trans. Automatic Control 39, 1994; the same
recursion is that of a Bernoulli filter (Ristic, Vo, Vo, Farina: A tutorial on Bernoulli filters, IEEE Trans. Signal
Processing 61, 2013). With the existence probability r, an object survives the time dt with probability
exp(-dt / lifetime), and a list that could have shown it changes the odds r / (1 - r) by the factor

    1 - P_D + P_D L,   L = N(z - h(x); 0, S) / clutter density * p(score | object) / p(score | clutter)

where the track was matched, and by 1 - P_D where it was not. Approximate are: L is that of the one detection which the
assignment gives (the probabilities of other assignments are left out), of its position alone, and as it was when the
detection arrived. Each factor counts at the stamp of its list, whatever the order of arrival within `memory_s`: what
is late changes what came after it.
"""

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from fgtrack.core.linalg import mahalanobis_squared
from fgtrack.core.settings import OpenProbability, settings
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray, TrackStatus
from fgtrack.estimation.base import StatesAt
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.lifecycle import CountingLifecycle, Scan
from fgtrack.tracking.preprocess import Candidate, Candidates

#: Bounds of log-odds: a probability that differs from 0 or 1 by less says nothing more.
_LARGEST_LOG_ODDS = 30.0
_SINGULAR = 1e-12


@settings
class ExistenceRules:
    """Confirmation and end of tracks by the probability that the object exists."""

    kind: Literal["existence"] = "existence"
    birth_probability: OpenProbability = 0.2
    """Probability that an unassociated detection stems from an object, before its score is considered."""
    confirm_probability: OpenProbability = 0.9
    """A track is confirmed from here on."""
    doubt_probability: OpenProbability = 0.5
    """A confirmed track below this is published as tentative until it is seen again."""
    delete_probability: OpenProbability = 0.02
    """A track below this ends."""
    lifetime_s: PositiveFloat = 20.0
    """Mean time for which an object stays: oncoming traffic is near for seconds, a car ahead for minutes. It matters
    where few lists could show an object; elsewhere those that miss it end its track."""
    out_of_view_s: PositiveFloat = 0.5
    """A track ends where the newest list that could not show it is so much newer than the last one that could: half a
    second bridges a gap between two fields of view, and little is known of an object that nothing sees for longer."""
    min_travel_m: NonNegativeFloat = 0.0
    """A track is not confirmed before it was so far from where it began: what never moves is shore, or moored."""
    memory_s: PositiveFloat = 5.0
    """Time for which late lists change the probability at their own stamp; older ones count as if they were so old."""
    suppress_births_near_newer_tracks: bool = True
    """True if a late detection near a track that a newer detection has started begins no track of its own."""

    def __post_init__(self) -> None:
        if not self.delete_probability < min(self.birth_probability, self.doubt_probability):
            raise ValueError("delete_probability: must be less than birth_probability and doubt_probability")
        if self.doubt_probability > self.confirm_probability:
            raise ValueError("doubt_probability: must not be more than confirm_probability")


@dataclass(slots=True)
class Existence:
    """The existence probability of one object as a function of time: evidence in order of its stamps."""

    lifetime_s: float
    stamps_ns: list[int]
    """Rising; the first is the birth, or the oldest that is remembered."""
    weights: list[float]
    """Logarithm of the factor by which each evidence changes the odds; of the first the log-odds themselves."""
    log_odds: list[float] = field(default_factory=list)
    """After each evidence."""
    in_view_ns: int = 0
    """Stamp of the newest list that could have shown it."""
    misses: int = 0
    """Lists since the last match that could have shown it."""
    confirmed: bool = False
    first_m: FloatArray | None = None
    """First position, shape (2,)."""
    travelled: bool = False
    """True if it was ever as far from there as a track must be to be confirmed."""

    def learn(self, stamp_ns: int, weight: float) -> None:
        """Evidence of `stamp_ns`, in any order; what is older than all that is remembered counts as the oldest."""
        row = max(bisect_right(self.stamps_ns, stamp_ns), 1)
        self.in_view_ns = max(self.in_view_ns, stamp_ns)
        self.stamps_ns.insert(row, max(stamp_ns, self.stamps_ns[0]))
        self.weights.insert(row, weight)
        del self.log_odds[row:]
        for k in range(row, len(self.stamps_ns)):
            self.log_odds.append(_bounded(self._survived(k - 1, self.stamps_ns[k]) + self.weights[k]))

    def probability(self, stamp_ns: int) -> float:
        """Existence probability at `stamp_ns`, at or after the newest evidence."""
        return 1.0 / (1.0 + math.exp(-self._survived(-1, stamp_ns)))

    def forget(self, oldest_ns: int) -> None:
        """Remember what is older than `oldest_ns` by its outcome alone."""
        keep = max(bisect_right(self.stamps_ns, oldest_ns) - 1, 0)
        if keep:
            del self.stamps_ns[:keep], self.weights[:keep], self.log_odds[:keep]
            self.weights[0] = self.log_odds[0]

    def _survived(self, row: int, stamp_ns: int) -> float:
        """Log-odds that it exists and is still there at `stamp_ns`, given the evidence up to `row`."""
        log_odds, dt_s = self.log_odds[row], seconds(stamp_ns - self.stamps_ns[row])
        if dt_s <= 0.0:
            return log_odds
        gone = -math.expm1(-dt_s / self.lifetime_s)
        dead = math.exp(-log_odds)  # odds r / (1 - r) become r s / (1 - r s) with s = exp(-dt / lifetime)
        return _bounded(-math.log(dead + gone) - dt_s / self.lifetime_s)


class ExistenceLifecycle:
    """Tracks live by the probability that their objects exist; see the module.
    A list says nothing of objects out of its sensor's range and field of view. Without an ego all are in view.
    """

    def __init__(
        self, rules: ExistenceRules, sensors: Mapping[str, SensorModel], detection_origin_m: tuple[float, float]
    ) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point."""
        self._rules = rules
        self._sensors = sensors
        self._origin_m = detection_origin_m
        self._memory_ns = nanoseconds(rules.memory_s)
        self._out_of_view_ns = nanoseconds(rules.out_of_view_s)
        self._present_ns = 0
        self._newest_ns = 0  # stamp of the newest list that could have shown something
        self.lives: dict[int, Existence] = {}
        """Existence by track id."""

    def born(self, track_id: int, scan: Scan, candidate: Candidate) -> None:
        """See `CountingLifecycle.born`."""
        odds = self._rules.birth_probability / (1.0 - self._rules.birth_probability)
        log_odds = _bounded(math.log(odds) + self._score(scan, candidate))
        self.lives[track_id] = life = Existence(
            self._rules.lifetime_s, [scan.stamp_ns], [log_odds], [log_odds], in_view_ns=scan.stamp_ns
        )
        life.first_m, life.travelled = candidate.position_m, self._rules.min_travel_m == 0.0
        self._confirm(life)

    def matched(self, scan: Scan, candidates: Candidates, pairs: Sequence[tuple[int, int]], states: StatesAt) -> None:
        """See `CountingLifecycle.matched`."""
        sensor = self._sensors[scan.sensor]
        P_D = sensor.detection_probability
        for position, track in pairs:
            if not candidates.placed[position]:
                continue
            life, mean, candidate = self.lives[states.track_ids[track]], states.means[track], candidates[position]
            life.misses = 0
            if not life.travelled and life.first_m is not None:
                life.travelled = math.dist(mean[:2].tolist(), life.first_m.tolist()) >= self._rules.min_travel_m
            density = _position_density(candidate, mean, states.covariances[track])
            if density is not None:
                ratio = density / sensor.clutter_per_m2 * math.exp(self._score(scan, candidate))
                life.learn(scan.stamp_ns, math.log(1.0 - P_D + P_D * ratio))
                self._confirm(life)

    def fused(self, track_id: int) -> None:
        """See `CountingLifecycle.fused`; the match has counted already."""

    def missed(self, scan: Scan, track_ids: Sequence[int], positions_m: FloatArray, ranges_m: FloatArray) -> list[int]:
        """See `CountingLifecycle.missed`."""
        sensor = self._sensors[scan.sensor]
        self._newest_ns = max(self._newest_ns, scan.stamp_ns)
        weight = math.log1p(-sensor.detection_probability)
        in_view = np.ones(len(track_ids), dtype=bool)
        if scan.ego is not None:
            pose = np.array([scan.ego.x_m, scan.ego.y_m, scan.ego.yaw_rad])
            in_view = sensor.sees(positions_m, np.broadcast_to(pose, (len(track_ids), 3)), self._origin_m)
        for track_id in np.asarray(track_ids)[in_view].tolist():
            life = self.lives[track_id]
            life.misses += 1
            life.learn(scan.stamp_ns, weight)
        return [track_id for track_id in track_ids if self._ends(self.lives[track_id])]

    def expired(self, present_ns: int) -> list[int]:
        """See `CountingLifecycle.expired`."""
        self._present_ns = present_ns
        for life in self.lives.values():
            life.forget(present_ns - self._memory_ns)
        return [track_id for track_id, life in self.lives.items() if self._ends(life)]

    def forget(self, track_id: int) -> None:
        """See `CountingLifecycle.forget`."""
        del self.lives[track_id]

    def status(self, track_id: int) -> TrackStatus:
        """See `CountingLifecycle.status`."""
        life = self.lives[track_id]
        if not life.confirmed or life.probability(self._present_ns) < self._rules.doubt_probability:
            return TrackStatus.TENTATIVE
        return TrackStatus.COASTING if life.misses else TrackStatus.CONFIRMED

    def _confirm(self, life: Existence) -> None:
        if life.travelled and life.probability(self._present_ns) >= self._rules.confirm_probability:
            life.confirmed = True

    def _ends(self, life: Existence) -> bool:
        if self._newest_ns - life.in_view_ns > self._out_of_view_ns:
            return True
        return life.probability(self._present_ns) < self._rules.delete_probability

    def _score(self, scan: Scan, candidate: Candidate) -> float:
        """Logarithm of p(score | object) / p(score | clutter) of the best detection; 0 where there is none."""
        model = self._sensors[scan.sensor].score
        if model is None or not scan.objects:
            return 0.0
        indices = (candidate.leader, *candidate.merged)
        scores = [score for index in indices if (score := scan.objects[index].score) is not None]
        return min(max((max(scores) - model.even) / model.scale, -10.0), 10.0) if scores else 0.0


Lifecycle = CountingLifecycle | ExistenceLifecycle


def _position_density(candidate: Candidate, mean: FloatArray, P: FloatArray) -> float | None:
    """N(z - h(x); 0, S) of the position in 1/m^2; None where the detection gives none, or S is singular to rounding."""
    if candidate.position_m is None or candidate.position_covariance is None:
        return None
    S = P[:2, :2] + candidate.position_covariance
    variances = float(S[0, 0] * S[1, 1])
    determinant = variances - float(S[0, 1] * S[1, 0])
    if determinant <= _SINGULAR * variances:
        return None
    squared = float(mahalanobis_squared(candidate.position_m - mean[:2], S))
    return math.exp(-0.5 * squared) / (2.0 * math.pi * math.sqrt(determinant))


def _bounded(log_odds: float) -> float:
    return min(max(log_odds, -_LARGEST_LOG_ODDS), _LARGEST_LOG_ODDS)

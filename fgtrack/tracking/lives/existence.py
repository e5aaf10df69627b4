"""Existence probability of tracks: integrated probabilistic data association with visibility.

An object survives the time dt with probability exp(-dt / lifetime). A list of a sensor to which it is visible with
probability v changes the odds r / (1 - r) of its existence by the factor 1 - v + v l, where the track was matched with

    l = 1 - P_D + P_D L,   L = N(z - h(x); 0, S) / clutter density * p(score | object) / p(score | clutter)

and where it was missed with l = 1 - P_D. The visibility v falls with misses in a row, so that a
sensor which does not see an object does not end what another sees
(`fgtrack.tracking.lives.visibility`). A track ends at the stamp of a list, by the lists up to that
stamp, once the lists of all sensors that could show its object have come up to there, or should
have come (`fgtrack.tracking.lives.latency`). Until then a track that has become improbable is
suspended: it is not published, and newer lists are not compared with it.

Three things are approximate. L is the likelihood of the assigned detection alone, without other assignments. It is the
likelihood of the position alone. It is computed when the detection arrives, and not again. Each list counts at its
stamp, whatever the order of arrival within `memory_s`.
"""

import math
from bisect import bisect_right, insort
from collections.abc import Iterable, Mapping, Sequence
from itertools import compress
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from fgtrack.core.linalg import kernels
from fgtrack.core.settings import OpenProbability, settings
from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray, TrackStatus
from fgtrack.estimation.base import StatesAt
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.association import Assignment, Pairs, assigned, near
from fgtrack.tracking.lives.counters import STATUSES, CountingLifecycle, Scan
from fgtrack.tracking.lives.latency import FOREVER, NEVER, Views
from fgtrack.tracking.lives.visibility import Histories
from fgtrack.tracking.preprocess import Candidate, Candidates
from fgtrack.tracking.rows import FEWEST, TrackRows

#: Columns of the life of a track: misses since the last match, newest stamps at which it was in view and probably
#: visible, and newest stamp for which it is known which sensors could show it.
MISSES, IN_VIEW, VISIBLE, JUDGED = range(4)
NUM_LIFE = 4
#: Columns of its flags: it was ever confirmed, and was as far from its first position as it must be.
IS_CONFIRMED, IS_TRAVELLED = range(2)
NUM_FLAGS = 2
#: Numbers of the verdicts in compiled loops.
STAYS, ENDS, SUSPENDED = range(3)
_KERNELS = "fgtrack.tracking.lives.existence_kernels"


class _Matches(NamedTuple):
    """Matches of m detections of a list and tracks."""

    rows: IntArray
    """Rows of the tracks in the arrays of `ExistenceLifecycle`, shape (m,)."""
    stamp_ns: int
    sensor: int
    scores: FloatArray
    """See `ExistenceLifecycle._score`."""
    points_m: FloatArray
    """Shape (m, 2), and of the states at the stamp (m, 2)."""
    means_m: FloatArray
    P: FloatArray
    """Covariances of the positions of the states, shape (m, 2, 2), and of the detections."""
    R: FloatArray


@settings
class ExistenceRules:
    """Confirmation and end of tracks by the probability that the object exists."""

    kind: Literal["existence"] = "existence"
    birth_probability: OpenProbability = 0.2
    """Probability that an unassociated detection stems from an object, before its score is considered."""
    confirm_probability: OpenProbability = 0.9
    """A track is confirmed from here on."""
    doubt_probability: OpenProbability = 0.5
    """A confirmed track below this is published as tentative until it is detected once more."""
    delete_probability: OpenProbability = 0.02
    """A track below this ends."""
    lifetime_s: PositiveFloat = 20.0
    """Mean time for which an object stays: oncoming traffic is near for seconds, a car ahead for minutes. It matters
    where few lists could show an object; elsewhere those that miss it end its track."""
    visible_share: OpenProbability = 0.9
    """Share of the time for which an object is visible to a sensor: less where objects hide each other often."""
    visible_s: PositiveFloat = 2.0
    """Time after which visibility to a sensor is forgotten to 1/e: misses come in rows of about that length."""
    out_of_view_s: PositiveFloat = 0.5
    """A track ends where the newest list that could not show it is so much newer than the last one that could: half a
    second bridges a gap between two fields of view, and little is known of an object that nothing sees for longer."""
    hidden_s: PositiveFloat = 2.0
    """A track ends that was probably visible to no sensor for so long: what comes back may be another object."""
    min_travel_m: NonNegativeFloat = 0.0
    """A track is not confirmed before it was so far from where it began: what never moves is shore, or moored."""
    memory_s: PositiveFloat = 5.0
    """Time for which late lists change the probability at their own stamp; older ones count as if they were so old."""
    weigh_births: bool = False
    """True if a position belongs to a track only where that is more probable than clutter or a new object. It matters
    where tracks coast for long: gates grow until they reach other objects (`association.kind: mahalanobis`)."""
    suppress_births_near_newer_tracks: bool = True
    """True if a late detection near a track that a newer detection has started begins no track of its own."""

    def __post_init__(self) -> None:
        if not self.delete_probability < min(
            self.birth_probability, self.doubt_probability
        ):
            raise ValueError(
                "delete_probability: must be less than birth_probability and doubt_probability"
            )
        if self.doubt_probability > self.confirm_probability:
            raise ValueError(
                "doubt_probability: must not be more than confirm_probability"
            )


class ExistenceLifecycle(Stateful):
    """Decides by the probability that an object exists which tracks are confirmed, and which tracks end.

    A list does not count for objects out of its sensor's range and field of view. Without an ego all are in view.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_present_ns",
        "_watermarks_ns",
        "_processed_ns",
        "_scans_ns",
        "_suspended",
        "_histories",
        "_rows",
        "_arrays",
        "_first_m",
        "_matches",
    )

    def __init__(
        self,
        rules: ExistenceRules,
        sensors: Mapping[str, SensorModel],
        detection_origin_m: tuple[float, float],
    ) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point."""
        self._rules = rules
        self.weighs_births = rules.weigh_births
        self.birth_probability = rules.birth_probability
        self._sensors = sensors
        self._index = {name: index for index, name in enumerate(sensors)}
        self._views = Views(sensors, detection_origin_m)
        self._memory_ns = nanoseconds(rules.memory_s)
        self._out_of_view_ns = nanoseconds(rules.out_of_view_s)
        self._hidden_ns = nanoseconds(rules.hidden_s)
        self._present_ns = 0
        self._watermarks_ns = np.full(len(sensors), FOREVER)
        self._processed_ns = FOREVER  # all lists before it that have come are processed
        self._scans_ns: list[
            int
        ] = []  # stamps of lists that could have shown something, ascending
        self._suspended: tuple[int, ...] = ()
        self._histories = Histories(
            len(sensors), rules.lifetime_s, rules.visible_share, rules.visible_s
        )
        self._rows = TrackRows()
        self._first_m: FloatArray = np.zeros((0, 2))
        """First positions, shape (tracks, 2)."""
        self._arrays: tuple[IntArray, BoolArray, BoolArray, IntArray] = (
            np.zeros((0, NUM_LIFE), dtype=np.int64),
            np.zeros((0, NUM_FLAGS), dtype=bool),
            np.zeros((0, len(sensors)), dtype=bool),
            np.zeros((0, len(sensors)), dtype=np.int64),
        )
        """Lives and flags, shapes (tracks, columns). By sensor, shapes (tracks, sensors): true if the sensor could show
        the object at the newest stamp for which that is known, and the newest stamp at which the sensor could."""
        self._matches: list[_Matches] = []  # that are not in the histories yet
        own = sensors.values()
        self._P_D = np.array([each.detection_probability for each in own])
        self._clutter = np.array([each.clutter_per_m2 for each in own])

    def born(self, track_id: int, scan: Scan, candidate: Candidate) -> None:
        """See `CountingLifecycle.born`."""
        odds = self._rules.birth_probability / (1.0 - self._rules.birth_probability)
        log_odds = math.log(odds) + self._score(
            scan, (candidate.leader, *candidate.merged)
        )
        own, stamp_ns = self._index[scan.sensor], scan.stamp_ns
        could_show = self._views.at_birth(candidate.position_m, scan.ego, own)
        if self._rows.following >= len(self._first_m):
            self._allocate(2 * len(self._first_m) or FEWEST)
        self._histories.begin(self._rows.following, stamp_ns, own, log_odds)
        row = self._rows.begin(track_id)
        lives, flags, could, expected_ns = self._arrays
        lives[row] = 0, stamp_ns, stamp_ns, stamp_ns
        has_travelled = self._rules.min_travel_m == 0.0
        exists = self._histories.present(np.array([row]), stamp_ns)[0]
        is_confirmed = has_travelled and exists >= self._rules.confirm_probability
        flags[row] = is_confirmed, has_travelled
        self._first_m[row] = candidate.position_m
        could[row], expected_ns[row] = could_show, np.where(could_show, stamp_ns, NEVER)

    def _allocate(self, num_tracks: int) -> None:
        """Make larger arrays with the present contents; all are allocated before one is replaced."""
        present, num_sensors = len(self._first_m), len(self._sensors)
        first_m = np.zeros((num_tracks, 2))
        arrays = (
            np.zeros((num_tracks, NUM_LIFE), dtype=np.int64),
            np.zeros((num_tracks, NUM_FLAGS), dtype=bool),
            np.zeros((num_tracks, num_sensors), dtype=bool),
            np.zeros((num_tracks, num_sensors), dtype=np.int64),
        )
        first_m[:present] = self._first_m
        for more, own in zip(arrays, self._arrays, strict=True):
            more[:present] = own
        self._arrays, self._first_m = arrays, first_m

    def matched(
        self,
        scan: Scan,
        candidates: Candidates,
        pairs: Sequence[tuple[int, int]],
        states: StatesAt,
    ) -> None:
        """See `CountingLifecycle.matched`."""
        placed = pairs
        if not all(candidates.placed):
            placed = [pair for pair in pairs if candidates.placed[pair[0]]]
        if not placed:
            return
        chosen, tracks = np.array(placed).T
        rows = self._rows.of(map(states.track_ids.__getitem__, tracks.tolist()))
        scores = self._scores(scan, candidates, placed)
        points_m = candidates.lines.take(chosen, axis=0)[:, :2]
        means_m = states.means.take(tracks, axis=0)[:, :2]
        P = states.covariances.take(tracks, axis=0)[:, :2, :2]
        R = position_covariances(candidates, chosen)
        own = scan.stamp_ns, self._index[scan.sensor], scores, points_m, means_m, P, R
        self._matches.append(_Matches(rows, *own))

    def _settle(self) -> None:
        """Add the matches since the last call to the histories, in one pass."""
        if not self._matches:
            return
        tracks, stamps, of, *others = zip(*self._matches, strict=True)
        counts = list(map(len, tracks))
        rows, stamps_ns, sensors = (
            np.concatenate(tracks),
            np.repeat(stamps, counts),
            np.repeat(of, counts),
        )
        scores, points_m, means_m, P, R = map(np.concatenate, others)
        self._matches = []
        travel = self._rules.min_travel_m, self._first_m
        kernels(_KERNELS).match(rows, sensors, means_m, *travel, *self._arrays)
        density, P_D = densities(points_m - means_m, P, R), self._P_D[sensors]
        ratios = 1.0 - P_D + P_D * density / self._clutter[sensors] * np.exp(scores)
        known = ~np.isnan(density)
        if not known.all():
            rows, stamps_ns, sensors = rows[known], stamps_ns[known], sensors[known]
            ratios = ratios[known]
        self._learn(rows, stamps_ns, sensors, ratios, self._rules.confirm_probability)

    def fused(self, track_ids: Iterable[int]) -> None:
        """See `CountingLifecycle.fused`; the match has counted already."""

    def missed(
        self,
        scan: Scan,
        track_ids: Sequence[int],
        positions_m: FloatArray,
        ranges_m: FloatArray,
    ) -> list[int]:
        """See `CountingLifecycle.missed`."""
        self._settle()
        sensor, own = self._sensors[scan.sensor], self._index[scan.sensor]
        rows, stamp_ns = self._rows.of(track_ids), scan.stamp_ns
        insort(self._scans_ns, stamp_ns)
        missed = own, stamp_ns, 1.0 - sensor.detection_probability
        ratios = kernels(_KERNELS).miss(
            rows, self._views.of(positions_m, scan.ego), *missed, *self._arrays
        )
        stamps_ns, sensors = np.full(len(rows), stamp_ns), np.full(len(rows), own)
        self._learn(rows, stamps_ns, sensors, ratios, math.inf)
        self._processed_ns = stamp_ns
        return self._ended()

    def expired(
        self,
        present_ns: int,
        watermarks_ns: IntArray | None = None,
        processed_ns: int = FOREVER,
    ) -> list[int]:
        """See `CountingLifecycle.expired`."""
        self._settle()
        self._present_ns, self._processed_ns = present_ns, processed_ns
        if watermarks_ns is not None:
            self._watermarks_ns = watermarks_ns
        oldest_ns = min([present_ns, *self._watermarks_ns.tolist()])
        self._histories.forget(oldest_ns - self._memory_ns)
        del self._scans_ns[: max(bisect_right(self._scans_ns, oldest_ns) - 1, 0)]
        return self._ended()

    def suspended(self, stamp_ns: int | None = None) -> frozenset[int]:
        """See `CountingLifecycle.suspended`."""
        if stamp_ns is None or not self._suspended:
            return frozenset(self._suspended)
        self._settle()
        improbable = (
            self._histories.known(self._rows.of(self._suspended), stamp_ns)
            < self._rules.delete_probability
        )
        return frozenset(compress(self._suspended, improbable.tolist()))

    def likely(
        self, name: str, stamp_ns: int, track_ids: Sequence[int], pairs: Pairs
    ) -> BoolArray:
        """Return True for each pair whose position is likelier from the track than from clutter or a new object, (m,).

        The pairs are pairs of positions of a list and tracks. The test is P_D r N(y; 0, S) > (1 - P_D r) clutter / (1 -
        birth probability), for each pair by itself. Sensors without `scan` have 1 instead of 1 - P_D r.
        """
        sensor, rules = self._sensors[name], self._rules

        def most(exists: float | FloatArray) -> FloatArray:
            detected = sensor.detection_probability * exists
            odds = detected / (1.0 - detected) if sensor.scan else detected
            return 2.0 * np.log(
                odds
                * (1.0 - rules.birth_probability)
                / (math.tau * sensor.clutter_per_m2)
            )

        likely = pairs.values < most(rules.delete_probability)
        doubtful = (~likely).nonzero()[0]
        if len(doubtful):
            self._settle()
            rows = self._rows.of(
                [track_ids[column] for column in pairs.columns[doubtful].tolist()]
            )
            likely[doubtful] = pairs.values[doubtful] < most(
                self._histories.present(rows, stamp_ns)
            )
        return np.asarray(likely)

    def existing(self, track_ids: Sequence[int], stamp_ns: int) -> FloatArray:
        """See `CountingLifecycle.existing`."""
        self._settle()
        return self._histories.present(self._rows.of(track_ids), stamp_ns)

    def forget(self, track_id: int) -> None:
        """See `CountingLifecycle.forget`."""
        self._settle()
        row = self._rows.end(track_id)
        if row is not None:
            self._histories.end(row)
        self._suspended = tuple([each for each in self._suspended if each != track_id])

    def reported(
        self, track_ids: Sequence[int]
    ) -> tuple[list[TrackStatus], Sequence[float | None]]:
        """See `CountingLifecycle.reported`. The probabilities are those at present."""
        self._settle()
        rows = self._rows.of(track_ids)
        codes, exists = np.empty(len(rows), dtype=np.int64), np.empty(len(rows))
        known = self._watermarks_ns, self._processed_ns, self._present_ns
        history = self._rules.doubt_probability, *self._arrays, *self._histories.arrays
        kernels(_KERNELS).report(rows, *known, *history, codes, exists)
        return [STATUSES[code] for code in codes.tolist()], exists.tolist()

    def _learn(
        self,
        rows: IntArray,
        stamps_ns: IntArray,
        sensors: IntArray,
        ratios: FloatArray,
        confirm_probability: float,
    ) -> None:
        """Add evidence (m,) to the histories; `ratios` are NaN for tracks out of view.

        Tracks are confirmed from `confirm_probability` on.
        """
        evidence = rows, stamps_ns, sensors, ratios
        found = *self._histories.learn(*evidence), confirm_probability
        kernels(_KERNELS).note(*evidence, *found, *self._arrays)

    def _ended(self) -> list[int]:
        """Return the ids of the tracks that end. Suspend the tracks that end unless a list that is still due shows
        them.
        """
        rows, rules = self._rows.every, self._rules
        verdicts = np.empty(len(rows), dtype=np.int64)
        known = self._watermarks_ns, self._processed_ns, self._present_ns
        scans_ns = np.array(self._scans_ns, dtype=np.int64)
        limits = self._out_of_view_ns, self._hidden_ns, rules.delete_probability
        history = *self._arrays, *self._histories.arrays
        number = kernels(_KERNELS).judge(
            rows, *known, scans_ns, *limits, *history, verdicts
        )
        self._suspended = ()
        if not number:
            return []
        by_id = self._rows.by_id
        self._suspended = tuple(compress(by_id, (verdicts == SUSPENDED).tolist()))
        return list(compress(by_id, (verdicts == ENDS).tolist()))

    def _scores(
        self, scan: Scan, candidates: Candidates, pairs: Sequence[tuple[int, int]]
    ) -> FloatArray:
        """Return `_score` of the candidates of `pairs`, shape (m,)."""
        if self._sensors[scan.sensor].score is None or not scan.objects:
            return np.zeros(len(pairs))
        leaders = [candidates.leaders[position] for position, _ in pairs]
        every = [(each, *candidates.merged.get(each, ())) for each in leaders]
        return np.array([self._score(scan, each) for each in every])

    def _score(self, scan: Scan, indices: Iterable[int]) -> float:
        """Return the logarithm of p(score | object) / p(score | clutter) for the best detection; 0 without a score."""
        model = self._sensors[scan.sensor].score
        if model is None or not scan.objects:
            return 0.0
        scores = [
            score
            for index in indices
            if (score := scan.objects[index].score) is not None
        ]
        return (
            min(max((max(scores) - model.even) / model.scale, -10.0), 10.0)
            if scores
            else 0.0
        )


Lifecycle = CountingLifecycle | ExistenceLifecycle


def after_jumps(
    assignment: Assignment,
    candidates: Candidates,
    states: StatesAt,
    reaches_m: FloatArray,
    sensor: SensorModel,
) -> Assignment:
    """Return `assignment` in which refused candidates update tracks without a candidate, at most `reaches_m` away.

    A jump of the error must be likelier than clutter. The whole error counts as new, in `candidates` as well.
    """
    if sensor.correlation is None or not assignment.refused:
        return assignment
    pairs = near(candidates, states.means, reaches_m)
    pairs = pairs.at(
        np.isin(pairs.rows, assignment.refused)
        & np.isin(pairs.columns, assignment.missed)
    )
    rows, columns, _ = pairs
    densities = position_densities(
        candidates, rows, states.means[columns], states.covariances[columns]
    )
    ratios = (
        sensor.correlation.jump_probability
        * sensor.detection_probability
        * densities
        / sensor.clutter_per_m2
    )
    likely = ratios > 1.0
    jumps = assigned(
        pairs.at(likely)._replace(values=-np.log(ratios[likely])),
        len(candidates),
        len(states.means),
    ).pairs
    taken = {candidate for candidate, _ in jumps}
    candidates.renew(taken)
    if jumps:
        assignment = assignment._replace(
            readings=()
        )  # those of jumps are of the whole error
    return assignment._replace(
        pairs=sorted([*assignment.pairs, *jumps]),
        missed=sorted(set(assignment.missed).difference(track for _, track in jumps)),
        refused=tuple([each for each in assignment.refused if each not in taken]),
    )


def explained(
    pairs: Pairs,
    candidates: Candidates,
    states: StatesAt,
    odds: FloatArray,
    others_per_m2: float,
    more_nis: FloatArray,
) -> BoolArray:
    """Return True for each pair of a position and a track that is at least as likely as clutter or a new object, (m,).

    The test is odds N(y; 0, S) exp(-more_nis / 2) >= others_per_m2. `odds` (m,) are the odds that the list shows the
    object of the track. `others_per_m2` is the density of clutter and new objects. `more_nis` (m,) is the evidence of
    identities. A pair without a density stays.
    """
    rows, columns, _ = pairs
    densities = position_densities(
        candidates, rows, states.means[columns], states.covariances[columns]
    )
    return ~(odds * densities * np.exp(-0.5 * more_nis) < others_per_m2)


def position_densities(
    candidates: Candidates, chosen: IntArray, means: FloatArray, P: FloatArray
) -> FloatArray:
    """Return `densities` of the positions of `chosen` (m,) at states (m, n), (m, n, n)."""
    y_m = candidates.lines[chosen, :2] - means[:, :2]
    return densities(y_m, P[:, :2, :2], position_covariances(candidates, chosen))


def position_covariances(candidates: Candidates, chosen: IntArray) -> FloatArray:
    """Return the covariances of the positions of the candidates `chosen` (m,), shape (m, 2, 2)."""
    R = np.empty((len(chosen), 2, 2))
    for group, members, here in candidates.split(chosen):
        R[here] = group.position_covariances(members)
    return R


def densities(y_m: FloatArray, P: FloatArray, R: FloatArray) -> FloatArray:
    """Return N(y; 0, P + R) of innovations of positions (m, 2) with both covariances (m, 2, 2), in 1/m^2; NaN if
    singular.
    """
    own, H, every = (
        np.array(P, dtype=np.float64, order="C"),
        np.eye(2)[None],
        np.arange(len(y_m)),
    )
    _, nis, logdet = kernels("fgtrack.estimation.kernels.kalman").innovations(
        y_m, H, own, every, R, np.arange(2)
    )
    return np.asarray(np.exp(-0.5 * (nis + logdet)) / math.tau)

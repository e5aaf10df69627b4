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
from fgtrack.tracking.lives.counters import CountingLifecycle, Scan
from fgtrack.tracking.lives.latency import FOREVER, NEVER, Views, decided_ns
from fgtrack.tracking.lives.visibility import Histories
from fgtrack.tracking.preprocess import Candidate, Candidates


def _life(num_sensors: int) -> np.dtype[np.void]:
    """Return the type of the record of one track.

    True if it was ever confirmed, or as far from its first position as it must be; misses since the last match, and
    the newest stamps at which it was in view and probably visible. Then by sensor: true if the sensor could show it at
    the newest stamp `judged_ns` for which that is known, and the newest stamp at which the sensor could.
    """
    return np.dtype(
        [
            *[
                ("confirmed", "?"),
                ("travelled", "?"),
                ("first_m", "2f8"),
                ("misses", "i8"),
            ],
            *[("in_view_ns", "i8"), ("visible_ns", "i8"), ("judged_ns", "i8")],
            *[
                ("could_show", "?", (num_sensors,)),
                ("expected_ns", "i8", (num_sensors,)),
            ],
        ]
    )


class _Matches(NamedTuple):
    """Detections of a list with the tracks that they matched, m."""

    rows: IntArray
    """Of the tracks, see `ExistenceLifecycle`, shape (m,)."""
    stamp_ns: int
    sensor: int
    scores: list[float]
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
    """Tracks live by the probability that their objects exist; see the module.
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
        "_lives",
        "_matches",
        "_reports",
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
        self._rows: dict[int, int] = {}  # of the arrays, by track id in order of birth
        self._lives = np.zeros(0, dtype=_life(len(sensors)))
        self._matches: list[_Matches] = []  # that are not in the histories yet
        own = sensors.values()
        self._P_D = np.array([each.detection_probability for each in own])
        self._clutter = np.array([each.clutter_per_m2 for each in own])
        self._reports: dict[int, tuple[TrackStatus, float]] | None = (
            None  # by track id, once they are asked for
        )

    def born(self, track_id: int, scan: Scan, candidate: Candidate) -> None:
        """See `CountingLifecycle.born`."""
        odds = self._rules.birth_probability / (1.0 - self._rules.birth_probability)
        log_odds = math.log(odds) + self._score(
            scan, (candidate.leader, *candidate.merged)
        )
        row = self._rows[track_id] = self._histories.begin(
            scan.stamp_ns, self._index[scan.sensor], log_odds
        )
        if len(self._lives) <= row:
            more = np.zeros(
                len(self._histories.counts) - len(self._lives), self._lives.dtype
            )
            self._lives = np.concatenate([self._lives, more])
        self._reports = None
        could_show = self._views.at_birth(
            candidate.position_m, scan.ego, self._index[scan.sensor]
        )
        stamps_ns = (scan.stamp_ns,) * 3
        expected_ns = np.where(could_show, scan.stamp_ns, NEVER)
        has_travelled = self._rules.min_travel_m == 0.0
        self._lives[row] = (
            False,
            has_travelled,
            candidate.position_m,
            0,
            *stamps_ns,
            could_show,
            expected_ns,
        )
        self._confirm(
            np.array([row]), self._histories.present(np.array([row]), scan.stamp_ns)
        )

    def matched(
        self,
        scan: Scan,
        candidates: Candidates,
        pairs: Sequence[tuple[int, int]],
        states: StatesAt,
    ) -> None:
        """See `CountingLifecycle.matched`."""
        placed = [pair for pair in pairs if candidates.placed[pair[0]]]
        if not placed:
            return
        chosen, tracks = np.array(placed).T
        leaders = [candidates.leaders[position] for position in chosen.tolist()]
        scores = [
            self._score(scan, (leader, *candidates.merged.get(leader, ())))
            for leader in leaders
        ]
        rows = self._rows_of(states.track_ids[track] for track in tracks.tolist())
        points_m, means_m = (
            candidates.lines.take(chosen, axis=0)[:, :2],
            states.means.take(tracks, axis=0)[:, :2],
        )
        P, R = (
            states.covariances.take(tracks, axis=0)[:, :2, :2],
            position_covariances(candidates, chosen),
        )
        own = scan.stamp_ns, self._index[scan.sensor], scores, points_m, means_m, P, R
        self._matches.append(_Matches(rows, *own))
        self._reports = None

    def _settle(self) -> None:
        """Add the matches since the last time to the histories: of lists of one detection each, many at once."""
        if not self._matches:
            return
        counts = [len(each.rows) for each in self._matches]
        tracks, stamps, of, *others = zip(*self._matches, strict=True)
        rows, stamps_ns, sensors = (
            np.concatenate(tracks),
            np.repeat(stamps, counts),
            np.repeat(of, counts),
        )
        scores, points_m, means_m, P, R = map(np.concatenate, others)
        self._matches = []
        self._lives["misses"][rows] = 0
        self._lives["could_show"][rows, sensors] = True
        travelled_m = np.hypot(*(means_m - self._lives["first_m"][rows]).T)
        self._lives["travelled"][rows[travelled_m >= self._rules.min_travel_m]] = True
        density, P_D = densities(points_m - means_m, P, R), self._P_D[sensors]
        known = ~np.isnan(density)
        ratios = 1.0 - P_D + P_D * density / self._clutter[sensors] * np.exp(scores)
        exists = self._learn(
            *(each[known] for each in (rows, stamps_ns, sensors, ratios))
        )
        self._confirm(rows[known], exists)

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
        sensor, rows, own = (
            self._sensors[scan.sensor],
            self._rows_of(track_ids),
            self._index[scan.sensor],
        )
        insort(self._scans_ns, scan.stamp_ns)
        could_show = self._views.of(positions_m, scan.ego)
        newest = scan.stamp_ns >= self._lives["judged_ns"][rows]
        self._lives["could_show"][rows[newest]] = could_show[newest]
        self._lives["judged_ns"][rows[newest]] = scan.stamp_ns
        expected_ns = np.where(could_show, scan.stamp_ns, NEVER)
        self._lives["expected_ns"][rows] = np.maximum(
            self._lives["expected_ns"][rows], expected_ns
        )
        ratios = np.where(
            could_show[:, own], 1.0 - sensor.detection_probability, np.nan
        )
        self._lives["misses"][rows] += ~np.isnan(ratios)
        stamps_ns, sensors = np.full(len(rows), scan.stamp_ns), np.full(len(rows), own)
        self._learn(rows, stamps_ns, sensors, ratios)
        self._processed_ns = scan.stamp_ns
        return self._ended()

    def expired(
        self,
        present_ns: int,
        watermarks_ns: IntArray | None = None,
        processed_ns: int = FOREVER,
    ) -> list[int]:
        """See `CountingLifecycle.expired`."""
        self._settle()
        self._present_ns, self._processed_ns, self._reports = (
            present_ns,
            processed_ns,
            None,
        )
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
            self._histories.known(self._rows_of(self._suspended), stamp_ns)
            < self._rules.delete_probability
        )
        return frozenset(compress(self._suspended, improbable.tolist()))

    def likely(
        self, name: str, stamp_ns: int, track_ids: Sequence[int], pairs: Pairs
    ) -> BoolArray:
        """True of `pairs` of positions of a list and tracks that exist rather than of clutter or new objects, (m,).
        That is P_D r N(y; 0, S) > (1 - P_D r) clutter / (1 - birth probability), each pair by itself.
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
            rows = self._rows_of(
                track_ids[column] for column in pairs.columns[doubtful].tolist()
            )
            likely[doubtful] = pairs.values[doubtful] < most(
                self._histories.present(rows, stamp_ns)
            )
        return np.asarray(likely)

    def existing(self, track_ids: Sequence[int], stamp_ns: int) -> FloatArray:
        """See `CountingLifecycle.existing`."""
        self._settle()
        return self._histories.present(self._rows_of(track_ids), stamp_ns)

    def forget(self, track_id: int) -> None:
        """See `CountingLifecycle.forget`."""
        self._settle()
        row = self._rows.pop(track_id, None)
        if row is not None:
            self._histories.end(row)
        self._suspended = tuple([each for each in self._suspended if each != track_id])
        self._reports = None

    def probability(self, track_id: int) -> float:
        """See `CountingLifecycle.probability`; now."""
        return self._reported[track_id][1]

    def status(self, track_id: int) -> TrackStatus:
        """See `CountingLifecycle.status`."""
        return self._reported[track_id][0]

    @property
    def _reported(self) -> dict[int, tuple[TrackStatus, float]]:
        """Status and probability of all tracks, computed together when the first is asked for.
        The probability is that of now. The status follows from what is known: a late sensor leaves its tracks no doubt.
        """
        if self._reports is None:
            self._settle()
            rows = self._rows_of(self._rows)
            lives, exists = (
                self._lives[rows],
                self._histories.present(rows, self._present_ns),
            )
            known = self._histories.present(rows, self._known_ns(rows))
            published = lives["confirmed"] & (known >= self._rules.doubt_probability)
            statuses = [
                TrackStatus.TENTATIVE
                if not row[0]
                else TrackStatus.COASTING
                if row[1]
                else TrackStatus.CONFIRMED
                for row in zip(
                    published.tolist(), lives["misses"].tolist(), strict=True
                )
            ]
            self._reports = dict(
                zip(
                    self._rows, zip(statuses, exists.tolist(), strict=True), strict=True
                )
            )
        return self._reports

    def _rows_of(self, track_ids: Iterable[int]) -> IntArray:
        return np.array(
            [self._rows[track_id] for track_id in track_ids], dtype=np.int64
        )

    def _learn(
        self, rows: IntArray, stamps_ns: IntArray, sensors: IntArray, ratios: FloatArray
    ) -> FloatArray:
        """Add evidence to the histories, `ratios` NaN out of view; returns existence, see `Histories.learn`, (m,)."""
        self._reports = None
        visible, exists = self._histories.learn(rows, stamps_ns, sensors, ratios)
        in_view = ~np.isnan(ratios)
        for name, chosen in (("in_view_ns", in_view), ("visible_ns", visible >= 0.5)):
            np.maximum.at(self._lives[name], rows[chosen], stamps_ns[chosen])
        np.maximum.at(
            self._lives["expected_ns"],
            (rows[in_view], sensors[in_view]),
            stamps_ns[in_view],
        )
        return exists

    def _confirm(self, rows: IntArray, exists: FloatArray) -> None:
        probable = rows[exists >= self._rules.confirm_probability]
        self._lives["confirmed"][probable] |= self._lives["travelled"][probable]

    def _decided_ns(self, rows: IntArray) -> IntArray:
        """Stamps up to which all lists that could show the objects have come and are processed, (m,)."""
        lives, watermarks_ns = (
            self._lives[rows],
            np.minimum(self._watermarks_ns, self._processed_ns),
        )
        return decided_ns(watermarks_ns, lives["could_show"], lives["expected_ns"])

    def _known_ns(self, rows: IntArray) -> IntArray:
        """Stamps at which existence is judged, (m,): those of `_decided_ns`, at most now."""
        return np.minimum(self._decided_ns(rows), self._present_ns)

    def _ended(self) -> list[int]:
        """Return the ids of the tracks that end, and suspend those that end if nothing more shows them."""
        rows = self._rows_of(self._rows)
        lives, decided = self._lives[rows], self._decided_ns(rows)
        newest_ns = self._newest_scan_ns(decided)
        gone = newest_ns - lives["in_view_ns"] > self._out_of_view_ns
        gone |= newest_ns - lives["visible_ns"] > self._hidden_ns
        known_ns, least = (
            np.minimum(decided, self._present_ns),
            self._rules.delete_probability,
        )
        improbable = self._histories.present(rows, known_ns) < least
        chosen = (improbable & ~gone).nonzero()[0]
        awaited = chosen[self._histories.known(rows[chosen], known_ns[chosen]) >= least]
        track_ids = tuple(self._rows)
        self._suspended = tuple([track_ids[row] for row in awaited.tolist()])
        improbable[awaited] = False
        return list(compress(track_ids, (gone | improbable).tolist()))

    def _newest_scan_ns(self, until_ns: IntArray) -> IntArray:
        """Newest stamps up to `until_ns` of lists that could have shown the objects, (m,); `NEVER` without a list."""
        stamps_ns = np.array([NEVER, *self._scans_ns])
        return np.asarray(stamps_ns[stamps_ns.searchsorted(until_ns, side="right") - 1])

    def _score(self, scan: Scan, indices: Iterable[int]) -> float:
        """Logarithm of p(score | object) / p(score | clutter) of the best of some detections; 0 where there is none."""
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
    """Return `assignment` in which refused candidates update tracks without one, at most `reaches_m` away.
    A jump of the error must be likelier than clutter; the whole error counts as new, in `candidates` as well.
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
    """True of `pairs` of positions and tracks that are at least as likely as clutter or a new object, shape (m,).

    That is odds N(y; 0, S) exp(-more_nis / 2) >= others_per_m2. The `odds` (m,) are those that the list shows the
    object of the track, `others_per_m2` is the density of clutter and new objects, and `more_nis` (m,) the evidence of
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
    """Covariances of the positions of `chosen` (m,), shape (m, 2, 2)."""
    R = np.empty((len(chosen), 2, 2))
    for group, members, here in candidates.split(chosen):
        R[here] = group.position_covariances(members)
    return R


def densities(y_m: FloatArray, P: FloatArray, R: FloatArray) -> FloatArray:
    """N(y; 0, P + R) of innovations of positions (m, 2) with both covariances (m, 2, 2), in 1/m^2; NaN if singular."""
    own, H, every = (
        np.array(P, dtype=np.float64, order="C"),
        np.eye(2)[None],
        np.arange(len(y_m)),
    )
    _, nis, logdet = kernels("fgtrack.estimation.kernels.kalman").innovations(
        y_m, H, own, every, R, np.arange(2)
    )
    return np.asarray(np.exp(-0.5 * (nis + logdet)) / math.tau)

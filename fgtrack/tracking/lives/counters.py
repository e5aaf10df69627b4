"""Life of a track: the status counter of Karle et al. 2023, section III-D."""

from bisect import insort
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from fgtrack.core.settings import settings
from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Detection, FloatArray, IntArray, TrackStatus
from fgtrack.estimation.base import StatesAt
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.lives.latency import FOREVER, NEVER, Views, decided_ns
from fgtrack.tracking.preprocess import Candidate, Candidates


class Scan(NamedTuple):
    """Sensor, time and pose of a list: all of it that matters to the life of tracks."""

    sensor: str
    stamp_ns: int
    present_ns: int
    ego: EgoPose | None = None
    """At `stamp_ns`; None where it is not known."""
    objects: Sequence[Detection] = ()
    """All detections of the message."""


_MANY_CHANGES = (
    16  # of a counter, from which on those that no late list can precede are settled
)


@dataclass(slots=True)
class Life:
    """Counters of one track."""

    counter: int
    """After all matches and misses so far, in order of their stamps; it stays where it has reached 0."""
    last_seen_ns: int
    num_placed: int = 1
    """Measurements of its position that have changed its state, the first one included."""
    misses: int = 0
    """Misses since the last match."""
    settled: int = 0
    """Counter after the matches and misses that no late list can precede."""
    changes: list[tuple[int, int]] = field(default_factory=list)
    """The others, ascending: stamp, and decrement of the counter. At one stamp matches precede misses."""
    ends_ns: int = FOREVER
    """Stamp at which the counter reached 0."""
    judged_ns: int = NEVER
    """Newest stamp for which it is known which sensors could show it."""
    could_show: list[bool] = field(default_factory=list)
    """By sensor: true if the sensor could show it then."""
    expected_ns: list[int] = field(default_factory=list)
    """By sensor: newest stamp at which the sensor could show it."""


@settings
class LifecycleRules:
    """Start and end of tracks by counts of matches and misses."""

    kind: Literal["counting", "published"] = "counting"
    """`published`: which sensor ages which track, and when, as published (Q9, Q15, Q22)."""
    counter_cap: PositiveInt = 25
    """Largest value of the status counter."""
    forget_s: PositiveFloat = 2.0
    """A track not measured for so long ends, by the stamps of the lists; see `awaits_late_lists`."""
    awaits_late_lists: bool = True
    """True if a track ends when the lists that could show its object have come, or should have, by the usual delay of
    their sensors; matches and misses then count in order of their stamps. False, as published: times are compared with
    the present, and lists count in order of arrival."""
    short_range_m: NonNegativeFloat = 60.0
    """Up to here short-range sensors age a track, beyond it long-range sensors do."""
    confirm_count: PositiveInt = 3
    """Measurements of its position after which a track is confirmed."""
    suppress_births_near_newer_tracks: bool = False
    """True if a track claims a detection that the newer one which started it has overtaken. As in the paper it does
    not, and the detection starts a second track: with a fast and a slow sensor nearly every new object gets two."""


class CountingLifecycle(Stateful):
    """Counts matches and misses: status of tracks, and which of them end.
    A track is aged by every sensor at the range it is responsible for, and by time alone as well. Only sensors that
    give positions count: a bearing fits whatever is behind or before its object as well, so it neither starts nor
    confirms nor keeps a track.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_watermarks_ns",
        "lives",
    )

    birth_probability = 0.5
    """Probability that an unassociated detection stems from an object; counts give none."""

    def __init__(
        self,
        rules: LifecycleRules,
        sensors: Mapping[str, SensorModel],
        detection_origin_m: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """`detection_origin_m`: origin of the ego frame of detections, seen from the ego reference point."""
        self._rules = rules
        self._sensors = sensors
        self._index = {name: index for index, name in enumerate(sensors)}
        self._forget_ns = nanoseconds(rules.forget_s)
        self._awaits = rules.awaits_late_lists and rules.kind == "counting"
        self._views = Views(sensors, detection_origin_m)
        self._watermarks_ns = np.full(len(sensors), FOREVER)
        self.lives: dict[int, Life] = {}
        """Counters by track id."""

    def born(self, track_id: int, scan: Scan, candidate: Candidate) -> None:
        """A detection started a track."""
        counter = self._sensors[scan.sensor].counter_init
        self.lives[track_id] = life = Life(counter, scan.stamp_ns, settled=counter)
        if self._awaits:
            could_show = self._views.at_birth(
                candidate.position_m, scan.ego, self._index[scan.sensor]
            )
            life.judged_ns, life.could_show = scan.stamp_ns, could_show.tolist()
            life.expected_ns = [
                scan.stamp_ns if could else NEVER for could in life.could_show
            ]

    def matched(
        self,
        scan: Scan,
        candidates: Candidates,
        pairs: Sequence[tuple[int, int]],
        states: StatesAt,
    ) -> None:
        """Candidates were associated with tracks, which had these `states` at the stamp."""
        stamp_ns, own = scan.stamp_ns, self._index[scan.sensor]
        lives = [
            self.lives[states.track_ids[track]]
            for position, track in pairs
            if candidates.placed[position]
        ]
        self._change(lives, stamp_ns, self._sensors[scan.sensor].counter_add)
        for life in lives:
            life.misses = 0
            if stamp_ns > life.last_seen_ns:
                life.last_seen_ns = stamp_ns
            if self._awaits:
                life.could_show[own] = True
                if stamp_ns > life.expected_ns[own]:
                    life.expected_ns[own] = stamp_ns

    def fused(self, track_ids: Iterable[int]) -> None:
        """The associated detections, which give positions, changed the states."""
        for track_id in track_ids:
            self.lives[track_id].num_placed += 1

    def missed(
        self,
        scan: Scan,
        track_ids: Sequence[int],
        positions_m: FloatArray,
        ranges_m: FloatArray,
    ) -> list[int]:
        """Return the ids that end of tracks, at `positions_m` (n, 2) and so far from the ego, that a list misses."""
        ended = []
        views = self._views.of(positions_m, scan.ego) if self._awaits else None
        for row, (track_id, range_m) in enumerate(
            zip(track_ids, ranges_m.tolist(), strict=True)
        ):
            life = self.lives[track_id]
            if views is not None:
                self._judge(life, scan, views[row].tolist())
            if self._ages(scan.sensor, range_m):
                life.misses += 1
                self._change([life], scan.stamp_ns, -1)
            if self._ends(life, scan):
                ended.append(track_id)
        return ended

    def _judge(self, life: Life, scan: Scan, could_show: list[bool]) -> None:
        """Note which sensors could show the object at the stamp of a list."""
        for own, could in enumerate(could_show):
            if could and scan.stamp_ns > life.expected_ns[own]:
                life.expected_ns[own] = scan.stamp_ns
        if scan.stamp_ns >= life.judged_ns:
            life.judged_ns, life.could_show = scan.stamp_ns, could_show

    def _change(self, lives: Iterable[Life], stamp_ns: int, increment: int) -> None:
        """Change counters at the stamp of a list: by order of arrival, or from there on by order of stamps."""
        change, awaits = (stamp_ns, -increment), self._awaits
        most = self._rules.counter_cap
        for life in lives:
            if awaits:
                changes = life.changes
                if changes and change < changes[-1]:
                    self._recount(life, change)
                    continue
                changes.append(change)
                if life.ends_ns != FOREVER:
                    continue
            counter = life.counter + increment
            life.counter = most if increment >= 0 and counter > most else counter
            if awaits and life.counter <= 0:
                life.ends_ns = stamp_ns

    def _recount(self, life: Life, change: tuple[int, int]) -> None:
        """Insert a late change, and count again from the changes that no late list can precede."""
        insort(life.changes, change)
        life.counter, life.ends_ns = life.settled, FOREVER
        for stamp_ns, decrement in life.changes:
            life.counter = self._counted(life.counter, -decrement)
            if life.counter <= 0:
                life.ends_ns = stamp_ns
                return

    def _counted(self, counter: int, increment: int) -> int:
        return (
            counter + increment
            if increment < 0
            else min(counter + increment, self._rules.counter_cap)
        )

    def _ages(self, sensor: str, range_m: float) -> bool:
        """True if `sensor` counts down a track at `range_m` that it has missed."""
        ages = self._sensors[sensor].ages
        near = range_m <= self._rules.short_range_m
        return ages == "always" or ages == ("short_range" if near else "long_range")

    def _ends(self, life: Life, scan: Scan) -> bool:
        """True if a track ends at a list that misses it."""
        if not self._awaits:
            return life.counter <= 0
        if life.ends_ns == FOREVER:
            return False
        [decided] = self._decided_ns([life], scan.stamp_ns)
        return life.ends_ns <= decided

    def _decided_ns(self, lives: Sequence[Life], processed_ns: int) -> list[int]:
        """Stamps up to which all lists that could show each object have come and are processed."""
        watermarks_ns = np.minimum(self._watermarks_ns, processed_ns)
        could_show = np.array([life.could_show for life in lives])
        expected_ns = np.array([life.expected_ns for life in lives])
        decided: list[int] = decided_ns(watermarks_ns, could_show, expected_ns).tolist()
        return decided

    def expired(
        self,
        present_ns: int,
        watermarks_ns: IntArray | None = None,
        processed_ns: int = FOREVER,
    ) -> list[int]:
        """The ids of tracks that end because time has passed, or lists should have come.

        `watermarks_ns` are those of the sensors, shape (sensors,); None if they are as before. All lists with stamps
        before `processed_ns` that have come are processed.
        """
        if not self._awaits:
            return [
                i
                for i, life in self.lives.items()
                if present_ns - life.last_seen_ns > self._forget_ns
            ]
        if watermarks_ns is not None:
            self._watermarks_ns = watermarks_ns
        seen_ns = present_ns - self._forget_ns
        doubtful = {
            track_id: life
            for track_id, life in self.lives.items()
            if life.last_seen_ns < seen_ns
            or life.ends_ns != FOREVER
            or len(life.changes) >= _MANY_CHANGES
        }
        if not doubtful:
            return []
        ended = list[int]()
        known = self._decided_ns(list(doubtful.values()), processed_ns)
        for (track_id, life), known_ns in zip(doubtful.items(), known, strict=True):
            decided = min(known_ns, present_ns)
            if life.ends_ns <= decided or decided - life.last_seen_ns > self._forget_ns:
                ended.append(track_id)
            else:
                self._settle(life, decided)
        return ended

    def _settle(self, life: Life, decided_ns: int) -> None:
        """Count the changes up to a stamp that no late list can precede."""
        num_settled = 0
        for stamp_ns, decrement in life.changes:
            if stamp_ns > decided_ns:
                break
            life.settled = self._counted(life.settled, -decrement)
            num_settled += 1
        del life.changes[:num_settled]

    def suspended(self, stamp_ns: int | None = None) -> frozenset[int]:
        """The ids of tracks that end unless a list shows them that is still due, at `stamp_ns` or at all.
        They are not published. Counts suspend no track: a late match may precede the misses so far.
        """
        return frozenset()

    def forget(self, track_id: int) -> None:
        """The track has ended, or could not begin."""
        self.lives.pop(track_id, None)

    def existing(self, track_ids: Sequence[int], stamp_ns: int) -> FloatArray:
        """Probabilities that the objects of tracks exist at a stamp, shape (m,); 1 / 2, as counts give none."""
        return np.full(len(track_ids), 0.5)

    def probability(self, track_id: int) -> float | None:
        """Probability that the object of the track exists; None, as counts give none."""
        return None

    def status(self, track_id: int) -> TrackStatus:
        """Status of the track."""
        life = self.lives[track_id]
        if life.num_placed < self._rules.confirm_count:
            return TrackStatus.TENTATIVE
        return TrackStatus.COASTING if life.misses else TrackStatus.CONFIRMED

"""Life of a track: the status counter of Karle et al. 2023, section III-D."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from fgtrack.core.settings import settings
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Detection, FloatArray, TrackStatus
from fgtrack.estimation.base import StatesAt
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego import EgoPose
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


@dataclass(slots=True)
class Life:
    """Counters of one track."""

    counter: int
    last_seen_ns: int
    num_placed: int = 1
    """Measurements of its position that have changed its state, the first one included."""
    misses: int = 0
    """Misses since the last match."""


@settings
class LifecycleRules:
    """Start and end of tracks by counts of matches and misses."""

    kind: Literal["counting", "published"] = "counting"
    """`published`: which sensor ages which track, and when, as published (Q9, Q15, Q22)."""
    counter_cap: PositiveInt = 25
    """Largest value of the status counter."""
    forget_s: PositiveFloat = 2.0
    """A track not measured for so long ends."""
    short_range_m: NonNegativeFloat = 60.0
    """Up to here short-range sensors age a track, beyond it long-range sensors do."""
    confirm_count: PositiveInt = 3
    """Measurements of its position after which a track is confirmed."""
    suppress_births_near_newer_tracks: bool = False
    """True if a track claims a detection that the newer one which started it has overtaken. As in the paper it does
    not, and the detection starts a second track: with a fast and a slow sensor nearly every new object gets two."""


class CountingLifecycle:
    """Counts matches and misses: status of tracks, and which of them end.
    A track is aged by every sensor at the range it is responsible for, and by time alone as well. Only sensors that
    give positions count: a bearing fits whatever is behind or before its object as well, so it neither starts nor
    confirms nor keeps a track.
    """

    def __init__(self, rules: LifecycleRules, sensors: Mapping[str, SensorModel]) -> None:
        self._rules = rules
        self._sensors = sensors
        self._forget_ns = nanoseconds(rules.forget_s)
        self.lives: dict[int, Life] = {}
        """Counters by track id."""

    def born(self, track_id: int, scan: Scan, candidate: Candidate) -> None:
        """A detection started a track."""
        self.lives[track_id] = Life(self._sensors[scan.sensor].counter_init, scan.stamp_ns)

    def matched(self, scan: Scan, candidates: Candidates, pairs: Sequence[tuple[int, int]], states: StatesAt) -> None:
        """Candidates were associated with tracks, which had these `states` at the stamp."""
        add, cap = self._sensors[scan.sensor].counter_add, self._rules.counter_cap
        for position, track in pairs:
            if candidates.placed[position]:
                life = self.lives[states.track_ids[track]]
                counter, life.misses = life.counter + add, 0
                life.counter = counter if counter < cap else cap
                if scan.stamp_ns > life.last_seen_ns:
                    life.last_seen_ns = scan.stamp_ns

    def fused(self, track_ids: Iterable[int]) -> None:
        """The associated detections, which give positions, changed the states."""
        for track_id in track_ids:
            self.lives[track_id].num_placed += 1

    def missed(self, scan: Scan, track_ids: Sequence[int], positions_m: FloatArray, ranges_m: FloatArray) -> list[int]:
        """Return the ids that end of tracks, at `positions_m` (n, 2) and so far from the ego, that a list misses."""
        ended = []
        for track_id, range_m in zip(track_ids, ranges_m.tolist(), strict=True):
            life = self.lives[track_id]
            if self._ages(scan.sensor, range_m):
                life.counter -= 1
                life.misses += 1
            if self._ends(life, scan.present_ns):
                ended.append(track_id)
        return ended

    def _ages(self, sensor: str, range_m: float) -> bool:
        """True if `sensor` counts down a track at `range_m` that it has missed."""
        ages = self._sensors[sensor].ages
        near = range_m <= self._rules.short_range_m
        return ages == "always" or ages == ("short_range" if near else "long_range")

    def _ends(self, life: Life, present_ns: int) -> bool:
        return life.counter <= 0

    def expired(self, present_ns: int) -> list[int]:
        """The ids of tracks that end because time has passed."""
        return [i for i, life in self.lives.items() if present_ns - life.last_seen_ns > self._forget_ns]

    def forget(self, track_id: int) -> None:
        """The track has ended, or could not begin."""
        self.lives.pop(track_id, None)

    def probability(self, track_id: int) -> float | None:
        """Probability that the object of the track exists; None, as counts give none."""
        return None

    def status(self, track_id: int) -> TrackStatus:
        """Status of the track."""
        life = self.lives[track_id]
        if life.num_placed < self._rules.confirm_count:
            return TrackStatus.TENTATIVE
        return TrackStatus.COASTING if life.misses else TrackStatus.CONFIRMED

"""Life of a track: the status counter of Karle et al. 2023, section III-D."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from fgtrack.core.linalg import kernels
from fgtrack.core.settings import settings
from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import (
    BoolArray,
    Detection,
    FloatArray,
    IntArray,
    TrackStatus,
)
from fgtrack.estimation.base import StatesAt
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.lives.latency import FOREVER, NEVER, Views
from fgtrack.tracking.preprocess import Candidate, Candidates
from fgtrack.tracking.rows import FEWEST, TrackRows


class Scan(NamedTuple):
    """Sensor, time, pose and detections of a list, which determine the life of tracks."""

    sensor: str
    stamp_ns: int
    present_ns: int
    ego: EgoPose | None = None
    """Pose of the ego at `stamp_ns`; None if it is unknown."""
    objects: Sequence[Detection] = ()
    """All detections of the message."""


#: Columns of the counters of a track:
#: - counter after all matches and misses so far, in order of their stamps; it stays where it has reached 0
#: - newest stamp of a match
#: - measurements of the position that have changed the state, the first one included
#: - misses since the last match
#: - counter after the matches and misses that no late list can precede, and the number of the others
#: - stamp at which the counter has reached 0
#: - newest stamp for which it is known which sensors could show the object
COUNTER, LAST_SEEN, NUM_PLACED, MISSES, SETTLED, NUM_CHANGES, ENDS, JUDGED = range(8)
NUM_COLUMNS = 8
#: Numbers of the statuses in compiled loops.
TENTATIVE, CONFIRMED, COASTING = range(3)
STATUSES = TrackStatus.TENTATIVE, TrackStatus.CONFIRMED, TrackStatus.COASTING
#: Changes from which on those that no late list can precede are settled.
MANY_CHANGES = 16
_FEWEST_CHANGES = 32
_KERNELS = "fgtrack.tracking.lives.counter_kernels"


@dataclass(frozen=True, slots=True)
class Life:
    """Counters of one track."""

    counter: int
    """Status counter after all matches and misses so far, in order of their stamps."""
    last_seen_ns: int
    num_placed: int
    """Number of measurements of the position that have changed the state, the first measurement included."""
    misses: int
    """Number of misses since the last match."""
    settled: int
    """Counter after the matches and misses that no late list can precede."""
    num_changes: int
    """Number of the matches and misses that a late list can still precede."""


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
    """Decides by counts of matches and misses which tracks are confirmed, and which tracks end.

    Each sensor that could show a track and does not, ages the track. So does time alone. Only sensors of positions
    count. A bearing also fits objects behind and before its own object, so it neither starts nor confirms nor keeps
    a track.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_watermarks_ns",
        "_rows",
        "_arrays",
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
        self._rows = TrackRows()
        self._arrays: tuple[IntArray, IntArray, BoolArray, IntArray] = (
            np.zeros((0, NUM_COLUMNS), dtype=np.int64),
            np.zeros((0, _FEWEST_CHANGES, 2), dtype=np.int64),
            np.zeros((0, len(sensors)), dtype=bool),
            np.zeros((0, len(sensors)), dtype=np.int64),
        )
        """Counters, shape (tracks, columns). Stamps of matches and misses that are not settled, ascending, and
        decrements of the counter, shape (tracks, changes, 2). By sensor, shapes (tracks, sensors): true if the sensor
        could show the object at the newest stamp for which that is known, and the newest stamp at which it could."""

    @property
    def lives(self) -> dict[int, Life]:
        """Copies of the counters by track id."""
        return {
            track_id: Life(*self._arrays[0][row, :ENDS].tolist())
            for track_id, row in self._rows.by_id.items()
        }

    def born(self, track_id: int, scan: Scan, candidate: Candidate) -> None:
        """Start the counters of a track that a detection has started."""
        num_tracks, num_changes, _ = self._arrays[1].shape
        if self._rows.following >= num_tracks:
            self._allocate(2 * num_tracks or FEWEST, num_changes)
        counter, stamp_ns = self._sensors[scan.sensor].counter_init, scan.stamp_ns
        could_show = self._views.at_birth(
            candidate.position_m, scan.ego, self._index[scan.sensor]
        )
        row = self._rows.begin(track_id)
        counters, _, could, expected_ns = self._arrays
        counters[row] = counter, stamp_ns, 1, 0, counter, 0, FOREVER, stamp_ns
        could[row], expected_ns[row] = could_show, np.where(could_show, stamp_ns, NEVER)

    def _allocate(self, num_tracks: int, num_changes: int) -> None:
        """Make larger arrays with the present contents; all are allocated before one is replaced."""
        tracks, changes, _ = self._arrays[1].shape
        counters = np.zeros((num_tracks, NUM_COLUMNS), dtype=np.int64)
        more = np.zeros((num_tracks, num_changes, 2), dtype=np.int64)
        could_show = np.zeros((num_tracks, len(self._sensors)), dtype=bool)
        expected_ns = np.zeros((num_tracks, len(self._sensors)), dtype=np.int64)
        counters[:tracks], more[:tracks, :changes] = self._arrays[:2]
        could_show[:tracks], expected_ns[:tracks] = self._arrays[2:]
        self._arrays = counters, more, could_show, expected_ns

    def matched(
        self,
        scan: Scan,
        candidates: Candidates,
        pairs: Sequence[tuple[int, int]],
        states: StatesAt,
    ) -> None:
        """Count the matches of candidates and tracks. `states` are the states of the tracks at the stamp."""
        placed, track_ids = candidates.placed, states.track_ids
        rows = self._rows.of([track_ids[track] for i, track in pairs if placed[i]])
        increment = self._sensors[scan.sensor].counter_add
        match = rows, self._index[scan.sensor], scan.stamp_ns, increment
        self._count(kernels(_KERNELS).match, *match)

    def _count(self, function: Callable[..., bool], *change: object) -> None:
        """Call a compiled loop that adds one change to tracks. The arrays are enlarged if they have no room."""
        most, awaits = self._rules.counter_cap, self._awaits
        while not function(*change, most, awaits, *self._arrays):
            num_tracks, num_changes, _ = self._arrays[1].shape
            self._allocate(num_tracks, 2 * num_changes)

    def fused(self, track_ids: Sequence[int]) -> None:
        """Count detections with positions that have changed the states of `track_ids`."""
        kernels(_KERNELS).place(self._rows.of(track_ids), self._arrays[0])

    def missed(
        self,
        scan: Scan,
        track_ids: Sequence[int],
        positions_m: FloatArray,
        ranges_m: FloatArray,
    ) -> list[int]:
        """Count the misses of a list. Return the ids of the tracks that end.

        `positions_m` (n, 2) and `ranges_m` (n,) are the positions of the missed tracks and their distances from the
        ego.
        """
        rows, ages = self._rows.of(track_ids), self._ages(scan.sensor, ranges_m)
        views = self._views.of(positions_m, scan.ego)
        self._count(kernels(_KERNELS).miss, rows, ages, views, scan.stamp_ns)
        return list(compress(track_ids, self._ends(rows, scan).tolist()))

    def _ages(self, sensor: str, ranges_m: FloatArray) -> BoolArray:
        """Return True for each track at `ranges_m` (m,) whose counter falls if `sensor` misses it, shape (m,)."""
        ages = self._sensors[sensor].ages
        if ages in ("always", "never"):
            return np.full(len(ranges_m), ages == "always")
        near = ranges_m <= self._rules.short_range_m
        return np.asarray(near if ages == "short_range" else ~near)

    def _ends(self, rows: IntArray, scan: Scan) -> BoolArray:
        """Return True for each track in `rows` that ends because a list has missed it, shape (m,)."""
        if not self._awaits:
            return np.asarray(self._arrays[0][rows, COUNTER] <= 0)
        ended: BoolArray = kernels(_KERNELS).ended(
            rows, self._watermarks_ns, scan.stamp_ns, *self._arrays
        )
        return ended

    def expired(
        self,
        present_ns: int,
        watermarks_ns: IntArray | None = None,
        processed_ns: int = FOREVER,
    ) -> list[int]:
        """Return the ids of the tracks that end because time has passed, or because lists should have come.

        `watermarks_ns` are the watermarks of the sensors, shape (sensors,); None if they are as before. All received
        lists with stamps before `processed_ns` have been processed.
        """
        if watermarks_ns is not None:
            self._watermarks_ns = watermarks_ns
        rows = self._rows.every
        if not self._awaits:
            ended = present_ns - self._arrays[0][rows, LAST_SEEN] > self._forget_ns
            return list(compress(self._rows.by_id, ended.tolist()))
        ended = np.empty(len(rows), dtype=bool)
        number = kernels(_KERNELS).expire(
            rows,
            present_ns,
            self._forget_ns,
            self._watermarks_ns,
            processed_ns,
            self._rules.counter_cap,
            *self._arrays,
            ended,
        )
        return list(compress(self._rows.by_id, ended.tolist())) if number else []

    def suspended(self, stamp_ns: int | None = None) -> frozenset[int]:
        """Return the ids of tracks that end unless a list that is still due shows them, at `stamp_ns` or at any stamp.

        They are not published. Counts suspend no track, because a late match may precede the misses so far.
        """
        return frozenset()

    def forget(self, track_id: int) -> None:
        """Forget a track that has ended, or that could not begin."""
        self._rows.end(track_id)

    def existing(self, track_ids: Sequence[int], stamp_ns: int) -> FloatArray:
        """Return the probabilities that the objects of tracks exist at a stamp, shape (m,). They are always 1 / 2,
        because counts give no probability.
        """
        return np.full(len(track_ids), 0.5)

    def reported(
        self, track_ids: Sequence[int]
    ) -> tuple[list[TrackStatus], Sequence[float | None]]:
        """Return the statuses of tracks, and the probabilities that their objects exist.

        The probabilities are None, because counts give no probability.
        """
        codes = kernels(_KERNELS).report(
            self._rows.of(track_ids), self._rules.confirm_count, self._arrays[0]
        )
        return [STATUSES[code] for code in codes.tolist()], [None] * len(codes)

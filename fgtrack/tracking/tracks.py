"""Numbers and first positions of the tracks, beside their states, lives and objects."""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import ClassVar

import numpy as np

from fgtrack.core.state import Stateful
from fgtrack.core.types import BoolArray, Detection, IntArray, SmoothedReport
from fgtrack.estimation.base import Measurements, Start, StatesAt, UpdateResult
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.filters.ekf import correct_one
from fgtrack.tracking.birth import in_any_direction
from fgtrack.tracking.lives.latency import FOREVER, NEVER
from fgtrack.tracking.parts import TrackerParts


class Tracks(Stateful):
    """Numbers of the tracks, numbers of detections that have changed their states, and their first positions."""

    STATE: ClassVar[tuple[str, ...]] = (
        "_next_id",
        "num_measured",
        "_undirected",
        "_directed",
        "_newborn",
        "_public",
        "_bank_ids",
        "_dropped",
        "withheld",
    )

    def __init__(self, parts: TrackerParts) -> None:
        self._parts = parts
        self._next_id = parts.first_track_id
        self.num_measured = Counter[int]()
        """Number of detections that have changed the state, by track."""
        # Of tracks with one position and an unknown heading, by id.
        self._undirected: dict[int, Start] = {}
        # Of the tracks that have a second position since, and its stamp.
        self._directed: dict[int, tuple[Start, int]] = {}
        # Sensors of first positions, and stamps of second ones, by id.
        self._newborn: dict[int, tuple[str, int]] = {}
        # Public numbers of tracks, by their numbers in the bank, and the reverse.
        self._public: dict[int, int] = {}
        self._bank_ids: dict[int, int] = {}
        # Tracks whose last smoothed states are not to be published.
        self._dropped: set[int] = set()
        self.withheld: set[int] = set()
        """Tracks without final states, as they have one detection and are not confirmed."""

    def name(self, bank_id: int, public: int) -> None:
        """Publish the track `bank_id` of the bank as `public`."""
        self._public[bank_id], self._bank_ids[public] = public, bank_id

    def bank_id(self, public: int) -> int | None:
        """Return the track of the bank that is published as `public`; None without one."""
        found = self._bank_ids.get(public)
        return found if found is not None and self._parts.bank.holds(found) else None

    def public(self, bank_id: int) -> int:
        """Return the number under which a track of the bank is published."""
        return self._public.get(bank_id, bank_id)

    def drop(self, bank_id: int) -> None:
        """End a track without publishing its last smoothed states."""
        self._dropped.add(bank_id)
        self.end([bank_id])

    def published(self, reports: Sequence[SmoothedReport]) -> list[SmoothedReport]:
        """Return smoothed states of the bank as they are published."""
        if not (self._public or self._dropped):
            return list(reports)
        kept = [
            replace(each, track_id=self.public(each.track_id))
            for each in reports
            if each.track_id not in self._dropped
            and (each.lag_s is not None or each.track_id not in self.withheld)
        ]
        self._dropped = set()
        return kept

    def number(self, detection: Detection) -> int:
        """Return the number of a new track. A former track with the identity of `detection` passes on its number."""
        track_id = self._parts.objects.former(detection)
        if track_id is None:
            return self.next_number()
        if track_id in self.num_measured:  # lost
            self._parts.objects.id_conflicts["reused"] += 1
            self.end([track_id])
        return track_id

    def next_number(self) -> int:
        """Return the next number of a track, which is not given again."""
        self._next_id += 1
        return self._next_id - 1

    def begin(self, track_id: int, sensor: str, prior: Start) -> None:
        """Note a track that the first detection of `sensor` has started."""
        if prior.yaw_rad is None and not self._parts.motion.cartesian:
            self._undirected[track_id] = prior
        self.num_measured[track_id] = 1
        self._newborn[track_id] = sensor, FOREVER

    def end(self, track_ids: Sequence[int]) -> None:
        """End tracks. An exception at the end of a track is counted as a failure.

        The track is forgotten nevertheless, and the remaining tracks end.
        """
        parts = self._parts
        for track_id in track_ids:
            self._undirected.pop(track_id, None)
            self._directed.pop(track_id, None)
            self._newborn.pop(track_id, None)
            self.num_measured.pop(track_id, None)
            facing = () if parts.facing is None else (parts.facing.forget,)
            for forget in (
                parts.bank.remove,
                parts.objects.forget,
                *facing,
                parts.lifecycle.forget,
            ):
                try:
                    forget(track_id)
                except Exception as error:
                    parts.contain(error, Failure.STEP_FAILED)

    def forget_first(self, oldest_ns: int) -> None:
        """Forget the first positions of tracks whose second position is older than `oldest_ns`.

        No late list can be older than this stamp.
        """
        if self._newborn:
            self._newborn = {
                i: each for i, each in self._newborn.items() if each[1] >= oldest_ns
            }
        if self._directed:
            self._directed = {
                i: each for i, each in self._directed.items() if each[1] >= oldest_ns
            }

    def is_undirected(self, track_id: int) -> bool:
        """True for a track with one position and an unknown heading."""
        return track_id in self._undirected

    def in_any_direction(self, states: StatesAt, stamp_ns: int) -> StatesAt:
        """Return `states` at `stamp_ns`. States of tracks without a second position are uncertain in all directions."""
        if not (self._undirected or self._directed):
            return states
        return in_any_direction(states, stamp_ns, self._undirected, self._directed)

    def newborn_of_others(
        self, sensor: str, stamp_ns: int, track_ids: Sequence[int]
    ) -> BoolArray | None:
        """Return True for each track with one position up to the stamp, which another sensor with `scan` gave, shape
        (m,).

        The next list of the other sensor shows the object again. Until then its velocity is unknown, and its gate is
        wide. None if there is no such track.
        """
        if not self._newborn:
            return None
        first = [self._newborn.get(each, (sensor, NEVER)) for each in track_ids]
        others = [
            name != sensor and self._parts.sensors[name].scan and stamp_ns < until_ns
            for name, until_ns in first
        ]
        return np.array(others, dtype=bool) if any(others) else None

    def placed(
        self,
        ids: Sequence[int],
        fused: Sequence[int],
        measurements: Measurements,
        of: IntArray,
        states: StatesAt,
        results: Sequence[UpdateResult],
    ) -> None:
        """Count the `fused` rows of these measurements, which give positions, for the lives of the tracks `ids` (m,).

        `of` (m,) are the indices of the tracks in `states`.
        """
        is_all = len(fused) == len(ids)
        self._parts.lifecycle.fused(ids if is_all else [ids[row] for row in fused])
        if not (self._newborn or self._directed or self._undirected):
            return
        stamp_ns = measurements.stack.stamp_ns
        for row in fused:
            track_id = ids[row]
            if track_id in self._newborn:
                name, until_ns = self._newborn[track_id]
                self._newborn[track_id] = name, min(until_ns, stamp_ns)
            if track_id in self._directed:
                start, until_ns = self._directed[track_id]
                self._directed[track_id] = start, min(until_ns, stamp_ns)
            if track_id in self._undirected:
                self._directed[track_id] = self._undirected.pop(track_id), stamp_ns
                # The estimator's prior, linearised along an unknown direction, spreads along it alone.
                seen, track = measurements[row].seen_by(self._parts.motion), of[row]
                with suppress(np.linalg.LinAlgError):
                    results[row].nis = correct_one(
                        states.means[track], states.covariances[track], seen
                    ).nis

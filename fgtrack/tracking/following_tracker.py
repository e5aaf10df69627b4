"""A tracker whose estimators follow decisions that change: tracks lose and win detections, or start once more."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import ClassVar, NamedTuple, cast

import numpy as np

from fgtrack.core.types import (
    UpdateRecord,
)
from fgtrack.estimation.base import Measurement, StatesAt
from fgtrack.estimation.failures import Failure
from fgtrack.tracking.association import Assignment, Pairs, quantiles, weighed
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.decisions.history import Decisions
from fgtrack.tracking.decisions.lives import DecidedLives
from fgtrack.tracking.decisions.nodes import NONE
from fgtrack.tracking.facing import is_read
from fgtrack.tracking.lives.latency import FOREVER
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.stamped_facing import StampedFacing
from fgtrack.tracking.stamped_objects import Key, StampedObjects
from fgtrack.tracking.tracker import MultiObjectTracker

_FIRST_REBUILT = 1_000_000_000
_GATE_PROBABILITY = 0.9999


class Place(NamedTuple):
    """A candidate of a list, as a measurement of a track."""

    entry: Entry
    position: int
    public: int | None

    @property
    def track(self) -> int:
        """The track."""
        return NONE if self.public is None else self.public

    @property
    def key(self) -> tuple[int, int]:
        """Number of the list, and position."""
        return self.entry.number, self.position

    @property
    def detection(self) -> tuple[int, int]:
        """Key of the detection: its message, and its index in the message."""
        return id(self.entry.batch.message), self.entry.candidates.leaders[
            self.position
        ]


class FollowingTracker(MultiObjectTracker):
    """Lets the estimators follow decisions about the lists inside the horizon, which derived classes make.

    If the detections of a track change, its estimator undoes the fusion of the lost detections. If it cannot undo the
    fusion, it starts once more with the first detection.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *MultiObjectTracker.STATE,
        "decisions",
        "_roots",
        "_next_rebuilt",
        "_of",
        "_fused_as",
        "_beliefs",
        "_firsts",
    )

    def __init__(self, parts: TrackerParts, decisions: Decisions) -> None:
        super().__init__(parts)
        self._update.kept = {}
        self.decisions = decisions
        self._lives = cast(DecidedLives, parts.lifecycle)
        self._roots: dict[int, int] = {}
        """Root of each public number."""
        self._next_rebuilt = _FIRST_REBUILT
        self._of: dict[int, list[int | None]] = {}
        """Published track of each candidate, by the number of its list; None without a track."""
        self._fused_as: dict[tuple[int, int], tuple[int, Measurement, int]] = {}
        """Track in the bank, stack and row of each fused candidate, by the number of its list and its position."""
        self._beliefs: dict[tuple[int, int], tuple[int, tuple[float, int]]] = {}
        """Track in the bank, and belief about its front before it has fused a candidate; keys as in `_fused_as`."""
        self._facing = parts.facing if isinstance(parts.facing, StampedFacing) else None
        self._objects = (
            parts.objects if isinstance(parts.objects, StampedObjects) else None
        )
        self._firsts: dict[int, Place] = {}
        """First detections, before the horizon, of tracks that no estimator holds."""
        self._results: dict[int, UpdateRecord] = {}
        """Records of the fused detections of the newest list, by index."""

    def _estimate(
        self,
        again: set[int],
        lost: Sequence[Place],
        won: Sequence[Place],
        newest: Entry | None,
    ) -> None:
        """Take the `lost` candidates from their tracks, and fuse the candidates that tracks have `won`.

        The tracks in `again` that began inside the horizon start once more with their first detections.
        """
        anew = {
            public
            for public in again
            if self._is_unknown(public) or not self._began_before_horizon(public)
        }
        stuck = {
            (*place.detection, place.track)
            for place in self._withdraw(
                [place for place in lost if place.track not in anew]
            )
        }
        anew.update(
            public for _, _, public in stuck if not self._began_before_horizon(public)
        )
        again_read = self._withdraw_newer(self._read_newer(anew, lost, won), anew)
        chosen = [
            place
            for place in won
            if place.track not in anew and (*place.detection, place.track) not in stuck
        ]
        chosen += again_read
        self._go_back([place for place in lost if place.track not in anew], again_read)
        for public in anew:
            bank_id = self._tracks.bank_id(public)
            if bank_id is not None:
                self._tracks.drop(bank_id)
        if anew:
            chosen += [self._firsts[each] for each in anew if each in self._firsts]
            chosen += [
                Place(each, position, public)
                for each in self.decisions.entries
                for position, public in enumerate(self._of[each.number])
                if public in anew
            ]
        begun = set[int]()
        by_list: dict[int, list[Place]] = {}
        for place in chosen:
            by_list.setdefault(place.entry.number, []).append(place)
        for places in sorted(by_list.values(), key=lambda each: each[0].entry.key):
            own = places[0].entry
            births = [
                place
                for place in places
                if (place.track in anew and place.track not in begun)
                or self._roots.get(place.track) == own.roots[place.position]
            ]
            rest = sorted(place.position for place in places if place not in births)
            self._fuse(own, rest, own is newest)
            for place in births:
                begun.add(place.track)
                self._birth(place, is_again=place.track in anew)

    def _read_newer(
        self, anew: set[int], lost: Sequence[Place], won: Sequence[Place]
    ) -> dict[int, list[Place]]:
        """Return the measurements that were read from states of tracks which have changed, by track.

        Each of these measurements is newer than a measurement that its track has lost or won. Tracks in `anew` are left
        out.
        """
        since: dict[int, int] = {}
        for place in (*lost, *won):
            if place.track not in anew and not self._is_unknown(place.track):
                stamp_ns = place.entry.batch.stamp_ns
                since[place.track] = min(since.get(place.track, stamp_ns), stamp_ns)
        newest = self.decisions.newest
        if newest is None or {id(place.entry) for place in (*lost, *won)} <= {
            id(newest.entry)
        }:
            return {}
        if not since:
            return {}
        first_ns = min(since.values())
        newer = [
            each for each in self.decisions.entries if each.batch.stamp_ns >= first_ns
        ]
        if not any(map(self._reads_states, newer)):
            return {}
        taken = {place.key for place in won}
        found: dict[int, list[Place]] = {}
        read = set[int]()
        for each in newer:
            number, own_ns = each.number, each.batch.stamp_ns
            reads = self._reads_states(each)
            for position, public in enumerate(self._of[number]):
                if public is None or since.get(public, FOREVER) > own_ns:
                    continue
                key = number, position
                if key not in taken and key in self._fused_as:
                    found.setdefault(public, []).append(Place(each, position, public))
                    if reads:
                        read.add(public)
        return {public: own for public, own in found.items() if public in read}

    def _go_back(self, lost: Sequence[Place], again_read: Sequence[Place]) -> None:
        """Restore the beliefs about the fronts of tracks before the oldest measurement that was taken from them."""
        if self._facing is None:
            return
        restored = set[int]()
        places = sorted((*lost, *again_read), key=lambda place: place.entry.key)
        for place in places:
            bank_id, belief = self._beliefs.pop(place.key, (None, None))
            if bank_id is None or belief is None or place.track in restored:
                continue
            restored.add(place.track)
            if self._parts.bank.holds(bank_id):
                self._facing.believe(bank_id, belief)

    def _reads_states(self, entry: Entry) -> bool:
        """True for a list whose measurements depend on the states of their tracks."""
        return any(
            group.depends_on_state
            or (self._parts.facing is not None and is_read(group))
            for group in entry.candidates.groups
        )

    def _is_unknown(self, public: int) -> bool:
        """True for a track that no estimator holds."""
        return self._tracks.bank_id(public) is None

    def _began_before_horizon(self, public: int) -> bool:
        """True for a track that an estimator holds, and whose first detection is decided for good."""
        bank_id = self._tracks.bank_id(public)
        return bank_id is not None and not self._began_inside(bank_id)

    def _leaves_no_trace(self, place: Place) -> bool:
        """True for a candidate from which a track learns nothing but its state."""
        known = self._fused_as.get(place.key)
        if known is None:
            return False
        measurement = known[1]
        # A yaw of the map is no evidence of the front.
        return "yaw_rad" not in {*measurement.model.components} - {*measurement.assumed}

    def _withdraw_newer(
        self, newer: Mapping[int, Sequence[Place]], anew: set[int]
    ) -> list[Place]:
        """Undo the fusion of newer candidates, by track, and return these candidates.

        A track whose estimator cannot undo all of them is added to `anew`.
        """
        every = [place for places in newer.values() for place in places]
        every.sort(key=lambda place: place.entry.key, reverse=True)
        kept = self._withdraw(every)
        stuck = {
            place.track for place in kept if not self._began_before_horizon(place.track)
        }
        anew |= stuck
        keys = {place.key for place in kept}
        return [
            place
            for place in every
            if place.track not in stuck and place.key not in keys
        ]

    def _withdraw(self, places: Sequence[Place]) -> list[Place]:
        """Undo the fusion of candidates with their former tracks. Return the candidates that the bank still has."""
        kept: list[Place] = []
        known = [
            (place, *self._fused_as.pop(place.key))
            for place in places
            if place.key in self._fused_as
        ]
        for _, group in groupby(known, key=lambda each: id(each[2])):
            given = list(group)
            stack, rows = given[0][2], [row for *_, row in given]
            track_ids = [bank_id for _, bank_id, _, _ in given]
            own = replace(stack, z=stack.z[rows], R=stack.R[rows])
            if self._objects is not None:
                for place, bank_id, *_ in given:
                    self._objects.take_back(bank_id, _key(place.entry, place.position))
            undone = self._parts.bank.withdraw(track_ids, own)
            for (place, bank_id, *_), is_undone in zip(given, undone, strict=True):
                if not is_undone:
                    kept.append(place)
                    continue
                self._tracks.num_measured[bank_id] -= 1
                self._lives.unconfirm(bank_id)
        return kept

    def _birth(self, place: Place, is_again: bool) -> None:
        """Start the estimator of a track."""
        entry, position, public = place.entry, place.position, place.track
        start = entry.start(position)
        if start is None:
            return
        bank_id = public
        if is_again:
            bank_id = self._next_rebuilt
            self._next_rebuilt += 1
        parts = self._parts
        try:
            parts.bank.birth(bank_id, start)
            if not parts.bank.holds(bank_id):
                return
            self._tracks.name(bank_id, public)
            candidate = entry.candidates[position]
            self._tracks.begin(bank_id, entry.scan.sensor, start)
            if self._facing is not None:
                self._facing.turn_to(start.stamp_ns)
                self._facing.born(
                    bank_id, entry.scan.sensor, start, candidate.measurement
                )
            self._tell(bank_id, entry, position)
        except Exception as error:
            parts.contain(error, Failure.BIRTH_FAILED)
            self._tracks.end([bank_id])

    def _fuse(self, entry: Entry, positions: Sequence[int], is_recorded: bool) -> None:
        """Fuse candidates of a list with their tracks."""
        chosen: list[tuple[int, int]] = []
        for position in positions:
            bank_id = self._tracks.bank_id(cast(int, self._of[entry.number][position]))
            if bank_id is not None:
                chosen.append((position, bank_id))
        if not chosen:
            return
        parts, stamp_ns = self._parts, entry.batch.stamp_ns
        known = (
            parts.bank.state_of(chosen[0][1], stamp_ns)
            if len(chosen) == 1
            else parts.bank.states_at(stamp_ns)
        )
        states = self._tracks.in_any_direction(known, stamp_ns)
        index = {each: k for k, each in enumerate(states.track_ids)}
        pairs = [(p, index[bank_id]) for p, bank_id in chosen if bank_id in index]
        if not pairs:
            return
        if self._facing is not None:
            self._facing.turn_to(stamp_ns)
            for position, track in pairs:
                bank_id = states.track_ids[track]
                belief = self._facing.belief(bank_id)
                self._beliefs[entry.number, position] = bank_id, belief
        assignment = self._readings(entry, pairs, states)
        records: list[Iterable[UpdateRecord]] = []
        kept = self._update.kept = {}
        self._update.fuse(entry.batch, entry.candidates, assignment, states, records)
        for k, (stack, row) in kept.items():
            position, track = pairs[k]
            bank_id = states.track_ids[track]
            self._fused_as[entry.number, position] = bank_id, stack, row
        if entry.describes:
            for position, track in pairs:
                self._tell(states.track_ids[track], entry, position)
        if is_recorded:
            for made in records:
                for one in made:
                    self._results[one.index] = one

    def _tell(self, bank_id: int, entry: Entry, position: int) -> None:
        """Let the detections of a candidate describe a track."""
        if self._objects is not None and entry.describes:
            detections = entry.candidates.described(entry.batch, position)
            self._objects.tell(bank_id, _key(entry, position), detections)

    def _readings(
        self, entry: Entry, pairs: list[tuple[int, int]], states: StatesAt
    ) -> Assignment:
        """Return the assignment of `pairs` with the readings of their yaws."""
        facing = self._parts.facing
        assignment = Assignment(pairs, [], [])
        if facing is None:
            return assignment
        facings = facing.at(entry.scan.sensor, states.track_ids)
        rows, columns = np.array(pairs).T
        _, _, readings = weighed(
            Pairs(rows, columns, np.zeros(len(rows))),
            entry.candidates,
            states,
            facings,
            partial(quantiles, _GATE_PROBABILITY),
        )
        return assignment._replace(readings=tuple(readings))

    def _is_single(self, bank_id: int) -> bool:
        """True for a track with one detection that was not confirmed."""
        is_single = self._tracks.num_measured[bank_id] < 2
        return is_single and not self._lives.was_confirmed(bank_id)

    def _began_inside(self, bank_id: int) -> bool:
        """True for a track whose first detection is not decided for good."""
        root = self._roots.get(self._tracks.public(bank_id))
        return root is not None and self._is_inside(root)

    def _is_inside(self, root: int) -> bool:
        """True for a root that is not decided for good."""
        return any(root in entry.roots for entry in self.decisions.entries)


def _key(entry: Entry, position: int) -> Key:
    """Return stamp and sensor of a list, and the index of a candidate's detection."""
    leader = entry.candidates.leaders[position]
    return entry.batch.stamp_ns, entry.batch.message.sensor, leader

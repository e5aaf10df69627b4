"""A tracker whose estimators follow decisions about all lists inside the horizon."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import ClassVar, NamedTuple, cast

import numpy as np

from fgtrack.core.types import (
    Disposition,
    FinalTrack,
    Revision,
    UpdateRecord,
)
from fgtrack.estimation.base import Measurement, StatesAt
from fgtrack.estimation.failures import Failure
from fgtrack.tracking.association import Assignment, Pairs, quantiles, weighed
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.decisions.history import Decisions, Explained, Settled
from fgtrack.tracking.decisions.lives import DecidedLives, Life
from fgtrack.tracking.decisions.nodes import NONE, Ended
from fgtrack.tracking.detections import PosedBatch
from fgtrack.tracking.facing import is_read
from fgtrack.tracking.inbox import Batch, merged_records, record
from fgtrack.tracking.list_entries import ListEntries
from fgtrack.tracking.lives.latency import FOREVER
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Preprocessed
from fgtrack.tracking.replaced_lists import Replaced, tracks_of
from fgtrack.tracking.stamped_facing import StampedFacing
from fgtrack.tracking.stamped_objects import Key, StampedObjects
from fgtrack.tracking.tracker import MultiObjectTracker

_FIRST_REBUILT = 1_000_000_000
_GATE_PROBABILITY = 0.9999
_LAST_SHARE = 0.1  # of the horizon, in which an extrapolated pose becomes final


class _Place(NamedTuple):
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
        """Key of the detection, which all lists of the same message share."""
        return id(self.entry.batch.message), self.entry.candidates.leaders[
            self.position
        ]


class DecidedTracker(MultiObjectTracker):
    """Decides about all lists in the order of their stamps, and lets the estimators follow.

    A late list changes decisions about newer lists. If the detections of a track change, its estimator starts once
    more with the first detection.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *MultiObjectTracker.STATE,
        "decisions",
        "_public",
        "_roots",
        "_shown",
        "_next_rebuilt",
        "_revisions",
        "_final",
        "_ended",
        "_of",
        "_fused_as",
        "_beliefs",
        "_firsts",
        "_unposed",
        "_lists",
        "num_revisions",
    )

    def __init__(self, parts: TrackerParts, decisions: Decisions) -> None:
        super().__init__(parts)
        self._update.kept = {}
        self.decisions = decisions
        self._lives = cast(DecidedLives, parts.lifecycle)
        self._public: dict[int, int] = {}
        """Public number of each root."""
        self._roots: dict[int, int] = {}
        """Root of each public number."""
        self._shown = set[int]()
        """Public numbers of tracks that were confirmed at some time."""
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
        self._firsts: dict[int, _Place] = {}
        """First detections, before the horizon, of tracks that no estimator holds."""
        self._unposed: list[Batch] = []
        """Lists that could not be placed in the map: no state of the ego was near."""
        self._lists = ListEntries(parts, decisions)
        self.num_revisions = 0
        """Number of changes of a detection's track by late data."""
        self._revisions: list[Revision] = []
        self._results: dict[int, UpdateRecord] = {}
        self._final: dict[int, tuple[int, int]] = {}
        """First and last stamps of the detections of each track, by root."""
        self._ended: list[Ended] = []

    def revised(self) -> list[Revision]:
        """See `MultiObjectTracker.revised`."""
        found, self._revisions = self._revisions, []
        return found

    def final_tracks(self) -> list[FinalTrack]:
        """See `MultiObjectTracker.final_tracks`. The tracks are in the order of their numbers."""
        final, ended = dict(self._final), list(self._ended)
        _settle(self.decisions.finished(), final, ended)
        found = [
            FinalTrack(
                self._public[each.root],
                *final[each.root],
                each.is_confirmed,
                each.probability,
            )
            for each in ended
            if each.root in self._public and each.root in final
        ]
        return sorted(found)

    def _process(self, posed: PosedBatch, preprocessed: Preprocessed | None) -> None:
        """Decide about one list, and fuse its detections."""
        parts, batch = self._parts, posed.batch
        message = batch.message
        if posed.ego is None and message.frame != "map":
            self._unposed.append(batch)
            self._records.append(
                [record(message, index, Disposition.FAILED) for index in batch.indices]
            )
            return
        candidates, out_of_bounds = (
            preprocessed or parts.preprocess.together([posed])[0]
        )
        self._records.append(out_of_bounds)
        self._forget()
        if self._is_too_old_to_decide(batch):
            every = range(len(candidates))
            self._records += candidates.records(batch, every, Disposition.TOO_OLD)
            return
        entry = self._lists.made(posed, candidates)
        changes = self.decisions.add(entry)
        self._of[entry.number] = [None] * len(candidates)
        self._follow(entry, changes, Replaced())

    def _forget(self) -> None:
        """Decide for good about lists that no late list can precede."""
        oldest_ns = self._parts.bank.window_start_ns
        settled = self.decisions.forget(oldest_ns)
        for each in settled:
            self._lists.settle(each.entry)
            number, scan = each.entry.number, each.entry.scan
            publics = self._of.pop(number)
            self._keep_firsts(each.entry, publics)
            for position in range(len(publics)):
                self._fused_as.pop((number, position), None)
                self._beliefs.pop((number, position), None)
            if self._facing is not None:
                chosen = [k for k, public in enumerate(publics) if public is not None]
                self._facing.settle(scan.sensor, scan.stamp_ns, chosen)
        if settled:
            self._drop_firsts()
        if self._objects is not None:
            self._objects.settle(oldest_ns)
        _settle(settled, self._final, self._ended)
        for bank_id in self._lives.ended_before(oldest_ns):
            if self._is_single(bank_id):
                self._tracks.drop(bank_id)
            else:
                self._tracks.end([bank_id])
        self._unposed = [each for each in self._unposed if each.stamp_ns >= oldest_ns]

    def _keep_firsts(self, entry: Entry, publics: Sequence[int | None]) -> None:
        """Keep the first detections of tracks that no estimator holds, and that late data may bring back."""
        for position, public in enumerate(publics):
            if public is not None and self._is_unknown(public):
                self._firsts.setdefault(public, _Place(entry, position, public))

    def _drop_firsts(self) -> None:
        """Forget the first detections of tracks that no hypothesis has."""
        if self._firsts:
            possible = self.decisions.roots
            self._firsts = {
                public: place
                for public, place in self._firsts.items()
                if self._roots.get(public) in possible
            }

    def _process_waiting(self) -> bool:
        """See `MultiObjectTracker._process_waiting`. Lists whose poses have become known better are decided again."""
        self._forget()
        bank, ego = self._parts.bank, self._parts.ego
        after_ns, newest_ns = ego.changed_after_ns(), ego.newest_ns
        known = range(0)
        if after_ns is not None and newest_ns is not None:
            known = range(after_ns + 1, newest_ns + 1)
        reach_ns = bank.present_ns - bank.window_start_ns
        open_ns = bank.window_start_ns + round(_LAST_SHARE * reach_ns)
        self._pose_again(
            [
                each
                for each in self.decisions.entries
                if each.batch.stamp_ns in known
                or (each.batch.stamp_ns < open_ns and self._lists.is_open(each))
            ]
        )
        return super()._process_waiting()

    def _complete(self) -> None:
        """See `MultiObjectTracker._complete`. Poses that are still extrapolated become final."""
        self._pose_again(list(filter(self._lists.is_open, self.decisions.entries)))

    def _pose_again(self, entries: Sequence[Entry]) -> None:
        """Decide again about the lists whose poses have changed: among `entries`, and those without a pose."""
        try:
            old, new = [], []
            for entry in entries:
                again = self._lists.again(entry)
                if again is not None:
                    old.append(entry)
                    new.append(again)
            if self._unposed:
                new += self._newly_posed()
            if new:
                self._replace(old, new)
        except Exception as error:
            self._parts.contain(error, Failure.STEP_FAILED)

    def _newly_posed(self) -> list[Entry]:
        """Return the lists that can be placed in the map now."""
        waiting, self._unposed = self._unposed, []
        found: list[Entry] = []
        for batch in waiting:
            posed = self._lists.posed(batch)
            if posed.ego is None:
                self._unposed.append(batch)
            elif not self._is_too_old_to_decide(batch):
                candidates = self._parts.preprocess.together([posed])[0][0]
                found.append(self._lists.made(posed, candidates))
        return found

    def _is_too_old_to_decide(self, batch: Batch) -> bool:
        """True for a list before the lists that are decided for good."""
        return self._is_too_old(batch) or self.decisions.is_too_old(batch.stamp_ns)

    def _replace(self, old: Sequence[Entry], new: Sequence[Entry]) -> None:
        """Decide with the lists `new` instead of the lists `old`; new lists that replace none come last."""
        changes = self.decisions.replace(old, new)
        replaced = Replaced()
        for before, after in zip(old, new, strict=False):
            replaced.add(before, self._of.pop(before.number), after)
        for entry in new:
            self._of[entry.number] = replaced.publics_of(entry)
        self._follow(None, changes, replaced)

    def _follow(
        self, entry: Entry | None, changes: Sequence[Explained], replaced: Replaced
    ) -> None:
        """Let the estimators follow the decisions, and record the detections of the newly received list `entry`."""
        again: set[int] = set()
        self._name_unknown(changes, again)
        changes = [*changes, *self._inherit(changes, again)]
        named = [list(map(self._numbered, each.taken)) for each in changes]
        self._revise(entry, changes, named, again, replaced)
        self._update_lives()
        if entry is not None:
            self._record(entry)

    def _name_unknown(self, changes: Sequence[Explained], again: set[int]) -> None:
        """Give the numbers of tracks that vanish to new tracks with most of their detections.

        A track with another first detection than before keeps its number, and is added to `again`.
        """
        unknown: dict[int, Counter[int]] = {}
        for each in changes:
            for root, old in zip(each.taken, self._of[each.entry.number], strict=True):
                if root != NONE and root not in self._public:
                    votes = unknown.setdefault(root, Counter())
                    if old is not None:
                        votes[old] += 1
        if any(unknown.values()):
            present = self._present_roots(changes)
            for root, votes in unknown.items():
                for public, _ in votes.most_common():
                    if self._roots.get(public) not in present:
                        self._rename(root, public)
                        again.add(public)
                        break

    def _inherit(
        self, changes: Sequence[Explained], again: set[int]
    ) -> list[Explained]:
        """Exchange the numbers of tracks if most detections of a published track now belong to an unpublished one.

        Both tracks are added to `again`. Return the other lists with detections of these tracks.
        """
        won: dict[int, Counter[int]] = {}
        for each in changes:
            for root, old in zip(each.taken, self._of[each.entry.number], strict=True):
                if old is not None and self._public.get(root, old) != old:
                    won.setdefault(root, Counter())[old] += 1
        former: dict[int, int] = {}
        for root, votes in won.items():
            own, (public, count) = self._public[root], votes.most_common(1)[0]
            rival = self._roots[public]
            if (
                public in self._shown
                and own not in self._shown
                and former.keys().isdisjoint((own, public))
                and self._is_inside(root)
                and self._is_inside(rival)
                and count > self._num_detections(rival, changes)
            ):
                former[own], former[public] = root, rival
                self._public[root], self._public[rival] = public, own
                self._roots[public], self._roots[own] = root, rival
                again.update((own, public))
        if not former:
            return []
        changed = {id(each.entry) for each in changes}
        return [
            Explained(each, tuple([self._root(old, former) for old in publics]))
            for each in self.decisions.entries
            if id(each) not in changed
            for publics in [self._of[each.number]]
            if not former.keys().isdisjoint(publics)
        ]

    def _num_detections(self, root: int, changes: Sequence[Explained]) -> int:
        """Return the number of detections of a track after `changes`, inside the horizon."""
        changed = {id(each.entry) for each in changes}
        kept = sum(
            self._of[each.number].count(self._public[root])
            for each in self.decisions.entries
            if id(each) not in changed
        )
        return kept + sum(each.taken.count(root) for each in changes)

    def _root(self, public: int | None, former: Mapping[int, int]) -> int:
        """Return the root of a public track; `former` has the roots of tracks with a new number."""
        if public is None:
            return NONE
        return former[public] if public in former else self._roots[public]

    def _rename(self, root: int, public: int) -> None:
        """Give a root the number of another one."""
        self._public.pop(self._roots.get(public, NONE), None)
        self._public[root], self._roots[public] = public, root

    def _numbered(self, root: int) -> int | None:
        """Return the public number of a root, a new one for a new root; None without a track."""
        if root == NONE:
            return None
        if root not in self._public:
            public = self._tracks.next_number()
            self._public[root], self._roots[public] = public, root
        return self._public[root]

    def _present_roots(self, changes: Sequence[Explained]) -> set[int]:
        """Return the roots of all tracks in the decisions as they are now."""
        changed = {id(each.entry) for each in changes}
        present = {root for each in changes for root in each.taken}
        for entry in self.decisions.entries:
            if id(entry) not in changed:
                present.update(
                    self._roots[public]
                    for public in self._of[entry.number]
                    if public is not None and public in self._roots
                )
        nodes = self.decisions.nodes
        if nodes is not None:
            present.update(nodes.roots.tolist())
        return present

    def _revise(
        self,
        entry: Entry | None,
        changes: Sequence[Explained],
        named: Sequence[list[int | None]],
        again: set[int],
        replaced: Replaced,
    ) -> None:
        """Publish the decisions. Estimate tracks once more whose detections have changed, and those in `again`."""
        lost: list[_Place] = []
        won: list[_Place] = []
        corrected = set[tuple[int, int, int]]()
        for former, own_key in replaced.kept:
            if former in self._fused_as:
                self._fused_as[own_key] = self._fused_as.pop(former)
            if former in self._beliefs:
                self._beliefs[own_key] = self._beliefs.pop(former)
        for each, own in zip(changes, named, strict=True):
            number = each.entry.number
            is_new = each.entry is entry
            if own == self._of[number] and not replaced.is_any:
                continue
            for position, (public, old) in enumerate(
                zip(own, self._of[number], strict=True)
            ):
                is_birth = each.taken[position] == each.entry.roots[position]
                place = _Place(each.entry, position, public)
                if is_birth and number in replaced.restarted:
                    again.add(place.track)
                if (number, position) in replaced.renewed:
                    if public is not None:
                        if public != old or is_birth:
                            again.add(public)
                        won.append(place)
                        corrected.add((*place.detection, public))
                    continue
                if public == old:
                    continue
                if not (is_new or number in replaced.tracks):
                    self._note(each.entry, position, old, public)
                if old is not None:
                    former_place = _Place(each.entry, position, old)
                    lost.append(former_place)
                    if not self._leaves_no_trace(former_place):
                        again.add(old)
                if public is not None:
                    if self._is_unknown(public) != (is_birth and is_new):
                        again.add(public)
                    won.append(place)
            self._of[number] = own
            self._note_replaced(each.entry, own, replaced)
        for former_list, position, public in replaced.lost:
            place = _Place(former_list, position, public)
            lost.append(place)
            is_corrected = (*place.detection, public) in corrected
            if not (is_corrected and self._leaves_no_trace(place)):
                again.add(public)
        self._results = {}
        self._estimate(again, lost, won, entry)

    def _estimate(
        self,
        again: set[int],
        lost: Sequence[_Place],
        won: Sequence[_Place],
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
                _Place(each, position, public)
                for each in self.decisions.entries
                for position, public in enumerate(self._of[each.number])
                if public in anew
            ]
        begun = set[int]()
        by_list: dict[int, list[_Place]] = {}
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
        self, anew: set[int], lost: Sequence[_Place], won: Sequence[_Place]
    ) -> dict[int, list[_Place]]:
        """Return the measurements that were read from states of tracks which have changed, by track.

        They are newer than a measurement that the track has lost or won. Tracks in `anew` are left out.
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
        found: dict[int, list[_Place]] = {}
        read = set[int]()
        for each in newer:
            number, own_ns = each.number, each.batch.stamp_ns
            reads = self._reads_states(each)
            for position, public in enumerate(self._of[number]):
                if public is None or since.get(public, FOREVER) > own_ns:
                    continue
                key = number, position
                if key not in taken and key in self._fused_as:
                    found.setdefault(public, []).append(_Place(each, position, public))
                    if reads:
                        read.add(public)
        return {public: own for public, own in found.items() if public in read}

    def _go_back(self, lost: Sequence[_Place], again_read: Sequence[_Place]) -> None:
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

    def _note(
        self, entry: Entry, position: int, old: int | None, public: int | None
    ) -> None:
        """Note that a candidate has another track than before."""
        leader = entry.candidates.leaders[position]
        self.num_revisions += 1
        for index in (leader, *entry.candidates.merged.get(leader, ())):
            self._note_detection(entry, index, old, public)

    def _note_replaced(
        self, entry: Entry, own: Sequence[int | None], replaced: Replaced
    ) -> None:
        """Note which detections of a list have other tracks than in the list that it has replaced."""
        if entry.number not in replaced.tracks:
            return
        before, after = replaced.tracks[entry.number], tracks_of(entry, own)
        for index in sorted({*before, *after}):
            old, public = before.get(index), after.get(index)
            if old != public:
                self.num_revisions += 1
                self._note_detection(entry, index, old, public)

    def _note_detection(
        self, entry: Entry, index: int, old: int | None, public: int | None
    ) -> None:
        message = entry.batch.message
        stamp_ns = message.objects[index].stamp_ns
        self._revisions.append(
            Revision(
                self._tick,
                message.sensor,
                message.stamp_ns if stamp_ns is None else stamp_ns,
                message.receipt_ns,
                index,
                old,
                public,
            )
        )

    def _is_unknown(self, public: int) -> bool:
        """True for a track that no estimator holds."""
        return self._tracks.bank_id(public) is None

    def _began_before_horizon(self, public: int) -> bool:
        """True for a track that an estimator holds, and whose first detection is decided for good."""
        bank_id = self._tracks.bank_id(public)
        return bank_id is not None and not self._began_inside(bank_id)

    def _leaves_no_trace(self, place: _Place) -> bool:
        """True for a candidate from which a track learns nothing but its state."""
        known = self._fused_as.get(place.key)
        if known is None:
            return False
        measurement = known[1]
        # A yaw of the map is no evidence of the front.
        return "yaw_rad" not in {*measurement.model.components} - {*measurement.assumed}

    def _withdraw_newer(
        self, newer: Mapping[int, Sequence[_Place]], anew: set[int]
    ) -> list[_Place]:
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

    def _withdraw(self, places: Sequence[_Place]) -> list[_Place]:
        """Undo the fusion of candidates with their former tracks. Return the candidates that the bank still has."""
        kept: list[_Place] = []
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
                self._lives.doubt(bank_id)
        return kept

    def _birth(self, place: _Place, is_again: bool) -> None:
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
        if entry.is_described:
            for position, track in pairs:
                self._tell(states.track_ids[track], entry, position)
        if is_recorded:
            for made in records:
                for one in made:
                    self._results[one.index] = one

    def _tell(self, bank_id: int, entry: Entry, position: int) -> None:
        """Let the detections of a candidate describe a track."""
        if self._objects is not None and entry.is_described:
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

    def _update_lives(self) -> None:
        """Note which tracks live, and end the others."""
        step = self.decisions.newest
        if step is None:
            return
        best, nodes = step.hypotheses[0], step.nodes
        exists = nodes.present
        living = set[int]()
        for row, root, probability, hazard_hz, is_confirmed, is_coasting in zip(
            best.rows.tolist(),
            nodes.roots[best.rows].tolist(),
            exists[best.rows].tolist(),
            nodes.hazards_hz[best.rows].tolist(),
            nodes.is_confirmed[best.rows].tolist(),
            nodes.coasts[best.rows].tolist(),
            strict=True,
        ):
            public = self._public.get(root)
            if public is None:
                continue
            if self._tracks.bank_id(public) is None:
                self._estimate({public}, [], [], None)
            held = self._tracks.bank_id(public)
            if held is None:
                continue
            living.add(held)
            if is_confirmed:
                self._shown.add(public)
            doubt = None
            least = self._lives.doubt_probability
            if is_confirmed and probability < least:
                doubt = self.decisions.doubt(row, least)
            life = Life(
                probability,
                step.stamp_ns,
                hazard_hz,
                is_confirmed,
                is_coasting,
                doubt,
            )
            self._lives.live(held, life)
        for bank_id in self._parts.bank.track_ids:
            if bank_id in living or self._lives.is_suspended(bank_id):
                continue
            if self._is_single(bank_id) and self._began_inside(bank_id):
                self._tracks.drop(bank_id)
            else:
                self._lives.suspend(bank_id, step.stamp_ns)
        self._tracks.withheld = set(filter(self._is_single, self._parts.bank.track_ids))

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

    def _record(self, entry: Entry) -> None:
        """Record what has become of the detections of a list."""
        batch, candidates = entry.batch, entry.candidates
        for position, public in enumerate(self._of[entry.number]):
            leader = candidates.leaders[position]
            is_birth = public is not None and (
                self._roots.get(public) == entry.roots[position]
            )
            if public is None:
                self._records += candidates.records(
                    batch, [position], Disposition.GATED
                )
                continue
            fused = self._results.get(leader)
            if fused is not None:
                if fused.track_id != public:
                    fused = replace(fused, track_id=public)
                merged = candidates.merged.get(leader, ())
                others = merged_records(batch.message, merged, public) if merged else []
                self._records.append((fused, *others))
                continue
            disposition = Disposition.BIRTH if is_birth else Disposition.FAILED
            self._records += candidates.records(
                batch, [position], disposition, public if is_birth else None
            )


def _key(entry: Entry, position: int) -> Key:
    """Return stamp and sensor of a list, and the index of a candidate's detection."""
    leader = entry.candidates.leaders[position]
    return entry.batch.stamp_ns, entry.batch.message.sensor, leader


def _settle(
    settled: Sequence[Settled],
    final: dict[int, tuple[int, int]],
    ended: list[Ended],
) -> None:
    """Add decisions to the first and last stamps of tracks, and to the ended tracks."""
    for each in settled:
        stamp_ns = each.entry.batch.stamp_ns
        for root in each.taken:
            if root != NONE:
                first_ns, _ = final.get(root, (stamp_ns, stamp_ns))
                final[root] = first_ns, stamp_ns
        ended += each.ended

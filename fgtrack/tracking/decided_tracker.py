"""A tracker whose estimators follow decisions about all lists inside the horizon."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, TypeVar

from fgtrack.core.types import (
    Disposition,
    FinalTrack,
    Revision,
)
from fgtrack.estimation.failures import Failure
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.decisions.history import Decisions, Explained, Settled
from fgtrack.tracking.decisions.lives import Life
from fgtrack.tracking.decisions.nodes import NONE, Ended
from fgtrack.tracking.detections import PosedBatch
from fgtrack.tracking.following_tracker import FollowingTracker, Place
from fgtrack.tracking.inbox import Batch, merged_records, record
from fgtrack.tracking.list_entries import ListEntries
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Preprocessed
from fgtrack.tracking.replaced_lists import Replaced, tracks_of

_T = TypeVar("_T")
_LEAST_RELEASE = 256
_LAST_SHARE = 0.1  # of the horizon, in which an extrapolated pose becomes final


class DecidedTracker(FollowingTracker):
    """Decides about all lists in the order of their stamps, and lets the estimators follow.

    A late list changes decisions about newer lists. If the detections of a track change, its estimator starts once
    more with the first detection.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *FollowingTracker.STATE,
        "_public",
        "_shown",
        "_revisions",
        "_final",
        "_ended",
        "_settled_tracks",
        "_next_release",
        "_unposed",
        "_lists",
        "num_revisions",
    )

    def __init__(self, parts: TrackerParts, decisions: Decisions) -> None:
        super().__init__(parts, decisions)
        self._public: dict[int, int] = {}
        """Public number of each root."""
        self._shown = set[int]()
        """Public numbers of tracks that were confirmed at some time."""
        self._unposed: list[Batch] = []
        """Lists that could not be placed in the map: no state of the ego was near."""
        self._lists = ListEntries(parts, decisions)
        self.num_revisions = 0
        """Number of changes of a detection's track by late data."""
        self._revisions: list[Revision] = []
        self._final: dict[int, tuple[int, int]] = {}
        """First and last stamps of the detections of each track, by root."""
        self._ended: dict[int, Ended] = {}
        """Tracks that have ended, by root."""
        self._settled_tracks: list[FinalTrack] = []
        self._next_release = _LEAST_RELEASE
        """Number of known roots at which tracks are handed out."""

    def revised(self) -> list[Revision]:
        """See `MultiObjectTracker.revised`."""
        found, self._revisions = self._revisions, []
        return found

    def settled_tracks(self) -> list[FinalTrack]:
        """See `MultiObjectTracker.settled_tracks`."""
        found, self._settled_tracks = self._settled_tracks, []
        return found

    def final_tracks(self) -> list[FinalTrack]:
        """See `MultiObjectTracker.final_tracks`. The tracks are in the order of their numbers."""
        final, ended = dict(self._final), dict(self._ended)
        _settle(self.decisions.finished(), final, ended)
        found = [
            _final_track(self._public[root], final[root], each)
            for root, each in ended.items()
            if root in self._public and root in final
        ]
        return sorted(found)

    def _release(self) -> None:
        """Hand out the tracks that no late list can change any more, and forget their numbers."""
        if len(self._public) < self._next_release:
            return
        possible = self.decisions.open_roots
        in_use = {public for publics in self._of.values() for public in publics}
        in_use.update(self._firsts)
        for root, public in list(self._public.items()):
            if root in possible or public in in_use or not self._is_unknown(public):
                continue
            final, ended = self._final.pop(root, None), self._ended.pop(root, None)
            if final is not None and ended is not None:
                self._settled_tracks.append(_final_track(public, final, ended))
            del self._public[root]
            if self._roots.get(public) == root:
                del self._roots[public]
            self._shown.discard(public)
        self._final = _known(self._final, self._public)
        self._ended = _known(self._ended, self._public)
        self._next_release = max(2 * len(self._public), _LEAST_RELEASE)

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
        self._release()

    def _keep_firsts(self, entry: Entry, publics: Sequence[int | None]) -> None:
        """Keep the first detections of tracks that no estimator holds, and that late data may bring back."""
        for position, public in enumerate(publics):
            if public is not None and self._is_unknown(public):
                self._firsts.setdefault(public, Place(entry, position, public))

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

        Both tracks are added to `again`. Returned are the lists outside of `changes` with detections of these tracks.
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
        lost: list[Place] = []
        won: list[Place] = []
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
                place = Place(each.entry, position, public)
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
                    former_place = Place(each.entry, position, old)
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
            place = Place(former_list, position, public)
            lost.append(place)
            is_corrected = (*place.detection, public) in corrected
            if not (is_corrected and self._leaves_no_trace(place)):
                again.add(public)
        self._results = {}
        self._estimate(again, lost, won, entry)

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


def _settle(
    settled: Sequence[Settled],
    final: dict[int, tuple[int, int]],
    ended: dict[int, Ended],
) -> None:
    """Add decisions to the first and last stamps of tracks, and to the ended tracks."""
    for each in settled:
        stamp_ns = each.entry.batch.stamp_ns
        for root in each.taken:
            if root != NONE:
                first_ns, _ = final.get(root, (stamp_ns, stamp_ns))
                final[root] = first_ns, stamp_ns
        ended.update((own.root, own) for own in each.ended)


def _known(own: Mapping[int, _T], roots: Mapping[int, int]) -> dict[int, _T]:
    """Return the items of `own` whose roots have public numbers."""
    return {root: each for root, each in own.items() if root in roots}


def _final_track(public: int, final: tuple[int, int], ended: Ended) -> FinalTrack:
    """Return a track that has ended, with its first and last stamps `final`."""
    return FinalTrack(public, *final, ended.is_confirmed, ended.probability)

"""A tracker whose estimators follow decisions about all lists inside the horizon."""

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from typing import ClassVar, cast

import numpy as np

from fgtrack.core.types import (
    Disposition,
    EgoState,
    FinalTrack,
    Revision,
    UpdateRecord,
)
from fgtrack.estimation.base import Measurement, Measurements, StatesAt
from fgtrack.estimation.failures import Failure
from fgtrack.tracking.association import Assignment, Pairs, quantiles, weighed
from fgtrack.tracking.decisions.entries import NOTHING, Entry, Starts
from fgtrack.tracking.decisions.history import Decisions, Explained, Settled
from fgtrack.tracking.decisions.lives import DecidedLives, Life
from fgtrack.tracking.decisions.nodes import NONE, Ended
from fgtrack.tracking.detections import PosedBatch
from fgtrack.tracking.inbox import record
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Candidates, Preprocessed
from fgtrack.tracking.tracker import MultiObjectTracker

_FIRST_REBUILT = 1_000_000_000
_GATE_PROBABILITY = 0.9999


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
        "_next_rebuilt",
        "_revisions",
        "_final",
        "_ended",
        "_of",
        "_fused_as",
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
        self._next_rebuilt = _FIRST_REBUILT
        self._of: dict[int, list[int | None]] = {}
        """Published track of each candidate, by the number of its list; None without a track."""
        self._fused_as: dict[tuple[int, int], tuple[int, Measurement, int]] = {}
        """Track in the bank, stack and row of each fused candidate, by the number of its list and its position."""
        self.num_revisions = 0
        """Number of changes of a detection's track by late data."""
        self._revisions: list[Revision] = []
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
        parts, batch, ego = self._parts, posed.batch, posed.ego
        message = batch.message
        if ego is None and message.frame != "map":
            self._records.append(
                [record(message, index, Disposition.FAILED) for index in batch.indices]
            )
            return
        scan = Scan(
            message.sensor, batch.stamp_ns, parts.bank.present_ns, ego, message.objects
        )
        candidates, out_of_bounds = (
            preprocessed or parts.preprocess.together([posed])[0]
        )
        self._records.append(out_of_bounds)
        self._forget()
        if self._is_too_old(batch) or self.decisions.is_too_old(batch.stamp_ns):
            every = range(len(candidates))
            self._records += candidates.records(batch, every, Disposition.TOO_OLD)
            return
        entry = self._entry(posed, candidates, scan)
        changes = self.decisions.add(entry)
        self._of[entry.number] = [None] * len(candidates)
        self._follow(entry, changes)

    def _forget(self) -> None:
        """Decide for good about lists that no late list can precede."""
        oldest_ns = self._parts.bank.window_start_ns
        settled = self.decisions.forget(oldest_ns)
        for each in settled:
            for position in range(len(self._of.pop(each.entry.number))):
                self._fused_as.pop((each.entry.number, position), None)
        _settle(settled, self._final, self._ended)
        self._tracks.end(self._lives.ended_before(oldest_ns))

    def _entry(self, posed: PosedBatch, candidates: Candidates, scan: Scan) -> Entry:
        """Return a list ready for decisions."""
        parts, sensor = self._parts, posed.sensor
        scores = np.zeros(len(candidates))
        if sensor.score is not None:
            for position in range(len(candidates)):
                own = [
                    each.score
                    for each in candidates.described(posed.batch, position)
                    if each.score is not None
                ]
                if own:
                    score = (max(own) - sensor.score.even) / sensor.score.scale
                    scores[position] = min(max(score, -10.0), 10.0)
        may_start = np.array(candidates.placed, dtype=bool) & sensor.births
        starts = Starts(parts.birth, parts.road, self._ego(scan), parts.ego.in_pit)
        return Entry(
            posed.batch,
            candidates,
            scan,
            sensor,
            list(parts.sensors).index(scan.sensor),
            self.decisions.motion,
            scores,
            may_start,
            starts,
        )

    def _ego(self, scan: Scan) -> EgoState | None:
        """Return the ego at the stamp of a list."""
        pose, current = scan.ego, self._parts.ego.current
        if pose is None:
            return None
        return EgoState(
            scan.stamp_ns,
            scan.stamp_ns,
            *pose[:5],
            accel_mps2=0.0 if current is None else current.accel_mps2,
        )

    def _follow(self, entry: Entry, changes: Sequence[Explained]) -> None:
        """Let the estimators follow the decisions, and record the detections of `entry`."""
        again: set[int] = set()
        named = self._named(changes, again)
        self._revise(entry, changes, named, again)
        self._update_lives(entry.batch.stamp_ns)
        self._record(entry)

    def _named(
        self, changes: Sequence[Explained], again: set[int]
    ) -> list[list[int | None]]:
        """Return the public track of each candidate of the changed lists. New tracks get numbers.

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
                        self._public.pop(self._roots.get(public, NONE), None)
                        self._public[root], self._roots[public] = public, root
                        again.add(public)
                        break
        named: list[list[int | None]] = []
        for each in changes:
            own: list[int | None] = []
            for root in each.taken:
                if root == NONE:
                    own.append(None)
                    continue
                if root not in self._public:
                    public = self._tracks.next_number()
                    self._public[root], self._roots[public] = public, root
                own.append(self._public[root])
            named.append(own)
        return named

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
        entry: Entry,
        changes: Sequence[Explained],
        named: Sequence[list[int | None]],
        again: set[int],
    ) -> None:
        """Publish the decisions. Estimate tracks once more whose detections have changed, and those in `again`."""
        lost: dict[int, list[tuple[Entry, int]]] = {}
        added: list[tuple[Entry, list[int]]] = []
        for each, own in zip(changes, named, strict=True):
            before = self._of[each.entry.number]
            is_new = each.entry is entry
            new_positions = []
            for position, (public, old) in enumerate(zip(own, before, strict=True)):
                if public == old:
                    continue
                if not is_new:
                    self._note(each.entry, position, old, public)
                if old is not None:
                    lost.setdefault(old, []).append((each.entry, position))
                if public is not None:
                    is_birth = each.taken[position] == each.entry.roots[position]
                    if self._is_unknown(public) != (is_birth and is_new):
                        again.add(public)
                    new_positions.append(position)
            self._of[each.entry.number] = own
            if new_positions:
                added.append((each.entry, new_positions))
        self._results: dict[int, UpdateRecord] = {}
        for public, places in sorted(lost.items()):
            is_old = self._began_before_horizon(public)
            if not is_old and not all(self._leaves_no_trace(*at) for at in places):
                again.add(public)
            if is_old or public not in again:
                undone = [self._withdraw(*at) for at in places]
                if not all(undone):
                    again.add(public)
        again = {each for each in again if not self._began_before_horizon(each)}
        for public in sorted(again):
            self._rebuild(public, entry)
        for each_entry, positions in added:
            rest = [p for p in positions if self._of[each_entry.number][p] not in again]
            births = [
                p
                for p in rest
                if self._roots[cast(int, self._of[each_entry.number][p])]
                == each_entry.roots[p]
            ]
            self._fuse(
                each_entry, [p for p in rest if p not in births], each_entry is entry
            )
            for position in births:
                self._birth(each_entry, position)

    def _note(
        self, entry: Entry, position: int, old: int | None, public: int | None
    ) -> None:
        """Note that a detection has another track than before."""
        self.num_revisions += 1
        message, leader = entry.batch.message, entry.candidates.leaders[position]
        stamp_ns = message.objects[leader].stamp_ns
        self._revisions += [
            Revision(
                self._tick,
                message.sensor,
                message.stamp_ns if stamp_ns is None else stamp_ns,
                message.receipt_ns,
                index,
                old,
                public,
            )
            for index in (leader, *entry.candidates.merged.get(leader, ()))
        ]

    def _is_unknown(self, public: int) -> bool:
        """True for a track that no estimator holds."""
        return self._tracks.bank_id(public) is None

    def _began_before_horizon(self, public: int) -> bool:
        """True for a track that an estimator holds, and whose first detection is decided for good."""
        bank_id = self._tracks.bank_id(public)
        return bank_id is not None and not self._began_inside(bank_id)

    def _leaves_no_trace(self, entry: Entry, position: int) -> bool:
        """True for a candidate from which a track learns nothing but its state."""
        known = self._fused_as.get((entry.number, position))
        return (
            known is not None
            and entry.descriptions[position] is NOTHING
            and "yaw_rad" not in known[1].model.components
        )

    def _withdraw(self, entry: Entry, position: int) -> bool:
        """Undo the fusion of a candidate with its former track; return False if the bank cannot undo it.

        What the track has learned from a class, an identity or a yaw stays.
        """
        known = self._fused_as.pop((entry.number, position), None)
        if known is None:
            return False
        bank_id, stack, row = known
        if not self._parts.bank.withdraw(bank_id, Measurements(stack)[row]):
            return False
        self._tracks.num_measured[bank_id] -= 1
        return True

    def _rebuild(self, public: int, newest: Entry | None = None) -> None:
        """Estimate a track once more, from its first detection inside the horizon."""
        bank_id = self._tracks.bank_id(public)
        if bank_id is not None:
            self._tracks.drop(bank_id)
        is_first = True
        for entry in self.decisions.entries:
            for position, each in enumerate(self._of[entry.number]):
                if each != public:
                    continue
                if is_first:
                    self._birth(entry, position, is_again=True)
                    is_first = False
                else:
                    self._fuse(entry, [position], entry is newest)

    def _birth(self, entry: Entry, position: int, is_again: bool = False) -> None:
        """Start the estimator of a track."""
        public = cast(int, self._of[entry.number][position])
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
            if parts.facing is not None:
                parts.facing.born(
                    bank_id, entry.scan.sensor, start, candidate.measurement
                )
            parts.objects.learn(
                bank_id, entry.candidates.described(entry.batch, position)
            )
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
        assignment = self._readings(entry, pairs, states)
        records: list[Iterable[UpdateRecord]] = []
        kept = self._update.kept = {}
        self._update.fuse(entry.batch, entry.candidates, assignment, states, records)
        for k, (stack, row) in kept.items():
            position, track = pairs[k]
            bank_id = states.track_ids[track]
            self._fused_as[entry.number, position] = bank_id, stack, row
        if parts.objects.describes(entry.scan.objects):
            for position, track in pairs:
                parts.objects.learn(
                    states.track_ids[track],
                    entry.candidates.described(entry.batch, position),
                )
        if is_recorded:
            for made in records:
                for one in made:
                    self._results[one.index] = one

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

    def _update_lives(self, stamp_ns: int) -> None:
        """Note which tracks live, and end the others."""
        step = self.decisions.newest
        if step is None:
            return
        best, nodes = step.hypotheses[0], step.nodes
        matched = set(best.taken)
        exists = nodes.existed * nodes.alive * nodes.own
        living = set[int]()
        for root, probability, hazard_hz, is_confirmed in zip(
            nodes.roots[best.rows].tolist(),
            exists[best.rows].tolist(),
            nodes.hazards_hz[best.rows].tolist(),
            nodes.is_confirmed[best.rows].tolist(),
            strict=True,
        ):
            public = self._public.get(root)
            if public is None:
                continue
            if self._tracks.bank_id(public) is None:
                self._rebuild(public)
            held = self._tracks.bank_id(public)
            if held is None:
                continue
            living.add(held)
            is_coasting = root not in matched
            life = Life(
                probability, step.stamp_ns, hazard_hz, is_confirmed, is_coasting
            )
            self._lives.live(held, life)
        for bank_id in self._parts.bank.track_ids:
            if bank_id in living or self._lives.is_suspended(bank_id):
                continue
            known = self._lives.lives.get(bank_id)
            was_confirmed = known is not None and known.is_confirmed
            is_single = self._tracks.num_measured[bank_id] < 2
            if is_single and not was_confirmed and self._began_inside(bank_id):
                self._tracks.drop(bank_id)
            else:
                self._lives.suspend(bank_id, step.stamp_ns)

    def _began_inside(self, bank_id: int) -> bool:
        """True for a track whose first detection is not decided for good."""
        root = self._roots.get(self._tracks.public(bank_id))
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
                own = UpdateRecord(
                    fused.sensor,
                    fused.stamp_ns,
                    fused.receipt_ns,
                    fused.index,
                    fused.disposition,
                    public,
                    fused.nis,
                    fused.innovation,
                    yaw=fused.yaw,
                )
                others = candidates.records(
                    batch, [position], Disposition.BIRTH, public
                )
                self._records.append((own, *others[0][1:]))
                continue
            disposition = Disposition.BIRTH if is_birth else Disposition.FAILED
            self._records += candidates.records(
                batch, [position], disposition, public if is_birth else None
            )


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

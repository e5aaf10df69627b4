"""The tracker: the steps of a tick, in the order of the paper's algorithm (Karle et al. 2023, figure 2)."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fgtrack.core.diagnostic import EGO
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.state import copied_attributes, put_back
from fgtrack.core.types import (
    FRAMES,
    DetectionList,
    Disposition,
    EgoState,
    FinalTrack,
    FloatArray,
    Revision,
    SmoothedReport,
    TickReport,
    TrackReport,
    UpdateRecord,
)
from fgtrack.estimation.base import StatesAt
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.object_bank import ahead_of, states_of
from fgtrack.models.measurement import AT_ORIGIN
from fgtrack.tracking.association import Assignment
from fgtrack.tracking.decisions.lives import DecidedLives
from fgtrack.tracking.detections import PosedBatch
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.ego.waiting import places, range_of
from fgtrack.tracking.inbox import Batch, record, stamps
from fgtrack.tracking.list_association import ListAssociation
from fgtrack.tracking.list_update import ListUpdate
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.lives.latency import Delays
from fgtrack.tracking.parts import TrackerParts, check_sensor
from fgtrack.tracking.preprocess import Candidates, Preprocessed
from fgtrack.tracking.publication import Publication
from fgtrack.tracking.track_starts import TrackStarts
from fgtrack.tracking.tracker_state import TrackerState
from fgtrack.tracking.tracks import Tracks

if TYPE_CHECKING:
    from fgtrack.estimation.smoothing.window import Window


class MultiObjectTracker:
    """Tracks objects from object lists that arrive late.

    `receive` takes messages in the order of receipt. `tick` processes all messages that were received since the last
    tick. Every received detection ends in exactly one record of exactly one tick. The tick after an exception or an
    interrupt reports the batches that were processed, and processes the rest.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_tick",
        "_records",
        "_waiting",
        "_begun",
        "_tracks",
        "refused_ego",
        "unread",
        "last_updates",
    )

    def __init__(self, parts: TrackerParts) -> None:
        self._parts = parts
        self._tracks = Tracks(parts)
        self._association = ListAssociation(parts, self._tracks)
        self._update = ListUpdate(parts, self._tracks, self._association)
        self._starts = TrackStarts(parts, self._tracks)
        self._publication = Publication(parts, self._tracks)
        self._tick = -1
        # Some records are made when they are asked for.
        self._records: list[Iterable[UpdateRecord]] = []
        self._waiting: list[Batch] = []  # collected, and not processed to the end
        # The first of them, and the index of its first record.
        self._begun: tuple[int, Batch] | None = None
        # In this tick, by message: tracks that it has matched or started.
        self._seen: dict[int, set[int]] = {}
        self.failures = parts.failures
        """Counts of internal failures and of the tracks that they have ended."""
        self.delays: Mapping[str, Delays] = parts.watermarks.delays
        """Delays of the messages of each sensor, and of the ego under `EGO`."""
        self.refused_ego: Counter[str] = Counter()
        """Ego messages that were not used, by reason."""
        self.unread: TickReport | None = None
        """Report of the newest tick, until its reader sets None: an interrupt may keep a report from its reader."""
        self.last_updates: tuple[UpdateRecord, ...] = ()
        """Records of the detections that `finish` has processed, which no tick has, until their reader sets ()."""

    @property
    def received(self) -> EgoState | DetectionList | None:
        """The newest message that `receive` has taken to the end; it takes no other message in part."""
        return self._parts.inbox.received

    @received.setter
    def received(self, message: EgoState | DetectionList) -> None:
        self._parts.inbox.received = message

    @property
    def ego_jumps(self) -> int:
        """Number of jumps in the ego's states, see `EgoTrajectory`."""
        return self._parts.ego.jumps

    def located(self, ego: EgoState) -> EgoState:
        """Return `ego`, which was received, at the position that is used at its stamp."""
        return self._parts.ego.located(ego)

    @property
    def id_conflicts(self) -> Mapping[str, int]:
        """Number of identities that were reused or changed, see `Objects`."""
        return self._parts.objects.id_conflicts

    @property
    def yaws(self) -> Mapping[str, Mapping[str, int]]:
        """Numbers of matched detections by sensor: with a yaw (`yaws`), with a yaw that was turned by half a turn
        (`flipped`), and with a yaw that was not used (`unused`); see `Facing`.
        """
        return {} if self._parts.facing is None else self._parts.facing.counts

    def checkpoint(self) -> TrackerState:
        """Return a copy of the state between two ticks, from which `restore` goes on with the same bits.

        Raises `CallError` for an estimator of a plug-in that has no checkpoint.
        """
        parts = self._parts
        return TrackerState(
            copied_attributes(self, self.STATE),
            parts.bank.checkpoint(),
            parts.lifecycle.checkpoint(),
            parts.objects.checkpoint(),
            parts.ego.checkpoint(),
            parts.inbox.checkpoint(),
            parts.watermarks.checkpoint(),
            parts.failures.checkpoint(),
            None if parts.facing is None else parts.facing.checkpoint(),
        )

    def restore(self, state: TrackerState) -> None:
        """Put back a checkpoint of a tracker of the same configuration. It can be put back again."""
        parts = self._parts
        put_back(self, self.STATE, state.tracks)
        parts.bank.restore(state.bank)
        parts.lifecycle.restore(state.lifecycle)
        parts.objects.restore(state.objects)
        parts.ego.restore(state.ego)
        parts.inbox.restore(state.inbox)
        parts.watermarks.restore(state.watermarks)
        parts.failures.restore(state.failures)
        if parts.facing is not None and state.facing is not None:
            parts.facing.restore(state.facing)

    def receive(self, message: EgoState | DetectionList) -> None:
        """Take a message. Raises `DataError` for a sensor that has no model, and for an unknown frame."""
        if isinstance(message, EgoState):
            self.delays[EGO].add(message.stamp_ns, message.receipt_ns)
            reason = self._parts.ego.receive(message)
            if reason is not None:
                self.refused_ego[reason] += 1
            self.received = message
            return
        if message.sensor not in self._parts.sensors:
            check_sensor(message.sensor, self._parts.sensors)
        if message.frame not in FRAMES:
            raise DataError(
                f"{message.sensor}: frame: one of {', '.join(FRAMES)} expected, not {message.frame!r}"
            )
        own_ns = stamps(message, self._parts.sensors[message.sensor]) or [
            message.stamp_ns
        ]
        self.delays[message.sensor].add(min(own_ns), message.receipt_ns, max(own_ns))
        self._parts.inbox.put(message)

    def tick(self, now_ns: int, is_last: bool = False) -> TickReport:
        """Process everything received up to `now_ns`, except lists that wait for an ego message.

        At a tick that `is_last` no list waits any longer.
        """
        self._tick += 1
        parts, bank = self._parts, self._parts.bank
        if self._begun is not None:  # of a tick that was interrupted
            self._fail_rest()
        self._collect(now_ns, None if is_last else parts.wait)
        held_ns = parts.inbox.held_ns
        stamps_ns = map(attrgetter("stamp_ns"), self._waiting)
        self._expire(now_ns, min([held_ns, *stamps_ns]))
        bank.advance(now_ns)
        try:
            parts.ego.start_tick()
        except Exception as error:
            parts.contain(error, Failure.STEP_FAILED)
        self._tracks.forget_first(bank.window_start_ns)
        if self._process_waiting():
            self._expire(now_ns, held_ns)
        smoothed = self._publication.smoothed()
        tracks = self._publication.present()
        updates = partial(chain.from_iterable, self._records)
        report = TickReport.made_later(
            self._tick,
            now_ns,
            smoothed,
            self.revised(),
            self.settled_tracks(),
            tracks=tracks,
            updates=updates,
        )
        self._records, self.unread = [], report
        return report

    def _collect(self, now_ns: int, waits: Callable[[Batch, int], bool] | None) -> None:
        """Take the batches that are ready, and the records of detections that ended at their receipt."""
        inbox = self._parts.inbox
        ready, stay = inbox.due(now_ns, waits)
        waiting, ended = [*self._waiting, *ready], [*self._records, *inbox.ended]
        # One statement, so that an interrupt comes before or after it.
        self._waiting, self._records, inbox.pending, inbox.ended = (
            waiting,
            ended,
            stay,
            [],
        )

    def finish(self) -> tuple[SmoothedReport, ...]:
        """End all tracks. Return the final smoothed states that were still inside a window.

        Lists that still wait for an ego message are processed first; `last_updates` has their records.
        """
        self._fail_rest()
        self._collect(self._parts.bank.present_ns, None)
        self._process_waiting()
        self._complete()
        updates = (*self.last_updates, *chain.from_iterable(self._records))
        self.last_updates, self._records = updates, []
        self._tracks.end(self._parts.bank.track_ids)
        return tuple(self._publication.smoothed())

    def _complete(self) -> None:
        """Do what is left after the last list. Nothing is left for a tracker that decides once."""

    def revised(self) -> list[Revision]:
        """Return the decisions that late data has changed since the last report or call. This tracker decides once."""
        return []

    def settled_tracks(self) -> list[FinalTrack]:
        """Return the tracks that have ended for good since the last report or call. This tracker has none: it decides
        once.
        """
        return []

    def final_tracks(self) -> list[FinalTrack]:
        """Return the final tracks that no report has contained; empty for a tracker that decides once."""
        return []

    def state_at(self, track_id: int, stamp_ns: int) -> TrackReport:
        """Return the report of a track at any stamp in or after its window.

        The state is smoothed or filtered in the past, and predicted in the future. Raises `CallError` for a track that
        does not exist, for a stamp before its window, and for a state that is not finite.
        """
        track_id = self._checked_id(track_id)
        bank, motion = self._parts.bank, self._parts.motion
        known = bank.state_of(track_id, min(stamp_ns, bank.present_ns))
        states = ahead_of(known, bank.present_ns, motion, stamp_ns)
        for track in self._publication.at(states, stamp_ns):
            return track
        raise CallError(
            f"track {track_id} has no state at {stamp_ns} ns: "
            "the stamp lies before its window, or the state is not finite"
        )

    def window(self, track_id: int) -> "Window":
        """Return a copy of the window of a track.

        Raises `CallError` for a track that does not exist, and for an estimator that is not a smoother.
        """
        return self._parts.bank.window(self._checked_id(track_id))

    def _checked_id(self, track_id: int) -> int:
        """Return the number of a track in the bank. Raises `CallError` for a track that does not exist, or is
        suspended.
        """
        found = self._tracks.bank_id(track_id)
        track_id = track_id if found is None else found
        suspended = self._parts.lifecycle.suspended()
        track_ids = [
            each for each in self._parts.bank.track_ids if each not in suspended
        ]
        if track_id not in track_ids:
            raise CallError(
                f"track {track_id} does not exist: there are {', '.join(map(str, track_ids)) or 'none'}"
            )
        return track_id

    def tracks_at(self, stamp_ns: int) -> tuple[TrackReport, ...]:
        """Return the reports of all tracks that have a state at a stamp, in order of birth, see `state_at`."""
        states = states_of(self._parts.bank, self._parts.motion, stamp_ns)
        return self._publication.at(states, stamp_ns)

    def _expire(self, now_ns: int, processed_ns: int) -> None:
        """End tracks whose time has passed. All received lists before `processed_ns` have been processed."""
        parts = self._parts
        try:
            watermarks_ns = parts.watermarks.at(now_ns, parts.bank.window_start_ns)
            ended = parts.lifecycle.expired(now_ns, watermarks_ns, processed_ns)
            if ended:
                self._tracks.end(ended)
        except Exception as error:
            parts.contain(error, Failure.STEP_FAILED)

    def _process_waiting(self) -> bool:
        """Process all batches that were collected; return True if there was one."""
        self._seen = {}
        if not self._waiting:
            return False
        posed = list(map(self._posed, self._waiting))
        for each in zip(posed, self._preprocessed(posed), strict=True):
            self._process_if_possible(*each)
            self.delays[each[0].batch.message.sensor].processed(each[0].batch.stamp_ns)
        return True

    def _posed(self, batch: Batch) -> PosedBatch:
        """Return `batch` with the sensor pose from which it is measured. Detections in the map need no pose."""
        parts, sensor = self._parts, self._parts.sensors[batch.message.sensor]
        try:
            if places(batch, sensor):
                ego = parts.ego.placed(
                    batch.stamp_ns, parts.bank.present_ns, partial(range_of, batch)
                )
            else:
                ego = parts.ego.pose_at(batch.stamp_ns, parts.bank.present_ns)
            return parts.preprocess.posed(batch, sensor, ego)
        except Exception as error:
            parts.contain(error, Failure.STEP_FAILED)
            return PosedBatch(batch, sensor, None, AT_ORIGIN)

    def _preprocessed(
        self, batches: Sequence[PosedBatch]
    ) -> Sequence[Preprocessed | None]:
        """Return the candidates of `batches`, computed in one pass.

        If the pass raises, the entries are None. Each batch is then preprocessed by itself, so that one batch does not
        fail other batches.
        """
        try:
            return self._parts.preprocess.together(batches)
        except Exception as error:
            if isinstance(error, self._parts.propagated_exceptions):
                raise
            return [None] * len(batches)

    def _process_if_possible(
        self, posed: PosedBatch, preprocessed: Preprocessed | None
    ) -> None:
        """Process the first waiting batch; after an exception or interrupt its remaining detections end as failed."""
        self._begun = len(self._records), posed.batch
        try:
            self._process(posed, preprocessed)
        except BaseException as error:
            self._fail_rest()
            if not isinstance(error, Exception):
                raise
            self._parts.contain(error, Failure.LIST_FAILED)
        self._close()

    def _fail_rest(self) -> None:
        """Record the remaining detections of the batch that was begun as failed.

        If this is interrupted, or lacks memory, the next tick repeats it.
        """
        if self._begun is not None:
            first, batch = self._begun
            ended = {each.index for each in chain.from_iterable(self._records[first:])}
            rest = [index for index in batch.indices if index not in ended]
            self._records.append(
                [record(batch.message, index, Disposition.FAILED) for index in rest]
            )
            self._close()

    def _close(self) -> None:
        """Note that all detections of the batch that was begun have records."""
        if self._begun is not None:
            if self._waiting and self._waiting[0] is self._begun[1]:
                del self._waiting[0]
            self._begun = None

    def _process(self, posed: PosedBatch, preprocessed: Preprocessed | None) -> None:
        """Process one object list at its stamp: associate, count matches, update, count misses, start tracks."""
        parts, batch, ego = self._parts, posed.batch, posed.ego
        message = batch.message
        if ego is None and message.frame != "map":
            self._records.append(
                [record(message, index, Disposition.FAILED) for index in batch.indices]
            )
            return
        present_ns = parts.bank.present_ns
        scan = Scan(message.sensor, batch.stamp_ns, present_ns, ego, message.objects)
        candidates, out_of_bounds = (
            preprocessed or parts.preprocess.together([posed])[0]
        )
        self._records.append(out_of_bounds)
        if self._is_too_old(batch):
            every = range(len(candidates))
            self._records += candidates.records(batch, every, Disposition.TOO_OLD)
            return
        states, assignment = self._associated(batch, candidates)
        try:
            self._match(batch, candidates, assignment, states, scan)
        except Exception as error:
            parts.contain(error, Failure.STEP_FAILED)
        if assignment.pairs:
            self._update.fuse(batch, candidates, assignment, states, self._records)
        if assignment.missed:
            try:
                self._miss(batch, assignment, states, scan)
            except Exception as error:
                parts.contain(error, Failure.STEP_FAILED)
        if assignment.refused:
            self._records += candidates.records(
                batch, assignment.refused, Disposition.GATED
            )
        new = assignment.new
        if new and parts.suppress_births_near_newer_tracks:
            new = self._unclaimed(batch, candidates, new, states)
        for position in new:
            self._give_birth(batch, candidates, position, scan)

    def _associated(
        self, batch: Batch, candidates: Candidates
    ) -> tuple[StatesAt, Assignment]:
        """Return the states of the tracks that `batch` may be associated with, and the assignment."""
        identified = self._association.identified(batch, candidates)
        if identified is not None:
            return identified
        states = self._offered(batch)
        return states, self._association.assigned(batch, candidates, states)

    def _unclaimed(
        self, batch: Batch, candidates: Candidates, new: list[int], states: StatesAt
    ) -> list[int]:
        """Return the indices of `new` candidates that belong to no track which began after the batch's stamp."""
        found = self._association.claimed_by_younger(batch, candidates, new, states)
        if found is None:
            return new
        younger, claims = found
        for k, track in claims.pairs:
            claimed = [new[k]], Disposition.TOO_OLD, younger.track_ids[track]
            self._records += candidates.records(batch, *claimed)
        refused = [new[k] for k in claims.refused]
        self._records += candidates.records(batch, refused, Disposition.GATED)
        return [new[k] for k in claims.new]

    def _give_birth(
        self, batch: Batch, candidates: Candidates, position: int, scan: Scan
    ) -> None:
        """Start a track with a candidate, if the sensor and the birth rules want a track."""
        track_id = self._starts.give_birth(
            batch, candidates, position, scan, self._records
        )
        if track_id is not None:
            self._seen.setdefault(id(batch.message), set()).add(track_id)

    def _is_too_old(self, batch: Batch) -> bool:
        """True if no track could fuse a detection of `batch`."""
        return batch.stamp_ns < self._parts.bank.window_start_ns

    def _offered(self, batch: Batch) -> StatesAt:
        """Return the states of the tracks that `batch` may be associated with, at its stamp."""
        ended = self._parts.lifecycle.suspended(batch.stamp_ns)
        states = self._parts.bank.states_at(batch.stamp_ns)
        if ended:
            states = states.without(ended)
        return self._tracks.in_any_direction(states, batch.stamp_ns)

    def _ranges_m(
        self, track_ids: Sequence[int], positions_m: FloatArray, ego: EgoPose | None
    ) -> FloatArray:
        """Return the distances of tracks at `positions_m` (n, 2) from the ego, both at the stamp of the batch.

        All distances are 0 without an ego.
        """
        if ego is None:
            return np.zeros(len(track_ids))
        return np.asarray(
            np.hypot(positions_m[:, 0] - ego.x_m, positions_m[:, 1] - ego.y_m)
        )

    def _match(
        self,
        batch: Batch,
        candidates: Candidates,
        assignment: Assignment,
        states: StatesAt,
        scan: Scan,
    ) -> None:
        """Count the matches of tracks. Learn class, size and identity from the detections."""
        seen = self._seen.setdefault(id(batch.message), set())
        for _, track in assignment.pairs:
            seen.add(states.track_ids[track])
        self._parts.lifecycle.matched(scan, candidates, assignment.pairs, states)
        if self._parts.objects.describes(scan.objects):
            for position, track in assignment.pairs:
                self._parts.objects.learn(
                    states.track_ids[track], candidates.described(batch, position)
                )

    def _miss(
        self, batch: Batch, assignment: Assignment, states: StatesAt, scan: Scan
    ) -> None:
        """Count the misses of tracks, if the sensor gives positions and has `scan`. End the tracks whose counts run
        out.

        A track is missed by a message as a whole, so only its last batch counts. The list may end a track that it has
        matched, if clutter explains the match better. So tracks end after the list has been fused.
        """
        sensor = self._parts.sensors[batch.message.sensor]
        if not batch.last or not (sensor.gives_position and sensor.scan):
            return
        seen = self._seen[id(batch.message)]
        rows = [
            track for track in assignment.missed if states.track_ids[track] not in seen
        ]
        if rows:
            missed = [states.track_ids[track] for track in rows]
            positions_m = states.means[rows, :2]
            ranges_m = self._ranges_m(missed, positions_m, scan.ego)
            lives = self._parts.lifecycle
            if not isinstance(lives, DecidedLives):
                ended = lives.missed(scan, missed, positions_m, ranges_m)
                self._tracks.end(ended)

"""The tracker: the steps of a tick, in the order of the paper's algorithm (Karle et al. 2023, figure 2)."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, repeat
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fgtrack.core.diagnostic import EGO
from fgtrack.core.errors import CallError, DataError, FgtrackError, did_you_mean
from fgtrack.core.state import copied_attributes, put_back
from fgtrack.core.time import seconds
from fgtrack.core.types import (
    FRAMES,
    BoolArray,
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    FloatArray,
    IntArray,
    SmoothedReport,
    TickReport,
    TrackReport,
    TrackState,
    TrackStatus,
    UpdateRecord,
)
from fgtrack.estimation.base import (
    Measurement,
    Measurements,
    Start,
    StatesAt,
    UpdateResult,
    UpdateStatus,
)
from fgtrack.estimation.failures import Containment, Failure, Failures
from fgtrack.estimation.filters.ekf import correct_one, propagated
from fgtrack.estimation.filters.propagation import kinematic_states
from fgtrack.estimation.object_bank import ahead_of, states_of
from fgtrack.models.measurement import AT_ORIGIN
from fgtrack.models.motion import MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.association import (
    Assignment,
    Association,
    GatedMahalanobis,
    Likely,
    Pairs,
    claimed,
)
from fgtrack.tracking.birth import Birth, in_any_direction
from fgtrack.tracking.detections import PosedBatch
from fgtrack.tracking.ego.trajectory import EgoPose, EgoTrajectory
from fgtrack.tracking.ego.waiting import PoseWait, places, range_of
from fgtrack.tracking.facing import Facing, Facings, YawsRead, as_read
from fgtrack.tracking.guarded_bank import GuardedBank, faults
from fgtrack.tracking.inbox import (
    Batch,
    FusedRecords,
    Inbox,
    merged_records,
    record,
    stamps,
)
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.lives.existence import Lifecycle, after_jumps, explained
from fgtrack.tracking.lives.latency import FOREVER, NEVER, Delays, Watermarks
from fgtrack.tracking.objects import Apart, Evidence, Objects
from fgtrack.tracking.preprocess import (
    Candidates,
    Group,
    Preprocessed,
    Preprocessing,
)
from fgtrack.tracking.soft_association import equivalent, joint_probabilities
from fgtrack.tracking.tracker_state import TrackerState

if TYPE_CHECKING:
    from fgtrack.estimation.smoothing.window import Window

_SELDOM = 1e-3  # probability with which a true pair misses the usual gate


@dataclass(frozen=True)
class TrackerParts:
    """The components that a tracker is made of."""

    sensors: Mapping[str, SensorModel]
    ego: EgoTrajectory
    inbox: Inbox
    preprocess: Preprocessing
    association: Association
    bank: GuardedBank
    motion: MotionModel
    lifecycle: Lifecycle
    suppress_births_near_newer_tracks: bool
    birth: Birth
    road: Road
    watermarks: Watermarks
    """Learns the usual delays, of the sensors and the `EGO`."""
    objects: Objects = field(default_factory=Objects)
    joint: GatedMahalanobis | None = None
    """Gate of the detections that update a track together, and the distance from confirmed tracks within which no
    detection starts another one; None where each updates one track and any may start one."""
    weigh_births: Callable[[str, int, Sequence[int], Pairs], BoolArray] | None = None
    """See `ExistenceLifecycle.likely`; None where births are not weighed."""
    facing: Facing | None = None
    """Belief about the fronts of tracks; None where every yaw is taken as it is."""
    wait: PoseWait | None = None
    """Decides which lists wait for an ego message; None where none waits."""
    failures: Failures = field(default_factory=Failures)
    """Counts what fails inside, shared with `bank`."""
    propagated_exceptions: tuple[type[Exception], ...] = (FgtrackError, MemoryError)
    """Exceptions that the processing of a batch lets out; after any other one, it ends as failed."""


def check_sensor(name: str, sensors: Mapping[str, SensorModel]) -> None:
    """Raise `DataError` for a sensor that has no model."""
    if name not in sensors:
        raise DataError(
            f"sensor {name!r} has no model (the configuration has {', '.join(sensors) or 'none'}"
            f"{did_you_mean(name, sensors)}): "
            f"add it under `sensors`, or to `ignore_sensors`"
        )


class Tracker:
    """Tracks objects from object lists that arrive late.

    `receive` takes messages in the order of receipt. `tick` processes all messages that were received since the last
    tick. Every received detection ends in exactly one record of exactly one tick. The tick after an exception or an
    interrupt reports the batches that were processed, and processes the rest.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_tick",
        "_next_id",
        "_records",
        "_waiting",
        "_begun",
        "_num_measured",
        "_undirected",
        "_directed",
        "_newborn",
        "refused_ego",
        "unread",
        "last_updates",
    )

    def __init__(self, parts: TrackerParts) -> None:
        self._parts = parts
        self._tick = -1
        self._next_id = 0
        self._records: list[
            Iterable[UpdateRecord]
        ] = []  # some are made when they are asked for
        self._waiting: list[Batch] = []  # collected, and not processed to the end
        self._begun: tuple[int, Batch] | None = (
            None  # the first of them, and the index of its first record
        )
        self._num_measured = Counter[
            int
        ]()  # detections that have changed the state, by track
        self._undirected: dict[
            int, Start
        ] = {}  # of tracks with one position and an unknown heading, by id
        self._directed: dict[
            int, tuple[Start, int]
        ] = {}  # of those that have a second position since, and its stamp
        self._newborn: dict[
            int, tuple[str, int]
        ] = {}  # sensors of first positions, and stamps of second ones, by id
        self._seen: dict[
            int, set[int]
        ] = {}  # in this tick, by message: tracks that it has matched or started
        self.failures = parts.failures
        """Counts of internal failures and of the tracks that they have ended."""
        contained = partial(
            Containment, parts.failures, propagated=parts.propagated_exceptions
        )
        self._guarded_step = contained(Failure.STEP_FAILED)
        self._guarded_list = contained(Failure.LIST_FAILED)
        self._guarded_birth = contained(Failure.BIRTH_FAILED)
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
        """By sensor: numbers of `yaws` of matched detections, and of the `flipped` and `unused` ones, see `Facing`."""
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
        """Process everything received up to `now_ns`, but for lists that wait for an ego message.

        At a tick that `is_last` no list waits any longer.
        """
        self._tick += 1
        parts, bank = self._parts, self._parts.bank
        self._fail_rest()  # of a tick that was interrupted
        self._collect(now_ns, None if is_last else parts.wait)
        held_ns = parts.inbox.held_ns
        self._expire(
            now_ns, min([held_ns, *(batch.stamp_ns for batch in self._waiting)])
        )
        bank.advance(now_ns)
        with self._guarded_step:
            parts.ego.start_tick()
        self._forget_first(bank.window_start_ns)
        if self._process_waiting():
            self._expire(now_ns, held_ns)
        smoothed = self._smoothed()
        states = bank.present()  # tracks may end by both
        if parts.facing is not None:
            states = parts.facing.published(bank.track_ids, states)
        tracks = self._reports(*self._published(bank.track_ids, states))
        updates = partial(chain.from_iterable, self._records)
        report = TickReport.made_later(
            self._tick, now_ns, smoothed, tracks=tracks, updates=updates
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
        """End all tracks; gives the final smoothed states that were still inside a window.

        Lists that still wait for an ego message are processed first; `last_updates` has their records.
        """
        self._fail_rest()
        self._collect(self._parts.bank.present_ns, None)
        self._process_waiting()
        updates = (*self.last_updates, *chain.from_iterable(self._records))
        self.last_updates, self._records = updates, []
        self._end(self._parts.bank.track_ids)
        return tuple(self._smoothed())

    def _smoothed(self) -> Sequence[SmoothedReport]:
        reports, facing = self._parts.bank.smoothed(), self._parts.facing
        return reports if facing is None else facing.smoothed(reports)

    def state_at(self, track_id: int, stamp_ns: int) -> TrackReport:
        """A track at any stamp in or after its window: smoothed or filtered in the past, predicted ahead of now.
        Raises `CallError` for a track that does not exist, a stamp before its window, and a state that is not sound.
        """
        self._check_exists(track_id)
        bank, motion = self._parts.bank, self._parts.motion
        known = bank.state_of(track_id, min(stamp_ns, bank.present_ns))
        for track in self._reports_of(
            ahead_of(known, bank.present_ns, motion, stamp_ns), stamp_ns
        ):
            return track
        raise CallError(
            f"track {track_id} has no state at {stamp_ns} ns: before its window, or not finite"
        )

    def window(self, track_id: int) -> "Window":
        """A copy of the window of a track. Raises `CallError` for a track that does not exist, and unless the estimator
        is a smoother.
        """
        self._check_exists(track_id)
        return self._parts.bank.window(track_id)

    def _check_exists(self, track_id: int) -> None:
        """Raise `CallError` for a track that does not exist, or is suspended."""
        suspended = self._parts.lifecycle.suspended()
        track_ids = [
            each for each in self._parts.bank.track_ids if each not in suspended
        ]
        if track_id not in track_ids:
            raise CallError(
                f"track {track_id} does not exist: there are {', '.join(map(str, track_ids)) or 'none'}"
            )

    def tracks_at(self, stamp_ns: int) -> tuple[TrackReport, ...]:
        """All tracks that have a state at a stamp, see `state_at`, in order of birth."""
        return self._reports_of(
            states_of(self._parts.bank, self._parts.motion, stamp_ns), stamp_ns
        )

    def _reports_of(self, states: StatesAt, stamp_ns: int) -> tuple[TrackReport, ...]:
        """Tracks with these states at a stamp, those that are not suspended and whose states are sound."""
        states = states.without(self._parts.lifecycle.suspended())
        if not states.track_ids:
            return ()
        present: Sequence[TrackState] = kinematic_states(
            self._parts.motion, stamp_ns, states.means, states.covariances
        )
        if self._parts.facing is not None:
            present = self._parts.facing.seen(states.track_ids, present)
        unsound, reports = faults(present), self._reports(states.track_ids, present)()
        return tuple(report for row, report in enumerate(reports) if row not in unsound)

    def _published(
        self, track_ids: Sequence[int], states: Sequence[TrackState]
    ) -> tuple[Sequence[int], Sequence[TrackState]]:
        """Return the tracks with these states that are not suspended."""
        suspended = self._parts.lifecycle.suspended()
        if not suspended:
            return track_ids, states
        rows = [
            row for row, track_id in enumerate(track_ids) if track_id not in suspended
        ]
        return [track_ids[row] for row in rows], [states[row] for row in rows]

    def _expire(self, now_ns: int, processed_ns: int) -> None:
        """End tracks by the time that has passed, where all lists before `processed_ns` that came are processed."""
        parts = self._parts
        with self._guarded_step:
            watermarks_ns = parts.watermarks.at(now_ns, parts.bank.window_start_ns)
            ended = parts.lifecycle.expired(now_ns, watermarks_ns, processed_ns)
            if ended:
                self._end(ended)

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

    def _forget_first(self, oldest_ns: int) -> None:
        """Forget the first positions of tracks whose second one no late list can precede."""
        if self._newborn:
            self._newborn = {
                i: each for i, each in self._newborn.items() if each[1] >= oldest_ns
            }
        if self._directed:
            self._directed = {
                i: each for i, each in self._directed.items() if each[1] >= oldest_ns
            }

    def _posed(self, batch: Batch) -> PosedBatch:
        """Return `batch` with the pose that it is seen from; detections in the map need none."""
        parts, sensor = self._parts, self._parts.sensors[batch.message.sensor]
        with self._guarded_step:
            if places(batch, sensor):
                ego = parts.ego.placed(
                    batch.stamp_ns, parts.bank.present_ns, partial(range_of, batch)
                )
            else:
                ego = parts.ego.pose_at(batch.stamp_ns, parts.bank.present_ns)
            return parts.preprocess.posed(batch, sensor, ego)
        return PosedBatch(batch, sensor, None, AT_ORIGIN)

    def _preprocessed(
        self, batches: Sequence[PosedBatch]
    ) -> Sequence[Preprocessed | None]:
        """Candidates of `batches` in one pass; of a pass that fails nothing, so that one batch does not fail others."""
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
        with self._guarded_list:
            try:
                self._process(posed, preprocessed)
            except BaseException:
                self._fail_rest()
                raise
        self._close()

    def _fail_rest(self) -> None:
        """Let those detections of the batch that was begun end as failed that have no record.
        Where that is interrupted, or has not enough memory, it is repeated in the next tick.
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
        """One object list, at its own stamp: associate, age, estimate, give birth."""
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
        if self._is_too_old(batch):
            self._conclude(
                batch, candidates, range(len(candidates)), Disposition.TOO_OLD
            )
            return
        states, assignment = self._identified(batch, candidates) or self._associated(
            batch, candidates
        )
        with self._guarded_step:
            self._match(batch, candidates, assignment, states, scan)
        if assignment.pairs:
            self._estimate(batch, candidates, assignment, states)
        with self._guarded_step:
            self._miss(batch, assignment, states, scan)
        self._conclude(batch, candidates, assignment.refused, Disposition.GATED)
        new = assignment.new
        if new and parts.suppress_births_near_newer_tracks:
            new = self._unclaimed(batch, candidates, new, states)
        for position in new:
            self._give_birth(batch, candidates, position, scan)

    def _identified(
        self, batch: Batch, candidates: Candidates
    ) -> tuple[StatesAt, Assignment] | None:
        """Return the track with the identity of the only candidate, its state and the pair; None outside its gate.
        Identities that are seldom wrong need no other track: the cost does not depend on the number of tracks.
        """
        parts, message = self._parts, batch.message
        sensor = parts.sensors[message.sensor]
        if sensor.scan or len(candidates) != 1 or sensor.wrong_id_probability > _SELDOM:
            return None
        if parts.joint is not None and parts.joint.joint_from is not None:
            return None
        owner = parts.objects.owner(message.objects[candidates.leaders[0]])
        if owner is None or owner in self._undirected:
            return None
        states = parts.bank.state_of(owner, batch.stamp_ns)
        assignment = parts.association(
            candidates, states, facings=self._facings(batch, states)
        )
        return (states, assignment) if assignment.pairs else None

    def _associated(
        self, batch: Batch, candidates: Candidates
    ) -> tuple[StatesAt, Assignment]:
        """Return the states of the tracks that `batch` may be associated with, and the assignment."""
        states = self._offered(batch)
        return states, self._assigned(batch, candidates, states)

    def _assigned(
        self, batch: Batch, candidates: Candidates, states: StatesAt
    ) -> Assignment:
        """Return the assignment of candidates to tracks of the same class, and by their identities."""
        parts, evidence = self._parts, self._evidence(batch, candidates, states)
        likely = self._likely(batch, candidates, states, evidence)
        result = parts.association(
            candidates, states, evidence, likely, self._facings(batch, states)
        )
        if parts.joint is None or not (parts.joint.claim_m and result.new):
            return result
        statuses, _ = parts.lifecycle.reported(states.track_ids)
        tentative = [each is TrackStatus.TENTATIVE for each in statuses]
        result = claimed(
            result,
            candidates,
            states,
            np.where(tentative, -1.0, parts.joint.claim_m),
            evidence,
        )
        reaches_m = np.where(tentative, -1.0, parts.joint.max_distance_m)
        return after_jumps(
            result, candidates, states, reaches_m, parts.sensors[batch.message.sensor]
        )

    def _likely(
        self,
        batch: Batch,
        candidates: Candidates,
        states: StatesAt,
        evidence: Apart | None,
    ) -> Likely | None:
        """Return the test of pairs against clutter and new objects; None where no pair is tested."""
        weigh, tests = self._parts.weigh_births, list[Likely]()
        if weigh is not None and all(
            group.stack.model.components == ("x_m", "y_m")
            for group in candidates.groups
        ):
            tests.append(
                partial(weigh, batch.message.sensor, batch.stamp_ns, states.track_ids)
            )
        if self._newborn:
            newborn = self._newborn_of_others(batch, states)
            if newborn.any():
                tests.append(
                    partial(
                        self._explained, newborn, batch, candidates, states, evidence
                    )
                )
        if not tests:
            return None
        return lambda pairs: np.all([test(pairs) for test in tests], axis=0)

    def _newborn_of_others(self, batch: Batch, states: StatesAt) -> BoolArray:
        """True of tracks with one position so far, or up to the stamp, of a list of another sensor, shape (m,).
        The next list of that sensor shows the object again. Until then its velocity is unknown, and the gate wide.
        """
        sensors, own = self._parts.sensors, batch.message.sensor
        first = [
            self._newborn.get(track_id, (own, NEVER)) for track_id in states.track_ids
        ]
        others = [
            name != own and sensors[name].scan and batch.stamp_ns < until_ns
            for name, until_ns in first
        ]
        return np.array(others, dtype=bool)

    def _explained(
        self,
        newborn: BoolArray,
        batch: Batch,
        candidates: Candidates,
        states: StatesAt,
        evidence: Apart | None,
        pairs: Pairs,
    ) -> BoolArray:
        """True of pairs, but of those of `newborn` tracks that clutter or a new object explains better, shape (m,)."""
        result = np.ones(len(pairs.rows), dtype=bool)
        placed = np.array(
            [candidates.placed[row] for row in pairs.rows.tolist()], dtype=bool
        )
        chosen = (newborn[pairs.columns] & placed).nonzero()[0]
        if len(chosen):
            tested, lifecycle = pairs.at(chosen), self._parts.lifecycle
            sensor = self._parts.sensors[batch.message.sensor]
            ids = [states.track_ids[column] for column in tested.columns.tolist()]
            detected = sensor.detection_probability * lifecycle.existing(
                ids, batch.stamp_ns
            )
            odds = detected / (1.0 - detected) if sensor.scan else detected
            others_per_m2 = sensor.clutter_per_m2 / (1.0 - lifecycle.birth_probability)
            more_nis = np.zeros(len(chosen))
            if isinstance(evidence, Evidence):
                more_nis = evidence.nis(tested.rows, tested.columns)
            result[chosen] = explained(
                tested, candidates, states, odds, others_per_m2, more_nis
            )
        return result

    def _evidence(
        self, batch: Batch, candidates: Candidates, states: StatesAt
    ) -> Apart | None:
        described = map(batch.message.objects.__getitem__, candidates.leaders)
        wrong = self._parts.sensors[batch.message.sensor].wrong_id_probability
        return self._parts.objects.evidence(described, states.track_ids, wrong)

    def _facings(self, batch: Batch, states: StatesAt) -> Facings | None:
        """Return the belief about the fronts of the tracks; None where every yaw is taken as it is."""
        facing = self._parts.facing
        return (
            None
            if facing is None
            else facing.at(batch.message.sensor, states.track_ids)
        )

    def _joint(
        self, batch: Batch, candidates: Candidates, states: StatesAt
    ) -> Pairs | None:
        """Probabilities that candidates belong to tracks with enough detections; None where they are not considered."""
        rule = self._parts.joint
        if rule is None or rule.joint_from is None:
            return None
        evidence = self._evidence(batch, candidates, states)
        pairs = rule.gated(candidates, states, evidence, self._facings(batch, states))
        known = np.array(
            [
                self._num_measured[track_id] >= rule.joint_from
                for track_id in states.track_ids
            ]
        )
        sensor = self._parts.sensors[batch.message.sensor]
        return joint_probabilities(
            pairs.at(known[pairs.columns]), candidates, states, sensor
        )

    def _unclaimed(
        self, batch: Batch, candidates: Candidates, new: Sequence[int], states: StatesAt
    ) -> list[int]:
        """Return the indices of `new` candidates that belong to no track which began after the batch's stamp.

        Such a track was started by a newer detection that arrived earlier. Its candidates are too old for it, and are
        no new object. The candidates are compared with the present states of these tracks, moved back to the stamp.
        """
        bank, motion = self._parts.bank, self._parts.motion
        now, back_s = (
            bank.states_at(bank.present_ns),
            seconds(bank.present_ns - batch.stamp_ns),
        )
        now = now.without(self._parts.lifecycle.suspended())
        rows = [
            row
            for row, track_id in enumerate(now.track_ids)
            if track_id not in states.track_ids
        ]
        if not rows:
            return list(new)
        x, F = now.means[rows], motion.jacobian(now.means[rows], -back_s)
        P = propagated(F, now.covariances[rows], motion.process_noise(x, back_s))
        moved = StatesAt(
            tuple(now.track_ids[row] for row in rows), motion.predict(x, -back_s), P
        )
        younger = in_any_direction(
            moved, batch.stamp_ns, self._undirected, self._directed
        )
        claims = self._assigned(batch, candidates.at(new), younger)
        for k, track in claims.pairs:
            self._conclude(
                batch,
                candidates,
                [new[k]],
                Disposition.TOO_OLD,
                younger.track_ids[track],
            )
        self._conclude(
            batch, candidates, [new[k] for k in claims.refused], Disposition.GATED
        )
        return [new[k] for k in claims.new]

    def _is_too_old(self, batch: Batch) -> bool:
        """True if no track could fuse anything of `batch`."""
        return batch.stamp_ns < self._parts.bank.window_start_ns

    def _offered(self, batch: Batch) -> StatesAt:
        """The tracks that `batch` may be associated with, at its stamp."""
        ended = self._parts.lifecycle.suspended(batch.stamp_ns)
        states = self._parts.bank.states_at(batch.stamp_ns).without(ended)
        if not (self._undirected or self._directed):
            return states
        return in_any_direction(
            states, batch.stamp_ns, self._undirected, self._directed
        )

    def _ranges_m(
        self, track_ids: Sequence[int], positions_m: FloatArray, ego: EgoPose | None
    ) -> FloatArray:
        """Distances from the ego to tracks at `positions_m` (n, 2), both at the stamp of the batch."""
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
        """Lives of matched tracks, where it is positions that are seen, and the objects that detections describe."""
        seen = self._seen.setdefault(id(batch.message), set())
        seen.update([states.track_ids[track] for _, track in assignment.pairs])
        self._parts.lifecycle.matched(scan, candidates, assignment.pairs, states)
        if self._parts.objects.describes(scan.objects):
            for position, track in assignment.pairs:
                self._describe(batch, candidates, position, states.track_ids[track])

    def _miss(
        self, batch: Batch, assignment: Assignment, states: StatesAt, scan: Scan
    ) -> None:
        """Lives of missed tracks, where it is positions that are seen; tracks that run out end here.
        A track is missed by a message as a whole, so only its last batch counts. The list may end a track that it has
        matched, where clutter explains the match better. So tracks end after the list has been fused.
        """
        lifecycle, sensor = (
            self._parts.lifecycle,
            self._parts.sensors[batch.message.sensor],
        )
        if (
            not assignment.missed
            or not batch.last
            or not (sensor.gives_position and sensor.scan)
        ):
            return
        seen = self._seen[id(batch.message)]
        rows = [
            track for track in assignment.missed if states.track_ids[track] not in seen
        ]
        if rows:
            missed, positions_m = (
                [states.track_ids[track] for track in rows],
                states.means[rows, :2],
            )
            self._end(
                lifecycle.missed(
                    scan,
                    missed,
                    positions_m,
                    self._ranges_m(missed, positions_m, scan.ego),
                )
            )

    def _estimate(
        self,
        batch: Batch,
        candidates: Candidates,
        assignment: Assignment,
        states: StatesAt,
    ) -> None:
        """Fuse the matched candidates, group by group; the records are in the order of the candidates.
        A group that raises has failed, and what others have fused is recorded whatever happens afterwards.
        """
        outcomes: dict[
            int, tuple[Measurement, UpdateResult]
        ] = {}  # by index of the pair
        chosen, tracks = np.array(assignment.pairs).T
        read: YawsRead | None = None
        try:
            joint = self._joint(batch, candidates, states)
            read = self._read(batch, candidates, assignment, states)
            for group, members, here in candidates.split(chosen):
                with self._guarded_list:
                    for pairs, of, each, ways in _seen(
                        group, members, here, tracks, states, read
                    ):
                        stack = (
                            each
                            if joint is None
                            else equivalent(each, of, group, joint, states, ways)
                        )
                        own = Measurements(stack), of, states
                        results = self._fused(
                            batch.stamp_ns, *own, outcomes, pairs.tolist()
                        )
                        if candidates.placed[chosen[here[0]]]:  # as all others
                            with self._guarded_step:
                                self._placed(*own, results)
        finally:
            failed, leaders = (
                (None, UpdateResult(UpdateStatus.FAILED)),
                candidates.leaders,
            )
            matched = [
                (leaders[position], states.track_ids[track], *outcomes.get(k, failed))
                for k, (position, track) in enumerate(assignment.pairs)
            ]
            words = [None] * len(matched) if read is None else read.words
            self._records.append(
                FusedRecords(batch.message, matched, candidates.merged, words)
            )

    def _read(
        self,
        batch: Batch,
        candidates: Candidates,
        assignment: Assignment,
        states: StatesAt,
    ) -> YawsRead | None:
        """Return the readings of the matched candidates; None where every yaw is taken as it is."""
        facing = self._parts.facing
        if facing is None:
            return None
        pairs, readings = assignment.pairs, assignment.readings
        return facing.read(
            batch.message.sensor, batch.stamp_ns, candidates, pairs, readings, states
        )

    def _fused(
        self,
        stamp_ns: int,
        measurements: Measurements,
        of: IntArray,
        states: StatesAt,
        outcomes: dict[int, tuple[Measurement, UpdateResult]],
        pairs: Sequence[int],
    ) -> list[UpdateResult]:
        """Fuse measurements of the tracks whose states have the indices `of` (m,); note the outcomes of `pairs`."""
        ids = list(map(states.track_ids.__getitem__, of.tolist()))
        results = self._parts.bank.update(stamp_ns, ids, measurements)
        outcomes.update(
            zip(pairs, zip(repeat(measurements.stack), results), strict=True)
        )
        num_measured = self._num_measured
        for track_id, result in zip(ids, results, strict=True):
            if result.innovation is not None:
                num_measured[track_id] += 1
        return results

    def _placed(
        self,
        measurements: Measurements,
        of: IntArray,
        states: StatesAt,
        results: Sequence[UpdateResult],
    ) -> None:
        """Count the fused ones of these measurements, which give positions, for the lives of their tracks."""
        ids = list(map(states.track_ids.__getitem__, of.tolist()))
        fused = [
            row for row, result in enumerate(results) if result.innovation is not None
        ]
        self._parts.lifecycle.fused([ids[row] for row in fused])
        if not (self._newborn or self._directed or self._undirected):
            return
        for row in fused:
            track_id, stamp_ns = ids[row], measurements.stack.stamp_ns
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

    def _give_birth(
        self, batch: Batch, candidates: Candidates, position: int, scan: Scan
    ) -> None:
        """Start a track, if the sensor and the birth rules want one; a track whose start fails leaves nothing."""
        first, track_id = len(self._records), None
        try:
            with self._guarded_birth:
                prior = self._prior(candidates, position, scan)
                if prior is None:
                    self._conclude(batch, candidates, [position], Disposition.GATED)
                    return
                track_id = self._number(scan.objects[candidates.leaders[position]])
                self._parts.bank.birth(track_id, prior)
                if self._parts.bank.holds(track_id):
                    self._begin(track_id, batch, candidates, position, scan, prior)
                    self._conclude(
                        batch, candidates, [position], Disposition.BIRTH, track_id
                    )
        finally:
            if len(self._records) == first:
                self._conclude(batch, candidates, [position], Disposition.FAILED)
                self._end([] if track_id is None else [track_id])

    def _prior(self, candidates: Candidates, position: int, scan: Scan) -> Start | None:
        """Return the state that a track begins with; None where the candidate may start no track."""
        parts, candidate = self._parts, candidates[position]
        if not parts.sensors[scan.sensor].births:
            return None
        if parts.objects.is_stray(
            scan.objects[candidate.leader], (scan.sensor, scan.stamp_ns)
        ):
            return None
        return parts.birth.prior(
            candidate, parts.road, parts.ego.current, parts.ego.in_pit
        )

    def _number(self, detection: Detection) -> int:
        """Return the number of a new track. A former track with the identity of `detection` passes on its number."""
        track_id = self._parts.objects.former(detection)
        if track_id is None:
            self._next_id += 1
            return self._next_id - 1
        if track_id in self._num_measured:  # lost
            self._parts.objects.id_conflicts["reused"] += 1
            self._end([track_id])
        return track_id

    def _begin(
        self,
        track_id: int,
        batch: Batch,
        candidates: Candidates,
        position: int,
        scan: Scan,
        prior: Start,
    ) -> None:
        """Note what the tracker keeps of a track that the bank has started."""
        if prior.yaw_rad is None and not self._parts.motion.cartesian:
            self._undirected[track_id] = prior
        self._seen.setdefault(id(batch.message), set()).add(track_id)
        self._num_measured[track_id] = 1
        self._newborn[track_id] = scan.sensor, FOREVER
        if self._parts.facing is not None:
            self._parts.facing.born(
                track_id, scan.sensor, prior, candidates[position].measurement
            )
        self._parts.lifecycle.born(track_id, scan, candidates[position])
        self._describe(batch, candidates, position, track_id)

    def _describe(
        self, batch: Batch, candidates: Candidates, position: int, track_id: int
    ) -> None:
        leader = candidates.leaders[position]
        indices = leader, *candidates.merged.get(leader, ())
        self._parts.objects.learn(
            track_id, map(batch.message.objects.__getitem__, indices)
        )

    def _conclude(
        self,
        batch: Batch,
        candidates: Candidates,
        positions: Sequence[int],
        disposition: Disposition,
        track_id: int | None = None,
    ) -> None:
        """Record the outcome of candidates, and of the detections that were merged into them."""
        for leader in map(candidates.leaders.__getitem__, positions):
            own = record(batch.message, leader, disposition, track_id)
            self._records.append(
                (
                    own,
                    *merged_records(
                        batch.message, candidates.merged.get(leader, ()), track_id
                    ),
                )
            )

    def _end(self, track_ids: Sequence[int]) -> None:
        """End tracks. A track whose end raises is forgotten as well, and the remaining tracks still end."""
        for track_id in track_ids:
            self._undirected.pop(track_id, None)
            self._directed.pop(track_id, None)
            self._newborn.pop(track_id, None)
            self._num_measured.pop(track_id, None)
            parts = self._parts
            facing = () if parts.facing is None else (parts.facing.forget,)
            for forget in (
                parts.bank.remove,
                parts.objects.forget,
                *facing,
                parts.lifecycle.forget,
            ):
                with self._guarded_step:
                    forget(track_id)

    def _reports(
        self, track_ids: Sequence[int], states: Sequence[TrackState]
    ) -> Callable[[], Iterable[TrackReport]]:
        """Return a factory of track reports; status, probability and counters are captured now."""
        parts = self._parts
        statuses, probabilities = parts.lifecycle.reported(track_ids)
        num_measured = list(map(self._num_measured.__getitem__, track_ids))
        objects = parts.objects.reports(track_ids)
        return partial(
            map,
            TrackReport,
            track_ids,
            statuses,
            states,
            num_measured,
            objects,
            probabilities,
        )


def _seen(
    group: Group,
    members: IntArray,
    here: IntArray,
    tracks: IntArray,
    states: StatesAt,
    read: YawsRead | None,
) -> Iterator[tuple[IntArray, IntArray, Measurement, IntArray | None]]:
    """Yield the measurements of the `members` of a group, whose pairs have the indices `here`, as they are `read`.
    `tracks` are those of all pairs. Each stack comes with the indices of its pairs, their tracks and readings.
    """
    of = tracks.take(here)
    each = group.seen_at(members, states.means.take(of, axis=0), states.covariances, of)
    if read is None:
        yield here, of, each, None
        return
    ways = read.readings[here]
    for rows, part in as_read(each, ways):
        yield here[rows], of[rows], part, ways[rows]

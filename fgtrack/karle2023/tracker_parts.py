"""Defects of the published tracker of Karle et al. 2023, each as a separate component."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import (
    BoolArray,
    DetectionList,
    Disposition,
    EgoState,
    FloatArray,
    IntArray,
    TickReport,
    UpdateRecord,
)
from fgtrack.estimation.base import StatesAt
from fgtrack.karle2023.filter_defects import published_yaw
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.association import (
    Assignment,
    Association,
    AssociationProblem,
    assigned,
    near,
)
from fgtrack.tracking.detections import ConnectedMerge, Merge, PosedBatch
from fgtrack.tracking.ego.trajectory import EgoPose, EgoStd, EgoTrajectory
from fgtrack.tracking.inbox import Batch, Inbox, is_valid_covariance, record, records
from fgtrack.tracking.lives.counters import (
    COUNTER,
    LAST_SEEN,
    MISSES,
    CountingLifecycle,
    Scan,
)
from fgtrack.tracking.lives.latency import FOREVER
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Candidate, Candidates, Preprocessed
from fgtrack.tracking.tracker import MultiObjectTracker


class PublishedEgo(EgoTrajectory):
    """Ego storage with one entry per tick and a repeated low-pass (defect Q13).

    The nearest entry replaces interpolation. On every tick without a new message, the
    low-pass filters its own output again.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *EgoTrajectory.STATE,
        "_stored",
    )

    _straight = True

    def __init__(
        self,
        yaw_weight: float,
        yaw_rate_weight: float,
        step_ns: int,
        storage_ticks: int,
        std: EgoStd | None = None,
    ) -> None:
        super().__init__(yaw_weight, yaw_rate_weight, std)
        self._half_step_ns = step_ns / 2
        self._length = storage_ticks
        self._stored: list[EgoState] = []  # newest last

    def _store(self, ego: EgoState) -> str | None:
        """See `EgoTrajectory._store`."""
        if self.current is not None and ego.stamp_ns == self.current.stamp_ns:
            return "repeated stamp"
        self.current = ego
        return None

    def start_tick(self) -> None:
        """Store the current state, low-passed against the entry before it.

        If its stamp is already stored, the yaw and the yaw rate of the stored entry are
        low-passed again.
        """
        if self.current is None:
            return
        newest = self._stored[-1] if self._stored else None
        if newest is None or newest.stamp_ns != self.current.stamp_ns:
            if newest is not None:
                self.current = self._low_passed(
                    self.current, newest.yaw_rad, newest.yaw_rate_radps
                )
            self._stored.append(self.current)
            del self._stored[: -self._length]
        elif len(self._stored) > 1:
            before = self._stored[-2]
            filtered = self._low_passed(
                self.current, before.yaw_rad, before.yaw_rate_radps
            )
            refiltered = replace(
                newest, yaw_rad=filtered.yaw_rad, yaw_rate_radps=filtered.yaw_rate_radps
            )
            if newest is self.current:
                self.current = refiltered
            self._stored[-1] = refiltered

    def pose_at(self, stamp_ns: int, present_ns: int) -> EgoPose | None:
        """See `EgoTrajectory.pose_at`; extrapolates from the nearest entry, at any distance in time."""
        if self.current is None:
            return None
        if present_ns - stamp_ns <= self._half_step_ns:
            return self._extrapolated(self.current, stamp_ns)
        nearest = min(
            reversed(self._stored), key=lambda ego: abs(ego.stamp_ns - stamp_ns)
        )
        return self._extrapolated(nearest, stamp_ns)


class SlotInbox(Inbox):
    """Inbox with a single slot per sensor (defect Q12).

    A second message within a tick overwrites the first one. A repeated stamp empties
    the slot. The mean of object stamps is computed in floating point.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *Inbox.STATE,
        "_last_stamp_ns",
    )

    def __init__(self, sensors: Mapping[str, SensorModel]) -> None:
        super().__init__(sensors)
        self._last_stamp_ns: dict[str, int] = {}

    def put(self, message: DetectionList) -> list[UpdateRecord]:
        """See `Inbox.put`."""
        sensor = self._sensors[message.sensor]
        stamp_ns = (
            _float_stamp(message)
            if sensor.stamp_from == "objects_mean"
            else message.stamp_ns
        )
        if self._last_stamp_ns.get(message.sensor) == stamp_ns:
            return self._note(message, records(message, Disposition.DUPLICATE), [])
        delay_ns = message.receipt_ns - stamp_ns
        if sensor.max_delay_s is not None and delay_ns > nanoseconds(
            sensor.max_delay_s
        ):
            return self._note(message, records(message, Disposition.TOO_OLD), None)
        kept = []
        ended = []
        broken = False
        for index, detection in enumerate(message.objects):
            values = [getattr(detection, name) for name in sensor.components]
            if (detection.x_m or 0.0) == 0.0 and (detection.y_m or 0.0) == 0.0:
                ended.append(record(message, index, Disposition.INVALID))
            elif all(
                value is not None and abs(value) <= LARGEST for value in values
            ) and is_valid_covariance(detection, sensor):
                kept.append(index)
            else:
                broken = True
                ended.append(record(message, index, Disposition.INVALID))
        if broken and not kept:
            return self._note(message, ended, [])
        return self._note(message, ended, [Batch(message, stamp_ns, tuple(kept))])

    def _note(
        self,
        message: DetectionList,
        ended: list[UpdateRecord],
        slot: list[Batch] | None,
    ) -> list[UpdateRecord]:
        """Store the batch of a `message`, and return the records of detections that end here.

        `slot` becomes the content of the sensor's slot: the batch, or an empty list. Detections that it replaces are
        superseded. None leaves the slot as it is. `ended` are records of detections of the message itself.
        """
        pending, last_ns = self.pending, self._last_stamp_ns
        if slot is not None:
            former = [each for each in pending if each.message.sensor == message.sensor]
            ended = [
                record(batch.message, index, Disposition.SUPERSEDED)
                for batch in former
                for index in batch.indices
            ] + ended
            others = [each for each in pending if each.message.sensor != message.sensor]
            pending = others + slot
        for batch in slot or ():
            last_ns = {**last_ns, message.sensor: batch.stamp_ns}
        all_ended = [*self.ended, ended]
        self.pending, self.ended, self._last_stamp_ns, self.received = (
            pending,
            all_ended,
            last_ns,
            message,
        )
        return ended

    def due(
        self, now_ns: int = 0, waits: Callable[[Batch, int], bool] | None = None
    ) -> tuple[list[Batch], list[Batch]]:
        """See `Inbox.due`; equal stamps keep the order of the sensors, and no batch waits."""
        order = list(self._sensors)
        return sorted(
            self.pending,
            key=lambda batch: (batch.stamp_ns, order.index(batch.message.sensor)),
        ), []


def _float_stamp(message: DetectionList) -> int:
    """Mean of the object stamps in float64, with a resolution of 256 ns for present dates."""
    if not message.objects:
        return message.stamp_ns
    stamps = [
        message.stamp_ns if item.stamp_ns is None else item.stamp_ns
        for item in message.objects
    ]
    return int(np.mean(np.array(stamps, dtype=np.int64)))


@dataclass(frozen=True)
class NeighbourhoodMerge(Merge):
    """Merging of each distinct neighbourhood into one object (defect Q11).

    Neighbourhoods may overlap: there is no transitive closure. The yaw is averaged as a
    plain number, even across its jump.
    """

    kind: Literal["neighbourhood"] = "neighbourhood"
    distance_m: float = 5.1
    """Detections at most this far apart are neighbours."""

    def apart(self, points_m: FloatArray, starts: IntArray) -> list[bool]:
        """See `Merge.apart`."""
        return ConnectedMerge(self.distance_m).apart(points_m, starts)

    def groups(self, points_m: FloatArray) -> dict[int, tuple[int, ...]]:
        """See `Merge.groups`; merged groups come first, in the iteration order of a set of index tuples."""
        from scipy.spatial import cKDTree

        tree = cKDTree(points_m)
        neighbourhoods = [
            tuple(
                int(i)
                for i in tree.query_ball_point(
                    point, self.distance_m, return_sorted=True
                )
            )
            for point in points_m
        ]
        merged = {members for members in neighbourhoods if len(members) > 1}
        groups = {neighbourhoods.index(members): members for members in merged}
        return groups | {
            i: members for i, members in enumerate(neighbourhoods) if len(members) == 1
        }

    def mean(self, name: str, values: FloatArray) -> float:
        """See `Merge.mean`."""
        if name == "yaw_rad":
            values = published_yaw(values)
        return float(values.sum() / len(values))


@dataclass(frozen=True)
class UngatedEuclidean(Association):
    """Hungarian assignment over all pairs, gated only afterwards (defect Q10).

    A pair beyond the gate is split. Both partners then stay unassigned, even if a good
    second choice existed.
    """

    kind: Literal["ungated_euclidean"] = "ungated_euclidean"
    gate_m: float = 5.0
    """Largest distance of an accepted pair."""

    @property
    def reads_yaws(self) -> bool:
        """See `Association`."""
        return False

    def assign(self, problem: AssociationProblem) -> Assignment:
        """See `Association.assign`; pairs that are `apart` are not excluded.

        Detections of split pairs come after the detections without a partner.
        """
        candidates, states = problem.candidates, problem.states
        pairs = near(candidates, states.means, np.inf)
        rows, columns, distances_m = (array.tolist() for array in pairs)
        cost = dict(zip(zip(rows, columns, strict=True), distances_m, strict=True))
        assignment = assigned(pairs, len(candidates), len(states.means))
        split = [pair for pair in assignment.pairs if cost[pair] > self.gate_m]
        good = [pair for pair in assignment.pairs if pair not in split]
        missed = sorted(assignment.missed + [j for _, j in split])
        return Assignment(good, assignment.new + [i for i, _ in split], missed)


class PublishedLifecycle(CountingLifecycle):
    """Counting lifecycle of the published implementation (defects Q9 and Q15).

    - Only sensors with a range in `ages` age a track, each at its range.
    - Time counts only when a list arrives.
    - The counter may exceed its cap.
    - A birth has the time of the tick, and a match has the stamp of the sensor.

    The range belongs to the state one batch earlier; see `PublishedTracker`.
    """

    def born(self, track_id: int, scan: Scan, candidate: Candidate) -> None:
        """See `CountingLifecycle.born`."""
        super().born(track_id, scan._replace(stamp_ns=scan.present_ns), candidate)

    def matched(
        self,
        scan: Scan,
        candidates: Candidates,
        pairs: Sequence[tuple[int, int]],
        states: StatesAt,
    ) -> None:
        """See `CountingLifecycle.matched`."""
        for row in self._rows.of([states.track_ids[track] for _, track in pairs]):
            counters = self._arrays[0][row]
            if counters[COUNTER] < self._rules.counter_cap:
                counters[COUNTER] += self._sensors[scan.sensor].counter_add
            counters[LAST_SEEN], counters[MISSES] = scan.stamp_ns, 0

    def _ages(self, sensor: str, ranges_m: FloatArray) -> BoolArray:
        if self._sensors[sensor].ages == "always":
            return np.zeros(len(ranges_m), dtype=bool)
        return super()._ages(sensor, ranges_m)

    def _ends(self, rows: IntArray, scan: Scan) -> BoolArray:
        counters = self._arrays[0][rows]
        is_old = scan.present_ns - counters[:, LAST_SEEN] > self._forget_ns
        return np.asarray((counters[:, COUNTER] <= 0) | is_old)

    def expired(
        self,
        present_ns: int,
        watermarks_ns: IntArray | None = None,
        processed_ns: int = FOREVER,
    ) -> list[int]:
        """See `CountingLifecycle.expired`; always empty, as tracks end only when a list arrives."""
        return []


class PublishedTracker(MultiObjectTracker):
    """Tracker with the processing order of the published implementation (defects Q9 and Q22).

    A list older than the storage still starts tracks. An empty list ages every track. A
    track ages by its range: the distance from the present ego to an earlier position of
    the track. That position was known after the previous batch, or at the end of the
    previous tick.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *MultiObjectTracker.STATE,
        "_last_known",
    )

    def __init__(self, parts: TrackerParts) -> None:
        super().__init__(parts)
        self._last_known: dict[int, FloatArray] = {}

    def tick(self, now_ns: int, is_last: bool = False) -> TickReport:
        """See `MultiObjectTracker.tick`."""
        report = super().tick(now_ns, is_last)
        self._remember()
        return report

    def _process(self, posed: PosedBatch, preprocessed: Preprocessed | None) -> None:
        super()._process(posed, preprocessed)
        self._remember()

    def _remember(self) -> None:
        states = self._parts.bank.states_at(self._parts.bank.present_ns)
        self._last_known = dict(zip(states.track_ids, states.means[:, :2], strict=True))

    def _is_too_old(self, batch: Batch) -> bool:
        return False

    def _offered(self, batch: Batch) -> StatesAt:
        if batch.indices:
            return super()._offered(batch)
        return self._parts.bank.states_at(self._parts.bank.present_ns)

    def _ranges_m(
        self, track_ids: Sequence[int], positions_m: FloatArray, ego: EgoPose | None
    ) -> FloatArray:
        current = self._parts.ego.current
        if current is None:
            return np.zeros(len(track_ids))
        known = np.array([self._last_known[track_id] for track_id in track_ids])
        return np.asarray(
            np.hypot(known[:, 0] - current.x_m, known[:, 1] - current.y_m)
        )

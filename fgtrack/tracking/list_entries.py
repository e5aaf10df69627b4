"""Object lists made ready for decisions, and made once more when the ego's pose is known better."""

from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import numpy as np

from fgtrack.core.state import Stateful
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import EgoState
from fgtrack.tracking.decisions.entries import Entry, Starts
from fgtrack.tracking.decisions.history import Decisions
from fgtrack.tracking.detections import PosedBatch
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.ego.waiting import places, range_of
from fgtrack.tracking.inbox import Batch
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.parts import TrackerParts
from fgtrack.tracking.preprocess import Candidates

_LARGEST_SCORE = 10.0
_KEPT_NS = nanoseconds(10.0)  # no error of an extrapolated pose is shared for longer


class ListEntries(Stateful):
    """Makes lists ready for decisions.

    The pose of a list depends on the ego's states and on the stamps of the lists, and on no order of arrival. It is
    final once the ego has a state at or after the stamp.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_extrapolated_ns",)

    def __init__(self, parts: TrackerParts, decisions: Decisions) -> None:
        self._parts, self._decisions = parts, decisions
        self._indices = {name: k for k, name in enumerate(parts.sensors)}
        self._always = (
            parts.birth.ego_speed_factor != 0.0
            or parts.birth.slow_ego_mps > 0.0
            or any(
                each.gives_position and each.has_view_limits
                for each in parts.sensors.values()
            )
        )
        # Stamps of the lists with extrapolated poses that are decided for good.
        self._extrapolated_ns = deque[int]()

    def made(self, posed: PosedBatch, candidates: Candidates) -> Entry:
        """Return a list ready for decisions."""
        parts, batch, sensor = self._parts, posed.batch, posed.sensor
        message = batch.message
        scan = Scan(
            message.sensor,
            batch.stamp_ns,
            parts.bank.present_ns,
            posed.ego,
            message.objects,
        )
        scores = np.zeros(len(candidates))
        if sensor.score is not None:
            for position in range(len(candidates)):
                own = [
                    each.score
                    for each in candidates.described(batch, position)
                    if each.score is not None
                ]
                if own:
                    score = (max(own) - sensor.score.even) / sensor.score.scale
                    scores[position] = min(max(score, -_LARGEST_SCORE), _LARGEST_SCORE)
        return Entry(
            batch,
            candidates,
            scan,
            sensor,
            self._indices[message.sensor],
            self._decisions.motion,
            scores,
            np.array(candidates.placed, dtype=bool) & sensor.births,
            self._starts(batch.stamp_ns, posed.ego),
        )

    def _starts(self, stamp_ns: int, pose: EgoPose | None) -> Starts:
        """Return what first states depend on at a stamp."""
        parts, ego = self._parts, None
        if pose is not None:
            accel_mps2 = parts.ego.accel_at(stamp_ns)
            ego = EgoState(stamp_ns, stamp_ns, *pose[:5], accel_mps2=accel_mps2)
        return Starts(parts.birth, parts.road, ego, parts.ego.in_pit_at(stamp_ns))

    def again(self, entry: Entry) -> Entry | None:
        """Return a list with the pose as it is known now; None if nothing has changed."""
        if not self._depends_on_ego(entry.batch):
            return None
        posed = self.posed(entry.batch)
        pose, known = posed.ego, entry.scan.ego
        if pose is None or (
            _is_same(pose, known)
            and entry.starts == self._starts(entry.batch.stamp_ns, pose)
        ):
            return None
        result = self.made(posed, self._parts.preprocess.together([posed])[0][0])
        roots = dict(zip(entry.candidates.leaders, entry.roots, strict=True))
        result.roots = [roots.get(leader, -1) for leader in result.candidates.leaders]
        result.roots = [
            self._decisions.next_root() if root < 0 else root for root in result.roots
        ]
        return result

    def posed(self, batch: Batch) -> PosedBatch:
        """Return a list with the pose as it is known now."""
        parts, sensor = self._parts, self._parts.sensors[batch.message.sensor]
        present_ns = parts.bank.present_ns
        if places(batch, sensor):
            range_m, others_ns = partial(range_of, batch), self._others_ns(batch)
            ego = parts.ego.placed(batch.stamp_ns, present_ns, range_m, others_ns)
        else:
            ego = parts.ego.pose_at(batch.stamp_ns, present_ns)
        return parts.preprocess.posed(batch, sensor, ego)

    def _depends_on_ego(self, batch: Batch) -> bool:
        """True if decisions about a list depend on the ego's pose."""
        return self._always or places(batch, self._parts.sensors[batch.message.sensor])

    def _others_ns(self, batch: Batch) -> Sequence[int]:
        """Return the stamps of the older lists that were placed by extrapolated poses."""
        older = [
            each.batch.stamp_ns
            for each in self._decisions.entries
            if each.batch.stamp_ns < batch.stamp_ns and _is_extrapolated(each)
        ]
        return [*self._extrapolated_ns, *older]

    def is_open(self, entry: Entry) -> bool:
        """True for a list whose pose may change without a new state of the ego."""
        return entry.scan.ego is None or entry.scan.ego.extrapolated_s != 0.0

    def settle(self, entry: Entry) -> None:
        """Record that the decisions about a list are final."""
        if _is_extrapolated(entry) and places(entry.batch, entry.sensor):
            self._extrapolated_ns.append(entry.batch.stamp_ns)
            while entry.batch.stamp_ns - self._extrapolated_ns[0] > _KEPT_NS:
                self._extrapolated_ns.popleft()


def _is_extrapolated(entry: Entry) -> bool:
    return entry.scan.ego is not None and entry.scan.ego.extrapolated_s != 0.0


def _is_same(first: EgoPose, second: EgoPose | None) -> bool:
    """True for two equal poses."""
    if second is None or first[:5] != second[:5]:
        return False
    P, R = first.covariance, second.covariance
    return P is R or (P is not None and R is not None and np.array_equal(P, R))

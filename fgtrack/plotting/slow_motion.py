"""One late detection in slow motion: a track just before it and just after it, now and at the stamps before."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import DetectionList, Disposition, EgoState, FloatArray, IntArray, UpdateRecord
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.inbox import Batch
from fgtrack.tracking.preprocess import Candidate, Preprocess
from fgtrack.tracking.tracker import Tracker, TrackerParts

BACK_S = 0.15
"""How long before the detection the states begin."""
STEP_S = 0.01
"""Between states; that of the grid of the backward-forward EKF, whose states are held in between."""
_FUSED = (Disposition.IN_SEQUENCE, Disposition.OUT_OF_SEQUENCE, Disposition.BEYOND_WINDOW)


@dataclass(frozen=True, slots=True)
class Arrival:
    """A detection by where it is found: its list, and its place there."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    index: int

    def is_in(self, message: object) -> bool:
        """Whether `message` is the list."""
        return isinstance(message, DetectionList) and self.key == (message.sensor, message.receipt_ns)

    @property
    def key(self) -> tuple[str, int]:
        """Sensor and receipt of the list."""
        return self.sensor, self.receipt_ns

    def __str__(self) -> str:
        return f"detection {self.index} of {self.sensor} received at {self.receipt_ns} ns"


@dataclass(frozen=True)
class Estimates:
    """Estimates of one track at several stamps."""

    stamps_ns: IntArray
    """Rising, shape (m,); the last one is the present."""
    means: FloatArray
    """x, y, yaw, speed, yaw rate[, acceleration], shape (m, n)."""
    covariances: FloatArray
    """Shape (m, n, n)."""

    def at(self, stamp_ns: int) -> int:
        """Row of the stamp nearest to `stamp_ns`."""
        return int(np.abs(self.stamps_ns - stamp_ns).argmin())


@dataclass(frozen=True)
class CloseUp:
    """A late detection, and a track before and after it was fused."""

    arrival: Arrival
    now_ns: int
    """Time of the tick at which it came in."""
    track_id: int
    position_m: FloatArray
    """Where the detection says that the object is, in the map, shape (2,)."""
    position_covariance: FloatArray
    """Shape (2, 2)."""
    before: Estimates
    after: Estimates
    fused: tuple[UpdateRecord, ...]
    """What the track had fused from `BACK_S` before the detection on, without it, by rising stamp."""
    rule: str = ""
    """By what rule the detection was chosen, in a sentence."""


def close_up(
    build: Callable[[Callable[[TrackerParts], TrackerParts]], Tracker],
    ticks: Iterable[tuple[int, Sequence[EgoState | DetectionList]]],
    arrival: Arrival,
) -> CloseUp:
    """Run a tracker up to the tick of `arrival`, and look at its track before and after.

    What came with the same tick before the list is processed first, by itself; what came after it is left out.

    Parameters
    ----------
    build
        Makes the tracker; its argument may replace parts, as that of `build_tracker`.
    ticks
        Time of every tick, and the messages that arrived since the one before.
    arrival
        The detection.

    Raises
    ------
    DataError
        There is no such detection, it has no position, or no track fused it.
    """
    watched: list[_Watched] = []

    def observed(parts: TrackerParts) -> TrackerParts:
        watched.append(_Watched(parts.preprocess, arrival))
        return replace(parts, preprocess=watched[0])

    tracker, records = build(observed), list[UpdateRecord]()
    for now_ns, messages in ticks:
        place = next((k for k, message in enumerate(messages) if arrival.is_in(message)), None)
        for message in messages[:place]:
            tracker.receive(message)
        report = tracker.tick(now_ns)
        records += [one for one in report.updates if one.disposition in _FUSED]
        if place is None:
            continue
        start_ns = arrival.stamp_ns - nanoseconds(BACK_S)
        span_ns = start_ns, arrival.stamp_ns, now_ns
        before = {one.track_id: _estimates(tracker, one.track_id, *span_ns) for one in report.tracks}
        tracker.receive(messages[place])
        found = [
            one for one in tracker.tick(now_ns).updates if (one.sensor, one.index) == (arrival.sensor, arrival.index)
        ]
        taken = next((one for one in found if one.receipt_ns == arrival.receipt_ns), None)
        candidate = watched[0].candidate
        if taken is None or taken.disposition not in _FUSED or taken.track_id not in before:
            raise DataError(f"{arrival}: no track has fused it ({taken.disposition if taken else 'no such detection'})")
        if candidate is None or candidate.position_m is None or candidate.position_covariance is None:
            raise DataError(f"{arrival}: it has no position to draw")
        fused = [one for one in records if one.track_id == taken.track_id and one.stamp_ns >= start_ns]
        return CloseUp(
            arrival,
            now_ns,
            taken.track_id,
            candidate.position_m,
            candidate.position_covariance,
            before[taken.track_id],
            _estimates(tracker, taken.track_id, *span_ns),
            tuple(sorted(fused, key=lambda one: one.stamp_ns)),
        )
    raise DataError(f"{arrival}: there is no such list")


class _Watched(Preprocess):
    """Another `Preprocess`; remembers what became of one detection."""

    def __init__(self, watched: Preprocess, arrival: Arrival) -> None:
        self._watched = watched
        self._arrival = arrival
        self.candidate: Candidate | None = None

    def __call__(
        self, batch: Batch, sensor: SensorModel, ego: EgoPose | None
    ) -> tuple[list[Candidate], list[UpdateRecord]]:
        candidates, records = self._watched(batch, sensor, ego)
        if self._arrival.is_in(batch.message):
            mine = [one for one in candidates if one.index == self._arrival.index]
            self.candidate = mine[0] if mine else self.candidate
        return candidates, records


def _estimates(tracker: Tracker, track_id: int, start_ns: int, sensed_ns: int, now_ns: int) -> Estimates:
    """States every `STEP_S` from `start_ns`, or where the track's window begins, to `now_ns`, and at `sensed_ns`."""
    found = []
    for stamp_ns in sorted({*range(now_ns, start_ns - 1, -nanoseconds(STEP_S)), sensed_ns}, reverse=True):
        try:
            found.append(tracker.state_at(track_id, stamp_ns).state)
        except CallError:  # before its window
            break
    found.reverse()
    stamps_ns = np.array([state.stamp_ns for state in found], dtype=np.int64)
    return Estimates(stamps_ns, np.array([state.mean for state in found]), np.array([s.covariance for s in found]))

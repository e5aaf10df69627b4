"""Detections on their way from receipt to the tick that processes them."""

import marshal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import compress
from operator import attrgetter
from typing import Protocol

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Detection, DetectionList, Disposition, FloatArray, Frame, UpdateRecord
from fgtrack.models.sensors import SensorModel

#: In any unit: no sensor is better than this.
SMALLEST_STD = 1e-6
#: Of the standard deviations' product: what rounding a covariance to single precision may leave.
ASYMMETRY = 1e-6


@dataclass(frozen=True, slots=True)
class Batch:
    """The usable detections of one message, at the stamp that they are processed at."""

    message: DetectionList
    stamp_ns: int
    indices: tuple[int, ...]
    """Positions, in the message, of the detections to process."""
    last: bool = True
    """True for the newest batch of its message; only detections with stamps of their own make several."""

    @property
    def sensor(self) -> str:
        """Name of the sensor."""
        return self.message.sensor

    @property
    def frame(self) -> Frame:
        """Frame that the detections are given in."""
        return self.message.frame


def record(
    message: DetectionList,
    index: int,
    disposition: Disposition,
    track_id: int | None = None,
    nis: float | None = None,
    innovation: Mapping[str, float] | None = None,
) -> UpdateRecord:
    """Return the record of detection `index` of `message`."""
    stamp_ns = message.objects[index].stamp_ns
    return UpdateRecord(
        message.sensor,
        message.stamp_ns if stamp_ns is None else stamp_ns,
        message.receipt_ns,
        index,
        disposition,
        track_id,
        nis,
        innovation or {},
    )


def records(message: DetectionList, disposition: Disposition) -> list[UpdateRecord]:
    """The same disposition for every detection of `message`."""
    return [record(message, index, disposition) for index in range(len(message.objects))]


class Inbox(Protocol):
    """Receives messages, and gives them out at the tick."""

    def put(self, message: DetectionList) -> list[UpdateRecord]:
        """Receive a message; the records of detections that end here."""

    def collect(self) -> list[Batch]:
        """Everything received since the last call, oldest stamp first."""


def is_usable(detection: Detection, sensor: SensorModel) -> bool:
    """True if `detection` has valid values and a position or bearing, and is not an empty slot (x = y = 0)."""
    measured = {name: value for name in sensor.std if (value := getattr(detection, name)) is not None}
    if not all(map(is_bounded, measured.values())) or not is_covariance(detection, sensor):
        return False
    if detection.x_m == 0.0 and detection.y_m == 0.0:
        return False
    if "x_m" in measured or "y_m" in measured:
        return "x_m" in measured and "y_m" in measured
    return "bearing_rad" in measured


def is_bounded(value: float) -> bool:
    """True if `value` is finite and at most `LARGEST`."""
    return abs(value) <= LARGEST


def own_covariance(detection: Detection, names: Sequence[str]) -> FloatArray:
    """Covariance of the components `names` that `detection` carries, shape (k, k)."""
    measured = detection.measured
    places = [measured.index(name) for name in names]
    return np.array(detection.covariance).reshape(len(measured), len(measured))[np.ix_(places, places)]


def is_covariance(detection: Detection, sensor: SensorModel) -> bool:
    """True if the covariance of `detection` is not used, or is symmetric positive definite."""
    if detection.covariance is None or not sensor.message_covariance:
        return True
    measured = detection.measured
    if len(detection.covariance) != len(measured) ** 2:
        return False
    own = own_covariance(detection, [name for name in measured if name in sensor.std])
    variances = np.diag(own)
    if not np.all((np.abs(own) <= LARGEST**2) & (variances[:, None] >= SMALLEST_STD**2)):
        return False
    deviations = np.sqrt(variances)
    if not np.all(np.abs(own - own.T) <= ASYMMETRY * np.outer(deviations, deviations)):
        return False
    try:
        np.linalg.cholesky(own)
    except np.linalg.LinAlgError:
        return False
    return True


def stamps(message: DetectionList, sensor: SensorModel) -> list[int]:
    """Stamp of every detection of `message`: the list's, its own, or the mean of those that have one."""
    own = [detection.stamp_ns for detection in message.objects]
    known = [stamp_ns for stamp_ns in own if stamp_ns is not None]
    if sensor.stamp_from == "objects_mean" and known:
        return [sum(known) // len(known)] * len(own)
    if sensor.stamp_from == "object":
        return [message.stamp_ns if stamp_ns is None else stamp_ns for stamp_ns in own]
    return [message.stamp_ns] * len(own)


_values = attrgetter(*(each.name for each in fields(Detection)))


def _contents(objects: Sequence[Detection]) -> int:
    """Hash of the detections in any order. It is that of their bits, for NaN equals nothing, and hash(-1) hash(-2)."""
    try:
        values = [marshal.dumps(_values(one), 2) for one in objects]  # 2: without references to what is shared
    except ValueError:  # numbers of other libraries
        values = [repr(_values(one)).encode() for one in objects]
    return hash((len(objects), *sorted(values)))


class _Seen:
    """Lists that were received not long ago, by sensor, stamp and contents."""

    def __init__(self, memory_ns: int) -> None:
        self._memory_ns = memory_ns
        self._receipts_ns: dict[tuple[str, int, Frame, int], int] = {}  # in order of receipt

    def is_copy(self, message: DetectionList, usable: Sequence[bool]) -> bool:
        """True if `message` repeats one that is remembered; it is remembered from now on.

        Those that are not `usable` are not compared, nor is their order.
        """
        if message.objects and not any(usable):
            return False
        oldest_ns = message.receipt_ns - self._memory_ns
        while self._receipts_ns and self._receipts_ns[first := next(iter(self._receipts_ns))] < oldest_ns:
            del self._receipts_ns[first]
        contents = message.objects if all(usable) else tuple(compress(message.objects, usable))
        key = (message.sensor, message.stamp_ns, message.frame, _contents(contents))
        if key in self._receipts_ns:
            return True
        self._receipts_ns[key] = message.receipt_ns
        return False


class QueueInbox:
    """Keeps every message. Refuses repeated, too late and future ones, and single detections that are no detections."""

    def __init__(self, sensors: Mapping[str, SensorModel], max_future_s: float = 1.0, memory_s: float = 10.0) -> None:
        """`memory_s`: how long a list is remembered; at least as long as a sensor's list may take."""
        self._sensors = sensors
        self._max_future_ns = nanoseconds(max_future_s)
        longest_s = max((each.max_delay_s or 0.0 for each in sensors.values()), default=0.0)
        self._seen = _Seen(nanoseconds(max(memory_s, longest_s)))
        self._pending: list[Batch] = []

    def put(self, message: DetectionList) -> list[UpdateRecord]:
        """See `Inbox.put`; a message is repeated if an earlier one of the sensor had its stamp and contents."""
        sensor = self._sensors[message.sensor]
        usable = [is_usable(detection, sensor) for detection in message.objects]
        if self._seen.is_copy(message, usable):
            return records(message, Disposition.DUPLICATE)
        ended: list[UpdateRecord] = []
        kept: dict[int, list[int]] = {} if message.objects else {message.stamp_ns: []}
        stamps_ns = stamps(message, sensor)
        refusals = {stamp_ns: self._refusal(message, sensor, stamp_ns) for stamp_ns in set(stamps_ns)}
        for index, stamp_ns in enumerate(stamps_ns):
            refusal = refusals[stamp_ns] if usable[index] else Disposition.INVALID
            if refusal is None:
                kept.setdefault(stamp_ns, []).append(index)
            else:
                ended.append(record(message, index, refusal))
        newest_ns = max(kept, default=0)
        self._pending += [
            Batch(message, stamp_ns, tuple(indices), last=stamp_ns == newest_ns) for stamp_ns, indices in kept.items()
        ]
        return ended

    def _refusal(self, message: DetectionList, sensor: SensorModel, stamp_ns: int) -> Disposition | None:
        if stamp_ns - message.receipt_ns > self._max_future_ns:
            return Disposition.INVALID
        limit_s = sensor.max_delay_s
        if limit_s is not None and message.receipt_ns - stamp_ns > nanoseconds(limit_s):
            return Disposition.TOO_OLD
        return None

    def collect(self) -> list[Batch]:
        """See `Inbox.collect`."""
        batches = sorted(self._pending, key=lambda batch: batch.stamp_ns)
        self._pending = []
        return batches

"""Detections on their way from receipt to the tick that processes them."""

import marshal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from hashlib import blake2b
from itertools import compress, repeat
from operator import attrgetter
from typing import ClassVar

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.linalg import is_covariance
from fgtrack.core.state import Stateful
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    FloatArray,
    Frame,
    UpdateRecord,
    YawWord,
)
from fgtrack.estimation.base import Measurement, UpdateResult, UpdateStatus
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.lives.latency import FOREVER

#: In any unit: no sensor is better than this.
SMALLEST_STD = 1e-6
_MAX_FUTURE_NS = (
    NS_PER_S  # a detection stamped further ahead of its receipt has a wrong stamp
)


@dataclass(frozen=True, slots=True)
class Batch:
    """Usable detections of one message with the same stamp."""

    message: DetectionList
    stamp_ns: int
    indices: tuple[int, ...]
    """Indices in the message of the detections to process."""
    last: bool = True
    """True for the newest batch of its message. A message has several batches only if its detections have own
    stamps.
    """
    since_ns: int | None = None
    """First tick at which the batch had to wait, see `Inbox.due`; None if it never had to."""


def record(
    message: DetectionList,
    index: int,
    disposition: Disposition | UpdateStatus,
    track_id: int | None = None,
    nis: float | None = None,
    measurement: Measurement | None = None,
    innovation: FloatArray | None = None,
    yaw: YawWord | None = None,
) -> UpdateRecord:
    """Return the record of detection `index` of `message`.

    `innovation` is the innovation of `measurement`, or of a measurement with the same components.
    """
    stamp_ns, named = message.objects[index].stamp_ns, dict[str, float]()
    if measurement is not None and innovation is not None:
        named = dict(
            zip(measurement.model.components, innovation.tolist(), strict=True)
        )
        for name in measurement.assumed:
            del named[name]
    return UpdateRecord(
        message.sensor,
        message.stamp_ns if stamp_ns is None else stamp_ns,
        message.receipt_ns,
        index,
        disposition
        if isinstance(disposition, Disposition)
        else Disposition(disposition.value),
        track_id,
        nis,
        named,
        yaw=yaw,
    )


def records(message: DetectionList, disposition: Disposition) -> list[UpdateRecord]:
    """Return a record with the same disposition for each detection of `message`."""
    return [
        record(message, index, disposition) for index in range(len(message.objects))
    ]


def merged_records(
    message: DetectionList, indices: Iterable[int], track_id: int | None
) -> list[UpdateRecord]:
    """Return the records of the detections `indices`, which were merged into another detection.

    `track_id` is the track of the other detection; None if it has no track.
    """
    return [record(message, index, Disposition.MERGED, track_id) for index in indices]


@dataclass(frozen=True, slots=True)
class FusedRecords:
    """The records of matched detections, and of the detections merged into each; made at each iteration."""

    message: DetectionList
    matched: Sequence[tuple[int, int, Measurement | None, UpdateResult]]
    """Index and track of each matched detection, its measurement (or one like it), and the result of the update."""
    merged: Mapping[int, tuple[int, ...]]
    """Indices of the detections that were merged into a matched detection, by the index of the matched detection."""
    yaws: Sequence[YawWord | None]
    """Defect of the yaw of each matched detection; None for a yaw without a defect."""

    def __iter__(self) -> Iterator[UpdateRecord]:
        for (index, track_id, measurement, result), yaw in zip(
            self.matched, self.yaws, strict=True
        ):
            yield record(
                self.message,
                index,
                result.status,
                track_id,
                result.nis,
                measurement,
                result.innovation,
                yaw,
            )
            yield from merged_records(
                self.message, self.merged.get(index, ()), track_id
            )


def is_usable(
    detection: Detection, sensor: SensorModel, at_origin: bool = False
) -> bool:
    """True if all values of `detection` are valid, the sensor measured one, and it is no empty slot (x = y = 0).

    A sensor of positions or bearings must give a position or a bearing. A sensor of range rates alone must give a
    value; the association finds the object. With `at_origin` there are no empty slots: the first position of many
    recordings is the origin of the map.
    """
    for name in sensor.std:
        value = getattr(detection, name)
        if value is not None and not -LARGEST <= value <= LARGEST:
            return False
    if detection.covariance is not None and not is_valid_covariance(detection, sensor):
        return False
    x_m, y_m = detection.x_m, detection.y_m
    if x_m == 0.0 and y_m == 0.0 and not at_origin:
        return False
    if "x_m" in sensor.std and (x_m is not None or y_m is not None):
        return x_m is not None and y_m is not None
    if "x_m" in sensor.std or "bearing_rad" in sensor.std:
        return "bearing_rad" in sensor.std and detection.bearing_rad is not None
    return any(getattr(detection, name) is not None for name in sensor.std)


def own_covariance(detection: Detection, names: Sequence[str]) -> FloatArray:
    """Return the covariance of the components `names` that `detection` itself contains, shape (k, k)."""
    measured = detection.measured
    rows = [measured.index(name) for name in names]
    return np.array(detection.covariance).reshape(len(measured), len(measured))[
        np.ix_(rows, rows)
    ]


def is_valid_covariance(detection: Detection, sensor: SensorModel) -> bool:
    """True if the covariance of `detection` is not used, or is symmetric positive definite."""
    if detection.covariance is None or not sensor.message_covariance:
        return True
    measured = detection.measured
    if len(detection.covariance) != len(measured) ** 2:
        return False
    own = own_covariance(detection, [name for name in measured if name in sensor.std])
    return bool((np.diag(own) >= SMALLEST_STD**2).all()) and is_covariance(own, 0.0)


def stamps(message: DetectionList, sensor: SensorModel) -> list[int]:
    """Return the stamp of each detection of `message`, as `sensor.stamp_from` selects.

    It is the stamp of the list, the detection's own stamp, or the mean of all own stamps. The stamp of the list
    replaces an own stamp that is missing.
    """
    if sensor.stamp_from not in ("object", "objects_mean"):
        return [message.stamp_ns] * len(message.objects)
    own = [each.stamp_ns for each in message.objects if each.stamp_ns is not None]
    if not own:
        return [message.stamp_ns] * len(message.objects)
    if sensor.stamp_from == "objects_mean":
        return [sum(own) // len(own)] * len(message.objects)
    return [
        message.stamp_ns if each.stamp_ns is None else each.stamp_ns
        for each in message.objects
    ]


_Origin = tuple[str, str | None, float | None, float | None]


def _origin(sensor: str, detection: Detection) -> _Origin:
    """Return sensor, identity and position of a detection, which all copies of the detection have in common."""
    return sensor, detection.id, detection.x_m, detection.y_m


_values = attrgetter(*(each.name for each in fields(Detection)))


def _key(
    message: DetectionList, usable: Sequence[bool]
) -> tuple[str, int, Frame, bytes]:
    """Return a key that is equal for all copies of a message.

    The key contains the sensor, the stamp, the frame, and the bits of the usable detections in any order.
    """
    values = list(map(_values, compress(message.objects, usable)))
    try:
        # 2: without references to shared values
        contents = list(map(marshal.dumps, values, repeat(2)))
    except ValueError:  # numbers of other libraries
        contents = [repr(each).encode() for each in values]
    return (
        message.sensor,
        message.stamp_ns,
        message.frame,
        # Unlike a hash, the digest is the same in the process that loads a saved tracker.
        blake2b(b"".join(sorted(contents)), digest_size=16).digest(),
    )


class Inbox(Stateful):
    """Keeps every message until it is processed. Refuses messages that are repeated, too late or in the future.

    Refuses single detections that are invalid, too.

    An interrupt loses no detection and counts none twice. One statement assigns all that a message changes, and no
    interrupt comes inside a statement that calls nothing.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_receipts_ns",
        "pending",
        "ended",
        "received",
        "_originals",
    )

    def __init__(
        self, sensors: Mapping[str, SensorModel], memory_s: float = 10.0
    ) -> None:
        """`memory_s`: time for which a list is remembered; at least the largest delay of a list."""
        self._sensors = sensors
        self._max_delay_ns = {
            name: nanoseconds(sensor.max_delay_s)
            for name, sensor in sensors.items()
            if sensor.max_delay_s is not None
        }
        self._memory_ns = max([nanoseconds(memory_s), *self._max_delay_ns.values()])
        self._receipts_ns: dict[
            tuple[str, int, Frame, bytes], int
        ] = {}  # of lists, in order of receipt
        self.pending: list[Batch] = []
        """Batches that wait for their tick."""
        self.ended: list[list[UpdateRecord]] = []
        """Records that `put` has returned, of one message each, until a tick reports them."""
        self.received: DetectionList | EgoState | None = None
        """The newest message of which everything is noted."""
        self._originals: dict[_Origin, DetectionList] = {}

    def put(self, message: DetectionList) -> list[UpdateRecord]:
        """Receive a message. Return the records of the detections that are not processed further.

        A message is repeated if an earlier message of the sensor had its stamp and contents.
        """
        sensor = self._sensors[message.sensor]
        at_origin = message.origin_deg is not None
        usable = [
            is_usable(detection, sensor, at_origin) for detection in message.objects
        ]
        self._forget_lists(message.receipt_ns)
        key, pending = _key(message, usable), self.pending
        receipt_ns = self._receipts_ns.get(key)
        if receipt_ns is None:
            ended, pending = self._sorted(message, usable)
            receipt_ns = message.receipt_ns
        else:
            ended = records(message, Disposition.DUPLICATE)
        all_ended = [*self.ended, ended]
        # A list without usable detections equals no other one, and is not remembered.
        receipts_ns = {} if message.objects and not any(usable) else self._receipts_ns
        self.pending, self.ended, receipts_ns[key], self.received = (
            pending,
            all_ended,
            receipt_ns,
            message,
        )
        return ended

    def _forget_lists(self, receipt_ns: int) -> None:
        """Forget the lists that were received more than `memory_s` before `receipt_ns`."""
        oldest_ns, receipts_ns = receipt_ns - self._memory_ns, self._receipts_ns
        while receipts_ns and receipts_ns[first := next(iter(receipts_ns))] < oldest_ns:
            del receipts_ns[first]

    def _sorted(
        self, message: DetectionList, usable: Sequence[bool]
    ) -> tuple[list[UpdateRecord], list[Batch]]:
        """Return the records of detections of `message` that are not processed further, and all batches that then
        wait.
        """
        sensor, pending = self._sensors[message.sensor], self.pending.copy()
        ended: list[UpdateRecord] = []
        kept: dict[int, list[int]] = {} if message.objects else {message.stamp_ns: []}
        own_ns = stamps(message, sensor)
        fates = {stamp_ns: self._fate(message, stamp_ns) for stamp_ns in set(own_ns)}
        for index, (stamp_ns, is_sound) in enumerate(zip(own_ns, usable, strict=True)):
            fate = fates[stamp_ns] if is_sound else Disposition.INVALID
            if (
                fate is None
                and sensor.copies_s
                and self._is_heard(message, index, stamp_ns, pending)
            ):
                fate = Disposition.DUPLICATE
            if fate is None:
                kept.setdefault(stamp_ns, []).append(index)
            else:
                ended.append(record(message, index, fate))
        newest_ns = max(kept, default=0)
        for stamp_ns, indices in kept.items():
            pending.append(
                Batch(message, stamp_ns, tuple(indices), last=stamp_ns == newest_ns)
            )
        return ended, pending

    def _fate(self, message: DetectionList, stamp_ns: int) -> Disposition | None:
        """Return the disposition of the detections of `message` with this stamp, if they cannot be used; else None.

        Detections with a delay above the limit of the sensor are too old. Detections stamped in the future are invalid.
        """
        delay_ns = message.receipt_ns - stamp_ns
        if delay_ns < -_MAX_FUTURE_NS:
            return Disposition.INVALID
        return (
            Disposition.TOO_OLD
            if delay_ns > self._max_delay_ns.get(message.sensor, delay_ns)
            else None
        )

    def _is_heard(
        self, message: DetectionList, index: int, stamp_ns: int, pending: list[Batch]
    ) -> bool:
        """True if another receiver has already received the message of detection `index`.

        The earliest stamp within a tick counts: it replaces the stamp of the detection in `pending`.
        """
        item, copies_s = message.objects[index], self._sensors[message.sensor].copies_s
        if item.id is None or not copies_s:
            return False
        oldest_ns = message.receipt_ns - nanoseconds(copies_s)
        while (
            self._originals
            and self._originals[first := next(iter(self._originals))].receipt_ns
            < oldest_ns
        ):
            del self._originals[first]
        key = _origin(message.sensor, item)
        original = self._originals.setdefault(key, message)
        if original is message:
            return False
        for row, batch in enumerate(pending):
            if batch.message is not original or stamp_ns >= batch.stamp_ns:
                continue
            alike = tuple(
                i
                for i in batch.indices
                if _origin(message.sensor, original.objects[i]) == key
            )
            rest = tuple(i for i in batch.indices if i not in alike)
            pending[row] = (
                replace(batch, indices=rest)
                if rest
                else replace(batch, stamp_ns=stamp_ns)
            )
            if rest and alike:
                pending.append(Batch(original, stamp_ns, alike, last=False))
        return True

    @property
    def held_ns(self) -> int:
        """Oldest stamp of the pending batches; `FOREVER` if no batch is pending."""
        return min((batch.stamp_ns for batch in self.pending), default=FOREVER)

    def collect(self) -> list[Batch]:
        """Return all pending batches, oldest stamp first. Forget the batches and the records."""
        ready, self.pending, self.ended = self.due()[0], [], []
        return ready

    def due(
        self, now_ns: int = 0, waits: Callable[[Batch, int], bool] | None = None
    ) -> tuple[list[Batch], list[Batch]]:
        """Return the pending batches that are ready, oldest stamp first, and the batches that stay pending.

        `waits` returns True for a batch that waits at the tick `now_ns`. If a batch waits, all batches of its message
        stay, because the misses of tracks are counted once for a message. Later batches of the sensor stay, too.
        """
        pending, held, first_ns = (
            sorted(self.pending, key=attrgetter("stamp_ns")),
            set[int](),
            dict[str, int](),
        )
        if waits is None:
            return pending, []
        for batch in pending:
            sensor, stamp_ns = batch.message.sensor, batch.stamp_ns
            if first_ns.get(sensor, stamp_ns) < stamp_ns or waits(batch, now_ns):
                held.add(id(batch.message))
                first_ns.setdefault(sensor, stamp_ns)
        ready = [batch for batch in pending if id(batch.message) not in held]
        stay = [
            replace(batch, since_ns=now_ns) if batch.since_ns is None else batch
            for batch in self.pending
            if id(batch.message) in held
        ]
        return ready, stay

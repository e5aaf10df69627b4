"""The re-delayer: a recorded stream whose detections arrive later, earlier, not at all, or with wrong stamps.

What was sensed stays as it was recorded; so the same drive can be replayed under any delays.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.errors import CallError, DataError, did_you_mean
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, DetectionList, IntArray, Message
from fgtrack.sim.clocks import AnyClock, reported_stamps
from fgtrack.sim.delays import AnyDelay
from fgtrack.sim.settings import Probability, settings

#: Stands for all sensors that are not named.
OTHERS = "*"


@settings
class SensorDelays:
    """How the lists of one sensor arrive."""

    delay: AnyDelay | None = None
    """Delay behind the recorded stamp; null keeps the recorded receipt. Kind `none`: the stamp is the arrival."""
    clock: tuple[AnyClock, ...] = ()
    """What is wrong with the stamps that it reports; the delay is still that behind the recorded one."""
    loss_probability: Probability = 0.0
    """That a list never arrives, each by itself."""


@dataclass(frozen=True, eq=False)
class Redelayed:
    """The messages under their new delays, in order of receipt; can be iterated any number of times.

    At the same receipt, what keeps its receipt comes first, in its old order; then sensor by sensor, by stamp.
    Holds no more messages at a time than wait for an earlier one. Raises what the input raises, after everything
    before it; `DataError` where it is not what it was when the delays were drawn.
    """

    num_lost: Mapping[str, int]
    """Lists lost, by sensor."""
    _read: Callable[[], Iterable[Message]]
    _place: IntArray
    """Place of each message of the input in the order of receipt, -1 of a lost one."""
    _receipts_ns: IntArray
    _stamps_ns: IntArray

    def __iter__(self) -> Iterator[Message]:
        waiting: dict[int, Message] = {}
        next_place = count = 0
        for index, message in enumerate(self._read()):
            count = index + 1
            if index >= len(self._place):
                break
            place = int(self._place[index])
            if place < 0:
                continue
            receipt_ns, stamp_ns = int(self._receipts_ns[index]), int(self._stamps_ns[index])
            waiting[place] = _moved(message, stamp_ns, receipt_ns)
            while next_place in waiting:
                yield waiting.pop(next_place)
                next_place += 1
        if count != len(self._place):
            raise DataError("the input has changed while it was given other delays: record to the end, then convert")


def redelay(
    read: Callable[[], Iterable[Message]], delays: Mapping[str, SensorDelays], rng: np.random.Generator
) -> Redelayed:
    """Messages of `read()` with the detections of the sensors in `delays` under other delays.

    The receipt becomes the stamp plus a delay, drawn for all lists of a sensor in the order of their stamps. The
    ego, the truth and sensors that are not named keep theirs. Every sensor, and in it delays, losses and clock
    errors, draw from a generator of their own. Detections with stamps of their own follow their list's error.

    Parameters
    ----------
    read
        Gives the messages of the input; called here and once for each iteration over the result.
    delays
        By sensor; `OTHERS` stands for all that are not named.

    Raises
    ------
    CallError
        A sensor of `delays` is not in the input.
    """
    plan = _Plan.of(read)
    chosen = _chosen(delays, plan.places)
    num_lost = {}
    for rank, (sensor, child) in enumerate(zip(chosen, rng.spawn(len(chosen)), strict=True), 1):
        num_lost[sensor] = plan.draw(chosen[sensor], plan.places[sensor], rank, child)
    return Redelayed(num_lost, read, plan.order(), plan.receipts_ns, plan.reported_ns)


def _chosen(delays: Mapping[str, SensorDelays], known: Iterable[str]) -> dict[str, SensorDelays]:
    """Settings of every sensor that has some: the named ones in their order, then the others by name."""
    names = sorted(known)
    missing = [sensor for sensor in delays if sensor not in names and sensor != OTHERS]
    if missing:
        there = ", ".join(names) or "none"
        hint = did_you_mean(missing[0], names)
        raise CallError(f"sensor {missing[0]!r} is not in the input, whose sensors are: {there}{hint}")
    chosen = {sensor: settings for sensor, settings in delays.items() if sensor != OTHERS}
    if OTHERS in delays:
        chosen |= {sensor: delays[OTHERS] for sensor in names if sensor not in chosen}
    return chosen


@dataclass(eq=False)
class _Plan:
    """What becomes of each message of the input; all arrays of shape (n,)."""

    places: dict[str, IntArray]
    """Where the lists of each sensor are in the input."""
    receipts_ns: IntArray
    stamps_ns: IntArray
    reported_ns: IntArray
    """Stamps that will be reported."""
    rank: IntArray
    """Order at the same receipt: 0 of what keeps its receipt, then the sensors."""
    lost: BoolArray

    @classmethod
    def of(cls, read: Callable[[], Iterable[Message]]) -> "_Plan":
        """The plan that changes nothing, up to where the input breaks off."""
        places: dict[str, list[int]] = {}
        times: list[tuple[int, int]] = []
        try:
            for index, message in enumerate(read()):
                if isinstance(message, DetectionList):
                    places.setdefault(message.sensor, []).append(index)
                times.append((message.receipt_ns, message.stamp_ns))
        except DataError:
            pass  # comes again when the messages are read, after everything before it
        table = np.array(times, dtype=np.int64).reshape(-1, 2)
        receipts_ns, stamps_ns = table[:, 0].copy(), table[:, 1].copy()
        rank = np.zeros(len(times), dtype=np.int64)
        lost = np.zeros(len(times), dtype=bool)
        arrays = {sensor: np.array(where, dtype=np.int64) for sensor, where in places.items()}
        return cls(arrays, receipts_ns, stamps_ns, stamps_ns.copy(), rank, lost)

    def draw(self, settings: SensorDelays, where: IntArray, rank: int, rng: np.random.Generator) -> int:
        """Draw delays, losses and clock errors of the lists at `where`; gives the number of lists lost."""
        delay_rng, loss_rng, clock_rng = rng.spawn(3)
        where = where[np.argsort(self.stamps_ns[where], kind="stable")]
        stamps_ns = self.stamps_ns[where]
        lost = loss_rng.random(len(where)) < settings.loss_probability
        if settings.delay is not None:
            delays_s = settings.delay.draw(delay_rng, (stamps_ns - stamps_ns[:1]) / NS_PER_S)
            lost |= np.isnan(delays_s)
            self.receipts_ns[where] = stamps_ns + np.rint(np.nan_to_num(delays_s) * NS_PER_S).astype(np.int64)
            self.rank[where] = rank
        self.lost[where] = lost
        self.reported_ns[where] = reported_stamps(settings.clock, clock_rng, stamps_ns, self.receipts_ns[where])
        return int(np.count_nonzero(lost))

    def order(self) -> IntArray:
        """Place of each message in the order of receipt, -1 of a lost one."""
        # What keeps its receipt also keeps its place among equals: no stamp in its key.
        stamps_ns = np.where(self.rank > 0, self.stamps_ns, 0)
        order = np.lexsort((stamps_ns, self.rank, self.receipts_ns))
        place = np.full(len(order), -1, dtype=np.int64)
        kept = order[~self.lost[order]]
        place[kept] = np.arange(len(kept))
        return place


def _moved(message: Message, stamp_ns: int, receipt_ns: int) -> Message:
    """`message` with another stamp and receipt."""
    if (message.stamp_ns, message.receipt_ns) == (stamp_ns, receipt_ns):
        return message
    if isinstance(message, DetectionList):
        message = restamped(message, stamp_ns)
    return replace(message, receipt_ns=receipt_ns)


def restamped(message: DetectionList, stamp_ns: int) -> DetectionList:
    """`message` with another stamp; detections' own stamps move as their list's does."""
    error_ns = stamp_ns - message.stamp_ns
    objects = tuple(
        item if item.stamp_ns is None else replace(item, stamp_ns=item.stamp_ns + error_ns) for item in message.objects
    )
    return replace(message, stamp_ns=stamp_ns, objects=objects)

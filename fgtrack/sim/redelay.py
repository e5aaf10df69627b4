"""The re-delayer: a recorded stream whose detections arrive later, earlier, not at all, or with wrong stamps.

What was sensed stays as it was recorded; so the same drive can be replayed under any delays.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.errors import CallError, DataError, did_you_mean
from fgtrack.core.settings import Probability, settings
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, IntArray, Message
from fgtrack.sim.clocks import AnyClock, reported_stamps
from fgtrack.sim.delays import AnyDelay

#: Stands for all sensors that are not named.
OTHERS = "*"


@settings
class SensorDelays:
    """Delays, losses and clock errors of the lists of one sensor."""

    delay: AnyDelay | None = None
    """Delay behind the recorded stamp; null keeps the recorded receipt. Kind `none`: the stamp is the arrival."""
    clock: tuple[AnyClock, ...] = ()
    """Errors of the stamps that it reports; the delay is still that behind the recorded one."""
    loss_probability: Probability = 0.0
    """Probability that a list never arrives, each by itself."""


@dataclass(frozen=True, eq=False)
class Redelayed:
    """The messages under their new delays, in order of receipt; can be iterated any number of times.

    At the same receipt, what keeps its receipt comes first, in its old order; then sensor by sensor, by stamp.
    Holds no more messages at a time than wait for an earlier one. Raises what the input raises, after everything
    before it; `DataError` where it is shorter than it was when the delays were drawn.
    """

    num_lost: Mapping[str, int]
    """Lists lost, by sensor."""
    _read: Callable[[], Iterable[Message]]
    _ranks: IntArray
    """Rank of each message of the input in the order of receipt, -1 of a lost one."""
    _receipts_ns: IntArray
    _stamps_ns: IntArray

    def __iter__(self) -> Iterator[Message]:
        waiting: dict[int, Message] = {}
        next_rank = 0
        rows = zip(self._ranks.tolist(), self._stamps_ns.tolist(), self._receipts_ns.tolist(), strict=True)
        for message, (rank, stamp_ns, receipt_ns) in zip(self._read(), rows, strict=False):
            if rank >= 0:
                if isinstance(message, DetectionList):  # all others keep their stamp
                    message = restamped(message, stamp_ns)
                waiting[rank] = replace(message, receipt_ns=receipt_ns)
            while next_rank in waiting:
                yield waiting.pop(next_rank)
                next_rank += 1
        if next_rank <= self._ranks.max(initial=-1):
            raise DataError("the input has changed while it was given other delays: record to the end, then convert")


def redelay(
    read: Callable[[], Iterable[Message]], delays: Mapping[str, SensorDelays], rng: np.random.Generator
) -> Redelayed:
    """Return the messages of `read()` with the detections of the sensors in `delays` under other delays.

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
    times, sensors = list[tuple[int, int]](), list[str]()
    try:
        for message in read():
            times.append((message.receipt_ns, message.stamp_ns))
            sensors.append(message.sensor if isinstance(message, DetectionList) else "")
    except DataError:
        pass  # comes again when the messages are read, after everything before it
    receipts_ns, stamps_ns = np.array(times, dtype=np.int64).reshape(-1, 2).T.copy()
    reported_ns, priority, lost = stamps_ns.copy(), np.zeros_like(stamps_ns), np.zeros(len(times), dtype=bool)
    chosen, num_lost, names = _chosen(delays, set(sensors) - {""}), dict[str, int](), np.array(sensors)
    for number, (sensor, child) in enumerate(zip(chosen, rng.spawn(len(chosen)), strict=True), 1):
        settings, (delay_rng, loss_rng, clock_rng) = chosen[sensor], child.spawn(3)
        own = np.flatnonzero(names == sensor)
        own = own[np.argsort(stamps_ns[own], kind="stable")]
        lost[own] = loss_rng.random(len(own)) < settings.loss_probability
        if settings.delay is not None:
            delays_s = settings.delay.draw(delay_rng, (stamps_ns[own] - stamps_ns[own[:1]]) / NS_PER_S)
            lost[own] |= np.isnan(delays_s)
            receipts_ns[own] = stamps_ns[own] + np.rint(np.nan_to_num(delays_s) * NS_PER_S).astype(np.int64)
            priority[own] = number
        reported_ns[own] = reported_stamps(settings.clock, clock_rng, stamps_ns[own], receipts_ns[own])
        num_lost[sensor] = int(lost[own].sum())
    # What keeps its receipt also keeps its order among equals: no stamp in its key.
    order = np.lexsort((np.where(priority > 0, stamps_ns, 0), priority, receipts_ns))
    kept, ranks = order[~lost[order]], np.full(len(order), -1, dtype=np.int64)
    ranks[kept] = np.arange(len(kept))
    return Redelayed(num_lost, read, ranks, receipts_ns, reported_ns)


def _chosen(delays: Mapping[str, SensorDelays], known: Iterable[str]) -> dict[str, SensorDelays]:
    """Settings of every sensor that has some: the named ones in their order, then the others by name."""
    names = sorted(known)
    missing = [sensor for sensor in delays if sensor not in (*names, OTHERS)]
    if missing:
        there, hint = ", ".join(names) or "none", did_you_mean(missing[0], names)
        raise CallError(f"sensor {missing[0]!r} is not in the input, whose sensors are: {there}{hint}")
    named = {sensor: settings for sensor, settings in delays.items() if sensor != OTHERS}
    others = {sensor: delays[OTHERS] for sensor in names if sensor not in delays} if OTHERS in delays else {}
    return named | others


def restamped(message: DetectionList, stamp_ns: int) -> DetectionList:
    """`message` with another stamp; detections' own stamps move as their list's does."""
    error_ns = stamp_ns - message.stamp_ns
    objects = tuple(
        item if item.stamp_ns is None else replace(item, stamp_ns=item.stamp_ns + error_ns) for item in message.objects
    )
    return replace(message, stamp_ns=stamp_ns, objects=objects)

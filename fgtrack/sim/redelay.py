"""The re-delayer: a recorded stream whose detections arrive later, earlier, not at all, or with wrong stamps.

What was measured stays as it was recorded; so the same drive can be replayed under any delays.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from fgtrack.core.errors import CallError, DataError, did_you_mean
from fgtrack.core.settings import Probability, settings
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, Message
from fgtrack.sim.clocks import AnyClock, reported_stamps
from fgtrack.sim.delays import AnyDelay, draw_delays

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


def redelay(
    messages: Iterable[Message],
    delays: Mapping[str, SensorDelays],
    rng: np.random.Generator,
) -> tuple[Iterator[Message], dict[str, int]]:
    """Return `messages` with the detections of the sensors in `delays` under other delays, and the lists lost by each.

    `OTHERS` stands for all sensors that are not named. The receipt becomes the stamp plus a delay, drawn for all lists
    of a sensor in the order of their stamps. The ego, the truth and sensors that are not named keep theirs. Every
    sensor, and in it delays, losses and clock errors, draw from a generator of their own. Detections with stamps of
    their own follow their list's error. At the same receipt, what keeps its receipt comes first, in its old order; then
    sensor by sensor, by stamp. A `DataError` of the input comes after everything before it. Raises `CallError` if a
    sensor of `delays` is not in the input.
    """
    read, broken = list[Message](), list[DataError]()
    try:
        for message in messages:
            read.append(message)
    except DataError as error:
        broken.append(error)
    receipts_ns, stamps_ns = (
        np.array([(item.receipt_ns, item.stamp_ns) for item in read], dtype=np.int64)
        .reshape(-1, 2)
        .T
    )
    names = np.array(
        [item.sensor if isinstance(item, DetectionList) else "" for item in read]
    )
    reported_ns, priority, lost = (
        stamps_ns.copy(),
        np.zeros_like(stamps_ns),
        np.zeros(len(read), dtype=bool),
    )
    known, num_lost = sorted(set(names.tolist()) - {""}), dict[str, int]()
    for sensor in delays:
        if sensor not in (*known, OTHERS):
            there, hint = ", ".join(known) or "none", did_you_mean(sensor, known)
            raise CallError(
                f"sensor {sensor!r} is not in the input, whose sensors are: {there}{hint}"
            )
    others = (
        {sensor: delays[OTHERS] for sensor in known if sensor not in delays}
        if OTHERS in delays
        else {}
    )
    chosen = {
        sensor: settings for sensor, settings in delays.items() if sensor != OTHERS
    } | others
    for number, (sensor, child) in enumerate(
        zip(chosen, rng.spawn(len(chosen)), strict=True), 1
    ):
        settings, (delay_rng, loss_rng, clock_rng) = chosen[sensor], child.spawn(3)
        own = np.flatnonzero(names == sensor)
        own = own[np.argsort(stamps_ns[own], kind="stable")]
        lost[own] = loss_rng.random(len(own)) < settings.loss_probability
        if settings.delay is not None:
            delays_s = draw_delays(
                settings.delay,
                delay_rng,
                (stamps_ns[own] - stamps_ns[own[:1]]) / NS_PER_S,
            )
            lost[own] |= np.isnan(delays_s)
            receipts_ns[own] = stamps_ns[own] + np.rint(
                np.nan_to_num(delays_s) * NS_PER_S
            ).astype(np.int64)
            priority[own] = number
        reported_ns[own] = reported_stamps(
            settings.clock, clock_rng, stamps_ns[own], receipts_ns[own]
        )
        num_lost[sensor] = int(lost[own].sum())
    # What keeps its receipt also keeps its order among equals: no stamp in its key.
    order = np.lexsort((np.where(priority > 0, stamps_ns, 0), priority, receipts_ns))

    def redelayed() -> Iterator[Message]:
        for k in order[~lost[order]].tolist():
            message = read[k]
            if isinstance(message, DetectionList):  # all others keep their stamp
                message = restamped(message, int(reported_ns[k]))
            yield replace(message, receipt_ns=int(receipts_ns[k]))
        for error in broken:
            raise error

    return redelayed(), num_lost


def restamped(message: DetectionList, stamp_ns: int) -> DetectionList:
    """`message` with another stamp; detections' own stamps move as their list's does."""
    error_ns = stamp_ns - message.stamp_ns
    objects = tuple(
        item
        if item.stamp_ns is None
        else replace(item, stamp_ns=item.stamp_ns + error_ns)
        for item in message.objects
    )
    return replace(message, stamp_ns=stamp_ns, objects=objects)

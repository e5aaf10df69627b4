"""Re-delays a recorded stream: detections arrive later, earlier, not at all, or with wrong stamps.

The measured values stay. So the same drive can be replayed with any delays.
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

#: Name that stands for all sensors without an entry of their own.
OTHERS = "*"


@settings
class SensorDelays:
    """Delays, losses and clock errors of one sensor's lists."""

    delay: AnyDelay | None = None
    """Delay after the recorded stamp; null keeps the recorded receipt. Kind `none`: lists arrive at their stamp."""
    clock: tuple[AnyClock, ...] = ()
    """Errors of the reported stamps; delays still count from the recorded stamp."""
    loss_probability: Probability = 0.0
    """Probability that a list is lost, independently of other lists."""


def redelay(
    messages: Iterable[Message],
    delays: Mapping[str, SensorDelays],
    rng: np.random.Generator,
) -> tuple[Iterator[Message], dict[str, int]]:
    """Return `messages` with new delays of the sensors in `delays`, and the number of lost lists by sensor.

    `OTHERS` in `delays` stands for all sensors without an entry. The receipt of a list
    becomes its stamp plus a delay; the delays of a sensor are drawn in the order of the
    stamps. The ego, the truth and sensors without an entry keep their receipts. Each
    sensor has its own random generators for delays, losses and clock errors. Detections
    with stamps of their own get the error of their list's stamp.

    At equal receipts, messages that keep their receipt come first, in their old order.
    Lists with new receipts follow, sensor by sensor and by stamp. A `DataError` of the
    input is raised after all messages before it. Raises `CallError` if a sensor in
    `delays` is not in the input.
    """
    read = list[Message]()
    broken = list[DataError]()
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
    reported_ns = stamps_ns.copy()
    priority = np.zeros_like(stamps_ns)
    lost = np.zeros(len(read), dtype=bool)
    known = sorted(set(names.tolist()) - {""})
    num_lost = dict[str, int]()
    for sensor in delays:
        if sensor not in (*known, OTHERS):
            listed = ", ".join(known) or "none"
            hint = did_you_mean(sensor, known)
            raise CallError(
                f"sensor {sensor!r} is not in the input, whose sensors are: {listed}{hint}"
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
        settings = chosen[sensor]
        delay_rng, loss_rng, clock_rng = child.spawn(3)
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
    # Messages that keep their receipt are not sorted by stamp, so they keep their order at equal receipts.
    order = np.lexsort((np.where(priority > 0, stamps_ns, 0), priority, receipts_ns))

    def redelayed() -> Iterator[Message]:
        for k in order[~lost[order]].tolist():
            message = read[k]
            if isinstance(message, DetectionList):  # other messages keep their stamp
                message = restamped(message, int(reported_ns[k]))
            yield replace(message, receipt_ns=int(receipts_ns[k]))
        for error in broken:
            raise error

    return redelayed(), num_lost


def restamped(message: DetectionList, stamp_ns: int) -> DetectionList:
    """Return `message` with the stamp `stamp_ns`; its detections' own stamps move by the same time."""
    error_ns = stamp_ns - message.stamp_ns
    objects = tuple(
        item
        if item.stamp_ns is None
        else replace(item, stamp_ns=item.stamp_ns + error_ns)
        for item in message.objects
    )
    return replace(message, stamp_ns=stamp_ns, objects=objects)

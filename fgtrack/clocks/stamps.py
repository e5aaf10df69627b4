"""Findings on clocks: invalid stamps, unrelated clocks, changes of the delay, clock offsets and position biases."""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from fgtrack.clocks.arrivals import FEWEST, Arrivals
from fgtrack.clocks.offsets import (
    RECEIPT_S,
    SMALLEST_OFFSET_S,
    TRUTH,
    OffsetReport,
    SensorOffset,
)
from fgtrack.config.settings import EgoConfig
from fgtrack.core.diagnostic import EGO
from fgtrack.core.finding import Finding, milliseconds, percent

__all__ = [
    "DelayChange",
    "bias_findings",
    "clock_findings",
    "clock_text",
    "delay_change",
    "share_ahead",
    "stamp_findings",
]

# A stamp after its receipt counts only beyond the rounding of stamps, and for more than this share.
_AHEAD_S = 1e-3
_AHEAD_SHARE = 0.005
# The median delays of this number of parts of a recording are compared.
_PARTS = 10
_SHORTEST_PART_S = 1.0
# Least change of the mean delay at the best of seven splits, in seconds, and for a jump in standard deviations.
_CHANGE_S = 0.015
_JUMP_STDS = 7.0
# A steady drift changes the mean by about 5 standard deviations. It differs from chance by its correlation with time.
_DRIFT_STDS = 4.0
_DRIFT_CORRELATION = 0.9
# Negative values are behind and to the right.
_WHERE = "{:.2f} m ahead and {:.2f} m left".format
# Largest difference of biases with one cause: two calibrations, or two parts of a car, may differ by it.
_SAME_BIAS_M = 0.5


def stamp_findings(one: Arrivals) -> Iterator[Finding]:
    """Yield findings on the stamps and receipts of one sensor, or of the ego."""
    name = one.name
    receipt = {} if name == EGO else {f"sensors.{name}.stamp_from": "receipt"}
    if not one.stamps_ns.any():
        if name != EGO:  # the reader of the recording reports it for the ego
            text = f"all {len(one.stamps_ns)} stamps are 0: its driver sets none, so its delay stays unknown."
            yield Finding("clock", name, 95.0, text, receipt)
    elif one.is_other_clock:
        off_s = abs(float(np.median(one.delays_s)))
        text = f"stamps and receipts differ by {off_s:.3g} s: they come from two unrelated clocks."
        yield Finding("clock", name, 95.0, text, receipt)
    elif len(one.stamps_ns) >= FEWEST:
        ahead = share_ahead(one)
        if ahead > _AHEAD_SHARE:
            most_s = -float(np.quantile(one.delays_s, 0.01))
            text = (
                f"{percent(ahead)} of its stamps lie after their receipt, by up to {milliseconds(most_s)}: its clock "
                "is ahead of the recorder's clock by at least this time."
            )
            yield Finding("clock", name, 85.0, text)
        if not one.usable.all():
            share = percent(1.0 - float(one.usable.mean()))
            text = f"{share} of its stamps are wrong: they differ from their receipt by more than an hour."
            yield Finding("clock", name, 40.0, text)
        if one.is_receipt and name != EGO:
            text = "every stamp equals the receipt, so its delay is unknown; set clock_offset_s to a constant delay."
            yield Finding("receipt", name, 20.0, text)
        yield from _change(one)


def share_ahead(one: Arrivals) -> float:
    """Return the share of stamps that lie after their receipt, beyond the rounding of stamps."""
    return float((one.delays_s < -_AHEAD_S).mean())


class DelayChange(NamedTuple):
    """Largest permanent change of the mean delay of a sensor.

    The recording is divided into ten parts, which are split into parts before and after the change.
    """

    before_s: float
    """Mean delay before the change."""
    after_s: float
    """Mean delay after the change."""
    at_s: float
    """Time of the change, counted from the first receipt."""
    std_s: float
    """Standard deviation of the change."""
    correlation: float
    """Correlation of the delay with time over the ten parts; near 1 or -1 for a drift."""

    @property
    def change_s(self) -> float:
        """Absolute change of the mean delay."""
        return abs(self.after_s - self.before_s)

    @property
    def limit_s(self) -> float:
        """Smallest change that is more than scatter."""
        return max(_CHANGE_S, _DRIFT_STDS * self.std_s)

    @property
    def is_change(self) -> bool:
        """True for a jump or a drift of the delay; False for scatter."""
        if self.change_s < self.limit_s:
            return False
        is_jump = self.change_s >= _JUMP_STDS * self.std_s
        return is_jump or abs(self.correlation) >= _DRIFT_CORRELATION


def delay_change(one: Arrivals) -> DelayChange | None:
    """Return the largest permanent change of the delay, computed from the medians of ten parts of the recording.

    None if the recording is too short.
    """
    times_s = (one.receipts_ns - one.receipts_ns[0]) / 1e9
    if len(times_s) < _PARTS * FEWEST or times_s[-1] < _PARTS * _SHORTEST_PART_S:
        return None
    medians_s = np.array(
        [np.median(part) for part in np.array_split(one.delays_s, _PARTS)]
    )
    # A change within the first two tenths, or the last one, may be temporary.
    splits = range(2, _PARTS - 1)
    halves = [np.split(medians_s, [k]) for k in splits]
    within = [float(a.var() * len(a) + b.var() * len(b)) for a, b in halves]
    k = int(np.argmin(within))
    before_s, after_s = (float(half.mean()) for half in halves[k])
    std_s = math.sqrt(
        within[k] / (_PARTS - 2) * (1.0 / splits[k] + 1.0 / (_PARTS - splits[k]))
    )
    at_s = float(times_s[splits[k] * len(times_s) // _PARTS])
    with np.errstate(invalid="ignore", divide="ignore"):  # a constant delay
        correlation = float(np.corrcoef(medians_s, np.arange(_PARTS))[0, 1])
    return DelayChange(before_s, after_s, at_s, std_s, correlation)


def _change(one: Arrivals) -> Iterator[Finding]:
    """Yield a finding on a permanent change of the delay: a jump or a drift."""
    change = delay_change(one)
    if change is not None and change.is_change:
        text = (
            f"its delay is {milliseconds(change.before_s)} until about {change.at_s:.0f} s and "
            f"{milliseconds(change.after_s)} after that: its clock was set, its clock drifts, or a queue fills. No "
            "setting corrects this: synchronise the clock."
        )
        yield Finding("clock", one.name, 80.0, text)


def clock_text(one: SensorOffset, report: OffsetReport) -> str:
    """Return a sentence on the clock of a sensor: its offset, its bounds, and the data needed to identify it."""
    reference = (
        "the truth of the recording"
        if report.reference == TRUTH
        else f"the clock of {report.reference}"
    )
    if one.offset_s is None or one.half_s is None:
        return f"its clock offset is not known: {one.why}."
    half = milliseconds(one.half_s)
    offset = f"{1e3 * one.offset_s:+.0f} ms"
    if not one.is_known:
        return f"its clock offset from {reference} is not known: {offset} ± {half}."
    if one.agrees:
        return f"its stamps agree with {reference} (offset {offset} ± {half})."
    side = "later" if one.offset_s > 0.0 else "earlier"
    amount = f"{milliseconds(abs(one.offset_s))} (± {half}) {side} than"
    if one.is_small:
        least = milliseconds(SMALLEST_OFFSET_S)
        return f"its stamps are {amount} {reference}: an offset below {least} does not matter."
    if not one.is_off:
        return (
            f"its stamps may be {amount} {reference}: "
            "the 95 % interval excludes 0, the 99 % interval contains it."
        )
    off = f"its stamps are {amount}"
    if report.reference == TRUTH:
        return f"{off} the truth of the recording."
    return (
        f"{off} those of {report.reference}. {_bound(one, report)} {report.reference} is assumed to be right. To "
        "identify the wrong clock, give truth or a sensor with a known clock (--reference NAME)."
    )


def _bound(one: SensorOffset, report: OffsetReport) -> str:
    """Return a sentence on which of the two clocks must be wrong.

    No list is received before it was measured, so delays bound the offsets.
    """
    early, late = (
        (report.reference, one.sensor)
        if (one.offset_s or 0.0) > 0.0
        else (one.sensor, report.reference)
    )
    least_s = report.least_delays_s.get(early, 0.0)
    surely_s = report.surely_late_s(one)
    if least_s <= RECEIPT_S:
        return f"Either clock may be wrong: without delays of {early} its clock has no bound."
    text = (
        f"{early} arrives at least {milliseconds(least_s)} after its stamps, "
        "so its stamps are early by at most this time"
    )
    if surely_s is None:
        return f"{text}: either clock may be wrong."
    return f"{text}: the stamps of {late} are late by at least {milliseconds(abs(surely_s))}."


def clock_findings(
    report: OffsetReport, configured_s: Mapping[str, float]
) -> Iterator[Finding]:
    """Yield a finding for each sensor with a clock that differs from the reference, or with an unknown clock.

    `configured_s` contains, by sensor, the offset that the configuration subtracts already. The proposed setting is the
    sum of this offset and the estimate.
    """
    for one in report.others:
        if one.is_off and one.offset_s is not None:
            total_s = round(configured_s[one.sensor] + one.offset_s, 4)
            settings = {f"sensors.{one.sensor}.clock_offset_s": total_s}
            yield Finding("clock", one.sensor, 90.0, clock_text(one, report), settings)
        elif not one.is_known:
            yield Finding("offset", one.sensor, 15.0, clock_text(one, report))


def bias_findings(report: OffsetReport, ego: EgoConfig) -> Iterator[Finding]:
    """Yield findings on constant position errors against the truth.

    If all sensors share one error in the ego frame, the finding proposes another origin of the ego frame. Else there is
    a finding for each sensor with an error.
    """
    biased = {
        item.sensor: item.bias for item in report.sensors if item.bias is not None
    }
    biases_m = np.array(
        [(bias.ahead_m, bias.left_m) for bias in biased.values() if bias.frame == "ego"]
    )
    num_placed = sum(item.offset_s is not None for item in report.sensors)
    if (
        len(biases_m) == num_placed > 0
        and (np.ptp(biases_m, axis=0) < _SAME_BIAS_M).all()
    ):
        off_m = biases_m.mean(axis=0).tolist()
        text = f"detections of all sensors lie {_WHERE(*off_m)} of the truth, in the frame of the ego: set its origin."
        origins = zip("xy", ego.detection_origin_m, off_m, strict=True)
        settings = {
            f"ego.detection_origin_{axis}_m": round(now - off, 2)
            for axis, now, off in origins
            if off
        }
        yield Finding("bias", EGO, 88.0, text, settings)
        return
    for name, bias in biased.items():
        setting = (
            "mount"
            if bias.frame == "ego"
            else "near_side_m: it detects another point of a vehicle than the truth refers to"
        )
        text = f"its detections lie {_WHERE(*bias[1:])} of the truth, in the frame of the {bias.frame}"
        yield Finding("bias", name, 50.0, f"{text}: check sensors.{name}.{setting}.")

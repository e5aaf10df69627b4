"""Validity of stamps: zeros, other clocks, the future, changes of the delay, offsets of clocks and of positions."""

import math
from collections.abc import Iterator, Mapping

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

__all__ = ["bias_findings", "clock_findings", "clock_text", "stamp_findings"]

_AHEAD_S, _AHEAD_SHARE = 1e-3, 0.005  # rounding of stamps
_PARTS, _SHORTEST_PART_S = 10, 1.0  # of a recording, whose median delays are compared
_CHANGE_S, _JUMP_STDS = (
    0.015,
    7.0,
)  # of the mean delay before and after the best of seven splits
_DRIFT_STDS, _DRIFT_CORRELATION = (
    4.0,
    0.9,
)  # a steady drift is 5 apart, but correlates with time as chance does not
_WHERE = "{:.2f} m ahead and {:.2f} m left".format  # negative behind, and to the right
_SAME_BIAS_M = 0.5  # of sensors of one frame: what two calibrations, or two parts of a car, may differ by


def stamp_findings(one: Arrivals) -> Iterator[Finding]:
    """Yield the problems of the stamps and receipts of one sensor, or of the ego."""
    name, receipt = (
        one.name,
        {} if one.name == EGO else {f"sensors.{one.name}.stamp_from": "receipt"},
    )
    if not one.stamps_ns.any():
        if name != EGO:  # of the ego it is a suspicion of what is read
            text = f"all {len(one.stamps_ns)} stamps are 0: its driver sets none, so its delay stays unknown."
            yield Finding("clock", name, 95.0, text, receipt)
    elif one.is_other_clock:
        off_s = abs(float(np.median(one.delays_s)))
        text = f"stamps and receipts are {off_s:.3g} s apart: they are of clocks that have nothing in common."
        yield Finding("clock", name, 95.0, text, receipt)
    elif len(one.stamps_ns) >= FEWEST:
        ahead = float((one.delays_s < -_AHEAD_S).mean())
        if ahead > _AHEAD_SHARE:
            most_s = -float(np.quantile(one.delays_s, 0.01))
            text = (
                f"{percent(ahead)} of its stamps lie after their receipt, by up to {milliseconds(most_s)}: its clock "
                "is ahead of the recorder's by at least that."
            )
            yield Finding("clock", name, 85.0, text)
        if not one.usable.all():
            share = percent(1.0 - float(one.usable.mean()))
            text = f"{share} of its stamps are more than an hour from their receipt: wrong."
            yield Finding("clock", name, 40.0, text)
        if one.is_receipt and name != EGO:
            text = "every stamp is the receipt, so nothing is known of its delay; a constant one is its clock_offset_s."
            yield Finding("receipt", name, 20.0, text)
        yield from _change(one)


def _change(one: Arrivals) -> Iterator[Finding]:
    """Yield a change of the delay that lasts, by the medians of ten parts: a jump, or a drift."""
    times_s = (one.receipts_ns - one.receipts_ns[0]) / 1e9
    if len(times_s) < _PARTS * FEWEST or times_s[-1] < _PARTS * _SHORTEST_PART_S:
        return
    medians_s = np.array(
        [np.median(part) for part in np.array_split(one.delays_s, _PARTS)]
    )
    splits = range(2, _PARTS - 1)  # a change within the first or last tenth may pass
    halves = [np.split(medians_s, [k]) for k in splits]
    within = [float(a.var() * len(a) + b.var() * len(b)) for a, b in halves]
    k = int(np.argmin(within))
    before_s, after_s = (float(half.mean()) for half in halves[k])
    std_s = math.sqrt(
        within[k] / (_PARTS - 2) * (1.0 / splits[k] + 1.0 / (_PARTS - splits[k]))
    )
    change_s, at_s = (
        abs(after_s - before_s),
        times_s[splits[k] * len(times_s) // _PARTS],
    )
    if change_s < max(_CHANGE_S, _DRIFT_STDS * std_s):
        return
    correlation = np.corrcoef(medians_s, np.arange(_PARTS))[0, 1]
    if change_s >= _JUMP_STDS * std_s or abs(correlation) >= _DRIFT_CORRELATION:
        text = (
            f"its delay is {milliseconds(before_s)} until about {at_s:.0f} s and {milliseconds(after_s)} after that: "
            "its clock was set, or drifts, or a queue fills. No setting corrects that: synchronise the clock."
        )
        yield Finding("clock", one.name, 80.0, text)


def clock_text(one: SensorOffset, report: OffsetReport) -> str:
    """Return what is known of the clock of a sensor, what bounds it, and what is missing to identify it."""
    what = (
        "the truth of the recording"
        if report.reference == TRUTH
        else f"the clock of {report.reference}"
    )
    if one.offset_s is None or one.half_s is None:
        return f"its clock offset is not known: {one.why}."
    half, offset = milliseconds(one.half_s), f"{1e3 * one.offset_s:+.0f} ms"
    if not one.is_known:
        return f"its clock offset from {what} is not known: {offset} ± {half}."
    if one.agrees:
        return f"its stamps agree with {what} (offset {offset} ± {half})."
    side = "later" if one.offset_s > 0.0 else "earlier"
    amount = f"{milliseconds(abs(one.offset_s))} (± {half}) {side} than"
    if one.is_small:
        return f"its stamps are {amount} {what}: less than {milliseconds(SMALLEST_OFFSET_S)}, which does not matter."
    if not one.is_off:
        return f"its stamps may be {amount} {what}: the 95 % interval excludes 0, that of 99 % does not."
    off = f"its stamps are {amount}"
    if report.reference == TRUTH:
        return f"{off} the truth of the recording."
    return (
        f"{off} those of {report.reference}. {_bound(one, report)} To identify the wrong one of the two clocks takes "
        f"truth, or a sensor with a known clock (--reference NAME): {report.reference} is taken to be right."
    )


def _bound(one: SensorOffset, report: OffsetReport) -> str:
    """Return which of two clocks cannot be the only wrong one: nothing is received before it was measured."""
    early, late = (
        (report.reference, one.sensor)
        if (one.offset_s or 0.0) > 0.0
        else (one.sensor, report.reference)
    )
    least_s, surely_s = report.least_delays_s.get(early, 0.0), report.surely_late_s(one)
    if least_s <= RECEIPT_S:
        return f"Nothing bounds either clock: {early} has no delays."
    text = f"{early} is received {milliseconds(least_s)} after its stamps at least, so these are not earlier by more"
    if surely_s is None:
        return f"{text}: either clock may be wrong."
    return (
        f"{text}: at least {milliseconds(abs(surely_s))} of it is the clock of {late}."
    )


def clock_findings(
    report: OffsetReport, configured_s: Mapping[str, float]
) -> Iterator[Finding]:
    """Yield the sensors with a clock offset, or an unknown one; `configured_s` is what is taken off already."""
    for one in report.others:
        if one.is_off and one.offset_s is not None:
            total_s = round(configured_s[one.sensor] + one.offset_s, 4)
            settings = {f"sensors.{one.sensor}.clock_offset_s": total_s}
            yield Finding("clock", one.sensor, 90.0, clock_text(one, report), settings)
        elif not one.is_known:
            yield Finding("offset", one.sensor, 15.0, clock_text(one, report))


def bias_findings(report: OffsetReport, ego: EgoConfig) -> Iterator[Finding]:
    """Yield constant errors of position against the truth: of the ego frame, which a setting corrects, or others."""
    biased = {
        item.sensor: item.bias for item in report.sensors if item.bias is not None
    }
    biases_m = np.array(
        [(bias.ahead_m, bias.left_m) for bias in biased.values() if bias.of == "ego"]
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
        cure = (
            "mount"
            if bias.of == "ego"
            else "near_side_m: it sees another part of a vehicle than the truth means"
        )
        text = f"its detections lie {_WHERE(*bias[1:])} of the truth, in the frame of the {bias.of}"
        yield Finding("bias", name, 50.0, f"{text}: look at sensors.{name}.{cure}.")

"""Validity of stamps: zeros, other clocks, the future, jumps, drifts, offsets of clocks and of positions."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.calibration.arrivals import FEWEST, Arrivals
from fgtrack.calibration.clock_offsets import RECEIPT_S, TRUTH, Bias, OffsetReport, SensorOffset
from fgtrack.calibration.finding import Finding, milliseconds, percent
from fgtrack.core.diagnostic import EGO
from fgtrack.pipeline.config import EgoConfig

__all__ = [
    "ClockVerdict",
    "bias_findings",
    "clock_findings",
    "clock_verdicts",
    "receipt_findings",
    "stamp_findings",
]

_AHEAD_S = 1e-3  # rounding of stamps
_AHEAD_SHARE = 0.005
_JUMP_S, _JUMP_STDS, _JUMP_WINDOW_S = 0.1, 8.0, 3.0
_JUMP_LASTS_S = 5.0  # a change within the first or last seconds of a recording may pass
_SAME_BIAS_M = 0.5  # of sensors of one frame: what two calibrations, or two parts of a car, may differ by
_DRIFT_BINS, _DRIFT_S, _DRIFT_STDS, _DRIFT_FIT = 10, 0.01, 5.0, 0.8


def stamp_findings(one: Arrivals) -> Iterator[Finding]:
    """Yield the problems of the stamps and receipts of one sensor, or of the ego."""
    name, receipt = one.name, {} if one.name == EGO else {f"sensors.{one.name}.stamp_from": "receipt"}
    if not one.stamps_ns.any():
        if name != EGO:  # of the ego it is a suspicion of what is read
            text = f"all {len(one.stamps_ns)} stamps are 0: its driver sets none, so its delay stays unknown."
            yield Finding("clock", name, 95.0, text, receipt)
        return
    if one.is_other_clock:
        off_s = abs(float(np.median(one.delays_s)))
        text = f"stamps and receipts are {off_s:.3g} s apart: they are of clocks that have nothing in common."
        yield Finding("clock", name, 95.0, text, receipt)
        return
    if len(one.stamps_ns) < FEWEST:
        return
    ahead = one.delays_s < -_AHEAD_S
    if float(ahead.mean()) > _AHEAD_SHARE:
        most_s = -float(np.quantile(one.delays_s, 0.01))
        text = (
            f"{percent(float(ahead.mean()))} of its stamps lie after their receipt, by up to {milliseconds(most_s)}: "
            "its clock is ahead of the recorder's by at least that."
        )
        yield Finding("clock", name, 85.0, text)
    jump = _jump(one)
    if jump is not None:
        at_s, by_s = jump
        text = (
            f"its delay changes by {milliseconds(by_s)} at {at_s:.1f} s and stays so: its clock was set, or its driver "
            "restarted. No setting mends that: cut the recording there."
        )
        yield Finding("clock", name, 80.0, text)
        return
    drift = _drift(one)
    if drift is not None:
        ppm, std_ppm, by_s = drift
        text = (
            f"its delay {'grows' if ppm > 0.0 else 'shrinks'} by {abs(ppm):.3g} us per second (± {2.0 * std_ppm:.2g}), "
            f"{milliseconds(by_s)} over the recording: its clock drifts, or a queue fills. No setting mends that: "
            "synchronise the clock, or replay shorter pieces."
        )
        yield Finding("clock", name, 60.0, text)


def receipt_findings(arrivals: Sequence[Arrivals]) -> Iterator[Finding]:
    """Sensors whose stamps are their receipts."""
    names = [one.name for one in arrivals if one.is_receipt and len(one.counts) >= FEWEST]
    if names:
        text = (
            "every stamp is the receipt: the recording has no times of receipt, or they were taken for stamps. "
            "Nothing is known of the delay, and no advice on it is given"
        )
        text += "." if len(names) == len(arrivals) else "; its latency is sensors.NAME.clock_offset_s."
        yield Finding("receipt", ", ".join(names), 20.0, text)


def _jump(one: Arrivals) -> tuple[float, float] | None:
    """When, from the first receipt, the delay changed for good, and by how much."""
    delays_s, count = one.delays_s, len(one.delays_s)
    width = max(FEWEST // 2, math.ceil(_JUMP_WINDOW_S * count / max(one.duration_s, 1e-9)))
    if count < 2 * width:
        return None
    medians = np.array([np.median(delays_s[k : k + width]) for k in range(count - width + 1)])
    changes = medians[width:] - medians[:-width]
    place = int(np.abs(changes).argmax())
    middle_s = (medians[place] + medians[place + width]) / 2.0
    above = np.where((delays_s > middle_s) == (changes[place] > 0.0), 1, -1)
    split = int((np.cumsum(-above)[width - 1 : count - width]).argmax()) + width
    before, after = delays_s[:split], delays_s[split:]
    noise_s = 1.4826 * float(np.median(np.abs(np.diff(delays_s))))
    lasting_s = float(np.median(after) - np.median(before))
    if min(abs(float(changes[place])), abs(lasting_s)) < max(_JUMP_S, _JUMP_STDS * noise_s):
        return None
    at_s = float(one.receipts_ns[split] - one.receipts_ns[0]) / 1e9
    if not _JUMP_LASTS_S <= at_s <= one.duration_s - _JUMP_LASTS_S:
        return None
    return at_s, lasting_s


def _drift(one: Arrivals) -> tuple[float, float, float] | None:
    """Slope of the delay over time and its standard deviation in 1e-6, and the change over the recording in s."""
    if len(one.stamps_ns) < _DRIFT_BINS * 10 or one.duration_s < 10.0:
        return None
    parts = np.array_split(np.arange(len(one.delays_s)), _DRIFT_BINS)
    times_s = (one.receipts_ns - one.receipts_ns[0]) / 1e9
    middles_s = np.array([times_s[part].mean() for part in parts])
    medians_s = np.array([np.median(one.delays_s[part]) for part in parts])
    slope, offset = np.polyfit(middles_s, medians_s, 1)
    left = medians_s - slope * middles_s - offset
    around_s = middles_s - middles_s.mean()
    std = math.sqrt(float(left @ left) / (len(parts) - 2) / float(around_s @ around_s))
    change_s = float(slope) * one.duration_s
    explained = 1.0 - float(left @ left) / max(float(np.square(medians_s - medians_s.mean()).sum()), 1e-30)
    if abs(change_s) < _DRIFT_S or abs(slope) < _DRIFT_STDS * std or explained < _DRIFT_FIT:
        return None
    return 1e6 * float(slope), 1e6 * std, change_s


@dataclass(frozen=True)
class ClockVerdict:
    """Clock of one sensor; `str` gives the offset, its bound, and what is missing to know more."""

    sensor: str
    offset_s: float | None
    """To take off its stamps; None where they agree with the reference, or that is not known."""
    is_known: bool
    """True if the offset, which may be 0, is known."""
    known: str
    bound: str = ""
    missing: str = ""

    def __str__(self) -> str:
        return " ".join(filter(None, (self.known, self.bound, self.missing)))


def clock_verdicts(report: OffsetReport) -> list[ClockVerdict]:
    """Return what `report` says of the clock of each sensor but the reference."""
    return [_verdict(one, report) for one in report.sensors if one.sensor != report.reference]


def _verdict(one: SensorOffset, report: OffsetReport) -> ClockVerdict:
    what = "the truth of the recording" if report.reference == TRUTH else f"the clock of {report.reference}"
    if one.offset_s is None or one.half_s is None:
        return ClockVerdict(one.sensor, None, False, f"its clock offset is not known: {one.why}.")
    half, offset = milliseconds(one.half_s), f"{1e3 * one.offset_s:+.0f} ms"
    if not one.is_known:
        return ClockVerdict(one.sensor, None, False, f"its clock offset from {what} is not known: {offset} ± {half}.")
    if not one.is_off:
        return ClockVerdict(one.sensor, None, True, f"its stamps agree with {what} (offset {offset} ± {half}).")
    side = "later" if one.offset_s > 0.0 else "earlier"
    off = f"its stamps are {milliseconds(abs(one.offset_s))} (± {half}) {side} than"
    if report.reference == TRUTH:
        return ClockVerdict(one.sensor, one.offset_s, True, f"{off} the truth of the recording says.")
    return ClockVerdict(
        one.sensor,
        one.offset_s,
        True,
        f"{off} those of {report.reference}.",
        _bound(one, one.offset_s, report),
        f"To tell which of the two clocks is wrong takes truth, or a sensor whose clock is known (--reference NAME): "
        f"{report.reference} is taken to be right.",
    )


def _bound(one: SensorOffset, offset_s: float, report: OffsetReport) -> str:
    """Return which of two clocks cannot be the only wrong one: nothing is received before it was sensed."""
    early, late = (report.reference, one.sensor) if offset_s > 0.0 else (one.sensor, report.reference)
    least_s = report.least_delays_s.get(early, 0.0)
    if least_s <= RECEIPT_S:
        return f"Nothing bounds either clock: {early} has no delays that say something."
    text = f"{early} is received {milliseconds(least_s)} after its stamps at least, so these are not earlier by more"
    surely_s = report.surely_late_s(one)
    if surely_s is None:
        return f"{text}: either clock may be wrong."
    return f"{text}: at least {milliseconds(abs(surely_s))} of it is the clock of {late}."


def clock_findings(report: OffsetReport, configured_s: Mapping[str, float]) -> Iterator[Finding]:
    """Yield the sensors whose clock is off, or not known; `configured_s` is what is taken off already."""
    for one in clock_verdicts(report):
        if one.offset_s is not None:
            total_s = round(configured_s[one.sensor] + one.offset_s, 4)
            yield Finding("clock", one.sensor, 90.0, str(one), {f"sensors.{one.sensor}.clock_offset_s": total_s})
        elif not one.is_known:
            yield Finding("offset", one.sensor, 15.0, str(one))


def bias_findings(report: OffsetReport, ego: EgoConfig) -> Iterator[Finding]:
    """Yield constant errors of position against the truth: of the ego frame, which a setting corrects, or others."""
    biased = {one.sensor: one.bias for one in report.sensors if one.bias is not None}
    of_ego = [bias for bias in biased.values() if bias.of == Bias.EGO]
    placed = [one for one in report.sensors if one.offset_s is not None]
    common = len(of_ego) == len(placed) > 0 and all(
        np.ptp([getattr(one, name) for one in of_ego]) < _SAME_BIAS_M for name in ("ahead_m", "left_m")
    )
    if common:
        ahead_m, left_m = (float(np.mean([getattr(one, name) for one in of_ego])) for name in ("ahead_m", "left_m"))
        text = f"detections of all sensors lie {_where(ahead_m, left_m)} of the truth, in the frame of the ego: "
        text += "the origin of that frame is another."
        now_x_m, now_y_m = ego.detection_origin_m
        origin_m = {"ego.detection_origin_x_m": (now_x_m, ahead_m), "ego.detection_origin_y_m": (now_y_m, left_m)}
        settings = {key: round(now_m - off_m, 2) for key, (now_m, off_m) in origin_m.items() if off_m}
        yield Finding("bias", EGO, 88.0, text, settings)
        return
    for name, bias in biased.items():
        text = f"its detections lie {_where(bias.ahead_m, bias.left_m)} of the truth, in the frame of the {bias.of}: "
        text += (
            f"look at sensors.{name}.mount."
            if bias.of == Bias.EGO
            else f"it sees another part of a vehicle than the truth means (sensors.{name}.near_side_m)."
        )
        yield Finding("bias", name, 50.0, text)


def _where(ahead_m: float, left_m: float) -> str:
    parts = [f"{abs(ahead_m):.2f} m {'ahead' if ahead_m > 0.0 else 'behind'}"] if ahead_m else []
    parts += [f"{abs(left_m):.2f} m to the {'left' if left_m > 0.0 else 'right'}"] if left_m else []
    return " and ".join(parts)

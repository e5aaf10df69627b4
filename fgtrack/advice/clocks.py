"""Whether stamps can be believed: zeros, other clocks, the future, jumps, drifts, and offsets between sensors."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy.special import stdtrit

from fgtrack.advice.arrivals import FEWEST, Arrivals
from fgtrack.advice.finding import Finding, milliseconds, percent
from fgtrack.core.caution import EGO
from fgtrack.pipeline.clock_offsets import OffsetReport, SensorOffset
from fgtrack.pipeline.truth_offsets import TRUTH

__all__ = ["offset_findings", "receipt_findings", "stamp_findings"]

_AHEAD_S = 1e-3  # rounding of stamps
_AHEAD_SHARE = 0.005
_JUMP_S, _JUMP_STDS, _JUMP_WINDOW_S = 0.1, 8.0, 3.0
_DRIFT_BINS, _DRIFT_S, _DRIFT_STDS, _DRIFT_FIT = 10, 0.01, 5.0, 0.8
_SURE = 0.99  # an offset is believed where 0 is outside of this interval of Student's t ...
_OFFSET_STDS = 4.0  # ... or farther off than so many standard deviations, where these are of a model ...
_SMALLEST_OFFSET_S = 0.01  # ... if it matters
_LARGEST_STD_S = 0.05


def stamp_findings(one: Arrivals) -> Iterator[Finding]:
    """What the stamps and receipts of one sensor, or of the ego, show by themselves."""
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
            "started anew. No setting mends that: cut the recording there."
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
    at_ns = one.receipts_ns[split] - one.receipts_ns[0]
    return float(at_ns) / 1e9, lasting_s


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


def _believed_s(one: SensorOffset) -> tuple[float, float] | None:
    """The offset of a sensor and half of its 95 % interval; None where it may well be none."""
    if one.offset_s is None or not one.std_s or one.std_s > _LARGEST_STD_S:
        return None
    if one.dof is None:
        std_s = max(one.std_s * max(1.0, one.residual or 1.0), (one.spread_s or 0.0) * 2.0 / 3.0)
        least_s, half_s = _OFFSET_STDS * std_s, 2.0 * std_s
    else:
        least_s, half_s = (one.std_s * float(stdtrit(one.dof, 0.5 + share / 2.0)) for share in (_SURE, 0.95))
    return None if abs(one.offset_s) < max(least_s, _SMALLEST_OFFSET_S) else (one.offset_s, half_s)


def offset_findings(report: OffsetReport, configured_s: Mapping[str, float]) -> Iterator[Finding]:
    """Sensors whose clock does not agree with that of the reference; `configured_s` is what is taken off already."""
    for one in report.sensors:
        found = _believed_s(one)
        if found is None:
            continue
        offset_s, half_s = found
        off = f"{milliseconds(abs(offset_s))} (± {milliseconds(half_s)}) {'later' if offset_s > 0.0 else 'earlier'}"
        if report.reference == TRUTH:
            text = f"its stamps are {off} than the truth of the recording says."
        else:
            text = (
                f"its stamps are {off} than those of {report.reference}. Which of the two clocks is wrong the "
                f"recording does not tell: {report.reference} is taken to be right (--reference takes another)."
            )
        total_s = round(configured_s[one.sensor] + offset_s, 4)
        yield Finding("clock", one.sensor, 90.0, text, {f"sensors.{one.sensor}.clock_offset_s": total_s})

"""Tests of a recording and its configuration: each has a number, or the reason why it was not made."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgtrack.advice.run_quality import RunQuality
from fgtrack.clocks.agreement import Agreement
from fgtrack.clocks.arrivals import FEWEST, Arrivals
from fgtrack.clocks.offsets import TRUTH, OffsetReport, SensorOffset
from fgtrack.clocks.stamps import delay_change, share_ahead
from fgtrack.config.settings import Config
from fgtrack.core.diagnostic import EGO
from fgtrack.core.finding import Finding, milliseconds, percent
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.diagnostics import (
    FAILED_SHARE,
    FAR_OFF,
    MOST_BREAKS_PER_MINUTE,
    USED,
    lifetimes_and_breaks,
)
from fgtrack.evaluation.diagnostics import FEWEST as FEWEST_UPDATES
from fgtrack.meaning.decision import Decision
from fgtrack.runs import Run

__all__ = ["TRACKS", "Check", "Evidence", "checks", "dead_share", "ego_way_ratio"]

Verdict = Literal["fine", "finding", "untested"]
TRACKS = "tracks"
"""`Check.about` of the tests of the tracks."""
MOST_DEAD = 0.1
"""Largest share of the used detections that start a track which is never confirmed, for a verdict of fine."""
_LEAST_USED = 0.5
# Least tracked share of the time in view, for a verdict of fine.
_LEAST_TRACKED = 0.9
# Weight of a finding that makes other results of the same sensor doubtful.
_DOUBTFUL = 50.0
# Largest relative difference of the way of the ego's positions from the way of its speed.
WAY_TOLERANCE = 0.1
# Least way, and length of the steps over which it is measured.
_LEAST_WAY_M = 20.0
_WAY_STEP_NS = NS_PER_S


@dataclass(frozen=True)
class Check:
    """Result of one test."""

    about: str
    """Name of a sensor, `ego` or `tracks`."""
    what: str
    """Property: `stamps`, `clock`, `position`, `use`, `noise`, `window` ..."""
    verdict: Verdict
    """`fine`: the test was passed; `finding`: a finding reports the result; `untested`: the test was not made."""
    text: str
    """Test with its number, or the reason why it was not made."""

    def __str__(self) -> str:
        return f"{self.what}: {self.text}"


@dataclass(frozen=True)
class Evidence:
    """Results of an advice on which the tests are based."""

    config: Config
    findings: Sequence[Finding]
    ego: Arrivals | None
    sensors: Mapping[str, Arrivals]
    """Arrivals of the used sensors, with corrected stamps."""
    moving: Collection[str]
    """Sensors with detections in a moving frame."""
    clocks: OffsetReport | None
    agreements: Sequence[Agreement]
    decisions: Sequence[Decision]
    outcome: RunQuality | None

    def has(self, kind: str, about: str) -> bool:
        """True if there is a finding of this kind."""
        return any((item.kind, item.about) == (kind, about) for item in self.findings)

    def doubt(self, about: str) -> str | None:
        """Subject of a finding that makes results of the run doubtful for `about`; None if there is no such finding."""
        subjects = [about, *([EGO] if about in self.moving or about == TRACKS else [])]
        if about == TRACKS:
            subjects += [*self.sensors, "recording"]
        for item in self.findings:
            is_severe = item.weight >= _DOUBTFUL and not item.settings
            if not is_severe or item.kind in ("noise", "window", "tune"):
                continue
            if item.about in subjects or item.kind == "agreement":
                return item.about
        return None


def checks(evidence: Evidence) -> list[Check]:
    """Return all tests of the ego, of each sensor and of the tracks, in this order."""
    result: list[Check] = []
    if evidence.ego is not None:
        result += _ego(evidence, evidence.ego)
    for name, arrivals in evidence.sensors.items():
        for test in _SENSOR_TESTS:
            check = test(evidence, name, arrivals)
            if check is not None:
                result.append(check)
    return [*result, *_decided(evidence), *_tracks(evidence)]


def _verdict(is_fine: bool) -> Verdict:
    return "fine" if is_fine else "finding"


def _ego(evidence: Evidence, one: Arrivals) -> Iterator[Check]:
    """Yield the tests of the ego: rate, delay, stamps, and the way of its positions."""
    if len(one.stamps_ns) < FEWEST or not one.has_stamps or not one.period_s:
        yield Check(
            EGO,
            "states",
            "untested",
            f"{len(one.stamps_ns)} states with stamps, fewer than {FEWEST}",
        )
        return
    is_found = any(
        evidence.has(kind, EGO) for kind in ("ego", "clock", "input", "track")
    )
    longest = milliseconds(float(one.steps_s.max()))
    yield Check(
        EGO,
        "states",
        _verdict(not is_found),
        f"{1.0 / one.period_s:.0f} Hz, longest gap {longest}, {round(share_ahead(one) * len(one.stamps_ns))} of "
        f"{len(one.stamps_ns)} stamps after their receipt",
    )
    delay_s = one.quantile_s(0.5)
    lists_s = [
        item.quantile_s(0.5)
        for name, item in evidence.sensors.items()
        if name in evidence.moving and item.has_stamps
    ]
    if lists_s:
        text = f"{milliseconds(delay_s)}, the lists that need it {milliseconds(min(lists_s))} and more"
        yield Check(EGO, "delay", _verdict(not is_found), text)
    run = None if evidence.outcome is None else evidence.outcome.run
    ratio = None if run is None else ego_way_ratio(run)
    if ratio is None:
        yield Check(
            EGO,
            "positions against speed",
            "untested",
            f"it moves less than {_LEAST_WAY_M:g} m, or has no speed",
        )
    else:
        text = f"its positions move {ratio:.3g} times the way of its speed"
        yield Check(
            EGO,
            "positions against speed",
            _verdict(abs(ratio - 1.0) <= WAY_TOLERANCE),
            text,
        )


def ego_way_ratio(run: Run) -> float | None:
    """Return the way of the ego's positions over the way of its speed, in steps of a second.

    None for a short way by both, or without states.
    """
    table = run.tables["ego"]
    order = np.argsort(table["stamp_ns"], kind="stable")
    stamps_ns = table["stamp_ns"][order]
    if len(stamps_ns) < FEWEST:
        return None
    step = max(1, round(_WAY_STEP_NS / max(float(np.median(np.diff(stamps_ns))), 1.0)))
    rows = order[::step]
    positions_m = np.stack([table["x_m"][rows], table["y_m"][rows]], axis=-1)
    moved_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=-1)
    speeds_mps = np.abs(table["speed_mps"])[order]
    steps_s = np.diff(stamps_ns, append=stamps_ns[-1:]) / NS_PER_S
    ways_m = np.add.reduceat(speeds_mps * steps_s, np.arange(0, len(order), step))[
        : len(moved_m)
    ]
    usable = np.isfinite(moved_m) & np.isfinite(ways_m)
    moved, way = float(moved_m[usable].sum()), float(ways_m[usable].sum())
    if max(moved, way) < _LEAST_WAY_M or way <= 0.0:
        return None
    return moved / way


def _stamps(evidence: Evidence, name: str, one: Arrivals) -> Check | None:
    if not one.has_stamps or len(one.stamps_ns) < FEWEST:
        return _open(
            name,
            "stamps",
            evidence.has("clock", name),
            f"{len(one.stamps_ns)} usable stamps, fewer than {FEWEST}",
        )
    if one.is_receipt:
        return Check(
            name,
            "stamps",
            "untested",
            "they equal the receipts, so the delay is unknown",
        )
    ahead = round(share_ahead(one) * len(one.stamps_ns))
    text = f"{ahead} of {len(one.stamps_ns)} after their receipt"
    if (change := delay_change(one)) is not None:
        text = f"{text}, the delay changes by {milliseconds(change.change_s)} (limit {milliseconds(change.limit_s)})"
    return Check(name, "stamps", _verdict(not evidence.has("clock", name)), text)


def _clock(evidence: Evidence, name: str, one: Arrivals) -> Check | None:
    report = evidence.clocks
    if report is None:
        return Check(
            name,
            "clock",
            "untested",
            "no object is tracked well enough, or a finding forbids it",
        )
    if name == report.reference and len(report.sensors) == 1:
        return Check(name, "clock", "untested", "no truth, and no second sensor")
    if name == report.reference:
        return Check(
            name,
            "clock",
            "untested",
            "the reference of the other clocks; only truth shows its offset",
        )
    found = next((item for item in report.sensors if item.sensor == name), None)
    if found is None:
        return Check(name, "clock", "untested", "no detections of tracked objects")
    if not found.is_known or found.offset_s is None or found.half_s is None:
        return Check(name, "clock", "untested", _unknown(found))
    against = "the truth" if report.reference == TRUTH else report.reference
    text = (
        f"{1e3 * found.offset_s:+.0f} ms ± {milliseconds(found.half_s)} from {against}"
    )
    return Check(name, "clock", _verdict(not evidence.has("clock", name)), text)


def _unknown(found: SensorOffset) -> str:
    if found.offset_s is None or found.half_s is None:
        return found.why
    return f"{1e3 * found.offset_s:+.0f} ms ± {milliseconds(found.half_s)} is too wide"


def _position(evidence: Evidence, name: str, one: Arrivals) -> Check | None:
    """Test of frame and mount: compare the positions with the positions of another sensor."""
    found = next((item for item in evidence.agreements if item.sensor == name), None)
    if found is None:
        others = {item.reference for item in evidence.agreements}
        reason = (
            "the reference of the other sensors"
            if name in others
            else "no second sensor with positions to compare"
        )
        return Check(name, "frame and mount", "untested", reason)
    if not found.is_known:
        share = percent(found.share)
        reason = f"{share} of {found.pairs} pairs with {found.reference} have a common displacement"
        return Check(name, "frame and mount", "untested", reason)
    is_found = evidence.has("agreement", name) or evidence.has("input", name)
    return Check(name, "frame and mount", _verdict(not is_found), str(found))


def _use(evidence: Evidence, name: str, one: Arrivals) -> Check | None:
    outcome = evidence.outcome
    counts = {} if outcome is None else dict(outcome.run.meta["counts"]).get(name, {})
    total = sum(counts.values())
    if outcome is None or not total:
        return Check(name, "use", "untested", "no detections in the replayed part")
    used = outcome.used.get(name, 0.0)
    failed = counts.get("failed", 0) / total
    rest = {
        fate: count
        for fate, count in counts.items()
        if fate not in (*USED, "failed") and count
    }
    most = max(rest, key=rest.__getitem__, default=None)
    unused = "" if most is None else f", {percent(rest[most] / total)} {most}"
    is_fine = (
        used >= _LEAST_USED
        and failed <= FAILED_SHARE
        and not evidence.has("track", name)
    )
    text = (
        f"{percent(used)} of {total} detections used (limit {percent(_LEAST_USED)}){unused}, {percent(failed)} failed "
        f"(limit {percent(FAILED_SHARE)})"
    )
    return _unless(evidence.doubt(name), Check(name, "use", _verdict(is_fine), text))


def _noise(evidence: Evidence, name: str, one: Arrivals) -> Check | None:
    doubt = evidence.doubt(name)
    if doubt is not None:
        return Check(name, "noise", "untested", f"the finding on {doubt} comes first")
    noise = () if evidence.outcome is None else evidence.outcome.noise
    fit = next((item for item in noise if item.sensor == name), None)
    if fit is None or fit.count < FEWEST_UPDATES:
        return Check(
            name,
            "noise",
            "untested",
            f"{0 if fit is None else fit.count} innovations, fewer than {FEWEST_UPDATES}",
        )
    is_fine = fit.is_consistent and not evidence.has("noise", name)
    text = f"{fit}; limit {1.0 / FAR_OFF:.2g} to {FAR_OFF:g}"
    return Check(name, "noise", _verdict(is_fine), text)


def _window(evidence: Evidence, name: str, one: Arrivals) -> Check | None:
    if not one.has_stamps or one.is_receipt:
        return None
    reach = evidence.config.effective
    limit_s = evidence.config.sensors[name].max_delay_s
    late = round(one.share_later_than(reach.reach_s) * one.counts.sum())
    text = f"{late} of {one.counts.sum()} detections later than {reach.lag_key} allows ({reach.reach_s:g} s)"
    if limit_s is not None:
        refused = round(one.share_later_than(limit_s) * one.counts.sum())
        text = f"{text}, {refused} later than max_delay_s ({limit_s:g} s)"
    is_found = evidence.has("window", name) or evidence.has("window", "window")
    return Check(name, "window", _verdict(not is_found), text)


def _open(about: str, what: str, is_found: bool, text: str) -> Check:
    return Check(about, what, "finding" if is_found else "untested", text)


_SENSOR_TESTS: Sequence[Callable[[Evidence, str, Arrivals], Check | None]] = (
    _stamps,
    _clock,
    _position,
    _use,
    _noise,
    _window,
)


def _decided(evidence: Evidence) -> Iterator[Check]:
    """Yield the decisions about what the numbers mean: tested ones, and assumed ones as not tested."""
    for item in evidence.decisions:
        if item.certainty == "tested":
            yield Check(item.about, item.what, "fine", item.reason)
        elif item.certainty == "assumed" and item.what != "role":
            yield Check(item.about, item.what, "untested", f"assumed: {item.reason}")


def dead_share(outcome: RunQuality) -> tuple[int, int]:
    """Return the number of births that were never confirmed, and the number of used detections."""
    used = sum(
        round(share * sum(dict(outcome.run.meta["counts"])[name].values()))
        for name, share in outcome.used.items()
    )
    return max(outcome.births - outcome.confirmed, 0), used


def _tracks(evidence: Evidence) -> Iterator[Check]:
    """Yield the tests of the tracks: unconfirmed births, breaks, and the truth."""
    outcome = evidence.outcome
    if outcome is None:
        yield Check(TRACKS, "births", "untested", "nothing can be tracked")
        return
    doubt = evidence.doubt(TRACKS)
    dead, used = dead_share(outcome)
    is_found = evidence.has("track", TRACKS) or not outcome.confirmed
    is_fine = not is_found and dead <= MOST_DEAD * used
    share = percent(dead / max(used, 1))
    text = (
        f"{dead} of {used} used detections began a track that was never confirmed ({share}, limit "
        f"{percent(MOST_DEAD)})"
    )
    yield _unless(doubt, Check(TRACKS, "births", _verdict(is_fine), text))
    breaks, rate = _breaks(outcome)
    text = (
        f"{breaks}, {rate:.2g} per object and minute (limit {MOST_BREAKS_PER_MINUTE:g})"
    )
    is_fine = not is_found and rate <= MOST_BREAKS_PER_MINUTE
    yield _unless(doubt, Check(TRACKS, "breaks", _verdict(is_fine), text))
    if outcome.truth is None:
        yield Check(
            TRACKS,
            "errors",
            "untested",
            "the recording has no truth; errors are predicted only",
        )
    else:
        truth = outcome.truth
        errors_m = truth.errors["position_m"]
        size = (
            f"position RMSE {errors_m.rmse:.3g} m"
            if errors_m.count
            else "no track to measure a position error of"
        )
        share = percent(truth.tracked_share_in_view)
        text = f"{share} of the time in view tracked (limit {percent(_LEAST_TRACKED)}), {size}"
        is_fine = truth.tracked_share_in_view >= _LEAST_TRACKED and not is_found
        yield _unless(doubt, Check(TRACKS, "truth", _verdict(is_fine), text))


def _breaks(outcome: RunQuality) -> tuple[int, float]:
    """Return the number of breaks, and their rate per object and minute; without truth from the tracks alone."""
    if outcome.truth is not None:
        return outcome.truth.breaks, outcome.breaks_per_minute
    lifetimes_s, breaks = lifetimes_and_breaks(outcome.run)
    return breaks, breaks / max(float(lifetimes_s.sum()) / 60.0, 1.0)


def _unless(doubt: str | None, check: Check) -> Check:
    """Return `check`; as not tested if a finding on `doubt` makes its result doubtful."""
    if doubt is None or check.verdict != "fine":
        return check
    return Check(
        check.about,
        check.what,
        "untested",
        f"the finding on {doubt} comes first ({check.text})",
    )

"""Quality of a run in the few numbers that advice is judged by, and the consistency of its noise."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.finding import Finding, percent
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.comparison import POSITION_NEES, comparisons
from fgtrack.evaluation.diagnostics import CORRELATED, FAR_OFF, FEWEST, USED, misfits
from fgtrack.evaluation.intervals import Estimate, by_stamp, mean_square
from fgtrack.evaluation.metrics import ObjectMetrics, evaluate
from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.evaluation.scores.innovations import autocorrelation, num_measured
from fgtrack.runs import Run

__all__ = ["NoiseFit", "Outcome", "harm", "noise_findings", "noise_fits", "objection"]

_SMALLEST = 1e-3  # ratio of NIS below which ratios are the same


@dataclass(frozen=True)
class NoiseFit:
    """The normalised innovations squared of one sensor."""

    sensor: str
    count: int
    ratio: Estimate
    """Mean NIS over what is expected; the interval considers that innovations are correlated."""
    lag1: float | None
    """Autocorrelation of its position innovations at lag 1, of tracks that are long enough; near 0 where its errors are
    white and the noise is consistent."""

    @property
    def lasts(self) -> bool:
        """True if its innovations are correlated in time."""
        return self.lag1 is not None and self.lag1 > CORRELATED

    @property
    def is_consistent(self) -> bool:
        """True if there are enough innovations, and their mean NIS is that expected, to a factor."""
        return self.count >= FEWEST and 1.0 / FAR_OFF <= self.ratio.mean <= FAR_OFF

    def __str__(self) -> str:
        known = (
            f"{self.ratio.low:.3g} to {self.ratio.high:.3g}, "
            if self.ratio.is_known
            else ""
        )
        return f"mean NIS is {self.ratio.mean:.3g} times what is expected ({known}{self.count} innovations)"


def noise_fits(run: Run) -> list[NoiseFit]:
    """Return the fits of every sensor with innovations."""
    updates, dof = run.tables["updates"], num_measured(run.tables["updates"])
    fits = []
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = (updates["sensor"] == sensor) & np.isfinite(updates["nis"]) & (dof > 0)
        if not mine.any():
            continue
        samples = np.stack(
            [updates["nis"][mine], dof[mine].astype(np.float64)], axis=-1
        )
        ratio = mean_square(by_stamp(updates["stamp_ns"][mine], samples))
        white = autocorrelation(updates.where(updates["sensor"] == sensor))
        fits.append(
            NoiseFit(
                sensor, int(mine.sum()), ratio, None if white is None else white.lag1
            )
        )
    return fits


def noise_findings(outcome: "Outcome") -> Iterator[Finding]:
    """Yield sensors whose noise does not fit, and those of which a few innovations are far too large."""
    off = dict(misfits(outcome.run))
    for one in outcome.noise:
        if one.sensor in off:
            factor = math.sqrt(one.ratio.mean)
            size = "small" if factor > 1.0 else "large"
            lag1 = "" if one.lag1 is None else f" (autocorrelation {one.lag1:.2f})"
            cause = f"Innovations are white enough{lag1} to fit it (--tune)."
            if one.lasts:
                cause = f"Innovations are correlated in time{lag1}: so are its errors, or process noise is too small"
                cause += "; fitted white noise (--tune) is taken only if innovations are white then."
            text = f"{one}: the configured noise is too {size}, as if errors were {factor:.2g} times as large. {cause}"
            weight = min(
                30.0 + 10.0 * abs(math.log(max(one.ratio.mean, _SMALLEST))), 75.0
            )
            yield Finding("noise", one.sensor, weight, text)
        elif one.count >= FEWEST and not one.is_consistent:
            text = f"{one}, but its median is as expected: a few innovations are far off. Look at its clutter and the "
            text += (
                f"gate, or try sensors.{one.sensor}.loss: {{kind: huber, width: 3.0}}."
            )
            yield Finding("noise", one.sensor, 45.0, text)


_CHANCE = 2.0  # standard deviations of the difference of two counts
_MORE_USED = 0.05  # share of the detections of a sensor
_LESS = 0.02  # share of states that fewer are tracked by where it counts
_POSITION_DOF = 2.0


@dataclass(frozen=True)
class Outcome:
    """Quality of a run in a few numbers."""

    births: int
    """Beginnings of tracks."""
    confirmed: int
    """Tracks that were ever confirmed."""
    used: Mapping[str, float]
    """Share of the detections of each sensor that took part."""
    noise: tuple[NoiseFit, ...]
    """NIS over what is expected, by sensor."""
    truth: ObjectMetrics | None
    """All true objects together; None for a recording without truth."""
    tick_s: float
    """Time between two ticks."""
    run: Run = field(repr=False)

    @classmethod
    def of(cls, run: Run) -> "Outcome":
        """Return the numbers of `run`."""
        counts = dict(run.meta["counts"])
        used = {
            name: sum(item.get(fate, 0) for fate in USED) / (sum(item.values()) or 1)
            for name, item in counts.items()
        }
        metrics, ticks_ns = evaluate(run), run.tables["timing"]["now_ns"]
        return cls(
            births=int(
                np.count_nonzero(run.tables["updates"]["disposition"] == "birth")
            ),
            confirmed=metrics.num_confirmed,
            used=used,
            noise=tuple(noise_fits(run)),
            truth=None if metrics.truth is None else metrics.truth.overall,
            tick_s=float(np.ptp(ticks_ns)) / NS_PER_S / max(len(ticks_ns) - 1, 1)
            if len(ticks_ns)
            else 0.0,
            run=run,
        )

    @property
    def breaks_per_minute(self) -> float:
        """Breaks of tracking per true object and minute; NaN without truth."""
        minutes = (
            0.0 if self.truth is None else self.truth.ticks_present * self.tick_s / 60.0
        )
        return (
            math.nan
            if self.truth is None or not minutes
            else self.truth.breaks / minutes
        )

    def rows(self) -> Iterator[tuple[str, float]]:
        """Yield what a page shows, with units."""
        yield "beginnings of tracks", self.births
        yield "tracks confirmed", self.confirmed
        if self.truth is not None:
            yield "tracked [%]", 100.0 * self.truth.tracked_share_in_view
            yield "breaks per object and minute", self.breaks_per_minute
            yield "identity switches", self.truth.id_switches
            yield "position RMSE [m]", self.truth.errors["position_m"].rmse
        for name, share in self.used.items():
            yield f"detections used, {name} [%]", 100.0 * share
        for one in self.noise:
            yield f"NIS / expected, {one.sensor}", one.ratio.mean


def harm(before: Outcome, after: Outcome) -> str | None:
    """Return what gets worse from one run to another, with its numbers; None where nothing does.
    Counts get worse where they rise by more than two standard deviations of their difference (Poisson). Where clearly
    more detections of a sensor are used, the two runs are not of the same data, and nothing is harm.
    """
    if any(
        share > before.used.get(name, 0.0) + _MORE_USED
        for name, share in after.used.items()
    ):
        return None
    for name, share in after.used.items():
        if share < before.used.get(name, 0.0) - _LESS:
            return f"detections of {name} that are used go from {percent(before.used[name])} to {percent(share)}"
    old, new = before.truth, after.truth
    if old is not None and new is not None:
        was_share, share = old.tracked_share_in_view, new.tracked_share_in_view
        if share < was_share - _LESS:
            return f"the share of time tracked goes from {percent(was_share)} to {percent(share)}"
        if share > was_share + _LESS:
            return None
        counts = (
            ("identity switches", old.id_switches, new.id_switches),
            ("breaks", old.breaks, new.breaks),
        )
        for what, was, now in counts:
            if now - was > _CHANCE * math.sqrt(now + was):
                return f"{what} go from {was} to {now}"
    if after.confirmed - before.confirmed > _CHANCE * math.sqrt(
        after.confirmed + before.confirmed
    ):
        return f"confirmed tracks go from {before.confirmed} to {after.confirmed}"
    return None


def objection(before: Outcome, after: Outcome) -> str | None:
    """Return why the fitted noise of the run `after` is not taken, in words; None where nothing speaks against it."""
    for one in filter(lambda one: one.lasts, after.noise):
        return (
            f"innovations of {one.sensor} are still correlated in time (autocorrelation {one.lag1:.2f}): so are "
            "errors, of it or of the sensor that is trusted more, and white noise cannot express that; "
            "sensors.NAME.correlation can, with std and time_s from truth or a data sheet"
        )
    for sensor, nis in misfits(after.run):
        return f"mean NIS of {sensor} is {nis.mean:.3g} then, expected {nis.dof:.3g}"
    if (worse := harm(before, after)) is not None:
        return f"{worse}: tracks break at errors that the noise does not expect"
    runs = [EvaluatedRun("before", before.run), EvaluatedRun("after", after.run)]
    for name, entries in (
        each for one in comparisons(runs) for each in one.quantities.items()
    ):
        result = {entry.name: entry for entry in entries}
        was, now = result["before"].value, result["after"].value
        fits = name == POSITION_NEES and 1.0 / FAR_OFF <= now / _POSITION_DOF <= FAR_OFF
        if result["after"].standing == "worse" and not fits:
            return f"{name} against the truth of the recording goes from {was:.3g} to {now:.3g}"
    return None

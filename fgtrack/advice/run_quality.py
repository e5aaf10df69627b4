"""Quality of a run in a few numbers for advice, and the consistency of its noise."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.finding import Finding, percent
from fgtrack.core.time import NS_PER_S
from fgtrack.evaluation.comparison import POSITION_NEES, comparisons
from fgtrack.evaluation.diagnostics import (
    CORRELATED,
    FAR_OFF,
    FEWEST,
    USED,
    inconsistent_sensors,
)
from fgtrack.evaluation.intervals import Estimate, mean_square, sums_by_stamp
from fgtrack.evaluation.metrics import ObjectMetrics, evaluate
from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.evaluation.scores.innovations import autocorrelation, num_measured
from fgtrack.runs import Run

__all__ = [
    "NoiseFit",
    "RunQuality",
    "harm",
    "noise_findings",
    "noise_fits",
    "objection",
]

# Least NIS ratio in the weight of a finding; smaller ratios weigh the same.
_SMALLEST = 1e-3


@dataclass(frozen=True)
class NoiseFit:
    """Consistency of one sensor's normalised innovations squared (NIS)."""

    sensor: str
    count: int
    ratio: Estimate
    """Mean NIS over its expected value; the interval takes correlated innovations into account."""
    lag1: float | None
    """Autocorrelation of the sensor's position innovations at lag 1; None if no track is long enough.

    It is near 0 for white errors and consistent noise.
    """

    @property
    def is_correlated(self) -> bool:
        """True if the innovations are correlated in time."""
        return self.lag1 is not None and self.lag1 > CORRELATED

    @property
    def is_consistent(self) -> bool:
        """True if there are enough innovations and their mean NIS is near its expected value."""
        return self.count >= FEWEST and 1.0 / FAR_OFF <= self.ratio.mean <= FAR_OFF

    def __str__(self) -> str:
        known = (
            f"{self.ratio.low:.3g} to {self.ratio.high:.3g}, "
            if self.ratio.is_known
            else ""
        )
        return f"mean NIS is {self.ratio.mean:.3g} times the expected value ({known}{self.count} innovations)"


def noise_fits(run: Run) -> list[NoiseFit]:
    """Return the consistency of every sensor with innovations."""
    updates = run.tables["updates"]
    dof = num_measured(run.tables["updates"])
    fits = []
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = (updates["sensor"] == sensor) & np.isfinite(updates["nis"]) & (dof > 0)
        if not mine.any():
            continue
        samples = np.stack(
            [updates["nis"][mine], dof[mine].astype(np.float64)], axis=-1
        )
        ratio = mean_square(sums_by_stamp(updates["stamp_ns"][mine], samples))
        white = autocorrelation(updates.where(updates["sensor"] == sensor))
        fits.append(
            NoiseFit(
                sensor, int(mine.sum()), ratio, None if white is None else white.lag1
            )
        )
    return fits


def noise_findings(outcome: "RunQuality") -> Iterator[Finding]:
    """Yield findings on sensors with inconsistent noise, and on sensors with a few very large innovations."""
    off = dict(inconsistent_sensors(outcome.run))
    for one in outcome.noise:
        if one.sensor in off:
            factor = math.sqrt(one.ratio.mean)
            size = "small" if factor > 1.0 else "large"
            lag1 = "" if one.lag1 is None else f" (autocorrelation {one.lag1:.2f})"
            cause = f"Innovations are white enough{lag1} to fit the noise (--tune)."
            if one.is_correlated:
                cause = (
                    f"Innovations are autocorrelated{lag1}: the errors of this sensor are correlated in time, or the "
                    "process noise is too small. Fitted noise (--tune) is adopted only if it makes innovations white."
                )
            text = f"{one}: the configured noise is too {size}; errors are {factor:.2g} times as large. {cause}"
            weight = min(
                30.0 + 10.0 * abs(math.log(max(one.ratio.mean, _SMALLEST))), 75.0
            )
            yield Finding("noise", one.sensor, weight, text)
        elif one.count >= FEWEST and not one.is_consistent:
            text = (
                f"{one}, but its median is as expected: a few innovations are very large. Check its clutter and the "
                f"gate, or try sensors.{one.sensor}.loss: {{kind: huber, width: 3.0}}."
            )
            yield Finding("noise", one.sensor, 45.0, text)


# Significant difference of two counts, in its standard deviations.
_CHANCE = 2.0
# Increase of the share of a sensor's used detections that makes two runs incomparable.
_MORE_USED = 0.05
# Significant decrease of the share of used detections, or of tracked states.
_LESS = 0.02
_POSITION_DOF = 2.0


@dataclass(frozen=True)
class RunQuality:
    """Quality of a run in a few numbers."""

    births: int
    """Number of track births."""
    confirmed: int
    """Number of tracks that were confirmed at any time."""
    used: Mapping[str, float]
    """Share of the used detections by sensor."""
    noise: tuple[NoiseFit, ...]
    """Consistency of the noise by sensor."""
    truth: ObjectMetrics | None
    """Metrics over all true objects together; None for a recording without truth."""
    tick_s: float
    """Time between two ticks."""
    run: Run = field(repr=False)

    @classmethod
    def of(cls, run: Run) -> "RunQuality":
        """Return the quality of `run`: used detections, births, consistency of the noise, and metrics of the truth."""
        counts = dict(run.meta["counts"])
        used = {
            name: sum(item.get(fate, 0) for fate in USED) / (sum(item.values()) or 1)
            for name, item in counts.items()
        }
        metrics = evaluate(run)
        ticks_ns = run.tables["timing"]["now_ns"]
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
        """Track breaks per minute in which a true object is present; NaN without truth.

        A break is a resumption of tracking after a loss, or with another track.
        """
        minutes = (
            0.0 if self.truth is None else self.truth.ticks_present * self.tick_s / 60.0
        )
        return (
            math.nan
            if self.truth is None or not minutes
            else self.truth.breaks / minutes
        )

    def rows(self) -> Iterator[tuple[str, float]]:
        """Yield the name, with unit, and the value of each number."""
        yield "track births", self.births
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


def harm(before: RunQuality, after: RunQuality) -> str | None:
    """Return a clause with numbers on the result that gets worse between two runs; None if none does.

    A count gets worse if it rises by more than two standard deviations of the
    difference (Poisson). If clearly more detections of a sensor are used, the two runs
    do not compare, and the result is None.
    """
    if any(
        share > before.used.get(name, 0.0) + _MORE_USED
        for name, share in after.used.items()
    ):
        return None
    for name, share in after.used.items():
        if share < before.used.get(name, 0.0) - _LESS:
            return f"used detections of {name} fall from {percent(before.used[name])} to {percent(share)}"
    old = before.truth
    new = after.truth
    if old is not None and new is not None:
        was_share = old.tracked_share_in_view
        share = new.tracked_share_in_view
        if share < was_share - _LESS:
            return f"the tracked share of time falls from {percent(was_share)} to {percent(share)}"
        if share > was_share + _LESS:
            return None
        counts = (
            ("identity switches", old.id_switches, new.id_switches),
            ("breaks", old.breaks, new.breaks),
        )
        for what, was, now in counts:
            if now - was > _CHANCE * math.sqrt(now + was):
                return f"{what} rise from {was} to {now}"
    if after.confirmed - before.confirmed > _CHANCE * math.sqrt(
        after.confirmed + before.confirmed
    ):
        return f"confirmed tracks rise from {before.confirmed} to {after.confirmed}"
    return None


def objection(before: RunQuality, after: RunQuality) -> str | None:
    """Return a clause on why the fitted noise of the run `after` is not adopted; None if nothing speaks against it."""
    for one in filter(lambda one: one.is_correlated, after.noise):
        return (
            f"innovations of {one.sensor} remain autocorrelated ({one.lag1:.2f}): model time-correlated errors of this "
            "sensor, or of the most accurate one (sensors.NAME.correlation), with std and time_s from truth or a data "
            "sheet"
        )
    for sensor, nis in inconsistent_sensors(after.run):
        return f"mean NIS of {sensor} is {nis.mean:.3g}, expected {nis.dof:.3g}"
    if (worse := harm(before, after)) is not None:
        return f"{worse}: errors are larger than this noise, so tracks break"
    runs = [EvaluatedRun("before", before.run), EvaluatedRun("after", after.run)]
    for name, entries in (
        each for one in comparisons(runs) for each in one.quantities.items()
    ):
        result = {entry.name: entry for entry in entries}
        was = result["before"].value
        now = result["after"].value
        fits = name == POSITION_NEES and 1.0 / FAR_OFF <= now / _POSITION_DOF <= FAR_OFF
        if result["after"].standing == "worse" and not fits:
            return f"{name} against the truth of the recording goes from {was:.3g} to {now:.3g}"
    return None

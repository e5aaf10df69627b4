"""Whether the innovations of a run fit the configured noise, and whether errors last."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.advice.finding import Finding
from fgtrack.evaluation.cautions import FAR_OFF, FEWEST, misfits
from fgtrack.evaluation.contest import POSITION_NEES, contests
from fgtrack.evaluation.innovations import autocorrelations, num_measured
from fgtrack.evaluation.paired import Estimate, by_stamp, mean_square
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.io.run import Run

__all__ = ["NoiseFit", "noise_findings", "noise_fits", "objection"]

_LASTING = 0.3  # autocorrelation of innovations at lag 1
_CHANCE = 2.0  # standard deviations of the difference of two counts
_POSITION_DOF = 2.0
_SMALLEST = 1e-3  # ratio of NIS that is told from one that is smaller


@dataclass(frozen=True)
class NoiseFit:
    """The normalised innovations squared of one sensor."""

    sensor: str
    count: int
    ratio: Estimate
    """Mean NIS over what is expected; the interval knows that innovations resemble each other."""
    lag1: float | None
    """Autocorrelation of its position innovations at lag 1, of tracks that are long enough; near 0 where its errors are
    white and the noise fits."""

    @property
    def lasts(self) -> bool:
        """Whether its innovations resemble the one before."""
        return self.lag1 is not None and self.lag1 > _LASTING

    def __str__(self) -> str:
        known = f"{self.ratio.low:.3g} to {self.ratio.high:.3g}, " if self.ratio.is_known else ""
        return f"mean NIS is {self.ratio.mean:.3g} times what is expected ({known}{self.count} innovations)"


def noise_fits(run: Run) -> list[NoiseFit]:
    """Of every sensor with innovations."""
    updates, dof = run.updates, num_measured(run.updates)
    fits = []
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = (updates["sensor"] == sensor) & np.isfinite(updates["nis"]) & (dof > 0)
        if not mine.any():
            continue
        samples = np.stack([updates["nis"][mine], dof[mine].astype(np.float64)], axis=-1)
        ratio = mean_square(by_stamp(updates["stamp_ns"][mine], samples), np.random.default_rng(0))
        found = autocorrelations(updates.where(updates["sensor"] == sensor))
        first = next(iter(found.values()), None)
        fits.append(NoiseFit(sensor, int(mine.sum()), ratio, None if first is None else first.lag1))
    return fits


def noise_findings(run: Run, fits: list[NoiseFit], tune: bool) -> Iterator[Finding]:
    """Sensors whose noise does not fit, and those of which a few innovations are far too large.

    With `tune` noise is fitted afterwards, which need not be offered.
    """
    off = dict(misfits(run))
    for one in fits:
        sensor = one.sensor
        if sensor not in off:
            if one.count >= FEWEST and one.ratio.low > FAR_OFF:
                text = (
                    f"{one}, but its median is right: a few detections are of something else. "
                    f"Look at its clutter and the gate, or set sensors.{sensor}.loss: {{kind: huber, width: 3.0}}."
                )
                yield Finding("noise", sensor, 45.0, text)
            continue
        factor = math.sqrt(one.ratio.mean)
        size = "small" if factor > 1.0 else "large"
        text = f"{one}: the configured noise is too {size}, as if errors were {factor:.2g} times as large. "
        if one.lasts:
            text += (
                f"Innovations resemble the one before (autocorrelation {one.lag1:.2f}): errors last, or the process "
                "noise is too small."
            )
            text += "" if tune else " --tune fits white noise, and takes it only if innovations are white then."
        else:
            white = "" if one.lag1 is None else f" (autocorrelation {one.lag1:.2f})"
            text += f"Innovations are white enough{white}"
            text += " to fit it." if tune else ": `fgtrack tune` fits it (--tune)."
        yield Finding("noise", sensor, min(30.0 + 10.0 * abs(math.log(max(one.ratio.mean, _SMALLEST))), 75.0), text)


def objection(before: Run, after: Run) -> str | None:
    """Why noise that was fitted makes the run `after` worse than `before`, in words; None where it does not."""
    for one in noise_fits(after):
        if one.lasts:
            return (
                f"innovations of {one.sensor} still resemble the one before (autocorrelation {one.lag1:.2f}): errors "
                "last, of it or of what is believed more, and white noise cannot say so; sensors.NAME.correlation can, "
                "with std and time_s from truth or a data sheet"
            )
    for sensor, nis in misfits(after):
        return f"mean NIS of {sensor} is {nis.mean:.3g} then, expected {nis.dof:.3g}"
    runs = [JudgedRun("before", before), JudgedRun("after", after)]
    for what, (old, new) in _counts(runs).items():
        if new - old > _CHANCE * math.sqrt(new + old):
            return f"{what} go from {old} to {new}: tracks break at errors that the noise does not expect"
    for quantity in (each for contest in contests(runs) for each in contest.quantities):
        found = {entry.name: entry for entry in quantity.entries}
        was, now = found["before"].value, found["after"].value
        fits = quantity.name == POSITION_NEES and 1.0 / FAR_OFF <= now / _POSITION_DOF <= FAR_OFF
        if found["after"].standing == "worse" and not fits:
            return f"{quantity.name} against the truth of the recording goes from {was:.3g} to {now:.3g}"
    return None


def _counts(runs: Sequence[JudgedRun]) -> dict[str, tuple[int, ...]]:
    """What there should be few of."""
    births = tuple(int(np.count_nonzero(one.run.updates["disposition"] == "birth")) for one in runs)
    truths = [one.metrics.truth for one in runs]
    switches = tuple(truth.overall.id_switches for truth in truths if truth is not None)
    return {"beginnings of tracks": births, "identity switches": switches or (0, 0)}

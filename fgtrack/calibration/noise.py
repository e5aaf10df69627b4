"""Whether the innovations of a run fit the configured noise, and whether errors last."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.calibration.finding import Finding
from fgtrack.evaluation.diagnostics import CORRELATED, FAR_OFF, FEWEST, innovation_lag1, misfits
from fgtrack.evaluation.intervals import Estimate, by_stamp, mean_square
from fgtrack.evaluation.scores.innovations import num_measured
from fgtrack.io.run import Run

__all__ = ["NoiseFit", "noise_findings", "noise_fits"]

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
        return self.lag1 is not None and self.lag1 > CORRELATED

    @property
    def is_consistent(self) -> bool:
        """True if there are enough innovations, and their mean NIS is that expected, to a factor."""
        return self.count >= FEWEST and 1.0 / FAR_OFF <= self.ratio.mean <= FAR_OFF

    def __str__(self) -> str:
        known = f"{self.ratio.low:.3g} to {self.ratio.high:.3g}, " if self.ratio.is_known else ""
        return f"mean NIS is {self.ratio.mean:.3g} times what is expected ({known}{self.count} innovations)"


def noise_fits(run: Run) -> list[NoiseFit]:
    """Of every sensor with innovations."""
    updates, dof = run.tables["updates"], num_measured(run.tables["updates"])
    fits = []
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = (updates["sensor"] == sensor) & np.isfinite(updates["nis"]) & (dof > 0)
        if not mine.any():
            continue
        samples = np.stack([updates["nis"][mine], dof[mine].astype(np.float64)], axis=-1)
        ratio = mean_square(by_stamp(updates["stamp_ns"][mine], samples), np.random.default_rng(0))
        fits.append(NoiseFit(sensor, int(mine.sum()), ratio, innovation_lag1(run, sensor)))
    return fits


def noise_findings(run: Run, fits: Sequence[NoiseFit], tune: bool) -> Iterator[Finding]:
    """Sensors whose noise does not fit, and those of which a few innovations are far too large.

    With `tune` noise is fitted afterwards, which need not be offered.
    """
    off = dict(misfits(run))
    for one in fits:
        sensor = one.sensor
        if sensor not in off:
            if one.count >= FEWEST and not one.is_consistent:
                text = f"{one}, but its median is as expected: a few innovations are far off. Look at its clutter and "
                text += f"the gate, or try sensors.{sensor}.loss: {{kind: huber, width: 3.0}}."
                yield Finding("noise", sensor, 45.0, text)
            continue
        factor = math.sqrt(one.ratio.mean)
        size = "small" if factor > 1.0 else "large"
        text = f"{one}: the configured noise is too {size}, as if errors were {factor:.2g} times as large. "
        if one.lasts:
            text += (
                f"Innovations are correlated in time (autocorrelation {one.lag1:.2f}): so are its errors, or the "
                "process noise is too small."
            )
            text += "" if tune else " --tune fits white noise, and takes it only if innovations are white then."
        else:
            white = "" if one.lag1 is None else f" (autocorrelation {one.lag1:.2f})"
            text += f"Innovations are white enough{white}"
            text += " to fit it." if tune else ": --tune fits it."
        yield Finding("noise", sensor, min(30.0 + 10.0 * abs(math.log(max(one.ratio.mean, _SMALLEST))), 75.0), text)

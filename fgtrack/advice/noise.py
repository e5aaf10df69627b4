"""Whether the innovations of a run fit the configured noise, and whether errors last."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fgtrack.advice.finding import Finding
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.cautions import FAR_OFF, FEWEST, misfits
from fgtrack.evaluation.innovations import autocorrelations, num_measured
from fgtrack.evaluation.paired import Estimate, by_stamp, within_run
from fgtrack.io.run import Run

__all__ = ["NoiseFit", "noise_findings", "noise_fits"]

_LASTING = 0.3  # autocorrelation of innovations at lag 1


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


def noise_fits(run: Run) -> list[NoiseFit]:
    """Of every sensor with innovations."""
    updates, dof = run.updates, num_measured(run.updates)
    fits = []
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = (updates["sensor"] == sensor) & np.isfinite(updates["nis"]) & (dof > 0)
        if not mine.any():
            continue
        samples = np.stack([updates["nis"][mine], dof[mine].astype(np.float64)], axis=-1)
        ticks = by_stamp(updates["stamp_ns"][mine], samples)
        ratio = within_run(ticks, _ratio, np.random.default_rng(0))
        found = autocorrelations(updates.where(updates["sensor"] == sensor))
        first = next(iter(found.values()), None)
        fits.append(NoiseFit(sensor, int(mine.sum()), ratio, None if first is None else first.lag1))
    return fits


def _ratio(sums: FloatArray) -> FloatArray:
    return np.asarray(sums[0] / sums[1])


def noise_findings(run: Run, fits: list[NoiseFit]) -> Iterator[Finding]:
    """Sensors whose noise does not fit, and those of which a few innovations are far too large."""
    off = dict(misfits(run))
    for one in fits:
        sensor = one.sensor
        if sensor not in off:
            if one.count >= FEWEST and one.ratio.low > FAR_OFF:
                text = (
                    f"mean NIS is {one.ratio.mean:.3g} times what is expected ({one.ratio.low:.3g} to "
                    f"{one.ratio.high:.3g}), but its median is right: a few detections are of something else. "
                    f"Look at its clutter and the gate, or set sensors.{sensor}.loss: {{kind: huber, width: 3.0}}."
                )
                yield Finding("noise", sensor, 45.0, text)
            continue
        nis = off[sensor]
        factor = math.sqrt(one.ratio.mean)
        size = "small" if factor > 1.0 else "large"
        text = (
            f"mean NIS is {one.ratio.mean:.3g} times what is expected ({one.ratio.low:.3g} to {one.ratio.high:.3g}, "
            f"{nis.count} innovations): the configured noise is too {size}, as if errors were {factor:.2g} times as "
            "large. "
        )
        if one.lag1 is not None and one.lag1 > _LASTING:
            text += (
                f"Innovations resemble the one before (autocorrelation {one.lag1:.2f}): errors last, or the process "
                f"noise is too small; set sensors.{sensor}.correlation, and fit the rest by `fgtrack tune` (--tune)."
            )
        else:
            white = "" if one.lag1 is None else f" (autocorrelation {one.lag1:.2f})"
            text += f"Innovations are white enough{white}: `fgtrack tune` fits it (--tune)."
        yield Finding("noise", sensor, min(30.0 + 10.0 * abs(math.log(one.ratio.mean)), 75.0), text)

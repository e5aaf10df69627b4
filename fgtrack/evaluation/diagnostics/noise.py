"""Consistency of a run's innovations with the configured noise."""

import math
from collections.abc import Iterator

import numpy as np

from fgtrack.core.diagnostic import Diagnostic
from fgtrack.evaluation.scores.innovations import by_sensor, num_measured
from fgtrack.evaluation.scores.statistics import ChiSquareMean
from fgtrack.runs import Run

FAR_OFF = 1.5
"""A mean NIS that differs from its expected value by more than this factor is inconsistent."""
FEWEST = 30
"""Least number of updates of a sensor for a statement on its NIS."""
CORRELATED = 0.3
"""Autocorrelation of innovations at lag 1 above which errors are correlated in time."""


def noise_diagnostics(run: Run) -> Iterator[Diagnostic]:
    """Yield sensors whose innovations are inconsistent with the noise.

    The verdict of `compare` uses the same check.
    """
    source = (run.meta.get("input") or {}).get("path")
    of_run = (
        f" {source} -c {run.path / 'config.yaml'}"
        if run.path is not None and source
        else ""
    )
    for sensor, nis in inconsistent_sensors(run):
        size = "small" if nis.mean > nis.dof else "large"
        # The mean may be negative by rounding, if two standard deviations differ by a factor of 1e9.
        factor = math.sqrt(max(nis.mean, 0.0) / nis.dof)
        text = (
            f"mean NIS {nis.mean:.3g}, expected {nis.dof:.3g}: the configured noise is too {size}, errors are "
            f"{factor:.2g} times as large as configured; `fgtrack advise{of_run} --tune -o advised.yaml` fits the "
            "noise, or reports the problem to solve first"
        )
        yield Diagnostic(sensor, text)


def inconsistent_sensors(run: Run) -> Iterator[tuple[str, ChiSquareMean]]:
    """Yield the sensors with inconsistent NIS, and their NIS.

    Mean and median must both deviate in the same direction, so that a few outliers do
    not count.
    """
    for sensor, mine in by_sensor(run.tables["updates"]):
        nis = ChiSquareMean.without_band(mine["nis"], num_measured(mine))
        if nis.count >= FEWEST and is_far_off(nis):
            # This import takes a quarter of a second; a consistent run does not need it.
            from scipy.special import chdtri

            ratio = float(np.nanmedian(mine["nis"])) / float(chdtri(nis.dof, 0.5))
            if ratio > FAR_OFF if nis.mean > nis.dof else ratio < 1.0 / FAR_OFF:
                yield sensor, nis


def is_far_off(square: ChiSquareMean) -> bool:
    """True if a mean NEES or NIS differs from its expected value by more than `FAR_OFF`."""
    return not square.dof / FAR_OFF <= square.mean <= square.dof * FAR_OFF

"""Summaries of samples: moments, quantiles, and means of normalised squares."""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fgtrack.core.geometry import circular_mean, wrap_angle, wrap_angles
from fgtrack.core.types import FloatArray, IntArray

NORMAL_95 = 1.959963984540054
"""Half-width of the 95 % interval of a normal variable, in standard deviations."""
CHI_SQUARE_2_95 = -2.0 * math.log(0.05)
"""95 % quantile of the normalised square of two normal variables: the square of the 95 % ellipse."""


@dataclass(frozen=True)
class Moments:
    """Mean and standard deviation of a sample; NaN for an empty sample."""

    count: int = 0
    mean: float = math.nan
    std: float = math.nan
    """Standard deviation of the sample (divided by n, not n - 1)."""

    @classmethod
    def of(cls, values: FloatArray) -> Self:
        """Return the moments of `values` (n,), ignoring NaN."""
        values = values[~np.isnan(values)]
        return (
            cls(len(values), float(values.mean()), float(values.std()))
            if len(values)
            else cls()
        )

    @classmethod
    def of_angles(cls, values_rad: FloatArray) -> Self:
        """Return the circular mean of angles, and the standard deviation of the wrapped deviations from it.

        NaN is ignored.
        """
        values_rad = values_rad[~np.isnan(values_rad)]
        if not len(values_rad):
            return cls()
        middle_rad = circular_mean(values_rad)
        around = cls.of(wrap_angles(values_rad - middle_rad))
        return cls(around.count, wrap_angle(middle_rad + around.mean), around.std)

    @property
    def rmse(self) -> float:
        """Root mean square."""
        return math.hypot(self.mean, self.std)


@dataclass(frozen=True)
class Distribution:
    """Mean and quantiles of a sample; NaN for an empty sample."""

    count: int = 0
    mean: float = math.nan
    p50: float = math.nan
    p90: float = math.nan
    p99: float = math.nan
    max: float = math.nan

    @classmethod
    def of(cls, values: FloatArray) -> Self:
        """Return the distribution of `values` (n,); quantiles are interpolated linearly."""
        if not len(values):
            return cls()
        quantiles = np.quantile(values, (0.5, 0.9, 0.99, 1.0)).tolist()
        return cls(len(values), float(values.mean()), *quantiles)


@dataclass(frozen=True)
class ChiSquareMean:
    """Mean of independent normalised squares (NEES or NIS)."""

    count: int = 0
    mean: float = math.nan
    dof: float = math.nan
    """Mean of the degrees of freedom, which is the expected value of `mean`."""
    band_low: float = math.nan
    """Lower end of the two-sided 95 % interval of `mean` for consistent values."""
    band_high: float = math.nan
    """Upper end of this interval."""

    @classmethod
    def of(cls, values: FloatArray, dof: IntArray) -> Self:
        """Return the mean of `values` (n,), which have `dof` (n,) degrees of freedom, ignoring NaN."""
        mean = cls.without_band(values, dof)
        if not mean.count:
            return mean
        low, high = chi_square_band(
            np.array([mean.dof * mean.count]), np.array([mean.count])
        )
        return replace(mean, band_low=low.item(), band_high=high.item())

    @classmethod
    def without_band(cls, values: FloatArray, dof: IntArray) -> Self:
        """Return the same as `of` without the band; the band needs SciPy, whose import is slow."""
        known = ~np.isnan(values)
        if not known.any():
            return cls()
        return cls(
            int(known.sum()), float(values[known].mean()), float(dof[known].mean())
        )


def chi_square_band(dof: FloatArray, count: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the two-sided 95 % band of the mean of normalised squares, shape (n,) each.

    `count` (n,) is their number, and `dof` (n,) the sum of their degrees of freedom.
    """
    from scipy.special import gammaincinv

    low, high = (
        2.0 * gammaincinv(dof / 2.0, share) / count for share in (0.025, 0.975)
    )
    return low, high

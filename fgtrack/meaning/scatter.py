"""Scatter of three successive values of an object around a straight line, and its growth with the range."""

from typing import NamedTuple

import numpy as np

from fgtrack.core.types import FloatArray

__all__ = ["MAD", "Trend", "growing", "line_errors", "sight_errors"]

#: Ratio of a median absolute deviation and a standard deviation.
MAD = 0.6745
#: Groups of ranges in which the scatter is estimated.
_GROUPS = 6


class Trend(NamedTuple):
    """Standard deviation of a component at range r: sqrt(std^2 + (growth r)^2)."""

    std: float
    """Standard deviation at range 0, in the unit of the component."""
    growth: float = 0.0
    """Growth per metre of range."""

    def at(self, ranges_m: FloatArray) -> FloatArray:
        """Return the standard deviations at `ranges_m`."""
        return np.hypot(self.std, self.growth * ranges_m)


def line_errors(times_s: FloatArray, values: FloatArray) -> FloatArray:
    """Return the distance of the middle of three values from the line through the others, shape (n, ...).

    The distance has the standard deviation of one value. Shapes (n, 3) and (n, 3, ...).
    """
    span_s = times_s[:, 2] - times_s[:, 0]
    share = (times_s[:, 1] - times_s[:, 0]) / span_s
    weights = np.column_stack([share - 1.0, np.ones(len(share)), -share])
    weights /= np.sqrt(np.square(weights).sum(axis=1))[:, None]
    return np.asarray(np.einsum("nt,nt...->n...", weights, values))


def sight_errors(
    errors_m: FloatArray, sights_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return errors along and across the line of sight, and the ranges, each of shape (n,).

    `errors_m` and `sights_m`, the positions seen from the sensor, have the shape (n, 2).
    """
    ranges_m = np.hypot(*sights_m.T)
    sight = sights_m / np.maximum(ranges_m, 1e-9)[:, None]
    along_m = np.einsum("nc,nc->n", errors_m, sight)
    across_m = sight[:, 0] * errors_m[:, 1] - sight[:, 1] * errors_m[:, 0]
    return along_m, across_m, ranges_m


def growing(errors: FloatArray, ranges_m: FloatArray, smallest: float) -> Trend:
    """Fit a trend to `errors` (n,) at `ranges_m` (n,), by medians in groups of ranges; at least `smallest`."""
    from scipy.optimize import nnls

    groups = np.array_split(np.argsort(ranges_m, kind="stable"), _GROUPS)
    stds = np.array([np.median(np.abs(errors[rows])) / MAD for rows in groups])
    stds = np.maximum(stds, smallest)
    square_m2 = np.array([np.mean(np.square(ranges_m[rows])) for rows in groups])
    # Relative errors count, because the variances differ by orders of magnitude.
    A = np.column_stack([np.ones(len(groups)), square_m2]) / np.square(stds)[:, None]
    std, growth = np.sqrt(nnls(A, np.ones(len(groups)))[0])
    return Trend(max(float(std), smallest), float(growth))

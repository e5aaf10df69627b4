"""Dots of single values, and the bands of their quantiles where there are too many dots."""

import numpy as np
from matplotlib.axes import Axes

from fgtrack.core.types import FloatArray, IntArray

MOST_DOTS = 20_000
"""Largest number of values that are drawn one by one; more dots would cover each other."""
BAND_NOTE = "line: median, bands: 50 and 90 %"
"""Meaning of the bands, for a legend."""
_INTERVALS = 300
_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)


def draw_values(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    colour: str,
    label: str = "",
    ms: float = 3.0,
) -> None:
    """Draw each value of `y`, shape (n,), as a dot, or the quantiles of many values.

    Quantiles are those of the values within 300 equal intervals of `x`, shape (n,). An
    interval without values is a gap.
    """
    if len(y) <= MOST_DOTS:
        axes.plot(
            x,
            y,
            ".",
            ms=ms,
            mew=0,
            color=colour,
            alpha=0.6,
            label=label,
            rasterized=True,
        )
        return
    middles, (lowest, low, median, high, highest) = quantile_bands(x, y)
    axes.fill_between(middles, lowest, highest, color=colour, alpha=0.2, lw=0)
    axes.fill_between(middles, low, high, color=colour, alpha=0.35, lw=0)
    text = f"{label}; {BAND_NOTE}" if label else ""
    axes.plot(middles, median, color=colour, lw=0.9, label=text)


def quantile_bands(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the middles of 300 equal intervals of `x`, (300,), and the quantiles of `y` in each, (5, 300).

    Quantiles are values of the sample, for the shares 5, 25, 50, 75 and 95 %. They are
    NaN in an interval without values. Values that are not finite do not count.
    """
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    edges = np.linspace(x.min(), x.max(), _INTERVALS + 1)
    index = np.minimum(np.searchsorted(edges, x, "right") - 1, _INTERVALS - 1)
    values = y[np.lexsort((y, index))]
    counts = np.bincount(index, minlength=_INTERVALS)
    firsts = np.cumsum(counts) - counts
    bands = np.full((len(_LEVELS), _INTERVALS), np.nan)
    filled = counts > 0
    for band, level in zip(bands, _LEVELS, strict=True):
        rows = firsts[filled] + np.rint(level * (counts[filled] - 1)).astype(np.int64)
        band[filled] = values[rows]
    return 0.5 * (edges[1:] + edges[:-1]), bands


def thinned(num_values: int, most: int = 3000) -> IntArray:
    """Return ascending indices of at most `most` of `num_values` values, the first and the last included."""
    if num_values <= most:
        return np.arange(num_values)
    return np.linspace(0, num_values - 1, most).astype(np.int64)

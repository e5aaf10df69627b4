"""Range of its data that an axis shows: the bulk, whatever single values are far away."""

from collections.abc import Iterable

import numpy as np

from fgtrack.core.types import FloatArray

_BEYOND = 3.0  # interquartile ranges beyond the quartiles that still belong to the bulk
_MARGIN = 0.05


def bulk(samples: Iterable[FloatArray], required: Iterable[FloatArray] = ()) -> tuple[float, float]:
    """Range with the bulk of each of `samples` and all of `required`, and a margin; (0, 1) without finite values."""
    lows, highs = [], []
    for values, is_required in (*((each, False) for each in samples), *((each, True) for each in required)):
        known = values[np.isfinite(values)]
        if len(known):
            first, third = np.quantile(known, (0.25, 0.75)).tolist()
            reach = np.inf if is_required else _BEYOND * (third - first)
            lows.append(max(float(known.min()), first - reach))
            highs.append(min(float(known.max()), third + reach))
    if not lows:
        return 0.0, 1.0
    low, high = min(lows), max(highs)
    margin = max(_MARGIN * (high - low), 1e-6, 1e-9 * max(abs(low), abs(high)))  # wide enough for bins of it
    return low - margin, high + margin

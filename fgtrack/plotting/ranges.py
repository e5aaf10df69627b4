"""Range of its data that an axis shows: the bulk, whatever single values are far away."""

from collections.abc import Iterable

import numpy as np

from fgtrack.core.types import FloatArray

_BEYOND = 3.0  # interquartile ranges beyond the quartiles that still belong to the bulk
_MARGIN = 0.05


def bulk(samples: Iterable[FloatArray], held: Iterable[FloatArray] = ()) -> tuple[float, float]:
    """Range with the bulk of every one of `samples` and all of `held`, with a margin; values that are not finite count
    for nothing. Of no values it is (0, 1).
    """
    lows, highs = [], []
    for values, is_held in (*((each, False) for each in samples), *((each, True) for each in held)):
        known = values[np.isfinite(values)]
        if len(known):
            first, third = np.quantile(known, (0.25, 0.75)).tolist()
            reach = np.inf if is_held else _BEYOND * (third - first)
            lows.append(max(float(known.min()), first - reach))
            highs.append(min(float(known.max()), third + reach))
    if not lows:
        return 0.0, 1.0
    low, high = min(lows), max(highs)
    margin = max(_MARGIN * (high - low), 1e-6, 1e-9 * max(abs(low), abs(high)))  # wide enough for bins of it
    return low - margin, high + margin

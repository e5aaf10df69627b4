"""OSPA, the optimal sub-pattern assignment distance of order 2.

Source: Schuhmacher, Vo and Vo, "A consistent metric for performance evaluation of
multi-object filters", IEEE Transactions on Signal Processing 56(8), 2008, equation 3,
with p = 2.
"""

import numpy as np

from fgtrack.evaluation.near_pairs import Scenes


def ospa(scenes: Scenes, c_m: float) -> dict[str, float]:
    """Return the mean `mean_m` and the root mean square `rms_m` of the OSPA distance over the ticks.

    `c_m` is the cut-off distance. m is the larger number of tracks and objects. The
    smaller set is assigned to the larger set in the best way:

        OSPA^2 = (sum of min(distance, c)^2 over the pairs + c^2 for each unassigned element) / m

    OSPA is 0 if both sets are empty.
    """
    num_ticks = len(scenes.present)
    scenes.near.check(c_m)
    gains_m2 = np.maximum(c_m**2 - np.square(scenes.near.distances_m), 0.0)
    pairs = scenes.assigned(gains_m2, np.full(num_ticks, -1))
    gain_m2 = np.bincount(
        scenes.tick_index[pairs.rows],
        np.maximum(c_m**2 - np.square(pairs.distances_m), 0.0),
        num_ticks,
    )
    num_tracks = np.bincount(scenes.tick_index, minlength=num_ticks)
    larger = np.maximum(num_tracks, scenes.present.sum(axis=1))
    squares_m2 = np.where(larger > 0, c_m**2 - gain_m2 / np.maximum(larger, 1), 0.0)
    if not num_ticks:
        return {"mean_m": np.nan, "rms_m": np.nan}
    squares_m2 = np.maximum(squares_m2, 0.0)  # rounding may make a square negative
    return {
        "mean_m": float(np.sqrt(squares_m2).mean()),
        "rms_m": float(np.sqrt(squares_m2.mean())),
    }

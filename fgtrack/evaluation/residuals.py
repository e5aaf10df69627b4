"""Innovations of a run, also along and across the direction of the track."""

from collections.abc import Mapping

import numpy as np

from fgtrack.core.types import MEASURABLE, BoolArray, FloatArray
from fgtrack.io.run import Run

#: Every residual, in the order in which it is shown.
RESIDUAL_NAMES = ("along_m", "across_m", *MEASURABLE)

#: Residuals that are directions.
ANGULAR = frozenset({"yaw_rad", "bearing_rad"})


def residuals(run: Run) -> Mapping[str, FloatArray]:
    """Innovations by name of `RESIDUAL_NAMES`, each of shape (rows of updates.csv,), NaN where there is none.

    `along_m` and `across_m` (left positive) turn the position residual into the direction of the track, the
    published yaw at the detection's stamp: they are x_loc and y_loc of Karle et al. 2023.
    """
    values: dict[str, FloatArray] = {name: run.updates[f"res_{name}"] for name in MEASURABLE}
    yaw_rad = _track_yaw(run, np.isfinite(values["x_m"]))
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    along_m = c * values["x_m"] + s * values["y_m"]
    across_m = c * values["y_m"] - s * values["x_m"]
    return {"along_m": along_m, "across_m": across_m, **values}


def _track_yaw(run: Run, wanted: BoolArray) -> FloatArray:
    """Yaw of the updated track at the stamps of the `wanted` updates, shape (rows,); NaN elsewhere.

    Linear between the published rows of the track, constant before the first and after the last one; NaN for
    a track that was never published.
    """
    yaw_rad = np.full(len(run.updates), np.nan)
    order = np.lexsort((run.tracks["stamp_ns"], run.tracks["track_id"]))
    ids = run.tracks["track_id"][order]
    for track_id in np.unique(run.updates["track_id"][wanted]).tolist():
        start, end = np.searchsorted(ids, (track_id, track_id + 1)).tolist()
        if start == end:
            continue
        rows = order[start:end]
        mine = np.flatnonzero(wanted & (run.updates["track_id"] == track_id))
        stamps_ns = run.tracks["stamp_ns"][rows]
        first_ns = stamps_ns[0]  # differences are exact as floats, epoch stamps are not
        known_rad = np.unwrap(run.tracks["yaw_rad"][rows])
        yaw_rad[mine] = np.interp(
            (run.updates["stamp_ns"][mine] - first_ns).astype(np.float64),
            (stamps_ns - first_ns).astype(np.float64),
            known_rad,
        )
    return yaw_rad

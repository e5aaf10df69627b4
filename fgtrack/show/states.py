"""States of a run for viewers: ellipses, positions, and the times at which states become final."""

import math
from collections.abc import Iterator

import numpy as np
from scipy.special import chdtri

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import published_rows
from fgtrack.runs import Columns, Run

#: Length, width and height of a racing car, used for an object of unknown size.
NOMINAL_SIZE_M = (4.8, 2.0, 1.2)
#: Radius in standard deviations that contains 95 % of a Gaussian in the plane.
AROUND_95 = math.sqrt(float(chdtri(2, 0.05)))
# Default of `smoother.lag_s`.
_DEFAULT_LAG_S = 1.0


def ellipses(states: Columns, deviations: float) -> FloatArray:
    """Return half axes (long, short) in m and direction in [0, pi) of the position ellipses, shape (n, 3).

    The half axes are `deviations` standard deviations long. The direction is that of the long axis. NaN without a
    covariance.
    """
    xx, xy, yy = (states[name] for name in ("p_x_x", "p_x_y", "p_y_y"))
    covariances = np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)
    result = np.full((len(xx), 3), math.nan)
    known = np.isfinite(covariances).all(axis=(1, 2))
    variances, axes = np.linalg.eigh(covariances[known])  # ascending variances
    result[known, :2] = deviations * np.sqrt(np.maximum(variances[:, ::-1], 0.0))
    result[known, 2] = np.mod(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]), math.pi)
    return result


def with_position(table: Columns) -> Columns:
    """Return the rows with a finite position."""
    return table.where(np.isfinite(table["x_m"]) & np.isfinite(table["y_m"]))


def track_positions(run: Run, update_rows: IntArray) -> FloatArray:
    """Position of the updated track at the tick of each update, shape (n, 2).

    `update_rows` are rows of updates.csv. NaN for row -1, and for a track that was not
    published.
    """
    tracks = run.tables["tracks"]
    updates = run.tables["updates"]
    known = np.flatnonzero(update_rows >= 0)
    ticks, ids = (updates[name][update_rows[known]] for name in ("tick", "track_id"))
    rows = published_rows(tracks, ticks, ids)
    result = np.full((len(update_rows), 2), np.nan)
    positions_m = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    result[known[rows >= 0]] = positions_m[rows[rows >= 0]]
    return result


def final_ns(run: Run, final: Columns) -> IntArray:
    """Time at which each row of `final` became final, shape (n,).

    A state becomes final when it leaves the window of the smoother, or at the end of
    the run.
    """
    lag_s = (run.config.get("smoother") or {}).get("lag_s", _DEFAULT_LAG_S)
    end_ns = run.tables["timing"]["now_ns"].max(initial=0)
    return np.asarray(
        np.maximum(
            np.minimum(final["stamp_ns"] + nanoseconds(float(lag_s)), end_ns),
            final["stamp_ns"],
        )
    )


def start_ns(run: Run) -> int:
    """Time of the earliest tick, receipt or truth of the run; 0 for an empty run."""
    columns = (
        run.tables["timing"]["now_ns"],
        run.tables["ego"]["receipt_ns"],
        run.tables["detections"]["receipt_ns"],
        run.tables["truth"]["stamp_ns"],
    )
    return min((int(column.min()) for column in columns if len(column)), default=0)


def groups(keys: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Yield each value of `keys` (n,) in ascending order, with the indices of its rows in ascending order."""
    order = np.argsort(keys, kind="stable")
    values, starts = np.unique(keys[order], return_index=True)
    if len(values):
        yield from zip(values.tolist(), np.split(order, starts[1:]), strict=True)

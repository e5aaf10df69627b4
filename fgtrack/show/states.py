"""Columns of a run as viewers need them: ellipses, positions, and when a state became final."""

import math
from collections.abc import Iterator

import numpy as np
from scipy.special import chdtri

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import published_rows
from fgtrack.runs import Columns, Run

#: Length, width and height of the box of an object of unknown size: those of a racing car.
NOMINAL_SIZE_M = (4.8, 2.0, 1.2)
#: Standard deviations around the mean that hold 95 % of a Gaussian in the plane.
AROUND_95 = math.sqrt(float(chdtri(2, 0.05)))
_DEFAULT_LAG_S = 1.0  # of `smoother.lag_s`, where the configuration has none


def ellipses(states: Columns, deviations: float) -> FloatArray:
    """Half axes (long, short) and direction in [0, pi) of the position covariances, shape (n, 3); NaN if unknown."""
    xx, xy, yy = (states[name] for name in ("p_x_x", "p_x_y", "p_y_y"))
    covariances = np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)
    result = np.full((len(xx), 3), math.nan)
    known = np.isfinite(covariances).all(axis=(1, 2))
    variances, axes = np.linalg.eigh(covariances[known])  # rising
    result[known, :2] = deviations * np.sqrt(np.maximum(variances[:, ::-1], 0.0))
    result[known, 2] = np.mod(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]), math.pi)
    return result


def located(table: Columns) -> Columns:
    """Rows with a finite position."""
    return table.where(np.isfinite(table["x_m"]) & np.isfinite(table["y_m"]))


def track_positions(run: Run, update_rows: IntArray) -> FloatArray:
    """Position of the track of each of these rows of updates.csv at its tick, shape (n, 2); NaN for row -1."""
    tracks, updates = run.tables["tracks"], run.tables["updates"]
    known = np.flatnonzero(update_rows >= 0)
    ticks, ids = (updates[name][update_rows[known]] for name in ("tick", "track_id"))
    rows, result = (
        published_rows(tracks, ticks, ids),
        np.full((len(update_rows), 2), np.nan),
    )
    positions_m = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    result[known[rows >= 0]] = positions_m[rows[rows >= 0]]
    return result


def final_ns(run: Run, final: Columns) -> IntArray:
    """Time at which each row of `final` left the window of the smoother, or the run ended, shape (n,)."""
    lag_s = (run.config.get("smoother") or {}).get("lag_s", _DEFAULT_LAG_S)
    end_ns = run.tables["timing"]["now_ns"].max(initial=0)
    return np.asarray(
        np.maximum(
            np.minimum(final["stamp_ns"] + nanoseconds(float(lag_s)), end_ns),
            final["stamp_ns"],
        )
    )


def start_ns(run: Run) -> int:
    """Earliest tick, receipt or truth of the run; 0 if it is empty."""
    columns = (
        run.tables["timing"]["now_ns"],
        run.tables["ego"]["receipt_ns"],
        run.tables["detections"]["receipt_ns"],
        run.tables["truth"]["stamp_ns"],
    )
    return min((int(column.min()) for column in columns if len(column)), default=0)


def groups(keys: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Every value of `keys`, shape (n,), in rising order, with its rows in their order."""
    order = np.argsort(keys, kind="stable")
    values, starts = np.unique(keys[order], return_index=True)
    if len(values):
        yield from zip(values.tolist(), np.split(order, starts[1:]), strict=True)

"""Innovations and delays by sensor, and the consistency of covariances: NEES, NIS, whiteness."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import MEASURABLE, BoolArray, FloatArray, IntArray
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, mean_square, sums_by_stamp
from fgtrack.evaluation.matching import Matching, confirmed, neighbours, position_nees
from fgtrack.evaluation.placement import roads
from fgtrack.evaluation.scores.statistics import NORMAL_95, ChiSquareMean, Moments
from fgtrack.models.measurement import ANGULAR
from fgtrack.runs import NO_TRACK, Columns, Run

#: Names of all residuals, in display order.
RESIDUAL_NAMES = ("along_m", "across_m", *MEASURABLE)
#: Names of the residuals in table I of Karle et al. 2023: x_loc, y_loc, psi and v.
LOCAL_NAMES = ("along_m", "across_m", "yaw_rad", "speed_mps")
FEWEST = 20
"""Least number of innovations of a track in the autocorrelation. Its band needs large samples."""

_TRACK_STATE = ("x_m", "y_m", "yaw_rad", "speed_mps")


@dataclass(frozen=True)
class Autocorrelation:
    """Autocorrelation at lag 1 of the innovations of one sensor, over tracks with at least `FEWEST`."""

    lag1: float
    """Normalised autocorrelation, from -1 to 1; 0 on average for white innovations."""
    lag1_band: float
    """Half-width of its 95 % interval for white innovations."""


def moments_of(name: str, values: FloatArray) -> Moments:
    """Return the moments of the residual `name`; circular moments for angles."""
    return (Moments.of_angles if name in ANGULAR else Moments.of)(values)


def local_innovations(run: Run) -> tuple[IntArray, dict[str, FloatArray], FloatArray]:
    """Return the innovations of confirmed tracks in the direction of the track.

    Returns rows of updates.csv (n,), values by name of `LOCAL_NAMES` (n,), and track
    states (n, 4). The values are NaN if not measured. A missing yaw is replaced by the
    map heading minus the yaw of the track. The states are x, y, yaw and speed at the
    detections. Raises `DataError` for an invalid map.
    """
    tracks = run.tables["tracks"]
    updates = run.tables["updates"]
    every = residuals(run)
    known = np.isin(updates["track_id"], tracks["track_id"][confirmed(tracks)])
    known &= np.isfinite([every[name] for name in LOCAL_NAMES]).any(axis=0)
    rows = np.flatnonzero(known)
    states = track_states(run, known)[known]
    values = {name: every[name][rows] for name in LOCAL_NAMES}
    road = roads(run)[0].get("track")
    missing = np.flatnonzero(
        np.isnan(values["yaw_rad"]) & np.isfinite(states).all(axis=1)
    )
    if road is not None and len(missing):
        values["yaw_rad"][missing] = wrap_angles(
            road.view(states[missing, :2], 0.0, 0.0).yaw_rad - states[missing, 2]
        )
    return rows, values, states


def residuals(run: Run) -> Mapping[str, FloatArray]:
    """Return the innovations by name of `RESIDUAL_NAMES`, shape (rows of updates.csv,) each.

    NaN if not measured. `along_m` and `across_m` (left positive) are relative to the
    direction of the track: x_loc and y_loc of Karle et al. 2023.
    """
    values: dict[str, FloatArray] = {
        name: run.tables["updates"][f"res_{name}"] for name in MEASURABLE
    }
    yaw_rad = track_states(run, np.isfinite(values["x_m"]))[:, 2]
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    along_m = c * values["x_m"] + s * values["y_m"]
    across_m = c * values["y_m"] - s * values["x_m"]
    return {"along_m": along_m, "across_m": across_m, **values}


def by_sensor(table: Columns) -> Iterator[tuple[str, Columns]]:
    """Yield each sensor of `table` by name, with its rows."""
    for sensor in np.unique(table["sensor"]).tolist():
        yield sensor, table.where(table["sensor"] == sensor)


def num_measured(updates: Columns) -> IntArray:
    """Number of components of each innovation, shape (rows,): the degrees of freedom of its NIS."""
    return np.asarray(
        np.sum([np.isfinite(updates[f"res_{name}"]) for name in MEASURABLE], axis=0)
    )


def message_delays(updates: Columns) -> tuple[IntArray, FloatArray]:
    """Receipt [ns] and delay [s] of the messages of one sensor with a detection in `updates`, by receipt."""
    messages = np.unique(
        np.stack([updates["receipt_ns"], updates["stamp_ns"]], axis=-1), axis=0
    )
    return messages[:, 0], (messages[:, 0] - messages[:, 1]) / NS_PER_S


def autocorrelation(updates: Columns) -> Autocorrelation | None:
    """Return the autocorrelation of the innovations in `updates` of one sensor.

    None if no track has enough innovations. Position innovations are used. A sensor
    without positions uses its first component.

    The innovations nu of a track are taken in the order of processing. Their normalised
    autocorrelation at lag 1 is

        rho = sum_k nu(k)' nu(k + 1) / sum_k nu(k)' nu(k).

    Without correlation the products are independent with mean 0. Then the band is 1.96
    sqrt(sum_k (nu(k)' nu(k + 1))^2) / sum_k nu(k)' nu(k). For a constant variance it is
    1.96 / sqrt(n) (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).
    """
    for names in (
        ("x_m", "y_m"),
        *((name,) for name in MEASURABLE if name not in ("x_m", "y_m")),
    ):
        innovations = np.stack([updates[f"res_{name}"] for name in names], axis=-1)
        known = np.isfinite(innovations).all(axis=1) & (updates["track_id"] != NO_TRACK)
        ids, counts = np.unique(updates["track_id"][known], return_counts=True)
        known &= np.isin(updates["track_id"], ids[counts >= FEWEST])
        order = np.flatnonzero(known)[
            np.argsort(updates["track_id"][known], kind="stable")
        ]
        nu = innovations[order]
        ids = updates["track_id"][order]
        products = np.einsum("ni,ni->n", nu[:-1], nu[1:])[ids[:-1] == ids[1:]]
        energy = float(np.square(nu).sum())
        if energy > 0.0:
            band = NORMAL_95 * math.sqrt(float(np.square(products).sum())) / energy
            return Autocorrelation(float(products.sum()) / energy, band)
    return None


def track_states(run: Run, wanted: BoolArray) -> FloatArray:
    """x, y, yaw (not wrapped) and speed of the updated track at the `wanted` updates, shape (rows, 4).

    States are linear between published rows, and constant before the first and after
    the last row. NaN for other updates.
    """
    tracks = run.tables["tracks"]
    updates = run.tables["updates"]
    before, after = neighbours(
        tracks, "stamp_ns", updates["stamp_ns"], updates["track_id"]
    )
    before, after = (
        np.where(before < 0, after, before),
        np.where(after < 0, before, after),
    )
    there = wanted & (before >= 0)
    states = np.full((updates.num_rows, len(_TRACK_STATE)), np.nan)
    a, b = (
        np.stack([tracks[name][rows[there]] for name in _TRACK_STATE], axis=-1)
        for rows in (before, after)
    )
    from_ns = tracks["stamp_ns"][before[there]]
    until_ns = tracks["stamp_ns"][after[there]]
    share = (updates["stamp_ns"][there] - from_ns).clip(0) / np.maximum(
        until_ns - from_ns, 1
    )
    change = b - a
    change[:, 2] = wrap_angles(change[:, 2])
    states[there] = a + share[:, None] * change
    return states


@dataclass(frozen=True)
class Consistency:
    """Consistency of one run: NEES, NIS, and whiteness of the innovations.

    Bands hold for independent samples. Errors along a run are correlated, see
    `position_nees_interval`.
    """

    position_nees: ChiSquareMean
    """NEES of the present position; empty without truth."""
    nis: Mapping[str, ChiSquareMean]
    """NIS by sensor."""
    autocorrelation: Mapping[str, Autocorrelation | None]
    """Autocorrelation of the innovations by sensor; None without enough innovations."""
    position_nees_interval: Estimate = UNKNOWN
    """Mean of `position_nees`, with an interval for correlated errors, see `mean_square`."""


def consistency(run: Run, matching: Matching | None) -> Consistency:
    """Return the NEES of the evaluated rows of `run`, and the NIS and whiteness of its innovations."""
    sensors = dict(by_sensor(run.tables["updates"]))
    nis = {
        name: ChiSquareMean.of(mine["nis"], num_measured(mine))
        for name, mine in sensors.items()
    }
    white = {name: autocorrelation(mine) for name, mine in sensors.items()}
    if matching is None or not matching.paired.any():
        return Consistency(ChiSquareMean(), nis, white)
    squares = position_nees(matching)
    ticks = sums_by_stamp(
        matching.tracks["stamp_ns"][matching.paired], squares[:, None]
    )
    interval = mean_square(ticks)
    return Consistency(
        ChiSquareMean.of(squares, np.full(len(squares), 2)), nis, white, interval
    )

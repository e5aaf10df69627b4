"""Innovations and delays by sensor, and the consistency of covariances: NEES, NIS, whiteness."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import MEASURABLE, BoolArray, FloatArray, IntArray
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, by_stamp, mean_square
from fgtrack.evaluation.matching import Matching, confirmed, neighbours, position_nees
from fgtrack.evaluation.placement import roads
from fgtrack.evaluation.scores.statistics import NORMAL_95, ChiSquareMean, Moments
from fgtrack.models.measurement import ANGULAR
from fgtrack.runs import NO_TRACK, Columns, Run

#: Every residual, in the order in which it is shown.
RESIDUAL_NAMES = ("along_m", "across_m", *MEASURABLE)
#: Residuals of table I of Karle et al. 2023: x_loc, y_loc, psi and v.
LOCAL_NAMES = ("along_m", "across_m", "yaw_rad", "speed_mps")
FEWEST = 20
"""A track with fewer innovations of the sensor is left out: the band is that of a large sample."""

_TRACK_STATE = ("x_m", "y_m", "yaw_rad", "speed_mps")


@dataclass(frozen=True)
class Autocorrelation:
    """Autocorrelation of the innovations of one sensor at lag 1, of the tracks with at least `FEWEST` of them."""

    lag1: float
    """Normalised: between -1 and 1, and 0 on average for white innovations."""
    lag1_band: float
    """Half-width of its 95 % interval for white innovations."""


def moments_of(name: str, values: FloatArray) -> Moments:
    """Moments of the residual `name`; those of angles are circular."""
    return (Moments.of_angles if name in ANGULAR else Moments.of)(values)


def local_innovations(run: Run) -> tuple[IntArray, dict[str, FloatArray], FloatArray]:
    """Innovations of the tracks that were `confirmed`: rows of updates.csv, values by name, and states of the track.
    Values are those of `LOCAL_NAMES`, shape (n,), NaN where not measured; without a measured yaw that of the map less
    the track's. States are x, y, yaw and speed at the detections, shape (n, 4). Raises `DataError` without a valid map.
    """
    tracks, updates, every = run.tables["tracks"], run.tables["updates"], residuals(run)
    known = np.isin(updates["track_id"], tracks["track_id"][confirmed(tracks)])
    known &= np.isfinite([every[name] for name in LOCAL_NAMES]).any(axis=0)
    rows, states = np.flatnonzero(known), track_states(run, known)[known]
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
    """Innovations by name of `RESIDUAL_NAMES`, each of shape (rows of updates.csv,), NaN where not measured.
    `along_m` and `across_m` (left positive) are in the direction of the track: x_loc and y_loc of Karle et al. 2023.
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
    """Yield the sensors of `table` by name, each with its rows."""
    for sensor in np.unique(table["sensor"]).tolist():
        yield sensor, table.where(table["sensor"] == sensor)


def num_measured(updates: Columns) -> IntArray:
    """Number of components of each innovation, the degrees of freedom of its NIS, shape (rows,)."""
    return np.asarray(
        np.sum([np.isfinite(updates[f"res_{name}"]) for name in MEASURABLE], axis=0)
    )


def message_delays(updates: Columns) -> tuple[IntArray, FloatArray]:
    """Receipt in ns and delay in s of the messages with a detection in `updates` of one sensor, by receipt."""
    messages = np.unique(
        np.stack([updates["receipt_ns"], updates["stamp_ns"]], axis=-1), axis=0
    )
    return messages[:, 0], (messages[:, 0] - messages[:, 1]) / NS_PER_S


def autocorrelation(updates: Columns) -> Autocorrelation | None:
    """Return the autocorrelation of the innovations in `updates` of one sensor; None where no track has enough of them.
    It is that of the positions, of a sensor without them that of the first component. Along a track, in the order of
    processing, the innovations nu of n updates have at lag 1 the normalised autocorrelation
        rho = sum_k nu(k)' nu(k + 1) / sum_k nu(k)' nu(k).
    Without correlation the products are independent with mean 0, so the band is
    1.96 sqrt(sum_k (nu(k)' nu(k + 1))^2) / sum_k nu(k)' nu(k): for a constant variance the 1.96 / sqrt(n) of
    Bar-Shalom, Li, Kirubarajan 2001, section 5.4.
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
        nu, ids = innovations[order], updates["track_id"][order]
        products, energy = (
            np.einsum("ni,ni->n", nu[:-1], nu[1:])[ids[:-1] == ids[1:]],
            float(np.square(nu).sum()),
        )
        if energy > 0.0:
            band = NORMAL_95 * math.sqrt(float(np.square(products).sum())) / energy
            return Autocorrelation(float(products.sum()) / energy, band)
    return None


def track_states(run: Run, wanted: BoolArray) -> FloatArray:
    """x, y, yaw (not wrapped) and speed of the updated track at the stamps of the `wanted` updates, shape (rows, 4).
    Linear between published rows, constant outside; NaN elsewhere.
    """
    tracks, updates = run.tables["tracks"], run.tables["updates"]
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
    from_ns, until_ns = (
        tracks["stamp_ns"][before[there]],
        tracks["stamp_ns"][after[there]],
    )
    share = (updates["stamp_ns"][there] - from_ns).clip(0) / np.maximum(
        until_ns - from_ns, 1
    )
    change = b - a
    change[:, 2] = wrap_angles(change[:, 2])
    states[there] = a + share[:, None] * change
    return states


@dataclass(frozen=True)
class Consistency:
    """Normalised squared errors and innovations of one run, and the whiteness of the innovations.

    Bands are those of independent samples; errors along a run are not, see `position_nees_interval`.
    """

    position_nees: ChiSquareMean
    """NEES of the present position; empty without truth."""
    nis: Mapping[str, ChiSquareMean]
    """By sensor."""
    autocorrelation: Mapping[str, Autocorrelation | None]
    """By sensor."""
    position_nees_interval: Estimate = UNKNOWN
    """Mean of `position_nees` with the interval of correlated errors, see `mean_square`."""


def consistency(run: Run, matching: Matching | None) -> Consistency:
    """NEES of the evaluated rows of `run`, NIS and whiteness of its innovations."""
    sensors = dict(by_sensor(run.tables["updates"]))
    nis = {
        name: ChiSquareMean.of(mine["nis"], num_measured(mine))
        for name, mine in sensors.items()
    }
    white = {name: autocorrelation(mine) for name, mine in sensors.items()}
    if matching is None or not matching.paired.any():
        return Consistency(ChiSquareMean(), nis, white)
    squares = position_nees(matching)
    ticks = by_stamp(matching.tracks["stamp_ns"][matching.paired], squares[:, None])
    interval = mean_square(ticks)
    return Consistency(
        ChiSquareMean.of(squares, np.full(len(squares), 2)), nis, white, interval
    )

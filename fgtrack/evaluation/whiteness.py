"""Whether the innovations of a sensor are white: the autocorrelation along every track."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgtrack.core.types import MEASURABLE, FloatArray
from fgtrack.evaluation.statistics import NORMAL_95
from fgtrack.io.run import NO_TRACK, Table

LAGS = 10
"""Lags 1 to this many innovations are looked at."""
FEWEST = 20
"""A track with fewer innovations of the sensor is left out: the band is that of a large sample."""

#: Innovations that are taken together, as a vector; the others stand alone.
_GROUPS: Mapping[str, tuple[str, ...]] = {
    "position_m": ("x_m", "y_m"),
    **{name: (name,) for name in MEASURABLE if name not in ("x_m", "y_m")},
}


@dataclass(frozen=True)
class Autocorrelation:
    """Autocorrelation of the innovations of one sensor, over all tracks with at least `FEWEST` of them."""

    tracks: int
    count: int
    """Innovations of these tracks."""
    lag1: float
    """Normalised autocorrelation at lag 1, between -1 and 1; 0 on average for white innovations."""
    lag1_band: float
    """White innovations stay within plus and minus this with 95 % probability."""
    share_outside: float
    """Share of the tracks and lags 1 to `LAGS` outside their own bands; 0.05 on average for white innovations."""


def autocorrelations(updates: Table) -> dict[str, Autocorrelation]:
    """Autocorrelation of the innovations in `updates` of one sensor: of the position and of every other component.

    Along a track, in the order of processing, the innovations nu of n updates have at lag l the normalised
    autocorrelation

        rho(l) = sum_k nu(k)' nu(k + l) / sum_k nu(k)' nu(k).

    Without correlation the products of the numerator have mean 0 and do not depend on each other, so its variance is
    the sum of their squares: the band is 1.96 sqrt(sum_k (nu(k)' nu(k + l))^2) / sum_k nu(k)' nu(k), whatever
    becomes of the covariance of the innovations along the track. Where that is constant and nu a number, this is the
    1.96 / sqrt(n) of Bar-Shalom, Li, Kirubarajan 2001, section 5.4.
    """
    found = {}
    for group, names in _GROUPS.items():
        innovations = np.stack([updates[f"res_{name}"] for name in names], axis=-1)
        known = np.isfinite(innovations).all(axis=1) & (updates["track_id"] != NO_TRACK)
        ids = updates["track_id"][known]
        counts = np.bincount(ids)
        tracks = np.flatnonzero(counts >= FEWEST).tolist()
        sums = np.array([_sums(innovations[known][ids == track_id]) for track_id in tracks])
        if len(sums) and sums[:, 0, 0].all():
            found[group] = _summary(sums, int(counts[tracks].sum()))
    return found


def _sums(innovations: FloatArray) -> FloatArray:
    """Sums over k of nu(k)' nu(k + l) and of its square at the lags l = 0, 1, ..., `LAGS`, shape (2, `LAGS` + 1)."""
    padded = np.concatenate([innovations, np.zeros((LAGS, innovations.shape[1]))])
    later = np.lib.stride_tricks.sliding_window_view(padded, LAGS + 1, axis=0)
    products = np.einsum("ni,nil->nl", innovations, later)
    return np.stack([products.sum(axis=0), np.square(products).sum(axis=0)])


def _summary(sums: FloatArray, count: int) -> Autocorrelation:
    energy, numerators, variances = sums[:, 0, 0], sums[:, 0, 1:], sums[:, 1, 1:]
    return Autocorrelation(
        tracks=len(sums),
        count=count,
        lag1=float(numerators[:, 0].sum() / energy.sum()),
        lag1_band=NORMAL_95 * math.sqrt(variances[:, 0].sum()) / float(energy.sum()),
        share_outside=float((np.abs(numerators) > NORMAL_95 * np.sqrt(variances)).mean()),
    )

"""Stretches of a track that say nothing of the noise, because most of the innovations in them are outliers."""

from dataclasses import replace

import numpy as np

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.likelihood.noise import NoiseSpace
from fgtrack.estimation.likelihood.reference import filtered
from fgtrack.estimation.likelihood.series import Series

#: So many successive innovations are looked at together.
WINDOW = 20
#: Where more than this share of them are outliers, they are left out.
MOST = 0.5
#: And with them what is nearer than this to them: the filter is on its way there, or back.
MARGIN_S = 1.0


def without_mixed(series: Series, space: NoiseSpace, values: FloatArray) -> Series:
    """`series` where only that has a part in the likelihood at `values`, shape (p,), which is of one object.

    Outliers are rare and independent of each other. Where most of 20 successive innovations are outliers, the track
    has gone from one object to another, or mixes two that pass; the mixture of `contaminated` does not describe that,
    and a few seconds of it inflate small standard deviations by many of their standard errors.
    """
    outlier = np.array([step.outlier for step in filtered(series, space, values)])
    stamps_ns = np.array([one.measurement.stamp_ns for one in series.observations])
    size = min(WINDOW, len(outlier))
    means = np.convolve(outlier, np.full(size, 1.0 / size), mode="valid")
    margin_ns = nanoseconds(MARGIN_S)
    mixed = np.zeros(len(outlier), dtype=np.bool_)
    for first in np.flatnonzero(means > MOST).tolist():
        mixed |= (stamps_ns >= stamps_ns[first] - margin_ns) & (stamps_ns <= stamps_ns[first + size - 1] + margin_ns)
    return replace(series, mixed=frozenset(np.flatnonzero(mixed).tolist()))

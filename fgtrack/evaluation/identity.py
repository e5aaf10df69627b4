"""IDF1 and HOTA: how well tracks keep their identity. Computed by motrics.

Scores lie between 0 and 1 and are NaN where there is no true object. They are those of TrackEval for its similarity of
positions, 1 - d / zero distance, with a zero distance of twice the gate: the similarity of 0.5, from which on IDF1
counts a pair, is at the gate.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from motrics import compute_hota_from_similarity, compute_identity_from_similarity

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.scenes import Scenes

AT_GATE = 0.5
"""Similarity of a pair that is as far apart as the gate, from which on it counts."""


@dataclass(frozen=True)
class Frames:
    """What motrics takes: lists with an entry for every tick."""

    objects: list[list[int]]
    tracks: list[list[int]]
    similarities: list[list[list[float]]]
    """A list for each object, with the similarity of each track."""
    gate_m: float

    @classmethod
    def of(cls, scenes: Scenes, gate_m: float) -> Self:
        """The ticks of `scenes`; a pair is not farther apart than `gate_m`."""
        track_ids = scenes.track_ids.tolist()
        scores = similarities(scenes.distances_m, gate_m)
        every = list(range(scores.shape[1]))
        frames = cls([], [], [], gate_m)
        for rows, present in zip(scenes, scenes.present, strict=True):
            complete = present.all()
            here = scores[rows].T
            frames.objects.append(every if complete else np.flatnonzero(present).tolist())
            frames.tracks.append(track_ids[rows])
            frames.similarities.append((here if complete else here[present]).tolist())
        return frames


@dataclass(frozen=True)
class Identity:
    """Ristani et al. 2016. Every object is given one track for the whole run, so that most of the pairs are right."""

    idf1: float
    """Harmonic mean of the two others."""
    idp: float
    """Share of the track rows that are at the object of their track."""
    idr: float
    """Share of the objects, at all ticks, that are at their track."""

    @classmethod
    def of(cls, frames: Frames) -> Self:
        """Identity of `frames`."""
        found = compute_identity_from_similarity(frames.objects, frames.tracks, frames.similarities, AT_GATE)
        return cls(found.idf1, found.idp, found.idr) if found.num_gt else cls(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Hota:
    """Luiten et al. 2021. Means over the bounds 0.05, 0.1, ..., 0.95 of the similarity."""

    hota: float
    """Mean of sqrt(DetA AssA)."""
    deta: float
    """Detection: pairs / (pairs + misses + false positives)."""
    assa: float
    """Association: the same, for the track and the object of a pair, averaged over the pairs."""

    @classmethod
    def of(cls, frames: Frames) -> Self:
        """HOTA of `frames`."""
        found = compute_hota_from_similarity(frames.objects, frames.tracks, frames.similarities)
        return cls(found.hota, found.deta, found.assa) if found.num_gt else cls(math.nan, math.nan, math.nan)


def similarities(distances_m: FloatArray, gate_m: float) -> FloatArray:
    """Similarity 1 - d / (2 gate), 0 where that is negative; the shape is kept."""
    return np.maximum(0.0, 1.0 - distances_m / (2.0 * gate_m))

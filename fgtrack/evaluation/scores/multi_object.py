"""All tracks against all true objects: GOSPA, CLEAR, IDF1 and HOTA.

GOSPA is the distance between the set of the tracks and the set of the true objects (Rahmathullah, Garcia-Fernandez,
Svensson: Generalized optimal sub-pattern assignment metric, Fusion 2017, with p = 2 and alpha = 2): with the best
assignment of tracks to objects nearer than c,

    GOSPA^2 = sum of squared distances of the pairs + c^2 / 2 (number of missed objects + number of false tracks).

The missed objects that no sensor could see are counted apart: no tracker can do better there.

CLEAR (Bernardin and Stiefelhagen 2008) counts as TrackEval does. That of motrics 0.3 differs: it charges 1e18 for a
pair outside the gate, in whose rounding the similarities of the other pairs are lost, and it keeps to the last track
that an object ever had.

IDF1 (Ristani et al. 2016) and HOTA (Luiten et al. 2021) are computed by motrics. They lie between 0 and 1, are NaN
without a true object, and are those of TrackEval for its similarity of positions, 1 - d / zero distance, with
a zero distance of twice the gate: the similarity of 0.5, from which on IDF1 counts a pair, is at the gate.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from motrics import compute_hota_from_similarity, compute_identity_from_similarity
from scipy.optimize import linear_sum_assignment

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import NO_OBJECT, Matching, Scenes, ambiguous, pair, scenes
from fgtrack.io.run import NO_TRACK, EvaluationConfig, Run

AT_GATE = 0.5
"""Similarity of a pair that is as far apart as the gate, from which on it counts."""


@dataclass(frozen=True)
class GospaParts:
    """Squared parts at every tick, shape (t,) each; they add up to the square of GOSPA.

    Attributes
    ----------
    localisation_m2, missed_m2, false_m2
        Of the pairs, the missed objects and the false tracks.
    out_of_sight_m2
        The part of `missed_m2` that no sensor could see.
    """

    localisation_m2: FloatArray
    missed_m2: FloatArray
    false_m2: FloatArray
    out_of_sight_m2: FloatArray

    @property
    def total_m(self) -> FloatArray:
        """GOSPA at every tick, shape (t,)."""
        return np.sqrt(self.localisation_m2 + self.missed_m2 + self.false_m2)

    @property
    def in_sight_m(self) -> FloatArray:
        """GOSPA at every tick without the missed objects out of sight, shape (t,)."""
        return np.sqrt(self.localisation_m2 + (self.missed_m2 - self.out_of_sight_m2) + self.false_m2)


@dataclass(frozen=True)
class Gospa:
    """GOSPA of a run; NaN without a tick.

    Attributes
    ----------
    c_m
        Cut-off distance: a missed object or a false track costs c^2 / 2.
    ticks
        Number of ticks.
    mean_m, rms_m
        Mean over the ticks, and root of the mean square, whose square is the sum of the three parts.
    localisation_m2, missed_m2, false_m2
        Mean squared parts of the pairs, the missed objects and the false tracks.
    in_sight_rms_m
        As `rms_m`, without the missed objects that no sensor could see.
    out_of_sight_m2
        Mean squared part of these objects, a part of `missed_m2`.
    """

    c_m: float
    ticks: int
    mean_m: float
    rms_m: float
    localisation_m2: float
    missed_m2: float
    false_m2: float
    in_sight_rms_m: float
    out_of_sight_m2: float

    @classmethod
    def of(cls, parts: GospaParts, c_m: float) -> "Gospa":
        """Averages of `parts` over the ticks."""
        ticks = len(parts.total_m)
        squares = (parts.total_m**2, parts.localisation_m2, parts.missed_m2, parts.false_m2)
        values = (parts.total_m, *squares, parts.in_sight_m**2, parts.out_of_sight_m2)
        mean_m, total, localisation, missed, false, in_sight, out = (
            float(value.mean()) if ticks else math.nan for value in values
        )
        return cls(c_m, ticks, mean_m, math.sqrt(total), localisation, missed, false, math.sqrt(in_sight), out)


@dataclass(frozen=True)
class Clear:
    """CLEAR scores; counts are sums over the ticks.

    Attributes
    ----------
    mota
        1 - (misses + false positives + switches) / number of objects; NaN without any object.
    motp_m
        Mean distance of the pairs; NaN without a pair.
    pairs
        Objects with a track (TP).
    misses
        Objects without one (FN).
    false_positives
        Tracks without an object (FP).
    id_switches
        Pairs with another track than the object's last one (IDSW).
    """

    mota: float
    motp_m: float
    pairs: int
    misses: int
    false_positives: int
    id_switches: int

    @classmethod
    def of(cls, scenes: Scenes, gate_m: float) -> "Clear":
        """CLEAR of `scenes`; a pair is not farther apart than `gate_m`.

        Pairs of the last tick with objects and tracks stay, the others have the largest sum of similarities.
        """
        similarity = similarities(scenes.distances_m, gate_m)
        scores = np.where(similarity >= AT_GATE - np.finfo(np.float64).eps, similarity, 0.0)
        used = scenes.present.any(axis=1) & (scenes.per_tick(np.ones(len(scores))) > 0)
        last = np.maximum.accumulate(np.where(used, np.arange(scenes.num_ticks), 0))
        columns = pair(scores, scenes.track_ids, scenes.tick_index, np.concatenate([[-1], last])[:-1])
        paired = np.flatnonzero(columns != NO_OBJECT)
        track_ids = np.full(scenes.present.shape, NO_TRACK)
        track_ids[scenes.tick_index[paired], columns[paired]] = scenes.track_ids[paired]
        sequences = (column[column != NO_TRACK] for column in track_ids.T)
        switches = sum(int((sequence[1:] != sequence[:-1]).sum()) for sequence in sequences)
        pairs, objects = len(paired), int(scenes.present.sum())
        misses, false_positives = objects - pairs, len(columns) - pairs
        mota = 1.0 - (misses + false_positives + switches) / objects if objects else math.nan
        motp_m = float(scenes.distances_m[paired, columns[paired]].mean()) if pairs else math.nan
        return cls(mota, motp_m, pairs, misses, false_positives, switches)


@dataclass(frozen=True)
class Identity:
    """Every object is given one track for the whole run, so that most of the pairs are right.

    Attributes
    ----------
    idf1
        Harmonic mean of the two others.
    idp
        Share of the track rows that are at the object of their track.
    idr
        Share of the objects, at all ticks, that are at their track.
    """

    idf1: float
    idp: float
    idr: float


@dataclass(frozen=True)
class Hota:
    """Means over the bounds 0.05, 0.1, ..., 0.95 of the similarity.

    Attributes
    ----------
    hota
        Mean of sqrt(DetA AssA).
    deta
        Detection: pairs / (pairs + misses + false positives).
    assa
        Association: the same, for the track and the object of a pair, averaged over the pairs.
    """

    hota: float
    deta: float
    assa: float


@dataclass(frozen=True)
class MultiObjectMetrics:
    """Scores over the ticks at which truth is recorded."""

    gospa: Gospa
    clear: Clear
    identity: Identity
    hota: Hota

    @classmethod
    def of(cls, scenes: Scenes, options: EvaluationConfig) -> "MultiObjectMetrics":
        """Scores of `scenes`."""
        frames = motrics_frames(scenes, options.gate_m)
        identity = compute_identity_from_similarity(*frames, AT_GATE)
        hota = compute_hota_from_similarity(*frames)
        return cls(
            Gospa.of(gospa(scenes, options.gate_m), options.gate_m),
            Clear.of(scenes, options.gate_m),
            Identity(*(getattr(identity, k) if identity.num_gt else math.nan for k in ("idf1", "idp", "idr"))),
            Hota(*(getattr(hota, k) if hota.num_gt else math.nan for k in ("hota", "deta", "assa"))),
        )


def multi_object_metrics(run: Run, matching: Matching | None, options: EvaluationConfig) -> MultiObjectMetrics | None:
    """Scores of the evaluated rows of `run`; None without truth, and where `options` exclude them."""
    wanted = matching is not None and options.multi_object
    return MultiObjectMetrics.of(scenes(run, matching), options) if wanted and matching is not None else None


def gospa(scenes: Scenes, c_m: float) -> GospaParts:
    """GOSPA with the cut-off distance `c_m`, as its parts at every tick.

    A pair at c or beyond costs as much as a missed object and a false track, and counts as these.
    """
    inside = scenes.distances_m < c_m
    squares = np.where(inside, scenes.distances_m, c_m) ** 2
    unclear = ambiguous(inside, scenes.tick_index, scenes.num_ticks)
    chosen = inside & ~unclear[scenes.tick_index, None]
    rows_of = list(scenes)
    for tick in np.flatnonzero(unclear).tolist():
        rows, columns = linear_sum_assignment(squares[rows_of[tick]])
        chosen[rows_of[tick].start + rows, columns] = inside[rows_of[tick]][rows, columns]
    paired = np.zeros_like(scenes.present)
    rows, columns = np.nonzero(chosen)
    paired[scenes.tick_index[rows], columns] = True
    single_m2, missed = c_m**2 / 2.0, scenes.present & ~paired
    return GospaParts(
        localisation_m2=scenes.per_tick(np.where(chosen, squares, 0.0).sum(axis=1)),
        missed_m2=single_m2 * missed.sum(axis=1),
        false_m2=single_m2 * (scenes.per_tick(np.ones(len(squares))) - paired.sum(axis=1)),
        out_of_sight_m2=single_m2 * (missed & ~scenes.in_sight).sum(axis=1),
    )


def similarities(distances_m: FloatArray, gate_m: float) -> FloatArray:
    """Similarity 1 - d / (2 gate), 0 where that is negative; the shape is kept."""
    return np.maximum(0.0, 1.0 - distances_m / (2.0 * gate_m))


def motrics_frames(scenes: Scenes, gate_m: float) -> tuple[list[Any], list[Any], list[Any]]:
    """Lists of the objects, the tracks and their similarities for motrics, with an entry for every tick."""
    scores = similarities(scenes.distances_m, gate_m)
    ids = scenes.track_ids.tolist()
    rows_of = list(zip(scenes, scenes.present, strict=True))
    objects = [np.flatnonzero(present).tolist() for _, present in rows_of]
    return objects, [ids[rows] for rows, _ in rows_of], [scores[rows].T[here].tolist() for rows, here in rows_of]

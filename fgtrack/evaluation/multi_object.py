"""All tracks against all true objects: GOSPA, CLEAR, IDF1 and HOTA.

GOSPA is the distance between the set of the tracks and the set of the true objects (Rahmathullah, Garcia-Fernandez,
Svensson: Generalized optimal sub-pattern assignment metric, Fusion 2017, with p = 2 and alpha = 2): with the best
assignment of tracks to objects nearer than c,

    GOSPA^2 = sum of squared distances of the pairs + c^2 / 2 (number of missed objects + number of false tracks).

Of the missed objects those are told apart that no sensor could see: no tracker can do better there.

CLEAR (Bernardin and Stiefelhagen 2008) counts as TrackEval does. motrics 0.3 has it, too, but otherwise: it charges
1e18 for a pair outside the gate, in whose rounding the similarities of the other pairs are lost, and it keeps to the
last track that an object ever had.

IDF1 (Ristani et al. 2016) and HOTA (Luiten et al. 2021) are computed by motrics. They lie between 0 and 1, are NaN
where there is no true object, and are those of TrackEval for its similarity of positions, 1 - d / zero distance, with
a zero distance of twice the gate: the similarity of 0.5, from which on IDF1 counts a pair, is at the gate.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from motrics import compute_hota_from_similarity, compute_identity_from_similarity
from scipy.optimize import linear_sum_assignment

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.matching import NO_OBJECT, Matching, Scenes, contested, scenes
from fgtrack.io.run import NO_TRACK, EvaluationConfig, Run

AT_GATE = 0.5
"""Similarity of a pair that is as far apart as the gate, from which on it counts."""

_CONTINUATION = 1000.0  # a pair of the tick before weighs more than the similarities of all pairs together


@dataclass(frozen=True)
class GospaParts:
    """Squared parts at every tick, shape (t,) each; they add up to the square of GOSPA."""

    localisation_m2: FloatArray
    missed_m2: FloatArray
    false_m2: FloatArray
    out_of_sight_m2: FloatArray
    """The part of `missed_m2` that no sensor could see."""

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
    """GOSPA of a run; NaN without a tick."""

    c_m: float
    """Cut-off distance: a missed object or a false track costs c^2 / 2."""
    ticks: int
    mean_m: float
    """Mean over the ticks."""
    rms_m: float
    """Root of the mean square over the ticks; its square is the sum of the three parts."""
    localisation_m2: float
    """Mean squared part of the pairs."""
    missed_m2: float
    false_m2: float
    in_sight_rms_m: float
    """As `rms_m`, without the missed objects that no sensor could see."""
    out_of_sight_m2: float
    """Mean squared part of these objects, a part of `missed_m2`."""

    @classmethod
    def of(cls, parts: GospaParts, c_m: float) -> Self:
        """Averages of `parts` over the ticks."""
        total_m, ticks = parts.total_m, len(parts.total_m)
        if not ticks:
            return cls(c_m, 0, *[np.nan] * 7)
        rms_m, in_sight_m = (float(np.sqrt(np.square(of).mean())) for of in (total_m, parts.in_sight_m))
        return cls(
            c_m=c_m,
            ticks=ticks,
            mean_m=float(total_m.mean()),
            rms_m=rms_m,
            localisation_m2=float(parts.localisation_m2.mean()),
            missed_m2=float(parts.missed_m2.mean()),
            false_m2=float(parts.false_m2.mean()),
            in_sight_rms_m=in_sight_m,
            out_of_sight_m2=float(parts.out_of_sight_m2.mean()),
        )


@dataclass(frozen=True)
class Clear:
    """Counts are sums over the ticks."""

    mota: float
    """1 - (misses + false positives + switches) / number of objects; NaN without any object."""
    motp_m: float
    """Mean distance of the pairs; NaN without a pair."""
    pairs: int
    """Objects with a track (TP)."""
    misses: int
    """Objects without one (FN)."""
    false_positives: int
    """Tracks without an object (FP)."""
    id_switches: int
    """Pairs with another track than the object's last one (IDSW)."""

    @classmethod
    def of(cls, scenes: Scenes, gate_m: float) -> Self:
        """CLEAR of `scenes`; a pair is not farther apart than `gate_m`."""
        columns = _pair(scenes, similarities(scenes.distances_m, gate_m))
        paired = np.flatnonzero(columns != NO_OBJECT)
        pairs, objects = len(paired), int(scenes.present.sum())
        track_ids = np.full(scenes.present.shape, NO_TRACK)
        track_ids[scenes.tick_index[paired], columns[paired]] = scenes.track_ids[paired]
        misses, false_positives, switches = objects - pairs, len(columns) - pairs, _switches(track_ids)
        return cls(
            mota=1.0 - (misses + false_positives + switches) / objects if objects else math.nan,
            motp_m=float(scenes.distances_m[paired, columns[paired]].mean()) if pairs else math.nan,
            pairs=pairs,
            misses=misses,
            false_positives=false_positives,
            id_switches=switches,
        )


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
    """Every object is given one track for the whole run, so that most of the pairs are right."""

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
    """Means over the bounds 0.05, 0.1, ..., 0.95 of the similarity."""

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


@dataclass(frozen=True)
class MultiObjectMetrics:
    """Scores over the ticks at which truth is recorded."""

    gospa: Gospa
    clear: Clear
    identity: Identity
    hota: Hota


def multi_object_metrics(run: Run, matching: Matching | None, options: EvaluationConfig) -> MultiObjectMetrics | None:
    """Scores of the judged rows of `run`; None without truth, and where `options` do not ask for them."""
    if matching is None or not options.multi_object:
        return None
    there = scenes(run, matching)
    c_m = options.gate_m
    frames = Frames.of(there, options.gate_m)
    return MultiObjectMetrics(
        Gospa.of(gospa(there, c_m), c_m), Clear.of(there, options.gate_m), Identity.of(frames), Hota.of(frames)
    )


def gospa(scenes: Scenes, c_m: float) -> GospaParts:
    """GOSPA with the cut-off distance `c_m`, as its parts at every tick.

    A pair at c or beyond costs as much as a missed object and a false track, and counts as these.
    """
    inside = scenes.distances_m < c_m
    squares = np.where(inside, scenes.distances_m, c_m) ** 2
    unclear = contested(inside, scenes.tick_index, scenes.num_ticks)
    clear = inside & ~unclear[scenes.tick_index, None]
    localisation_m2 = scenes.per_tick(np.where(clear, squares, 0.0).sum(axis=1))
    paired = np.zeros_like(scenes.present)
    clear_rows, clear_columns = np.nonzero(clear)
    paired[scenes.tick_index[clear_rows], clear_columns] = True
    rows_of = list(scenes)
    for tick in np.flatnonzero(unclear).tolist():
        cost = squares[rows_of[tick]]
        rows, columns = linear_sum_assignment(cost)
        chosen = inside[rows_of[tick]][rows, columns]
        localisation_m2[tick] = cost[rows, columns][chosen].sum()
        paired[tick, columns[chosen]] = True
    single_m2, pairs, missed = c_m**2 / 2.0, paired.sum(axis=1), scenes.present & ~paired
    return GospaParts(
        localisation_m2=localisation_m2,
        missed_m2=single_m2 * missed.sum(axis=1),
        false_m2=single_m2 * (scenes.per_tick(np.ones(len(squares))) - pairs),
        out_of_sight_m2=single_m2 * (missed & ~scenes.in_sight).sum(axis=1),
    )


def similarities(distances_m: FloatArray, gate_m: float) -> FloatArray:
    """Similarity 1 - d / (2 gate), 0 where that is negative; the shape is kept."""
    return np.maximum(0.0, 1.0 - distances_m / (2.0 * gate_m))


def _pair(scenes: Scenes, similarity: FloatArray) -> IntArray:
    """Object of every row, shape (r,); `NO_OBJECT` where none.

    Pairs of the last tick with objects and tracks stay, the others have the largest sum of similarities.
    """
    inside = similarity >= AT_GATE - np.finfo(np.float64).eps
    found = np.full(len(similarity), NO_OBJECT)
    unclear = contested(inside, scenes.tick_index, scenes.num_ticks)
    clear_rows, columns = np.nonzero(inside & ~unclear[scenes.tick_index, None])
    found[clear_rows] = columns
    rows_of, ids = list(scenes), scenes.track_ids
    used = scenes.present.any(axis=1) & (scenes.per_tick(np.ones(len(ids))) > 0)
    last = np.maximum.accumulate(np.where(used, np.arange(scenes.num_ticks), 0))
    for tick in np.flatnonzero(unclear).tolist():
        rows = rows_of[tick]
        previous = np.full(similarity.shape[1], NO_TRACK)
        if tick:
            before = np.arange(len(ids))[rows_of[last[tick - 1]]]
            before = before[found[before] != NO_OBJECT]
            previous[found[before]] = ids[before]
        score = similarity[rows] + _CONTINUATION * (ids[rows, None] == previous)
        score[~inside[rows]] = 0.0
        chosen, columns = linear_sum_assignment(score, maximize=True)
        found[rows][chosen] = np.where(inside[rows][chosen, columns], columns, NO_OBJECT)
    return found


def _switches(track_ids: IntArray) -> int:
    """How often an object has another track than its last one; `track_ids` has shape (t, objects)."""
    sequences = (column[column != NO_TRACK] for column in track_ids.T)
    return sum(int((sequence[1:] != sequence[:-1]).sum()) for sequence in sequences)

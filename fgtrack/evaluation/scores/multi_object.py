"""Multi-object scores of all tracks against all true objects: GOSPA, CLEAR, IDF1 and HOTA.

GOSPA uses the best assignment of tracks to objects within the cut-off distance c
(Rahmathullah, Garcia-Fernandez and Svensson, Fusion 2017):

    GOSPA^2 = sum of squared distances of the pairs + c^2 / 2 (number of missed objects + number of false tracks).

CLEAR (Bernardin and Stiefelhagen 2008), IDF1 (Ristani et al. 2016) and HOTA (Luiten et
al. 2021) count as TrackEval does, with the similarity 1 - d / (2 gate). The libraries
take matrices of all pairs as lists, which a recording of an hour does not allow.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.near_pairs import Scenes
from fgtrack.evaluation.scores.continuity import switches
from fgtrack.evaluation.scores.identities import hota, identity
from fgtrack.evaluation.scores.registry import registered_metrics
from fgtrack.runs import NO_TRACK

AT_GATE = 0.5
"""Similarity of a pair at the distance of the gate. Pairs below it do not count."""


@dataclass(frozen=True)
class MultiObjectMetrics:
    """Scores over the ticks with truth; NaN if there is nothing to score."""

    gospa: Mapping[str, float]
    """GOSPA: cut-off distance `c_m`, number of `ticks`, mean `mean_m` and root mean square `rms_m`.

    Also the mean squared parts `localisation_m2`, `missed_m2`, `false_m2` and
    `out_of_view_m2`, and `in_view_rms_m`, the root mean square without the last part.
    """
    clear: Mapping[str, float]
    """CLEAR: `mota`, mean distance `motp_m` of the pairs, `pairs` (TP), `misses` (FN),
    `false_positives` (FP), `id_switches`.

    An identity switch (IDSW) is a pair with another track than the object's last one.
    """
    identity: Mapping[str, float]
    """Identity precision `idp`, recall `idr` and F1 score `idf1`."""
    hota: Mapping[str, float]
    """Means of `deta`, `assa` and `hota` over the similarity thresholds 0.05, 0.1, ..., 0.95."""
    others: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Values of the registered metrics by name of the metric, for instance `ospa`; plug-ins included."""


def multi_object_metrics(scenes: Scenes, gate_m: float) -> MultiObjectMetrics:
    """Return the scores of `scenes`; a pair is at most `gate_m` apart."""
    squares_m2 = gospa(scenes, gate_m)
    means_m2 = {name: _mean(values) for name, values in squares_m2.items()}
    roots = {
        "mean_m": _mean(np.sqrt(squares_m2["total_m2"])),
        "rms_m": math.sqrt(means_m2.pop("total_m2")),
    }
    roots["in_view_rms_m"] = math.sqrt(means_m2.pop("in_view_m2"))
    similarity = _similarity(scenes, gate_m)
    return MultiObjectMetrics(
        {"c_m": gate_m, "ticks": len(scenes.present), **roots, **means_m2},
        clear(scenes, gate_m),
        identity(scenes, similarity, AT_GATE),
        hota(scenes, similarity),
        registered_metrics(scenes, gate_m),
    )


def clear(scenes: Scenes, gate_m: float) -> dict[str, float]:
    """CLEAR of `scenes`: pairs of the last tick stay, the rest has the largest sum of similarities within `gate_m`."""
    similarity = _similarity(scenes, gate_m)
    scores = np.where(similarity >= AT_GATE - np.finfo(np.float64).eps, similarity, 0.0)
    num_ticks = len(scenes.present)
    num_rows = np.bincount(scenes.tick_index, minlength=len(scenes.present))
    used = scenes.present.any(axis=1) & (num_rows > 0)
    last = np.maximum.accumulate(np.where(used, np.arange(num_ticks), 0))
    found = scenes.assigned(scores, np.concatenate([[-1], last])[:-1])
    track_ids = np.full(scenes.present.shape, NO_TRACK)
    track_ids[scenes.tick_index[found.rows], found.objects] = scenes.track_ids[
        found.rows
    ]
    switched = sum(len(switches(column)) for column in track_ids.T)
    pairs = len(found.rows)
    objects = int(scenes.present.sum())
    misses = objects - pairs
    false_positives = len(scenes.tick_index) - pairs
    return {
        "mota": 1.0 - (misses + false_positives + switched) / objects
        if objects
        else math.nan,
        "motp_m": _mean(found.distances_m),
        "pairs": pairs,
        "misses": misses,
        "false_positives": false_positives,
        "id_switches": switched,
    }


def gospa(scenes: Scenes, c_m: float) -> dict[str, FloatArray]:
    """Return the squared GOSPA with the cut-off distance `c_m` at every tick.

    Contains the parts, the total, and the total in view. Pairs at the distance c or
    farther do not count. `out_of_view_m2` is the part of `missed_m2` for objects that
    no sensor could detect.
    """
    scenes.near.check(c_m)
    gains_m2 = np.maximum(c_m**2 - np.square(scenes.near.distances_m), 0.0)
    num_ticks = len(scenes.present)
    tick_index = scenes.tick_index
    pairs = scenes.assigned(gains_m2, np.full(num_ticks, -1))
    ticks = tick_index[pairs.rows]
    squares_m2 = np.square(pairs.distances_m)
    paired = np.zeros_like(scenes.present)
    paired[ticks, pairs.objects] = True
    single_m2 = c_m**2 / 2.0
    missed = scenes.present & ~paired
    localisation_m2 = np.asarray(
        np.bincount(ticks, squares_m2, num_ticks), dtype=np.float64
    )
    missed_m2 = single_m2 * missed.sum(axis=1)
    false_m2 = single_m2 * (
        np.bincount(tick_index, minlength=num_ticks) - paired.sum(axis=1)
    )
    unseen_m2 = single_m2 * (missed & ~scenes.in_view).sum(axis=1)
    total_m2 = localisation_m2 + missed_m2 + false_m2
    parts = {
        "localisation_m2": localisation_m2,
        "missed_m2": missed_m2,
        "false_m2": false_m2,
    }
    return parts | {
        "out_of_view_m2": unseen_m2,
        "total_m2": total_m2,
        "in_view_m2": total_m2 - unseen_m2,
    }


def _similarity(scenes: Scenes, gate_m: float) -> FloatArray:
    """Return the similarity of each near pair, shape (k,): 1 at distance 0, and 0 at twice the gate."""
    scenes.near.check(2.0 * gate_m)
    return np.maximum(0.0, 1.0 - scenes.near.distances_m / (2.0 * gate_m))


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else math.nan

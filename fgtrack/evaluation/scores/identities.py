"""IDF1 and HOTA: how well the tracks keep the identities of the objects."""

import math

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.near_pairs import Scenes

#: Similarity thresholds of HOTA.
_THRESHOLDS = np.arange(1, 20) / 20.0
_EPS = float(np.finfo(np.float64).eps)


def identity(
    scenes: Scenes, similarity: FloatArray, threshold: float
) -> dict[str, float]:
    """Return identity precision `idp`, recall `idr` and F1 score `idf1`; NaN without objects.

    Every object gets at most one track for the whole time, so that the number of ticks
    with a similarity of at least `threshold` is largest. `similarity` (k,) is the
    similarity of each near pair.

    Source: Ristani, Solera, Zou, Cucchiara and Tomasi, "Performance measures and a data
    set for multi-target, multi-camera tracking", ECCV workshops 2016.
    """
    from scipy.optimize import linear_sum_assignment

    num_true = int(scenes.present.sum())
    num_rows = len(scenes.tick_index)
    if not num_true:
        return dict.fromkeys(("idf1", "idp", "idr"), math.nan)
    near = scenes.near.where(similarity >= threshold)
    ids, track = np.unique(scenes.track_ids[near.rows], return_inverse=True)
    counts = np.zeros((scenes.present.shape[1], len(ids)), dtype=np.int64)
    np.add.at(counts, (near.objects, track), 1)
    matched = int(counts[linear_sum_assignment(counts, maximize=True)].sum())
    return {
        "idf1": 2.0 * matched / (num_true + num_rows),
        "idp": matched / max(num_rows, 1),
        "idr": matched / num_true,
    }


def hota(scenes: Scenes, similarity: FloatArray) -> dict[str, float]:
    """Return the means of `hota`, `deta` and `assa` over the similarity thresholds; NaN without objects.

    A pair of an object and a track has an alignment over the whole time, which is the
    Jaccard index of their similarities. At each tick, the assignment has the largest sum
    of alignment times similarity. `similarity` (k,) is the similarity of each near pair.

    Source: Luiten, Osep, Dendorfer, Torr, Geiger, Leal-Taixe and Leibe, "HOTA: a higher
    order metric for evaluating multi-object tracking", International Journal of Computer
    Vision 129, 2021.
    """
    num_true = int(scenes.present.sum())
    num_rows = len(scenes.tick_index)
    if not num_true:
        return dict.fromkeys(("hota", "deta", "assa"), math.nan)
    ids, track_of_row = np.unique(scenes.track_ids, return_inverse=True)
    blocks = list(scenes.blocks())
    codes = np.unique(
        np.concatenate(
            [
                np.unique(_codes(scenes, track_of_row, len(ids), block))
                for block in blocks
            ]
        )
    )
    identity_of_pair = np.empty(len(similarity), dtype=np.int32)
    together = np.zeros(len(codes))
    for block in blocks:
        mine = np.searchsorted(codes, _codes(scenes, track_of_row, len(ids), block))
        identity_of_pair[block] = mine
        shares = _shares(scenes, similarity[block], block)
        together += np.bincount(mine, shares, minlength=len(codes))
    # Ticks with the object plus ticks with the track, of each pair of identities.
    either = (
        scenes.present.sum(axis=0)[codes // max(len(ids), 1)]
        + np.bincount(track_of_row, minlength=len(ids))[codes % max(len(ids), 1)]
    )
    alignment = together / (either - together)
    found = np.asarray(
        scenes.assigned_indices(
            alignment[identity_of_pair] * similarity, np.full(len(scenes.present), -1)
        )
    )
    values = [
        _at_threshold(
            identity_of_pair[found[similarity[found] >= threshold - _EPS]],
            either,
            num_true + num_rows,
        )
        for threshold in _THRESHOLDS.tolist()
    ]
    deta, assa = np.array(values).T
    return {
        "hota": float(np.sqrt(deta * assa).mean()),
        "deta": float(deta.mean()),
        "assa": float(assa.mean()),
    }


def _codes(
    scenes: Scenes, track_of_row: IntArray, num_tracks: int, block: slice
) -> IntArray:
    """Return a number for the object and the track of each near pair of `block`."""
    near = scenes.near
    return np.asarray(
        near.objects[block] * max(num_tracks, 1) + track_of_row[near.rows[block]]
    )


def _shares(scenes: Scenes, similarity: FloatArray, block: slice) -> FloatArray:
    """Return the similarity of each near pair over the similarities of its row and its object at the tick.

    `similarity` is that of the pairs in `block`, which contains whole ticks.
    """
    rows, objects = scenes.near.rows[block], scenes.near.objects[block]
    _, row = np.unique(rows, return_inverse=True)
    _, object_at_tick = np.unique(
        scenes.tick_index[rows] * scenes.present.shape[1] + objects,
        return_inverse=True,
    )
    of_row = np.bincount(row, similarity)[row]
    of_object = np.bincount(object_at_tick, similarity)[object_at_tick]
    either = of_row + of_object - similarity
    return np.divide(
        similarity, either, out=np.zeros_like(similarity), where=either > _EPS
    )


def _at_threshold(
    identity_of_pair: IntArray, either: IntArray, total: int
) -> tuple[float, float]:
    """Return detection and association accuracy of the pairs of one threshold.

    `total` is the number of true states plus the number of rows.
    """
    num_pairs = len(identity_of_pair)
    matches = np.bincount(identity_of_pair, minlength=len(either))
    accuracy = matches / np.maximum(1, either - matches)
    return (
        num_pairs / max(1, total - num_pairs),
        float((matches * accuracy).sum()) / max(1, num_pairs),
    )

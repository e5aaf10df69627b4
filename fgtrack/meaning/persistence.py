"""Estimates detection probability, clutter and score model of a sensor from the persistence of its detections.

Persistence means that the detections of an object recur from list to list; no tracks
are needed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress, pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.sensors import Score

if TYPE_CHECKING:  # takes half a second to import
    from scipy.spatial import cKDTree

__all__ = ["Lists", "Persistence", "disagreement_m", "persistence"]

#: Highest speed of an object.
_FASTEST_MPS = 90.0
_LARGEST_ERROR_M = 3.0
"""Largest difference of the errors of two detections of one object."""
_MOST_CENTRES = 3_000
"""Most detections whose neighbours are searched; in a longer recording only every n-th list contains centres."""
#: Fewest samples for an estimate, and fewest triples beyond an estimated maximum range.
_FEWEST = 30
_FEWEST_FAR = 5
_BESIDE_M = np.array([20.0, 20.0])
"""Offset of a reference point next to an object, longer than the hull of all objects but large ships."""
_CROWD_M = 50.0
"""Radius of crowds of clutter, for example at a shore or a hedge, in which clutter competes with a track."""
_CORE = 3.5
"""Largest second difference of one object's positions, in multiples of the scale: 99.8 % of a Rayleigh distribution."""
_LEAST_STD_M = 0.02
"""Smallest scatter: exact positions of a simulator differ from a straight line by rounding and by manoeuvres."""
#: Bisections of the share of clutter.
_BISECTIONS = 30
_PROBABILITY = (0.1, 0.9)
"""Bounds of the estimated detection probability, which is uncertain because occlusions last for several lists."""


class Lists(NamedTuple):
    """Positions in the lists of a sensor, in a frame with constant orientation."""

    stamps_s: FloatArray
    """Ascending stamps, shape (n,)."""
    points_m: Sequence[FloatArray]
    """Positions in each list, shape (m, 2)."""
    scores: Sequence[FloatArray]
    """Scores in each list, shape (m,); NaN where missing."""
    ranges_m: Sequence[FloatArray]
    """Distances from the sensor in each list, shape (m,); NaN where unknown."""


@dataclass(frozen=True)
class Persistence:
    """Detection probability, clutter and score model of a sensor, from triples of detections in successive lists.

    Three detections in successive lists, on a straight line at constant speed, belong
    to one object. The detection probability is the frequency with which the next lists
    continue this line. Detections in no triple are clutter, apart from those that
    missed detections explain. If scores identify clutter, its density is estimated
    around other clutter too, where it competes with tracks that began there (Song,
    Musicki: Adaptive clutter measurement density estimation for improved target
    tracking, IEEE T-AES 2011).
    """

    detection_probability: float
    clutter_per_list: float
    near_clutter_per_m2: float
    """Density of clutter near other clutter: in the next list if scores identify clutter, else in the same list."""
    score: Score | None
    """Score model; None if scores are missing, or higher scores do not belong to objects more often."""
    max_range_m: float | None
    """Range beyond which most triples are not continued, so clutter outnumbers objects; None if there is no such
    range.
    """
    lines: FloatArray
    """Stamp, position and velocity at the end of each triple, shape (n, 5)."""
    std_m: float
    """Standard deviation of a detection on each axis; only errors that are independent from list to list count."""
    lists: Lists


def disagreement_m(one: Persistence, other: Lists) -> float | None:
    """Return the standard deviation on each axis between positions of the objects of `one` and their detections in
    `other`.

    `other` contains the lists of another sensor. Pairs are mutual nearest neighbours.
    Returns None if there are few pairs, or if their distances are not clearly smaller
    than distances from a reference point next to the object.
    """
    distances_m = []
    beside_m = []
    for stamp_s, *state in one.lines.tolist():
        k = int(np.argmin(np.abs(other.stamps_s - stamp_s)))
        at_m = np.array(state[:2])
        points_m = other.points_m[k] - (other.stamps_s[k] - stamp_s) * np.array(
            state[2:]
        )
        if not len(points_m):
            continue
        nearest_m = points_m[np.argmin(np.hypot(*(points_m - at_m).T))]
        rivals_m = one.lists.points_m[int(np.searchsorted(one.lists.stamps_s, stamp_s))]
        if np.hypot(*(rivals_m - nearest_m).T).min() < np.hypot(*(at_m - nearest_m)):
            continue
        distances_m.append(np.hypot(*(nearest_m - at_m)))
        beside_m.append(np.hypot(*(points_m - at_m - _BESIDE_M).T).min())
    if len(distances_m) < _FEWEST:
        return None
    scale_m = _scale(np.array(distances_m), 0.25)
    return scale_m if scale_m < 0.5 * _scale(np.array(beside_m)) else None


def persistence(lists: Lists, grid_std_m: float = 0.0) -> Persistence | None:
    """Estimate detection probability, clutter and score model; None if too few detections recur in successive lists.

    `grid_std_m` is the standard deviation of the rounding of positions to a grid.
    """
    from scipy.spatial import cKDTree

    stamps_s = lists.stamps_s
    points_m = lists.points_m
    trees = [cKDTree(points) for points in points_m]
    every = max(1, math.ceil(sum(map(len, points_m)) / _MOST_CENTRES))
    centres = range(1, len(stamps_s) - 3, every)
    misfits = list[float]()
    scores = list[float]()
    ranges_m = list[float]()
    lines: list[tuple[int, FloatArray, FloatArray]] = []
    for k in centres:
        before_s = float(stamps_s[k] - stamps_s[k - 1])
        after_s = float(stamps_s[k + 1] - stamps_s[k])
        if min(before_s, after_s) <= 0.0:
            continue
        scores += lists.scores[k].tolist()
        ranges_m += lists.ranges_m[k].tolist()
        for centre_m in points_m[k]:
            misfit_m, end_m, velocity_mps = _best(
                centre_m, trees[k - 1], trees[k + 1], before_s, after_s
            )
            misfits.append(misfit_m)
            lines.append((k, end_m, velocity_mps))
    misfit = np.array(misfits)
    scale = max(_scale(misfit[np.isfinite(misfit)]), grid_std_m, _LEAST_STD_M)
    in_triple = misfit <= _CORE * scale
    num_triples = int(in_triple.sum())
    reach_m = _CORE * scale * math.sqrt(6.0)
    if num_triples < _FEWEST:
        return None
    hits = 0
    of_object = np.zeros(len(misfit), dtype=bool)
    for row in np.flatnonzero(in_triple).tolist():
        k, end_m, velocity_mps = lines[row]
        ahead_m = [
            end_m + velocity_mps * float(stamps_s[k + n] - stamps_s[k + 1])
            for n in (2, 3)
        ]
        seen = [
            bool(trees[k + n].query(at_m)[0] <= (n - 1) * reach_m)
            for n, at_m in enumerate(ahead_m, start=2)
        ]
        hits += sum(seen)
        of_object[row] = all(seen)
    share = (hits + 1) / (2 * num_triples + 2)
    probability = float(np.clip(share, *_PROBABILITY))
    # A detection of an object is in a triple if both its neighbours are detected.
    of_objects = min(num_triples / probability**2, float(len(misfit)))
    of_clutter = len(misfit) - of_objects
    model = _score(np.array(scores), of_object, ~in_triple)
    if model is not None:
        near = _near_clutter_per_m2(
            trees, lists.scores, model, len(misfit) / max(of_objects, 1.0) - 1.0
        )
    else:
        near = _crowding_per_m2(
            points_m, np.array([k for k, *_ in lines]), ~in_triple, of_clutter
        )
    max_range_m = _max_range_m(
        np.array(ranges_m)[in_triple], of_object[in_triple] / probability**2
    )
    ends = [
        (stamps_s[k + 1], *end_m, *velocity_mps)
        for k, end_m, velocity_mps in compress(lines, in_triple)
    ]
    clutter = of_clutter / len(centres)
    return Persistence(
        probability, clutter, near, model, max_range_m, np.array(ends), scale, lists
    )


def _crowding_per_m2(
    points_m: Sequence[FloatArray],
    numbers: IntArray,
    loose: BoolArray,
    of_clutter: float,
) -> float:
    """Return the density of false detections near other false detections of the same list.

    `loose` marks detections in no triple; `of_clutter` of them are clutter. `numbers`
    contains the index of the list of each detection.
    """
    from scipy.spatial import cKDTree

    num_loose = max(int(loose.sum()), 1)
    pairs = 0
    for k in np.unique(numbers[loose]).tolist():
        tree = cKDTree(points_m[k][loose[numbers == k]])
        pairs += int(tree.count_neighbors(tree, _CROWD_M)) - tree.n
    return (
        min(of_clutter / num_loose, 1.0) * pairs / (num_loose * math.pi * _CROWD_M**2)
    )


def _max_range_m(ranges_m: FloatArray, objects: FloatArray) -> float | None:
    """Return the range beyond which most triples are not continued; None if there is no such range.

    `ranges_m` and `objects` describe the triples. The entry in `objects` is 0 if a
    triple is not continued, else the number of objects that it stands for, which is
    above 1 because of missed detections.
    """
    known = np.isfinite(ranges_m)
    order = np.argsort(ranges_m[known])
    surplus = np.cumsum(objects[known][order] - 0.5)
    best = int(np.argmax(surplus)) if len(surplus) else 0
    if len(surplus) - best <= _FEWEST_FAR:
        return None
    return float(ranges_m[known][order][best])


def _near_clutter_per_m2(
    trees: "Sequence[cKDTree]", scores: Sequence[FloatArray], model: Score, odds: float
) -> float:
    """Return the density of clutter in a list near clutter of the list before.

    `model` and `scores` give the ratios of likelihoods of objects and clutter. `odds` are
    the odds of clutter before the score is known. `trees` contain the positions of each
    list. Two near detections of successive lists are both of objects, or both of clutter.
    The share of pairs of clutter is the most likely one of their scores.
    """
    ratios = [
        np.exp((np.nan_to_num(item, nan=model.even) - model.even) / model.scale)
        for item in scores
    ]
    total = sum(float((odds / (odds + item)).sum()) for item in ratios[:-1])
    of_pairs = [
        own[i] * others[near]
        for (tree, own), (after, others) in pairwise(zip(trees, ratios, strict=True))
        for i, near in enumerate(tree.query_ball_tree(after, _LARGEST_ERROR_M))
    ]
    if not of_pairs or not total:
        return 0.0
    pairs = np.concatenate(of_pairs)
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        # Derivative of the log-likelihood, which falls.
        slope = float(np.mean((1.0 - pairs) / (share + (1.0 - share) * pairs)))
        low, high = (share, high) if slope > 0.0 else (low, share)
    return low * len(pairs) / (total * math.pi * _LARGEST_ERROR_M**2)


def _best(
    centre_m: FloatArray,
    before: "cKDTree",
    after: "cKDTree",
    before_s: float,
    after_s: float,
) -> tuple[float, FloatArray, FloatArray]:
    """Return the misfit of the straightest triple around a detection, and position and velocity at its end.

    The misfit is infinite if there is no triple.
    """
    near = before.query_ball_point(centre_m, _FASTEST_MPS * before_s + _LARGEST_ERROR_M)
    if not near or not after.n:
        return math.inf, centre_m, centre_m
    firsts_m = np.asarray(before.data)[near]
    ratio = after_s / before_s
    result = after.query(centre_m + ratio * (centre_m - firsts_m))
    distances_m = np.asarray(result[0])
    ends = np.asarray(result[1])
    best = int(np.argmin(distances_m))
    end_m = np.asarray(after.data)[ends[best]]
    velocity_mps = (end_m - firsts_m[best]) / (before_s + after_s)
    return (
        float(distances_m[best]) / math.sqrt(1.0 + ratio**2 + (1.0 + ratio) ** 2),
        end_m,
        velocity_mps,
    )


def _scale(misfits: FloatArray, start: float = 0.5) -> float:
    """Scale of the Rayleigh distribution of the misfits, without outliers.

    `start` is a quantile of the misfits that outliers do not reach.
    """
    if not len(misfits):
        return 0.0
    scale = float(np.quantile(misfits, start)) / math.sqrt(-2.0 * math.log(1.0 - start))
    for _ in range(30):
        scale = float(np.median(misfits[misfits <= _CORE * scale])) / math.sqrt(
            2.0 * math.log(2.0)
        )
    return scale


def _score(
    scores: FloatArray, of_object: BoolArray, of_clutter: BoolArray
) -> Score | None:
    """Return a logistic fit to the scores of objects and of clutter, corrected for the ratio of their numbers.

    Returns None if there are too few scores, or if higher scores do not belong to
    objects more often.
    """
    from scipy.optimize import minimize
    from scipy.special import expit, log_expit

    known = np.isfinite(scores) & (of_object | of_clutter)
    x = scores[known]
    y = of_object[known]
    if min(y.sum(), (~y).sum()) < _FEWEST or np.ptp(x) == 0.0:
        return None
    middle = float(np.median(x))
    width = float(np.std(x))
    z = (x - middle) / width
    sign = np.where(y, 1.0, -1.0)

    def cost(p: FloatArray) -> tuple[float, FloatArray]:
        margin = sign * (p[0] + p[1] * z)
        slope = -sign * expit(-margin)
        return -float(log_expit(margin).sum()), np.array(
            [slope.sum(), (slope * z).sum()]
        )

    intercept, slope = minimize(cost, np.zeros(2), jac=True, method="BFGS").x
    if slope <= 0.0:
        return None
    prior = math.log(y.sum() / (~y).sum())
    return Score(even=middle + width * (prior - intercept) / slope, scale=width / slope)

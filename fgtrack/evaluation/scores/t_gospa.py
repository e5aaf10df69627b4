"""T-GOSPA, a distance between sets of trajectories.

Source: Garcia-Fernandez, Rahmathullah and Svensson, "A metric on the space of finite
sets of trajectories for evaluation of multi-target tracking algorithms", IEEE
Transactions on Signal Processing 68, 2020, section IV (linear program), with p = 2.
"""

import math
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from scipy.optimize import LinearConstraint, milp
from scipy.sparse import csr_array, eye_array, hstack, vstack
from scipy.sparse.csgraph import connected_components

from fgtrack.core.errors import FgtrackError
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.evaluation.near_pairs import NearPairs, Scenes

__all__ = ["t_gospa"]

SWITCH_M = 1.0
"""Default cost of a switch in m."""
MOST_TICKS = 10_000
"""Largest number of ticks of a run that is minimised as a whole."""
WINDOW_TICKS = 2_000
"""Number of ticks of a window of a longer run; the time of the linear program grows with the square."""


def t_gospa(
    scenes: Scenes, c_m: float, switch_m: float = SWITCH_M
) -> Mapping[str, float]:
    """Return T-GOSPA per tick, `rms_m`, its squared parts per tick, and the number of `windows`.

    The parts are `localisation_m2`, `missed_m2`, `false_m2` and `switches_m2`. All values
    are NaN without a tick. `c_m` is the cut-off distance and `switch_m` the cost gamma of a
    switch. The metric minimises over the shares W_k(i, j) in [0, 1] of object i that
    track j has at tick k:

        sum of GOSPA^2(W_k) over k
        + gamma^2 / 2 times the sum of abs(W_k(i, j) - W_(k-1)(i, j)) over i, j, k

    A change from one track to another costs gamma^2. The start or the end of a pair
    costs gamma^2 / 2.

    A run of more than `MOST_TICKS` ticks is cut into windows of `WINDOW_TICKS` ticks, and
    the minimum is that of each window. No change between two windows is counted. Therefore
    each cut lowers the sum by at most gamma^2 for each object.
    """
    num_ticks = len(scenes.present)
    names = ("localisation_m2", "missed_m2", "false_m2", "switches_m2")
    if not num_ticks:
        return dict.fromkeys(("rms_m", *names, "windows"), math.nan)
    scenes.near.check(c_m)
    length = WINDOW_TICKS if num_ticks > MOST_TICKS else num_ticks
    parts = []
    for block in scenes.blocks(length):
        near = scenes.near.where(block)
        near = near.where(near.distances_m < c_m)
        if len(near.rows):
            parts.append(_assignment(scenes, near, c_m, switch_m))
    localisation_m2, pairs, changes = np.sum(
        np.reshape(parts, (-1, 3)), axis=0
    ).tolist()
    single_m2 = c_m**2 / 2.0
    sums_m2 = (
        localisation_m2,
        single_m2 * (float(scenes.present.sum()) - pairs),
        single_m2 * (float(len(scenes.tick_index)) - pairs),
        0.5 * switch_m**2 * changes,
    )
    per_tick = [part / num_ticks for part in sums_m2]
    return {
        "rms_m": math.sqrt(sum(per_tick)),
        **dict(zip(names, per_tick, strict=True)),
        "windows": math.ceil(num_ticks / length),
    }


def _assignment(
    scenes: Scenes, near: NearPairs, c_m: float, switch_m: float
) -> tuple[float, float, float]:
    """Return the sums of squared distances, of shares and of changes of shares in one window.

    `near` are the pairs of the window below `c_m`.
    """
    ticks = scenes.tick_index[near.rows]
    squares_m2 = np.square(near.distances_m)
    pairs, pair_of_row = np.unique(
        np.stack([near.objects, scenes.track_ids[near.rows]]),
        axis=1,
        return_inverse=True,
    )
    shares = np.ones(len(near.rows))
    changes = 0.0
    for group in _competing_groups(pairs):
        mine = group[pair_of_row]
        used, at = np.unique(ticks[mine], return_inverse=True)
        column = np.cumsum(group)[pair_of_row[mine]] - 1
        gains_m2 = np.zeros((len(used), int(group.sum())))
        gains_m2[at, column] = squares_m2[mine] - c_m**2
        stretch = _stretches(gains_m2 < 0.0, pairs[:, group])
        sums_m2 = np.zeros((stretch[-1] + 1, gains_m2.shape[1]))
        np.add.at(sums_m2, stretch, gains_m2)
        found = _shares(sums_m2, pairs[:, group], switch_m)
        shares[mine] = found[stretch[at], column]
        changes += float(np.abs(np.diff(found, axis=0)).sum())
    return float(shares @ squares_m2), float(shares.sum()), changes


def _competing_groups(pairs: IntArray) -> list[BoolArray]:
    """Return a mask, shape (n,), for each group of pairs that compete for objects or tracks.

    `pairs` (2, n) are the object and the track of each pair. A pair without a
    competitor lasts for the whole time, and is in no group.
    """
    objects, tracks = (np.unique(of, return_inverse=True)[1] for of in pairs)
    first_track = int(objects.max(initial=-1)) + 1
    num_nodes = first_track + int(tracks.max(initial=-1)) + 1
    edges = csr_array(
        (np.ones(len(objects)), (objects, first_track + tracks)),
        shape=(num_nodes, num_nodes),
    )
    _, group_of_node = connected_components(edges, directed=False)
    sizes = np.bincount(group_of_node[objects], minlength=1)
    return [group_of_node[objects] == group for group in np.flatnonzero(sizes > 1)]


def _stretches(close: BoolArray, pairs: IntArray) -> IntArray:
    """Return the number of the stretch of each tick, shape (k,), from 0 in steps of 0 or 1.

    A stretch has ticks in a row in which no two close pairs share an object or a track.
    Constant shares are optimal in a stretch: a close pair may keep its largest share,
    every other pair its smallest share, and no change becomes dearer. A tick with
    competing close pairs is a stretch by itself. `close` (k, n) marks the close pairs.
    """
    objects, tracks = (np.unique(of, return_inverse=True)[1] for of in pairs)

    def competes(chosen: BoolArray) -> bool:
        """True if two of the `chosen` pairs share an object or a track."""
        most = np.bincount(objects[chosen]).max() + np.bincount(tracks[chosen]).max()
        return bool(most > 2)

    changes = np.flatnonzero((close[1:] != close[:-1]).any(axis=1)) + 1
    edges = [0, *changes.tolist(), len(close)]
    number = 0
    stretch = np.empty(len(close), dtype=np.int64)
    together = close[0]
    for first, last in pairwise(edges):  # ticks in a row with the same close pairs
        now = close[first]
        if competes(together | now):
            number += first > 0
            together = now
        together = together | now
        if competes(now):
            stretch[first:last] = number + np.arange(last - first)
            number += last - first - 1
        else:
            stretch[first:last] = number
    return stretch


def _shares(gains_m2: FloatArray, pairs: IntArray, switch_m: float) -> FloatArray:
    """Return the optimal shares of n competing pairs in k stretches, shape (k, n).

    `gains_m2` (k, n) is the change of the cost, at most 0, if the pair is made. A pair
    has a variable in each stretch from its first to its last gain. Its share is
    constant before and constant after these stretches. `pairs` (2, n) are the object
    and the track of each pair.

    Raises `FgtrackError` if the linear program has no solution.
    """
    num_stretches = len(gains_m2)
    gained = gains_m2 < 0.0
    first = gained.argmax(axis=0)
    last = num_stretches - 1 - gained[::-1].argmax(axis=0)
    # Variable of each share: one before the first gain, then one a stretch, one after the last gain.
    within = np.clip(np.arange(num_stretches)[:, None], first - 1, last + 1) - first + 1
    start = np.concatenate([[0], np.cumsum(last - first + 3)])
    variable = start[:-1] + within
    num_shares = int(start[-1])
    costs = np.bincount(variable.ravel(), gains_m2.ravel(), num_shares)
    limits = []
    stretches = np.broadcast_to(np.arange(num_stretches)[:, None], variable.shape)
    for of in pairs:
        numbers = np.unique(of, return_inverse=True)[1]
        row = stretches * (numbers.max() + 1) + numbers
        limits.append(
            csr_array(
                (np.ones(row.size), (row.ravel(), variable.ravel())),
                shape=(num_stretches * (int(numbers.max()) + 1), num_shares),
            )
        )
    at_most = vstack(limits)
    # A change leads from each variable to the next variable of the same pair.
    before = np.setdiff1d(np.arange(num_shares), start[1:] - 1)
    num_changes = len(before)
    change = np.arange(num_changes)
    steps = csr_array(
        (
            np.concatenate([np.ones(num_changes), -np.ones(num_changes)]),
            (np.tile(change, 2), np.concatenate([before + 1, before])),
        ),
        shape=(num_changes, num_shares),
    )
    rises = eye_array(num_changes)
    unchanged = csr_array((at_most.shape[0], 2 * num_changes))
    solution = milp(
        np.concatenate([costs, np.full(2 * num_changes, 0.5 * switch_m**2)]),
        constraints=[
            LinearConstraint(hstack([at_most, unchanged]), -np.inf, 1.0),
            LinearConstraint(hstack([steps, -rises, rises]), 0.0, 0.0),
        ],
    )
    if solution.x is None:
        raise FgtrackError(f"T-GOSPA: the linear program failed: {solution.message}")
    shares: FloatArray = solution.x[variable]
    return shares

"""The best assignments of candidates to tracks, in the order of their likelihood."""

import heapq
from collections.abc import Iterable, Sequence
from itertools import count
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import FloatArray

LARGEST_LOSS = 9.2
"""An assignment is left out if it is less likely than the best one by a factor of exp(9.2), about 10,000."""
_FORBIDDEN = 1e9


class Ranked(NamedTuple):
    """One assignment."""

    gain: float
    """Log-likelihood ratio to the assignment in which all tracks are missed."""
    pairs: tuple[tuple[int, int], ...]
    """Pairs (track, candidate)."""


def best_assignments(
    pairs: Iterable[tuple[int, int, float]], most: int
) -> list[Ranked]:
    """Return at most `most` assignments, the best one first.

    `pairs` are track, candidate, and the log-likelihood ratio of the pair to a missed track. Each track and each
    candidate is used at most once. Tracks that compete for no candidate are independent, so each cluster of competing
    tracks is solved by itself.
    """
    best = [Ranked(0.0, ())]
    for cluster in _clusters(pairs):
        best = _combined(best, _ranked(cluster, most), most)
    return best


_Cluster = dict[int, dict[int, float]]


def _clusters(pairs: Iterable[tuple[int, int, float]]) -> list[_Cluster]:
    """Return the gains by track and candidate of each cluster of tracks that share candidates, directly or not."""
    clusters: list[_Cluster] = []
    of_track: dict[int, _Cluster] = {}
    of_candidate: dict[int, _Cluster] = {}
    for track, candidate, gain in pairs:
        own, other = of_track.get(track), of_candidate.get(candidate)
        if own is None:
            own = other if other is not None else {}
            if other is None:
                clusters.append(own)
            of_track[track] = own
        elif other is not None and other is not own:
            own.update(other)
            clusters = [each for each in clusters if each is not other]
            for each, gains in other.items():
                of_track[each] = own
                for taken in gains:
                    of_candidate[taken] = own
        of_candidate[candidate] = own
        own.setdefault(track, {})[candidate] = gain
    return clusters


def _ranked(cluster: _Cluster, most: int) -> list[Ranked]:
    """Return the best assignments of one cluster, the best one first."""
    if len(cluster) == 1:
        [(track, gains)] = cluster.items()
        found = [
            Ranked(gain, ((track, candidate),)) for candidate, gain in gains.items()
        ]
        found.append(Ranked(0.0, ()))
        return sorted(found, key=_order)[:most]
    tracks = sorted(cluster)
    candidates = sorted({each for gains in cluster.values() for each in gains})
    cost = np.full((len(tracks), len(candidates) + len(tracks)), _FORBIDDEN)
    for row, track in enumerate(tracks):
        cost[row, len(candidates) + row] = 0.0
        for candidate, gain in cluster[track].items():
            cost[row, candidates.index(candidate)] = -gain
    return [
        Ranked(
            -value,
            tuple(
                (tracks[row], candidates[column])
                for row, column in enumerate(columns)
                if column < len(candidates)
            ),
        )
        for value, columns in _murty(cost, most)
    ]


def _order(ranked: Ranked) -> tuple[float, tuple[tuple[int, int], ...]]:
    """Return the sort key: the largest gain comes first, equal gains come in the order of their pairs."""
    return -ranked.gain, ranked.pairs


def _combined(
    first: Sequence[Ranked], second: Sequence[Ranked], most: int
) -> list[Ranked]:
    """Return the best combinations of the assignments of independent clusters."""
    least = first[0].gain + second[0].gain - LARGEST_LOSS
    found = []
    for own in first:
        for other in second:
            gain = own.gain + other.gain
            if gain < least:
                break
            found.append(Ranked(gain, own.pairs + other.pairs))
    return sorted(found, key=_order)[:most]


def _murty(cost: FloatArray, most: int) -> list[tuple[float, list[int]]]:
    """Return the assignments with the least costs, the best one first: cost, and the column of each row.

    Source: Murty, "An algorithm for ranking all the assignments in order of increasing cost", Operations Research
    16(3), 1968.
    """
    from scipy.optimize import linear_sum_assignment

    found: list[tuple[float, list[int]]] = []
    heap: list[tuple[float, int, list[int], FloatArray, int]] = []
    numbers = count()  # the earlier of two equal costs comes first

    def add(restricted: FloatArray, first: int) -> None:
        rows, columns = linear_sum_assignment(restricted)
        value = float(restricted[rows, columns].sum())
        if value < 0.5 * _FORBIDDEN and (
            not found or value < found[0][0] + LARGEST_LOSS
        ):
            heapq.heappush(
                heap, (value, next(numbers), columns.tolist(), restricted, first)
            )

    add(cost, 0)
    while heap and len(found) < most:
        value, _, columns, restricted, first = heapq.heappop(heap)
        found.append((value, columns))
        restricted = restricted.copy()
        for row in range(first, len(columns)):
            column = columns[row]
            without = restricted.copy()
            without[row, column] = _FORBIDDEN
            add(without, row)
            own = restricted[row, column]
            restricted[row] = restricted[:, column] = _FORBIDDEN
            restricted[row, column] = own
    return found

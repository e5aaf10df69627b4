"""Which detections of one list are the same object."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fgtrack.core.geometry import circular_mean
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.models.measurement import ANGULAR

_FEW = 256
"""All pairs of so many points are few."""
_MANY_PAIRS = 16
"""Pairs per point, above which points are a crowd."""
_SHORTER = 1.0 - 1e-6  # rounding of coordinates up to 1e9 times the distance puts no two points too far into one cell
_NEIGHBOURS = [(0, 1), (1, -1), (1, 0), (1, 1), (0, 2), (1, -2), (1, 2), (2, -2), (2, -1), (2, 0), (2, 1), (2, 2)]
"""Cells to ask for points of each; those on the other side ask themselves."""


class Merge(ABC):
    """Finds detections of one list that are the same object, and averages them."""

    @abstractmethod
    def groups(self, points_m: FloatArray) -> dict[int, tuple[int, ...]]:
        """Members of all groups of `points_m` (n, 2), by the point that leads it; one alone is a group of its own."""

    def mean(self, name: str, values: FloatArray) -> float:
        """Average of component `name`; of angles on the circle."""
        return circular_mean(values) if name in ANGULAR else float(values.sum() / len(values))


@dataclass(frozen=True)
class NoMerge(Merge):
    """Every detection stands for itself."""

    kind: Literal["none"] = "none"

    def groups(self, points_m: FloatArray) -> dict[int, tuple[int, ...]]:
        """See `Merge.groups`."""
        return {i: (i,) for i in range(len(points_m))}


@dataclass(frozen=True)
class ConnectedMerge(Merge):
    """Joins detections that are linked by steps of at most a distance."""

    distance_m: float
    """Detections at most this far apart are linked."""
    kind: Literal["connected"] = "connected"

    def groups(self, points_m: FloatArray) -> dict[int, tuple[int, ...]]:
        """See `Merge.groups`; in the order of their first members, which lead."""
        labels = _linked(points_m, self.distance_m)
        if labels is None:
            return NoMerge().groups(points_m)
        members: dict[int, list[int]] = {}
        for index, label in enumerate(labels.tolist()):
            members.setdefault(label, []).append(index)
        return {group[0]: tuple(group) for group in members.values()}


def _linked(points_m: FloatArray, distance_m: float) -> IntArray | None:
    """A number for each of `points_m` (n, 2), the same for those that steps of at most `distance_m` link.

    None where no two are linked. Pairs are looked at one by one only while they are few, so memory and time grow with
    the points and not with their pairs.
    """
    if len(points_m) < 2:
        return None
    tree = cKDTree(points_m)
    if len(points_m) > _FEW and int(tree.count_neighbors(tree, distance_m)) > _MANY_PAIRS * len(points_m):
        return _linked_in_cells(points_m, distance_m)
    pairs = tree.query_pairs(distance_m, output_type="ndarray")
    return _components(len(points_m), pairs[:, 0], pairs[:, 1]) if len(pairs) else None


def _components(count: int, first: IntArray, second: IntArray) -> IntArray:
    links = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1])


def _linked_in_cells(points_m: FloatArray, distance_m: float) -> IntArray:
    """`_linked` of a crowd: points in one cell of a grid, whose diagonal is shorter than the distance, belong together.

    So what is left is whether two cells near each other do: whether a point of one is near its nearest in the other. To
    find that at once for all, points are kept in a tree with the numbers of their cell as further coordinates, so far
    apart that only points of the cell that is asked for are near.
    """
    count = len(points_m)
    cells = np.floor(points_m / (distance_m * math.sqrt(0.5) * _SHORTER))
    _, leaders, own = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    first, second = [leaders[own.reshape(-1)]], [np.arange(count)]
    apart_m = 4.0 * distance_m
    tree = cKDTree(np.hstack([points_m, apart_m * cells]))
    occupied = cKDTree(cells[leaders])
    labels = _components(count, first[0], second[0])
    for step in _NEIGHBOURS:
        away, there = occupied.query(cells + step, distance_upper_bound=0.5)
        asking = np.flatnonzero(np.isfinite(away))
        asking = asking[labels[asking] != labels[leaders[np.asarray(there)[asking]]]]
        if not asking.size:
            continue
        place = np.hstack([points_m[asking], apart_m * (cells[asking] + step)])
        nearest = np.asarray(tree.query(place, distance_upper_bound=2.0 * distance_m)[1])
        found = nearest < count
        asking, nearest = asking[found], nearest[found]
        offsets = points_m[asking] - points_m[nearest]
        close = np.vecdot(offsets, offsets) <= distance_m**2
        first.append(asking[close])
        second.append(nearest[close])
        labels = _components(count, np.concatenate(first), np.concatenate(second))
    return labels

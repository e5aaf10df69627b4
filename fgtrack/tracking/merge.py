"""Merging detections of one list that belong to the same object."""

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
    """Labels of `points_m` (n, 2), equal for those that steps of at most `distance_m` link; None without a link."""
    if len(points_m) < 2:
        return None
    pairs = cKDTree(points_m).query_pairs(distance_m, output_type="ndarray")
    if not len(pairs):
        return None
    links = coo_array((np.ones(len(pairs), dtype=np.int8), pairs.T), shape=(len(points_m),) * 2)
    return np.asarray(connected_components(links, directed=False)[1])

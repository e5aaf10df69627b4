"""How the published implementation of Karle et al. 2023 merges, assigns and ages objects, one defect each."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import StatesAt
from fgtrack.estimation.published import published_yaw
from fgtrack.tracking.association import Assignment, euclidean_distances
from fgtrack.tracking.lifecycle import CountingLifecycle
from fgtrack.tracking.preprocess import Candidate, Group


@dataclass(frozen=True)
class NeighbourhoodMerge:
    """Each distinct neighbourhood becomes one object: no transitive closure, and yaw averaged as a plain number,
    across its jump (defect Q11)."""

    kind: Literal["neighbourhood"] = "neighbourhood"
    distance_m: float = 5.1

    def groups(self, points_m: FloatArray) -> list[Group]:
        """See `Merge.groups`; the merged ones first, in the order of a set of index tuples."""
        if not len(points_m):
            return []
        tree = cKDTree(points_m)
        neighbourhoods = [
            tuple(int(i) for i in tree.query_ball_point(point, self.distance_m, return_sorted=True))
            for point in points_m
        ]
        merged = {members for members in neighbourhoods if len(members) > 1}
        groups = [Group(neighbourhoods.index(members), members) for members in merged]
        return groups + [Group(i, members) for i, members in enumerate(neighbourhoods) if len(members) == 1]

    def mean(self, name: str, values: FloatArray) -> float:
        """See `Merge.mean`."""
        if name == "yaw_rad":
            values = published_yaw(values)
        return float(values.sum() / len(values))


@dataclass(frozen=True)
class UngatedEuclidean:
    """Hungarian assignment over all pairs; too distant pairs are torn up afterwards, and both partners are then
    alone, even where one had a good second choice (defect Q10)."""

    kind: Literal["ungated_euclidean"] = "ungated_euclidean"
    gate_m: float = 5.0

    def __call__(self, candidates: Sequence[Candidate], states: StatesAt) -> Assignment:
        """See `Association`; torn pairs are born after the detections that had no partner."""
        tracks = range(len(states.track_ids))
        if not candidates or not tracks:
            return Assignment([], list(range(len(candidates))), list(tracks))
        cost = euclidean_distances(candidates, states.means)
        rows, columns = linear_sum_assignment(cost)
        pairs = list(zip(rows.tolist(), columns.tolist(), strict=True))
        good = [(i, j) for i, j in pairs if not cost[i, j] > self.gate_m]
        torn = [i for i, j in pairs if cost[i, j] > self.gate_m]
        assigned = set(rows.tolist())
        seen = {j for _, j in good}
        alone = [i for i in range(len(candidates)) if i not in assigned]
        return Assignment(good, alone + torn, [j for j in tracks if j not in seen])


class PublishedLifecycle(CountingLifecycle):
    """Only two sensors age a track, each at its range; time counts only where a list came in; the cap may be passed;
    a birth is dated to the tick and a match to the sensor's stamp (defects Q9 and Q15).

    The range is that of a state which is one batch old; see `fgtrack.tracking.tracker.PublishedTracker`.
    """

    def born(self, track_id: int, sensor: str, stamp_ns: int, present_ns: int) -> None:
        """See `Lifecycle.born`."""
        super().born(track_id, sensor, present_ns, present_ns)

    def matched(self, track_id: int, sensor: str, stamp_ns: int) -> None:
        """See `Lifecycle.matched`."""
        life = self.lives[track_id]
        if life.counter < self._rules.counter_cap:
            life.counter += self._sensors[sensor].counter_add
        life.last_seen_ns = stamp_ns
        life.misses = 0

    def missed(self, track_ids: Sequence[int], sensor: str, ranges_m: FloatArray, present_ns: int) -> list[int]:
        """See `Lifecycle.missed`."""
        ages = self._sensors[sensor].ages
        ended = []
        for track_id, range_m in zip(track_ids, ranges_m.tolist(), strict=True):
            life = self.lives[track_id]
            near = range_m <= self._rules.short_range_m
            if (near and ages == "short_range") or (not near and ages == "long_range"):
                life.counter -= 1
                life.misses += 1
            if present_ns - life.last_seen_ns > self._forget_ns:
                life.counter = -1
            if life.counter <= 0:
                ended.append(track_id)
        return ended

    def expired(self, present_ns: int) -> list[int]:
        """See `Lifecycle.expired`; never, without a list."""
        return []

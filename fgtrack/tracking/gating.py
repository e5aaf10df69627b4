"""Which candidates and tracks are near enough to belong together: pairs, never a matrix of all with all."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from fgtrack.core.grouping import equal_ones
from fgtrack.core.linalg import congruence, mahalanobis_squared, symmetrise
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import Measurement, StatesAt
from fgtrack.estimation.ekf import innovations as innovations_of
from fgtrack.estimation.ekf import linearised
from fgtrack.tracking.pose_error import PoseError
from fgtrack.tracking.preprocess import Candidate

#: So many pairs are in memory at a time.
MOST_PAIRS = 1 << 17
#: A candidate is compared with so many tracks at most, the nearest ones: no real scene has as many inside one gate.
MOST_NEAR = 128
_FEW_DISTANCES = 1 << 14  # so many are calculated sooner than a tree is built
_NOWHERE = np.full(2, np.nan)  # in place of a position that a bearing does not give
_MARGIN = 1.0 + 1e-9  # a tree rounds in another way


class Pairs(NamedTuple):
    """Candidates and tracks that may belong together."""

    rows: IntArray
    """Candidates, shape (m,), as positions in their list."""
    columns: IntArray
    """Tracks, shape (m,)."""
    values: FloatArray
    """Distance or cost, shape (m,)."""

    def at(self, chosen: BoolArray | IntArray) -> "Pairs":
        """Those that are `chosen`."""
        return Pairs(self.rows[chosen], self.columns[chosen], self.values[chosen])

    @classmethod
    def joined(cls, parts: Sequence["Pairs"]) -> "Pairs":
        """All of `parts`, one after the other."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate(arrays) for arrays in zip(NO_PAIRS, *parts, strict=True)))


NO_PAIRS = Pairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))


class Alike(NamedTuple):
    """Candidates of one measurement model, seen from one pose."""

    rows: IntArray
    """Which of the candidates these are, shape (m,)."""
    one: Measurement
    """Any of them."""
    z: FloatArray
    """Shape (m, k)."""
    R: FloatArray
    """Shape (m, k, k)."""
    error: PoseError | None
    """Where it depends on the track what the ego's uncertainty does: of all, stacked."""

    def spread(self, places: IntArray, x: FloatArray) -> FloatArray:
        """Covariance of the measurements at `places` of objects at the states `x` (p, n), shape (p, k, k)."""
        if self.error is None:
            return self.R[places]
        error = PoseError(self.error.covariance, self.error.placement[places], self.error.R[places])
        return error.noise(self.one.model, self.one.pose, x)


def alike(candidates: Sequence[Candidate]) -> list[Alike]:
    """`candidates` in groups that can be compared with tracks at once."""
    kinds = []
    for candidate in candidates:
        own, error = candidate.measurement, candidate.pose_error
        kinds.append((id(own.model), id(own.pose), 0 if error is None else id(error.covariance)))
    return [_stacked([candidates[row] for row in rows], np.array(rows)) for rows in equal_ones(kinds)]


def _stacked(candidates: Sequence[Candidate], rows: IntArray) -> Alike:
    one = candidates[0].measurement
    z = np.array([candidate.measurement.z for candidate in candidates])
    R = np.array([candidate.measurement.R for candidate in candidates])
    errors = [candidate.pose_error for candidate in candidates if candidate.pose_error is not None]
    error = None
    if errors and one.model.relative:
        placement = np.array([each.placement for each in errors])
        error = PoseError(errors[0].covariance, placement, np.array([each.R for each in errors]))
    return Alike(rows, one, z, R, error)


def positions_m(candidates: Sequence[Candidate]) -> FloatArray:
    """Positions in the map, shape (m, 2); NaN of a bearing."""
    points = [_NOWHERE if candidate.position_m is None else candidate.position_m for candidate in candidates]
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def near(candidates: Sequence[Candidate], means: FloatArray, reach_m: float | FloatArray) -> Iterator[Pairs]:
    """Pairs at most `reach_m` apart, a number or one for each track, in portions; the values are distances.

    Of a candidate with more than `MOST_NEAR` tracks so near, those with the nearest of them. Distances are in the map;
    that of a bearing is from the track to the line of sight. Candidates ascend.
    """
    if not candidates or not len(means):
        return
    points = positions_m(candidates)
    if points.size // 2 * len(means) <= _FEW_DISTANCES:
        distances = euclidean_distances(candidates, means, points)
        rows, columns = (distances <= reach_m).nonzero()
        yield Pairs(rows, columns, distances[rows, columns])
        return
    placed = np.flatnonzero(~np.isnan(points[:, 0]))
    reach_m = np.broadcast_to(reach_m, len(means))
    farthest_m = float(reach_m.max()) * _MARGIN
    tracks = cKDTree(means[:, :2])
    counts = np.zeros(len(points), dtype=np.int64)
    counts[placed] = tracks.query_ball_point(points[placed], farthest_m, return_length=True)
    counts[np.isnan(points[:, 0])] = len(means)
    crowded = counts > MOST_NEAR
    for part in _portions(np.minimum(counts, MOST_NEAR)):
        seen = ~np.isnan(points[part, 0])
        here, crowd = part[seen & ~crowded[part]], part[seen & crowded[part]]
        found = [_near_ray(candidates[row], row, means) for row in part[np.isnan(points[part, 0])].tolist()]
        if len(here):
            close = cKDTree(points[here]).sparse_distance_matrix(tracks, farthest_m, output_type="ndarray")
            found.append(_apart(points, means, here[close["i"]], close["j"].astype(np.int64)))
        if len(crowd):
            nearest = tracks.query(points[crowd], MOST_NEAR)[1]
            found.append(_apart(points, means, np.repeat(crowd, MOST_NEAR), nearest.ravel()))
        pairs = Pairs.joined(found)
        pairs = pairs.at(pairs.values <= reach_m[pairs.columns])
        yield pairs.at(np.lexsort((pairs.columns, pairs.rows)))


def _apart(points: FloatArray, means: FloatArray, rows: IntArray, columns: IntArray) -> Pairs:
    offsets = points[rows] - means[columns, :2]
    return Pairs(rows, columns, np.sqrt(np.vecdot(offsets, offsets)))


def _portions(counts: IntArray) -> list[IntArray]:
    """Those with a count, in portions of at most `MOST_PAIRS` together, or of one."""
    some = np.flatnonzero(counts)
    ends = np.cumsum(counts[some])
    portions, start = [], 0
    while start < len(some):
        before = int(ends[start - 1]) if start else 0
        stop = max(int(np.searchsorted(ends, before + MOST_PAIRS, side="right")), start + 1)
        portions.append(some[start:stop])
        start = stop
    return portions


def euclidean_distances(
    candidates: Sequence[Candidate], means: FloatArray, points: FloatArray | None = None
) -> FloatArray:
    """Distances of all pairs, shape (candidates, tracks), as those of `near`; `points` are `positions_m`."""
    points = positions_m(candidates) if points is None else points
    offsets = points[:, None] - means[:, :2]
    distances = np.sqrt(np.vecdot(offsets, offsets))
    for row, candidate in enumerate(candidates):
        if candidate.position_m is None:
            distances[row] = _distances_to_ray(candidate, means)
    return np.asarray(distances)


def _near_ray(candidate: Candidate, row: int, means: FloatArray) -> Pairs:
    distances = _distances_to_ray(candidate, means)
    nearest = np.argpartition(distances, MOST_NEAR)[:MOST_NEAR] if len(means) > MOST_NEAR else np.arange(len(means))
    return Pairs(np.full(len(nearest), row), nearest, distances[nearest])


def _distances_to_ray(candidate: Candidate, means: FloatArray) -> FloatArray:
    pose = candidate.measurement.pose
    offsets = means[:, :2] - np.array([pose.x_m, pose.y_m])
    ranges = np.hypot(offsets[:, 0], offsets[:, 1])
    angle = np.arctan2(offsets[:, 1], offsets[:, 0]) - pose.yaw_rad - candidate.values["bearing_rad"]
    across = np.abs(ranges * np.sin(angle))
    return np.asarray(np.where(np.cos(angle) > 0.0, across, ranges))


class Innovations(NamedTuple):
    """What the candidates of pairs say against the states of their tracks.

    Of all components, what is assumed too: a gate judges what would be done to the track.
    """

    nis: FloatArray
    """Shape (m,)."""
    S: list[tuple[IntArray | slice, FloatArray]]
    """Covariances of the innovations, (p, k, k), and which of the pairs they are of, (p,)."""


def innovations(pairs: Pairs, groups: Sequence[Alike], num_candidates: int, states: StatesAt) -> Innovations:
    """Innovations of `pairs` of candidates, which are in `groups`, and tracks with these states."""
    nis = np.empty(len(pairs.rows))
    S_all = []
    for chosen, places, group in _by_group(pairs.rows, groups, num_candidates):
        columns = pairs.columns[chosen]
        x = states.means[columns]
        y, H = linearised(group.z[places], x, group.one.model, group.one.pose)
        known = (
            congruence(H, states.covariances)[columns] if H.ndim == 2 else congruence(H, states.covariances[columns])
        )
        S = known + group.spread(places, x)
        nis[chosen] = mahalanobis_squared(y, S)
        S_all.append((chosen, S))
    return Innovations(nis, S_all)


def nis_of(pairs: Pairs, groups: Sequence[Alike], candidates: Sequence[Candidate], states: StatesAt) -> FloatArray:
    """The NIS of `innovations`, shape (m,); without `groups` for few pairs."""
    if groups:
        return innovations(pairs, groups, len(candidates), states).nis
    found = np.empty(len(pairs.rows))
    for place, (row, column) in enumerate(zip(pairs.rows.tolist(), pairs.columns.tolist(), strict=True)):
        own, x, P = candidates[row].measurement, states.means[column], states.covariances[column]
        found[place] = innovations_of(x, P, own.z, candidates[row].noise_at(x), own.model, own.pose)[1]
    return found


def _by_group(
    rows: IntArray, groups: Sequence[Alike], num_candidates: int
) -> Iterator[tuple[IntArray | slice, IntArray, Alike]]:
    """Which of `rows` are candidates of each group, at which of its places, and the group."""
    if len(groups) == 1:
        yield slice(None), rows, groups[0]
        return
    place, number = np.empty((2, num_candidates), dtype=np.int64)
    for k, group in enumerate(groups):
        place[group.rows], number[group.rows] = np.arange(len(group.rows)), k
    for k, group in enumerate(groups):
        chosen = np.flatnonzero(number[rows] == k)
        if chosen.size:
            yield chosen, place[rows[chosen]], group


def reaches_m(groups: Sequence[Alike], states: StatesAt, quantiles: Sequence[float], limit_m: float) -> FloatArray:
    """How far from each track a candidate with a NIS up to its group's quantile can be, shape (tracks,).

    The NIS is at least that of the position alone, which is at least the squared distance over the largest variance of
    S = P + R in any direction. At most `limit_m`, and just that where it is not the position that is measured.
    """
    squared_m2 = np.zeros(len(states.means))
    for group, quantile in zip(groups, quantiles, strict=True):
        model, pose = group.one.model, group.one.pose
        plain = model.components[:2] == ("x_m", "y_m")
        if not plain or not np.array_equal(model.predict(states.means, pose)[:, :2], states.means[:, :2]):
            return np.full(len(states.means), limit_m)
        own_m2 = _largest_variances(group.R).max()
        squared_m2 = np.maximum(squared_m2, quantile * (_largest_variances(states.covariances) + own_m2))
    return np.minimum(np.sqrt(squared_m2) * _MARGIN, limit_m)


def _largest_variances(covariances: FloatArray) -> FloatArray:
    """Of the position, in any direction: the larger eigenvalues, shape (m,), of the leading blocks of (m, n, n)."""
    blocks = symmetrise(covariances[:, :2, :2])
    middle, half = 0.5 * (blocks[:, 0, 0] + blocks[:, 1, 1]), 0.5 * (blocks[:, 0, 0] - blocks[:, 1, 1])
    return np.asarray(middle + np.hypot(half, blocks[:, 0, 1]))

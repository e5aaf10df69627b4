"""Pairs of candidates and tracks that are near enough to belong together, and their innovations."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from fgtrack.core.grouping import equal_ones
from fgtrack.core.linalg import kernels, symmetrise
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import Measurement, StatesAt
from fgtrack.estimation.filters.ekf import linearised
from fgtrack.tracking.detections import PoseError
from fgtrack.tracking.preprocess import Candidate

MOST_NEAR = 128
"""Tracks, the nearest ones, that a candidate is compared with: no real scene has as many inside one gate."""
_DENSE = 1 << 14  # a matrix of so many distances is faster than a tree
_MARGIN = 1.0 + 1e-9  # a tree rounds differently


class Pairs(NamedTuple):
    """Candidates and tracks that may belong together."""

    rows: IntArray
    """Indices of candidates, ascending, shape (m,)."""
    columns: IntArray
    """Indices of tracks, shape (m,)."""
    values: FloatArray
    """Distance or cost, shape (m,)."""

    def at(self, chosen: BoolArray | IntArray) -> "Pairs":
        """Return the `chosen` ones."""
        return Pairs(self.rows[chosen], self.columns[chosen], self.values[chosen])


class Group(NamedTuple):
    """Candidates of one measurement model, seen from one pose."""

    rows: IntArray
    """Indices of the candidates, shape (m,)."""
    example: Measurement
    """Any of them."""
    z: FloatArray
    """Shape (m, k)."""
    R: FloatArray
    """Shape (m, k, k)."""
    error: PoseError | None
    """Error of the ego where its effect depends on the track: of all, stacked."""

    def noise(self, members: IntArray, x: FloatArray) -> FloatArray:
        """Covariance of the measurements of `members` of objects at the states `x` (p, n), shape (p, k, k)."""
        if self.error is None:
            return self.R[members]
        error = PoseError(self.error.covariance, self.error.placement[members], self.error.R[members])
        return error.noise(self.example.model, self.example.pose, x)


def grouped(candidates: Sequence[Candidate]) -> list[Group]:
    """Return `candidates` in groups that can be compared with tracks at once."""
    kinds = []
    for candidate in candidates:
        own, error = candidate.measurement, candidate.pose_error
        kinds.append((id(own.model), id(own.pose), 0 if error is None else id(error.covariance)))
    groups = []
    for rows in equal_ones(kinds):
        z, R, errors = [], [], []
        for row in rows:
            z.append(candidates[row].measurement.z)
            R.append(candidates[row].measurement.R)
            errors.append(candidates[row].pose_error)
        example, first = candidates[rows[0]].measurement, errors[0]
        error = None
        if first is not None and example.model.relative:
            parts = zip(*((each.placement, each.R) for each in errors if each is not None), strict=True)
            error = PoseError(first.covariance, *map(np.array, parts))
        groups.append(Group(np.array(rows), example, np.array(z), np.array(R), error))
    return groups


def near(candidates: Sequence[Candidate], means: FloatArray, reach_m: float | FloatArray) -> Pairs:
    """Return the pairs at most `reach_m` apart, a number or one for each track; the values are distances.

    Of a candidate with more than `MOST_NEAR` tracks so near, the nearest of them. Distances are in the map; that of a
    bearing is from the track to the line of sight.
    """
    points = _positions_m(candidates)
    if len(points) * len(means) <= _DENSE:
        distances = _distances(points, candidates, means)
        rows, columns = (distances <= reach_m).nonzero()
        return Pairs(rows, columns, distances[rows, columns])
    placed = np.flatnonzero(~np.isnan(points[:, 0]))
    reach_m = np.broadcast_to(reach_m, len(means))
    nearest = range(1, min(len(means), MOST_NEAR) + 1)
    farthest_m = float(reach_m.max()) * _MARGIN
    apart, tracks = cKDTree(means[:, :2]).query(points[placed], nearest, distance_upper_bound=farthest_m)
    inside, order = np.isfinite(apart).nonzero()
    rows, columns = placed[inside], np.asarray(tracks)[inside, order]
    offsets = points[rows] - means[columns, :2]
    found = [(rows, columns, np.sqrt(np.vecdot(offsets, offsets)))]
    for row in np.flatnonzero(np.isnan(points[:, 0])).tolist():
        distances = _distances_to_ray(candidates[row], means)
        columns = np.argsort(distances, kind="stable")[:MOST_NEAR]
        found.append((np.full(len(columns), row), columns, distances[columns]))
    pairs = Pairs(*(np.concatenate(arrays) for arrays in zip(*found, strict=True)))
    pairs = pairs.at(pairs.values <= reach_m[pairs.columns])
    return pairs.at(np.lexsort((pairs.columns, pairs.rows)))


def euclidean_distances(candidates: Sequence[Candidate], means: FloatArray) -> FloatArray:
    """Distances of all pairs as those of `near`, shape (candidates, tracks)."""
    return _distances(_positions_m(candidates), candidates, means)


def _distances(points: FloatArray, candidates: Sequence[Candidate], means: FloatArray) -> FloatArray:
    offsets = points[:, None] - means[:, :2]
    distances = np.sqrt(np.vecdot(offsets, offsets))
    for row, candidate in enumerate(candidates):
        if candidate.position_m is None:
            distances[row] = _distances_to_ray(candidate, means)
    return np.asarray(distances)


def _positions_m(candidates: Sequence[Candidate]) -> FloatArray:
    """Positions in the map, shape (m, 2); NaN of a bearing."""
    points = np.full((len(candidates), 2), np.nan)
    for point, candidate in zip(points, candidates, strict=True):
        if candidate.position_m is not None:
            point[:] = candidate.position_m
    return points


def _distances_to_ray(candidate: Candidate, means: FloatArray) -> FloatArray:
    pose = candidate.measurement.pose
    offsets = means[:, :2] - np.array([pose.x_m, pose.y_m])
    ranges = np.hypot(offsets[:, 0], offsets[:, 1])
    angle = np.arctan2(offsets[:, 1], offsets[:, 0]) - pose.yaw_rad - candidate.values["bearing_rad"]
    across = np.abs(ranges * np.sin(angle))
    return np.asarray(np.where(np.cos(angle) > 0.0, across, ranges))


def innovations(
    pairs: Pairs, groups: Sequence[Group], num_candidates: int, states: StatesAt
) -> Iterator[tuple[IntArray, FloatArray, FloatArray, int]]:
    """Yield the innovations of `pairs` of candidates, which are in `groups`, and tracks with these states.

    Indices of pairs that measure the same, assumed components included, with NIS and log det S, shapes (p,), and the
    number k of components. NaN where S has no root.
    """
    P = np.array(states.covariances, dtype=np.float64, order="C")
    member, number = np.empty((2, num_candidates), dtype=np.int64)
    for k, group in enumerate(groups):
        member[group.rows], number[group.rows] = np.arange(len(group.rows)), k
    for k, group in enumerate(groups):
        chosen = np.flatnonzero(number[pairs.rows] == k)
        if not len(chosen):
            continue
        members, columns = member[pairs.rows[chosen]], pairs.columns[chosen]
        x = states.means[columns]
        y, H = linearised(group.z[members], x, group.example.model, group.example.pose)
        R = group.noise(members, x)
        H = np.array(H, ndmin=3, order="C")
        yield chosen, *kernels("fgtrack.tracking.kernels").innovations(y, H, P, columns, R), y.shape[-1]


def reaches_m(groups: Sequence[Group], states: StatesAt, quantiles: Sequence[float], limit_m: float) -> FloatArray:
    """Largest distance from each track of a candidate with a NIS up to its group's quantile, shape (tracks,).

    The NIS is at least that of the position alone, which is at least the squared distance over the largest variance of
    S = P + R in any direction. At most `limit_m`, and just that where it is not the position that is measured.
    """
    squared_m2 = np.zeros(len(states.means))
    for group, quantile in zip(groups, quantiles, strict=True):
        model, pose = group.example.model, group.example.pose
        plain = model.components[:2] == ("x_m", "y_m")
        if not plain or not np.array_equal(model.predict(states.means, pose)[:, :2], states.means[:, :2]):
            return np.full(len(states.means), limit_m)
        own_m2 = _largest_variances(group.R).max()
        squared_m2 = np.maximum(squared_m2, quantile * (_largest_variances(states.covariances) + own_m2))
    return np.minimum(np.sqrt(squared_m2) * _MARGIN, limit_m)


def _largest_variances(covariances: FloatArray) -> FloatArray:
    """Larger eigenvalues, shape (m,), of the position blocks of (m, n, n)."""
    blocks = symmetrise(covariances[:, :2, :2])
    middle, half = 0.5 * (blocks[:, 0, 0] + blocks[:, 1, 1]), 0.5 * (blocks[:, 0, 0] - blocks[:, 1, 1])
    return np.asarray(middle + np.hypot(half, blocks[:, 0, 1]))

"""Tracklets: short associations between the successive lists of one sensor, without a tracker or its settings.

Positions are turned by the ego's yaw. So the unknown mount of a sensor turns and shifts
a tracklet, but the tracklet stays smooth. Three detections in successive lists, on a
straight line at constant speed, belong to one object. Chains of these triples are
tracklets.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from fgtrack.core.geometry import rotation, rotations
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import (
    Detection,
    DetectionList,
    EgoState,
    FloatArray,
    IntArray,
    Message,
)
from fgtrack.meaning.scatter import Trend, growing, line_errors, sight_errors

__all__ = [
    "EgoMotion",
    "Noise",
    "Points",
    "points_of",
    "sights_m",
    "speeds_mps",
    "tracklets",
    "triples",
]

#: Time from the first message that is evaluated, and most detections of a sensor.
LONGEST_S = 90.0
_MOST = 20_000
#: Components beside the position.
_VALUES = ("yaw_rad", "speed_mps", "range_rate_mps")
#: Highest speed of an object relative to the ego.
_FASTEST_MPS = 70.0
#: Most lists in which the object of a tracklet may be missing, plus 1.
_LISTS = 3
#: Fewest detections in a tracklet.
_SHORTEST = 5
#: Largest misfit of a triple: 99.9 % of chi-square with two degrees of freedom.
_LARGEST_MISFIT = 13.8
#: Largest acceleration relative to the ego, as a standard deviation.
_ACCEL_MPS2 = 4.0
#: Standard deviations before they are estimated: [m], and a share of the range; along and across the line of sight.
_USUAL = (Trend(0.5, 0.03), Trend(0.4, 0.015))
_SMALLEST_M = 0.02
_FEWEST_TRIPLES = 40
#: Half of the number of detections over which the speed of a tracklet is computed.
_SPEED_LAG = 3


@dataclass(frozen=True)
class Noise:
    """Variances of a sensor's positions along and across the line of sight: a^2 + (b range)^2."""

    along: Trend = _USUAL[0]
    across: Trend = _USUAL[1]

    def variances(self, ranges_m: FloatArray) -> FloatArray:
        """Return the variances along and across, shape (..., 2), at `ranges_m` (...)."""
        return np.stack(
            [np.square(each.at(ranges_m)) for each in (self.along, self.across)],
            axis=-1,
        )

    def covariances(self, sights_m: FloatArray) -> FloatArray:
        """Return the covariances, shape (..., 2, 2), of positions that lie at `sights_m` (..., 2) from the sensor."""
        ranges_m = np.hypot(sights_m[..., 0], sights_m[..., 1])
        along, across = np.moveaxis(self.variances(ranges_m), -1, 0)
        u = sights_m / np.maximum(ranges_m, 1e-6)[..., None]
        outer = u[..., :, None] * u[..., None, :]
        result: FloatArray = across[..., None, None] * np.eye(2)
        return np.asarray(result + (along - across)[..., None, None] * outer)


class EgoMotion:
    """Poses of the ego over time, interpolated."""

    def __init__(self, rows: FloatArray) -> None:
        """`rows` contains seconds, x, y and yaw of the ego's states, shape (n, 4), in any order."""
        rows = rows[np.isfinite(rows).all(axis=1)]
        _, first = np.unique(rows[:, 0], return_index=True)
        self.rows = rows[first]
        self.rows[:, 3] = np.unwrap(self.rows[:, 3])

    def __bool__(self) -> bool:
        return len(self.rows) > 1

    def poses(self, times_s: FloatArray) -> FloatArray:
        """Return x, y and unwrapped yaw, shape (n, 3); NaN outside the ego's states."""
        if not self:
            return np.full((len(times_s), 3), np.nan)
        known = self.rows[:, 0]
        poses = np.column_stack(
            [np.interp(times_s, known, column) for column in self.rows[:, 1:].T]
        )
        poses[(times_s < known[0] - 0.1) | (times_s > known[-1] + 0.1)] = np.nan
        return poses


@dataclass(frozen=True)
class Points:
    """Positions that one sensor detected, in the order of their lists."""

    sensor: str
    stamps_s: FloatArray
    """Stamps, shape (n,)."""
    lists: IntArray
    """Index of the list, in the order of stamps, shape (n,)."""
    points_m: FloatArray
    """Positions in the frame of the detections, shape (n, 2)."""
    in_map: bool
    """True if the positions are in the map frame."""
    poses: FloatArray
    """Poses of the ego at the stamps, shape (n, 3); NaN where unknown."""
    is_polar: bool
    """True if the sensor measures ranges and bearings."""
    values: Mapping[str, FloatArray] = field(default_factory=dict)
    """Other components by name, each of shape (n,); NaN where missing."""

    @cached_property
    def turned_m(self) -> FloatArray:
        """Positions, turned by the ego's yaw: smooth for every mount; positions in the map are unchanged."""
        if self.in_map:
            return self.points_m
        turns = rotations(self.poses[:, 2])
        return np.asarray(np.einsum("nij,nj->ni", turns, self.points_m))

    @cached_property
    def linked(self) -> tuple[IntArray, Noise]:
        """Tracklet of each detection, shape (n,), or -1, and the noise of the sensor."""
        return _linked(self)

    def read_in_map(self, in_map: bool) -> "Points":
        """Return the same numbers, read as positions in the map, or in the frame of the ego or the sensor."""
        if in_map == self.in_map:
            return self
        return replace(self, in_map=in_map)


def points_of(
    messages: Iterable[Message], origin_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[dict[str, Points], EgoMotion]:
    """Return the positions of each sensor by name, and the ego's motion, from the first minutes of `messages`.

    `origin_m` is the origin of detections in the ego frame. Sensors with bearings alone,
    and sensors with detections in several frames, are left out.
    """
    ego: list[tuple[float, float, float, float]] = []
    rows = defaultdict[str, list[tuple[float, ...]]](list)
    frames = defaultdict[str, set[str]](set)
    polar = set[str]()
    counts = defaultdict[str, int](int)
    first_ns: int | None = None
    for message in messages:
        first_ns = message.receipt_ns if first_ns is None else first_ns
        if message.receipt_ns - first_ns > LONGEST_S * NS_PER_S:
            break
        stamp_s = (message.stamp_ns - first_ns) / NS_PER_S
        if isinstance(message, EgoState):
            ego.append((stamp_s, message.x_m, message.y_m, message.yaw_rad))
        elif isinstance(message, DetectionList) and message.objects:
            name = message.sensor
            frames[name].add(message.frame)
            number = counts[name]
            counts[name] += 1
            for item in message.objects:
                at_m = _position(item)
                if at_m is None or len(rows[name]) >= _MOST:
                    continue
                polar |= {name} if item.x_m is None else set()
                own_ns = item.stamp_ns or message.stamp_ns
                values = (getattr(item, each) for each in _VALUES)
                known = (math.nan if each is None else each for each in values)
                own_s = (own_ns - first_ns) / NS_PER_S
                rows[name].append((own_s, number, *at_m, *known))
    motion = EgoMotion(np.array(ego).reshape(-1, 4))
    if motion and any(origin_m):
        motion.rows[:, 1:3] += rotations(motion.rows[:, 3]) @ np.array(origin_m)
    result = {}
    for name, each in sorted(rows.items()):
        if len(frames[name]) != 1:
            continue
        table = np.array(each)
        in_map = frames[name] == {"map"}
        result[name] = _points(name, table, in_map, name in polar, motion)
    return result, motion


def _points(
    name: str, table: FloatArray, in_map: bool, is_polar: bool, motion: EgoMotion
) -> Points:
    """Return the points in `table`, with the lists in the order of their stamps.

    The columns are the stamp, the list, x, y and `_VALUES`.
    """
    lists = table[:, 1].astype(np.int64)
    means_s = np.bincount(lists, table[:, 0]) / np.maximum(np.bincount(lists), 1)
    ranks = np.argsort(np.argsort(means_s, kind="stable"), kind="stable")
    table = table[np.argsort(ranks[lists], kind="stable")]
    numbers = np.unique(ranks[lists], return_inverse=True)[1]
    poses = motion.poses(table[:, 0])
    known = np.ones(len(table), dtype=bool) if in_map else np.isfinite(poses[:, 0])
    order = np.sort(numbers)[known]
    table = table[known]
    return Points(
        name,
        table[:, 0],
        order.astype(np.int64),
        table[:, 2:4],
        in_map,
        poses[known],
        is_polar,
        dict(zip(_VALUES, table[:, 4:].T, strict=True)),
    )


def _position(item: Detection) -> tuple[float, float] | None:
    """Return the position of a detection in its frame; None without a finite position."""
    if item.x_m is not None and item.y_m is not None:
        at_m = item.x_m, item.y_m
    elif item.range_m is not None and item.bearing_rad is not None:
        at_m = (
            item.range_m * math.cos(item.bearing_rad),
            item.range_m * math.sin(item.bearing_rad),
        )
    else:
        return None
    is_usable = max(map(abs, at_m)) < 1e7 and not math.isnan(sum(at_m))
    return at_m if is_usable else None


def tracklets(points: Points) -> tuple[IntArray, Noise]:
    """Return the tracklet of each detection, shape (n,), and the noise of the sensor; -1 for no tracklet.

    The noise is estimated from triples of a first association, and used in a second
    one. The result is computed once for each object `points`.
    """
    return points.linked


def _linked(points: Points) -> tuple[IntArray, Noise]:
    """Return the result of `tracklets`."""
    noise = Noise()
    first = _chains(points, noise)
    noise = _noise(points, first, noise)
    chains = _chains(points, noise)
    return chains, _noise(points, chains, noise)


def sights_m(points: Points) -> FloatArray:
    """Return the vectors from the ego or the sensor to the detections, in the axes of the tracklets, shape (n, 2)."""
    if not points.in_map:
        return points.turned_m
    if np.isfinite(points.poses).all():
        return points.points_m - points.poses[:, :2]
    return np.ones_like(points.points_m)


def _chains(points: Points, noise: Noise) -> IntArray:
    """Return the number of the tracklet of each detection, shape (n,); -1 for a detection without a tracklet."""
    at_m = points.turned_m
    count = len(at_m)
    R = noise.covariances(sights_m(points))
    times_s = points.stamps_s
    begins, ends = _edges(points, at_m)
    # Triples: an edge that ends in a detection, and an edge that begins in it.
    by_begin = np.searchsorted(begins, np.arange(count + 1))
    widths = by_begin[ends + 1] - by_begin[ends]
    first = np.repeat(np.arange(len(begins)), widths)
    offsets = np.arange(len(first)) - np.repeat(np.cumsum(widths) - widths, widths)
    second = by_begin[ends[first]] + offsets
    i, j, k = begins[first], ends[first], ends[second]
    before_s = times_s[j] - times_s[i]
    after_s = times_s[k] - times_s[j]
    share = (after_s / (before_s + after_s))[:, None]
    misfit_m = at_m[j] - share * at_m[i] - (1.0 - share) * at_m[k]
    squares = np.square(share)[:, :, None], np.square(1.0 - share)[:, :, None]
    C = R[j] + squares[0] * R[i] + squares[1] * R[k]
    C += np.square(0.5 * _ACCEL_MPS2 * before_s * after_s)[:, None, None] * np.eye(2)
    misfit = np.einsum(
        "ni,ni->n", misfit_m, np.linalg.solve(C, misfit_m[:, :, None])[:, :, 0]
    )
    skipped = points.lists[k] - points.lists[i] - 2
    keep = misfit < _LARGEST_MISFIT
    cost = misfit + 2.0 * _LARGEST_MISFIT * skipped + np.log(np.linalg.det(C))
    rows = np.flatnonzero(keep)[np.argsort(cost[keep], kind="stable")]
    following = np.full(count, -1)
    previous = np.full(count, -1)
    for a, b, c in zip(
        i[rows].tolist(), j[rows].tolist(), k[rows].tolist(), strict=True
    ):
        is_free = following[a] in (-1, b) and previous[b] in (-1, a)
        if is_free and following[b] in (-1, c) and previous[c] in (-1, b):
            following[a] = b
            previous[b] = a
            following[b] = c
            previous[c] = b
    return _numbered(following, previous)


def _edges(points: Points, at_m: FloatArray) -> tuple[IntArray, IntArray]:
    """Return pairs of detections in nearby lists that one object may cause: begins, ascending, and ends."""
    bounds = np.searchsorted(points.lists, np.arange(points.lists[-1] + 2))
    begins = list[IntArray]()
    ends = list[IntArray]()
    for number in range(len(bounds) - 1):
        own = np.arange(bounds[number], bounds[number + 1])
        last = min(number + 1 + _LISTS, len(bounds) - 1)
        later = np.arange(bounds[number + 1], bounds[last])
        time_s = points.stamps_s[later] - points.stamps_s[own, None]
        gap_m = np.hypot(*np.moveaxis(at_m[later] - at_m[own, None], -1, 0))
        near = (gap_m < _FASTEST_MPS * time_s) & (time_s > 0.0)
        rows, columns = np.nonzero(near)
        begins.append(own[rows])
        ends.append(later[columns])
    return np.concatenate(begins), np.concatenate(ends)


def _numbered(following: IntArray, previous: IntArray) -> IntArray:
    """Return the number of the chain of each detection; -1 for chains of fewer than `_SHORTEST` detections."""
    result = np.full(len(following), -1)
    number = 0
    for start in np.flatnonzero((previous < 0) & (following >= 0)).tolist():
        chain = [start]
        while (after := int(following[chain[-1]])) >= 0:
            chain.append(after)
        if len(chain) >= _SHORTEST:
            result[chain] = number
            number += 1
    return result


def _noise(points: Points, chains: IntArray, usual: Noise) -> Noise:
    """Estimate the noise from the second differences of the tracklets; `usual` if there are few."""
    rows = triples(points, chains)
    if len(rows) < _FEWEST_TRIPLES:
        return usual
    errors_m = line_errors(points.stamps_s[rows], points.turned_m[rows])
    along_m, across_m, ranges_m = sight_errors(errors_m, sights_m(points)[rows[:, 1]])
    return Noise(
        growing(along_m, ranges_m, _SMALLEST_M),
        growing(across_m, ranges_m, _SMALLEST_M),
    )


def triples(points: Points, chains: IntArray, lag: int = 1) -> IntArray:
    """Return the rows of three detections of a tracklet, each `lag` detections after the other, shape (n, 3)."""
    order = np.lexsort((points.stamps_s, chains))
    order = order[chains[order] >= 0]
    rows = np.column_stack(
        [order[: -2 * lag], order[lag:-lag], order[2 * lag :]]
        if len(order) > 2 * lag
        else [order[:0]] * 3
    )
    return np.asarray(rows[chains[rows[:, 0]] == chains[rows[:, 2]]])


def speeds_mps(points: Points, yaw_rad: float = 0.0) -> FloatArray:
    """Return the median speed in the map of each tracklet that is long enough, shape (n,).

    `yaw_rad` is the yaw of the sensor on the ego. The lever arm has no influence on
    straight roads, and a small influence in turns.
    """
    if len(points.points_m) < _SHORTEST:
        return np.zeros(0)
    chains, _ = tracklets(points)
    rows = triples(points, chains, _SPEED_LAG)[:, [0, 2]]
    elapsed_s = np.diff(points.stamps_s[rows], axis=1)
    moved_m = np.diff(points.turned_m[rows], axis=1)[:, 0]
    if not points.in_map:
        moved_m = moved_m @ rotation(yaw_rad).T
        moved_m += np.diff(points.poses[rows, :2], axis=1)[:, 0]
    speeds = np.hypot(*moved_m.T) / np.maximum(elapsed_s[:, 0], 1e-9)
    numbers = chains[rows[:, 0]]
    return np.array([np.median(speeds[numbers == each]) for each in np.unique(numbers)])

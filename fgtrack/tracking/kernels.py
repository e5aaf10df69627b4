"""Compiled loops over pairs of detections and tracks, and over the states that a tick publishes."""

import math

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.compiled import (
    add_congruence,
    check,
    check_rows,
    cholesky,
    inlined,
    njit,
    wrapped,
)
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.measurement import COMPONENTS

SOUND, NOT_FINITE, NOT_DEFINITE = range(3)
_ROUNDING = 1e-9
"""Tolerance of an eigenvalue of a correlation matrix below 0: rounding, where an entry is known for certain."""

X, Y, YAW, RANGE, BEARING, CURVATURE = (
    COMPONENTS.index(name)
    for name in ("x_m", "y_m", "yaw_rad", "range_m", "bearing_rad", "curvature_radpm")
)


@inlined
def _checked_starts(starts: IntArray, num_lists: int, num_rows: int) -> int:
    """Return the number of rows. Raise `IndexError` unless the `starts` of lists ascend from 0 to at most `num_rows`.

    A negative `num_rows` is no limit.
    """
    check(len(starts) == num_lists + 1 and starts[0] == 0)
    for k in range(num_lists):
        check(starts[k] <= starts[k + 1])
    check(num_rows < 0 or starts[num_lists] <= num_rows)
    return int(starts[num_lists])


@njit("(float64[::1], int64[:, ::1], int64[::1], float64[:, ::1], b1[::1])")
def to_map(
    numbers: FloatArray,
    columns: IntArray,
    starts: IntArray,
    poses: FloatArray,
    moves: BoolArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the components (m, 8) and the positions (m, 2) of detections in the map, and an array of False (m,).

    Missing values are NaN. List k has the rows from `starts[k]` up to the next start. `numbers` contains the components
    `columns[k]` of each row, one row after the other; the columns end with -1. If `moves[k]`, x, y and yaw are relative
    to the pose k (x, y, yaw ...). Range and bearing are always relative to it.
    """
    m, at, needed = _checked_starts(starts, len(poses), -1), 0, 0
    check(
        len(columns) >= len(poses) and len(moves) >= len(poses) and poses.shape[1] >= 3
    )
    for k in range(len(poses)):
        check_rows(columns[k], -1, len(COMPONENTS))
        for column in columns[k]:
            needed += starts[k + 1] - starts[k] if column >= 0 else 0
    check(len(numbers) >= needed)
    values, points = np.full((m, len(COMPONENTS)), np.nan), np.empty((m, 2))
    for k in range(len(poses)):
        x_m, y_m, yaw_rad = poses[k, 0], poses[k, 1], poses[k, 2]
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        for i in range(starts[k], starts[k + 1]):
            row = values[i]
            for column in columns[k]:
                if column >= 0:
                    row[column] = numbers[at]
                    at += 1
            if moves[k]:
                row[X], row[Y] = (
                    x_m + c * row[X] - s * row[Y],
                    y_m + s * row[X] + c * row[Y],
                )
                row[YAW] = wrapped(row[YAW] + yaw_rad)
            points[i, 0], points[i, 1] = row[X], row[Y]
            if math.isnan(row[X]):
                right, up = (
                    row[RANGE] * math.cos(row[BEARING]),
                    row[RANGE] * math.sin(row[BEARING]),
                )
                points[i, 0], points[i, 1] = (
                    x_m + c * right - s * up,
                    y_m + s * right + c * up,
                )
    return values, points, np.zeros(m, np.bool_)


@njit(
    "(float64[:, ::1], float64[:, ::1], b1[::1], int64[::1], b1[:, ::1], float64[:], float64[:], b1[:])"
)
def on_road(
    values: FloatArray,
    points: FloatArray,
    map_yaw: BoolArray,
    starts: IntArray,
    takes: BoolArray,
    heading: FloatArray,
    curvature: FloatArray,
    outside: BoolArray,
) -> BoolArray:
    """Write heading and curvature of the map into the `values` of detections with a position.

    `takes` (lists, 2) selects heading and curvature for each list. A measured yaw is kept. Returns `outside` (m,), but
    False for detections without a position.
    """
    m = _checked_starts(starts, len(takes), len(values))
    check(
        len(points) >= m
        and len(map_yaw) >= m
        and len(heading) >= m
        and len(curvature) >= m
        and len(outside) >= m
    )
    beyond = np.zeros(len(values), np.bool_)
    for k in range(len(takes)):
        for i in range(starts[k], starts[k + 1]):
            if math.isnan(points[i, 0]):
                continue
            beyond[i] = outside[i]
            if takes[k, 0] and math.isnan(values[i, YAW]):
                values[i, YAW], map_yaw[i] = heading[i], True
            if takes[k, 1]:
                values[i, CURVATURE] = curvature[i]
    return beyond


@njit("(float64[:, ::1], float64[:, ::1], b1[::1], int64[::1], float64[:, ::1])")
def described(
    values: FloatArray,
    points: FloatArray,
    map_yaw: BoolArray,
    starts: IntArray,
    poses: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Return the measured components of detections as the bits of a number (m,), and lines (m, 3).

    The highest bit is `map_yaw`. A line contains the position and NaN. For a bearing alone it contains the position of
    the sensor, and the direction; the direction is infinity without a bearing.
    """
    m, num = values.shape
    check(
        _checked_starts(starts, len(poses), m) <= min(len(points), len(map_yaw))
        and poses.shape[1] >= 3
    )
    codes, lines = np.zeros(m, np.int64), np.empty((m, 3))
    for k in range(len(poses)):
        for i in range(starts[k], starts[k + 1]):
            for a in range(num):
                codes[i] |= (0 if math.isnan(values[i, a]) else 1) << a
            if map_yaw[i] and not math.isnan(values[i, YAW]):
                codes[i] |= 1 << num
            lines[i, 0], lines[i, 1], lines[i, 2] = points[i, 0], points[i, 1], np.nan
            if math.isnan(points[i, 0]):
                lines[i, 0], lines[i, 1], lines[i, 2] = (
                    poses[k, 0],
                    poses[k, 1],
                    poses[k, 2] + values[i, BEARING],
                )
                if math.isnan(values[i, BEARING]):
                    lines[i, 2] = math.inf
    return codes, lines


@njit(
    "(float64[:, ::1], int64[::1], Array(float64, 1, 'C', readonly=True), float64, float64, float64, "
    "Array(float64, 2, 'C', readonly=True), float64[:, ::1], float64[:, :, ::1])"
)
def pose_error(
    points: FloatArray,
    components: IntArray,
    pose: FloatArray,
    yaw_rad: float,
    x_m: float,
    y_m: float,
    P: FloatArray,
    covariance: FloatArray,
    G: FloatArray,
) -> None:
    """Write the covariance J P J' (5, 5) of a sensor `pose` (x, y, yaw, vx, vy) and the derivatives G (m, k, 5) by it.

    The sensor is fixed to a body, at `x_m`, `y_m` in the body (`core.geometry.body_point`). P is the covariance of x,
    y, yaw, speed and yaw rate of the body. G are the derivatives of detections at `points` (m, 2), which the pose has
    placed in the map: of the `components` (k,), x, y and yaw depend on the pose.
    """
    check(
        len(pose) >= 5
        and len(P) == 5
        and P.shape[1] == 5
        and covariance.shape[0] == 5
        and covariance.shape[1] == 5
    )
    check(len(G) >= len(points) and G.shape[1] >= len(components) and G.shape[2] >= 5)
    J, JP, c, s = (
        np.zeros((5, 5)),
        np.empty((5, 5)),
        math.cos(yaw_rad),
        math.sin(yaw_rad),
    )
    right, up = pose[0] - x_m, pose[1] - y_m
    J[0, 0] = J[1, 1] = J[2, 2] = 1.0
    J[0, 2], J[1, 2], J[3, 2], J[4, 2] = -up, right, -pose[4], pose[3]
    J[3, 3], J[3, 4], J[4, 3], J[4, 4] = c, -up, s, right
    add_congruence(J, P, JP, covariance)
    for i in range(len(points)):
        for a in range(len(components)):
            if components[a] == X:
                G[i, a, 0], G[i, a, 2] = 1.0, pose[1] - points[i, 1]
            elif components[a] == Y:
                G[i, a, 1], G[i, a, 2] = 1.0, points[i, 0] - pose[0]
            elif components[a] == YAW:
                G[i, a, 2] = 1.0


@njit("(float64[:, :, ::1], float64[:, ::1], float64[:, :, ::1])")
def add_pose_error(G: FloatArray, P: FloatArray, R: FloatArray) -> None:
    """Add G P G' to R, shapes (m, k, 5), (5, 5) and (m, k, k)."""
    check(len(G) >= len(R) and len(P) == G.shape[2] and P.shape[1] == G.shape[2])
    check(R.shape[1] == G.shape[1] and R.shape[2] == G.shape[1])
    GP = np.empty(G.shape[1:])
    for i in range(len(R)):
        add_congruence(G[i], P, GP, R[i])


@njit("(float64[:, ::1], float64[:, ::1], int64[::1], float64[::1], int64)")
def near(
    points: FloatArray,
    means: FloatArray,
    by_x: IntArray,
    reach_m: FloatArray,
    most: int,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return rows, columns and distances of the pairs of points and tracks that are at most `reach_m` (n,) apart.

    `points` (m, 3) are positions and NaN, or the origin of a line of sight and its direction. The direction is infinity
    if it is unknown: all tracks then have the distance 0. Each point keeps its `most` nearest tracks. `by_x` are the
    indices of the tracks in the order of x.
    """
    m, n = len(points), len(means)
    check(len(by_x) >= n and len(reach_m) >= n and most > 0 and points.shape[1] >= 3)
    check_rows(by_x, 0, n)
    largest, count, longest = m * min(n, most), 0, 0.0
    rows, columns, distances = (
        np.empty(largest, np.int64),
        np.empty(largest, np.int64),
        np.empty(largest),
    )
    for j in range(n):
        longest = max(longest, reach_m[j] * (1.0 + 1e-9))
    for i in range(m):
        first, x, y, angle = count, points[i, 0], points[i, 1], points[i, 2]
        low, high = 0, n if math.isnan(angle) else 0
        while low < high:  # the first track that is not too far to the left
            middle = (low + high) // 2
            if means[by_x[middle], 0] < x - longest:
                low = middle + 1
            else:
                high = middle
        for at in range(low, n):
            j = by_x[at]
            dx, dy = means[j, 0] - x, means[j, 1] - y
            distance = math.sqrt(dx * dx + dy * dy)
            if math.isinf(angle):
                distance = 0.0
            elif not math.isnan(angle):
                off = math.atan2(dy, dx) - angle
                distance = (
                    abs(distance * math.sin(off)) if math.cos(off) > 0.0 else distance
                )
            elif dx > longest:
                break
            if distance > reach_m[j]:
                continue
            k = count
            if count - first == most:  # replaces the farthest, which moves to the end
                for other in range(first, count):
                    k = other if k == count or distances[other] > distances[k] else k
                if distances[k] <= distance:
                    continue
                for other in range(k, count - 1):
                    columns[other], distances[other] = (
                        columns[other + 1],
                        distances[other + 1],
                    )
                count -= 1
            k = count
            while k > first and columns[k - 1] > j:  # in the order of the tracks
                columns[k], distances[k] = columns[k - 1], distances[k - 1]
                k -= 1
            rows[count], columns[k], distances[k] = i, j, distance
            count += 1
    return rows[:count], columns[:count], distances[:count]


@inlined
def _largest_variance(P: FloatArray) -> float:
    """Return the largest variance of the position in any direction."""
    half = 0.5 * (P[0, 0] - P[1, 1])
    across = 0.5 * (P[0, 1] + P[1, 0])
    return float(0.5 * (P[0, 0] + P[1, 1]) + math.hypot(half, across))


@njit(
    "void(float64[:, :, ::1], Array(float64, 3, 'C', readonly=True), float64[:], float64, float64[::1])"
)
def widen(
    P: FloatArray,
    R: FloatArray,
    late_m2: FloatArray,
    quantile: float,
    squared_m2: FloatArray,
) -> None:
    """Widen the gates of tracks, with the squared radii (n,), for detections with covariances R (m, k, k).

    Tracks have the covariances P (n, d, d). Their positions have the further variances `late_m2` (n,). A radius is the
    root of `quantile` times the largest variance.
    """
    check(P.shape[1] >= 2 and P.shape[2] >= 2 and R.shape[1] >= 2 and R.shape[2] >= 2)
    check(len(late_m2) >= len(P) and len(squared_m2) >= len(P))
    own_m2 = 0.0
    for i in range(len(R)):
        own_m2 = max(own_m2, _largest_variance(R[i]))
    for i in range(len(P)):
        largest_m2 = _largest_variance(P[i]) + own_m2 + late_m2[i]
        squared_m2[i] = max(squared_m2[i], quantile * largest_m2)


@njit("(float64[:, ::1], int64[:], int64[::1], float64)")
def linked(
    points: FloatArray, by_x: IntArray, starts: IntArray, distance: float
) -> tuple[IntArray, BoolArray]:
    """Return for each of `points` (n, 2) the first point that it is linked to, shape (n,), and True for each list
    without links.

    Points of a list are linked by steps of at most `distance`.
    List k has the points `by_x` (n,) from `starts[k]` up to the next start, in the order of x.
    """
    check(_checked_starts(starts, len(starts) - 1, len(points)) <= len(by_x))
    check_rows(by_x, 0, len(points))
    leads, apart = np.arange(len(points)), np.ones(len(starts) - 1, np.bool_)
    for k in range(len(apart)):
        for a in range(starts[k], starts[k + 1]):
            i, b = by_x[a], a + 1
            while b < starts[k + 1] and points[by_x[b], 0] - points[i, 0] <= distance:
                j, b = by_x[b], b + 1
                dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                if dx * dx + dy * dy <= distance * distance:
                    apart[k] = False
                    first, second = i, j
                    while leads[first] != first:
                        first = leads[first]
                    while leads[second] != second:
                        second = leads[second]
                    leads[max(first, second)] = min(first, second)
    for i in range(len(leads)):
        leads[i] = leads[leads[i]]  # that of a point before it, which is done
    return leads, apart


@njit("int64[::1](float64[:, ::1], float64[:, :, ::1])")
def faults(means: FloatArray, covariances: FloatArray) -> IntArray:
    """Return the fault of each state (m, n) and (m, n, n), shape (m,).

    A state may be not finite, or beyond any vehicle, or its covariance may be invalid.
    """
    m, n = means.shape
    check(
        len(covariances) >= m
        and covariances.shape[1] == n
        and covariances.shape[2] == n
    )
    result, C, std = np.full(m, SOUND), np.empty((n, n)), np.empty(n)
    for i in range(m):
        P, size, total = covariances[i], 0.0, 0.0
        sound = (
            P[0, 0] > 0.0 and P[1, 1] > 0.0
        )  # every model has a position; other entries may be 0 for certain
        for a in range(n):
            std[a] = math.sqrt(max(P[a, a], 1e-300))
        for a in range(n):
            size += abs(means[i, a])
            for b in range(n):
                total += abs(P[a, b])
                root = std[a] * std[b]
                C[a, b] = 1.0 + _ROUNDING if a == b else P[a, b] / root
                sound = sound and abs(P[a, b] - P[b, a]) / root <= _ROUNDING
            sound = sound and P[a, a] >= 0.0
        if not (size <= LARGEST and total < np.inf):
            result[i] = NOT_FINITE
        elif not (sound and cholesky(C, n, C)):
            result[i] = NOT_DEFINITE
    return result

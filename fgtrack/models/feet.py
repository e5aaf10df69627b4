"""Compiled projection of points onto the reference line of a track map."""

import math

import numpy as np

from fgtrack.core.compiled import check, njit, shared, wrapped
from fgtrack.core.types import BoolArray, FloatArray, IntArray

# Columns of a segment row, see `fgtrack.models.track_map`.
_HEADING = 4
_CURVATURE = 5
_LEFT = 6
_RIGHT = 7
_ALONG = 9
_QUANTITIES = 10


@shared("int64(float64, float64, Array(float64, 2, 'C', readonly=True), float64)")
def _nearest(x: float, y: float, rows: FloatArray, longest_m: float) -> int:
    """Return the index of the first row of `rows` (n, ...) that is nearest to the point (x, y).

    The rows are points of a closed line. Neighbouring rows are at most `longest_m`
    apart.
    """
    # The distance to a few rows bounds the least distance, so that the search can skip rows.
    least_m = np.inf
    j = 0
    stride = math.ceil(math.sqrt(len(rows)))
    while j < len(rows):
        least_m = min(least_m, math.sqrt((rows[j, 0] - x) ** 2 + (rows[j, 1] - y) ** 2))
        j += stride
    least_m += 1e-6
    first = 0
    least = np.inf
    j = 0
    while j < len(rows):
        squared_m2 = (rows[j, 0] - x) ** 2 + (rows[j, 1] - y) ** 2
        distance_m = math.sqrt(squared_m2)
        if squared_m2 < least:
            first, least, least_m = j, squared_m2, min(distance_m, least_m)
        # Skip the rows that cannot be nearer: each is close to row j, and row j is far from the point.
        j += 1 + int(max((distance_m - least_m) / longest_m - 1e-6, 0.0))
    return first


@njit("int64[::1](float64[:, ::1], Array(float64, 2, 'C', readonly=True), float64)")
def nearest(points_m: FloatArray, rows: FloatArray, longest_m: float) -> IntArray:
    """Return the index of the nearest row for each of `points_m` (m, 2); the first row on a tie.

    `rows` (n, 2) are points of a closed line. Neighbouring rows are at most `longest_m`
    apart.
    """
    check(len(rows) > 0 and rows.shape[1] >= 2 and points_m.shape[1] >= 2)
    indices = np.empty(len(points_m), np.int64)
    for i in range(len(points_m)):
        indices[i] = _nearest(points_m[i, 0], points_m[i, 1], rows, longest_m)
    return indices


@njit("(float64[:, ::1], Array(float64, 2, 'C', readonly=True), float64)")
def feet(
    points_m: FloatArray, segments: FloatArray, longest_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return the map quantities (m, 10) at the foot of each point (m, 2), and the lateral offsets (m,).

    The foot of a point is its projection onto the line. An offset is positive to the
    left. `segments` (n, 20) are the segment rows of `TrackMap`, at most `longest_m`
    long.

    The foot lies in the nearest row, or in the row before it. There the share t of the
    segment solves a quadratic equation: Re((q - t e) (B + t dB)) = 0. It is limited to
    0 to 1. Here q is the vector from the start of the segment to the point, and e is the
    segment. B is exp(-i heading) at the start, and dB is its change along the segment.
    All are complex numbers.
    """
    check(
        len(segments) > 0
        and segments.shape[1] >= 2 * _QUANTITIES
        and points_m.shape[1] >= 2
    )
    quantities = np.empty((len(points_m), _QUANTITIES))
    lateral = np.empty(len(points_m))
    for i in range(len(points_m)):
        x, y = points_m[i, 0], points_m[i, 1]
        first = _nearest(x, y, segments, longest_m)
        at = segments[first]
        if (x - at[0]) * at[2] - (y - at[1]) * at[3] < 0.0:
            at = segments[(first - 1) % len(segments)]
        right, up = x - at[0], y - at[1]
        c = right * at[2] - up * at[3]
        # b is positive up to the centre of curvature. Beyond it the nearer end of the segment is the foot.
        b = max(0.5 * (at[_ALONG] - (right * at[12] - up * at[13])), 1e-12)
        part = c / (math.sqrt(max(b * b + at[_ALONG + _QUANTITIES] * c, 0.0)) + b)
        part = min(max(part, 0.0), 1.0)
        for j in range(_QUANTITIES):
            quantities[i, j] = at[j] + part * at[_QUANTITIES + j]
        right, up = right - part * at[10], up - part * at[11]
        lateral[i] = (right * quantities[i, 3] + up * quantities[i, 2]) / math.hypot(
            quantities[i, 2], quantities[i, 3]
        )
    return quantities, lateral


@njit(
    "(float64[:, ::1], Array(float64, 2, 'C', readonly=True), float64, float64, float64)"
)
def view(
    points_m: FloatArray,
    segments: FloatArray,
    longest_m: float,
    left_m: float,
    right_m: float,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return heading in (-pi, pi], curvature, and mask of points beyond the bounds, each of shape (m,).

    `points_m` has the shape (m, 2). A point is outside if it lies more than `left_m`
    beyond the left bound, or more than `right_m` beyond the right bound.
    """
    quantities, lateral = feet(points_m, segments, longest_m)
    m = len(points_m)
    heading = np.empty(m)
    curvature = np.empty(m)
    outside = np.empty(m, np.bool_)
    for i in range(m):
        heading[i] = wrapped(quantities[i, _HEADING])
        curvature[i] = quantities[i, _CURVATURE]
        outside[i] = (
            lateral[i] > quantities[i, _LEFT] + left_m
            or -lateral[i] > quantities[i, _RIGHT] + right_m
        )
    return heading, curvature, outside

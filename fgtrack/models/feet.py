"""Feet of points on the line of a map, compiled."""

import math

import numpy as np

from fgtrack.core.compiled import check, njit, shared, wrapped
from fgtrack.core.types import BoolArray, FloatArray, IntArray

_HEADING, _CURVATURE, _LEFT, _RIGHT, _ALONG, _QUANTITIES = (
    4,
    5,
    6,
    7,
    9,
    10,
)  # see `fgtrack.models.track_map`


@shared("int64(float64, float64, Array(float64, 2, 'C', readonly=True), float64)")
def _nearest(x: float, y: float, rows: FloatArray, longest_m: float) -> int:
    """Return the first of the nearest of points `rows` (n, ...) on a closed line, at most `longest_m` apart."""
    first, least_m, j, stride = 0, np.inf, 0, math.ceil(math.sqrt(len(rows)))
    while j < len(rows):  # a bound that lets the search leave out much
        least_m = min(least_m, math.sqrt((rows[j, 0] - x) ** 2 + (rows[j, 1] - y) ** 2))
        j += stride
    least_m, j, least = least_m + 1e-6, 0, np.inf
    while j < len(rows):
        squared_m2 = (rows[j, 0] - x) ** 2 + (rows[j, 1] - y) ** 2
        distance_m = math.sqrt(squared_m2)
        if squared_m2 < least:
            first, least, least_m = j, squared_m2, min(distance_m, least_m)
        # The rows up to there are too near to this one to be nearer to the point than the nearest so far.
        j += 1 + int(max((distance_m - least_m) / longest_m - 1e-6, 0.0))
    return first


@njit("int64[::1](float64[:, ::1], Array(float64, 2, 'C', readonly=True), float64)")
def nearest(points_m: FloatArray, rows: FloatArray, longest_m: float) -> IntArray:
    """Return for each of `points_m` (m, 2) the first of the nearest points `rows` (n, 2), at most `longest_m` apart."""
    check(len(rows) > 0 and rows.shape[1] >= 2 and points_m.shape[1] >= 2)
    indices = np.empty(len(points_m), np.int64)
    for i in range(len(points_m)):
        indices[i] = _nearest(points_m[i, 0], points_m[i, 1], rows, longest_m)
    return indices


@njit("(float64[:, ::1], Array(float64, 2, 'C', readonly=True), float64)")
def feet(
    points_m: FloatArray, segments: FloatArray, longest_m: float
) -> tuple[FloatArray, FloatArray]:
    """Quantities (m, 10) at the feet of points (m, 2) on the line, and lateral offsets (m,), left positive.
    `segments` (n, 20), at most `longest_m` long, are the rows of `TrackMap`. The foot, on a segment at the nearest
    point of the line, has the point on its normal: Re((q - t e) (B + t dB)) = 0 with q from the start of the segment to
    the point, e the segment, and B, dB the inverse of the heading and its change, as complex numbers.
    """
    check(
        len(segments) > 0
        and segments.shape[1] >= 2 * _QUANTITIES
        and points_m.shape[1] >= 2
    )
    quantities, lateral = (
        np.empty((len(points_m), _QUANTITIES)),
        np.empty(len(points_m)),
    )
    for i in range(len(points_m)):
        x, y = points_m[i, 0], points_m[i, 1]
        first = _nearest(x, y, segments, longest_m)
        at = segments[first]
        if (x - at[0]) * at[2] - (y - at[1]) * at[3] < 0.0:
            at = segments[(first - 1) % len(segments)]
        right, up = x - at[0], y - at[1]
        c = right * at[2] - up * at[3]
        # Positive as far as the centre of curvature; beyond it the nearer end of the segment is the foot.
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
    """Heading in (-pi, pi], curvature, and True beyond the bounds and so much more, of points (m, 2), shapes (m,)."""
    quantities, lateral = feet(points_m, segments, longest_m)
    m = len(points_m)
    heading, curvature, outside = np.empty(m), np.empty(m), np.empty(m, np.bool_)
    for i in range(m):
        heading[i], curvature[i] = (
            wrapped(quantities[i, _HEADING]),
            quantities[i, _CURVATURE],
        )
        outside[i] = (
            lateral[i] > quantities[i, _LEFT] + left_m
            or -lateral[i] > quantities[i, _RIGHT] + right_m
        )
    return heading, curvature, outside

"""Noise of each component of a sensor, by the scatter of its detections around straight lines, with intervals.

The scatter is the part of the errors that changes within a quarter of a second. An
error that is constant for longer stays unknown, as the offset on a large hull does.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.meaning.scatter import MAD, Trend, growing, line_errors, sight_errors
from fgtrack.meaning.tracklets import Points, sights_m, tracklets, triples

__all__ = ["Scatter", "scattered_noise"]

#: Fewest triples of an estimate.
_FEWEST = 100
#: Distances between the detections of a triple, in detections, and the longest duration of half a triple.
_LAGS = (1, 2, 3, 5, 8)
_LONGEST_S = 1.0
#: Half of the shortest duration of triples from which time-correlated errors are estimated.
_LASTING_S = 0.25
#: Quantiles of the errors, and the same of a normal distribution: the tails count up to the last quantile.
_QUANTILES = ((0.5, MAD), (0.683, 1.0), (0.9, 1.645), (0.95, 1.96))
#: Ratio of the noise at far and near ranges, or of long and short triples, from which it counts as different.
_DIFFERENT = 1.25
#: Shortest range of a bearing.
_SHORTEST_M = 1.0
#: Stretches of time of the jackknife, and the 97.5 % quantile of Student's distribution with their degrees of freedom.
_STRETCHES = 10
_STUDENT = 2.262
_SMALLEST = 1e-6
"""Smallest error, which the numbers of a computer have."""

Errors = Callable[[IntArray], tuple[FloatArray, FloatArray]]
"""Returns the errors and the ranges of triples, shapes (n,), from their rows (n, 3)."""


class Scatter(NamedTuple):
    """Noise of one component."""

    noise: Trend
    half_width: float
    """Half of the 95 % interval of the standard deviation, as a share of it."""
    num_triples: int


def scattered_noise(points: Points) -> Mapping[str, Scatter]:
    """Return the noise of the components that the triples of `points` show.

    `x_m` and `y_m` are the noise along and across the line of sight, as in a sensor model.
    """
    if len(points.points_m) < _FEWEST:
        return {}
    chains, _ = tracklets(points)
    rows = [triples(points, chains, lag) for lag in _LAGS]
    if len(rows[0]) < _FEWEST:
        return {}
    result = {}
    for name, errors in _components(points).items():
        found = _scatter(points.stamps_s, rows, errors)
        if found is not None:
            result[name] = found
    return result


def _components(points: Points) -> dict[str, Errors]:
    """Return the errors of each component."""
    sights = sights_m(points)
    at_m = points.turned_m

    def positions(rows: IntArray, axis: int) -> tuple[FloatArray, FloatArray]:
        errors_m = line_errors(points.stamps_s[rows], at_m[rows])
        *both_m, ranges_m = sight_errors(errors_m, sights[rows[:, 1]])
        return both_m[axis], ranges_m

    def bearings(rows: IntArray) -> tuple[FloatArray, FloatArray]:
        across_m, ranges_m = positions(rows, 1)
        far = ranges_m > _SHORTEST_M
        return across_m[far] / ranges_m[far], np.zeros(int(far.sum()))

    def others(rows: IntArray, name: str) -> tuple[FloatArray, FloatArray]:
        values = points.values[name][rows]
        rows, values = rows[np.isfinite(values).all(axis=1)], values
        values = values[np.isfinite(values).all(axis=1)]
        if name == "yaw_rad":
            values = wrap_angles(values - values[:, [1]])
        errors = line_errors(points.stamps_s[rows], values)
        return errors, np.zeros(len(errors))

    result: dict[str, Errors] = {}
    if points.is_polar:
        result["range_m"] = lambda rows: positions(rows, 0)
        result["bearing_rad"] = bearings
    else:
        result["x_m"] = lambda rows: positions(rows, 0)
        result["y_m"] = lambda rows: positions(rows, 1)
    for name in points.values:
        result[name] = lambda rows, name=name: others(rows, name)  # type: ignore[misc]
    return result


def _scatter(
    stamps_s: FloatArray, rows: list[IntArray], errors_of: Errors
) -> Scatter | None:
    """Return the noise of a component; None for too few triples. `rows` holds triples of detections, by lag."""
    errors, ranges_m = errors_of(rows[0])
    if len(errors) < _FEWEST:
        return None
    errors = np.maximum(np.abs(errors), _SMALLEST)
    trend = growing(errors, ranges_m, _SMALLEST)
    near, far = np.quantile(ranges_m, [1.0 / 6.0, 5.0 / 6.0])
    if trend.at(far) < _DIFFERENT * trend.at(near):
        trend = Trend(float(np.median(errors)) / MAD)
    errors = errors / trend.at(ranges_m)
    factor = _scale(errors) * _lasting(stamps_s, rows, errors_of, trend)
    noise = Trend(factor * trend.std, factor * trend.growth)
    return Scatter(noise, _half_width(errors), len(errors))


def _scale(errors: FloatArray) -> float:
    """Return the standard deviation of a normal distribution that covers the sizes of `errors` at all quantiles."""
    return max(float(np.quantile(errors, share)) / z for share, z in _QUANTILES)


def _lasting(
    stamps_s: FloatArray, rows: list[IntArray], errors_of: Errors, trend: Trend
) -> float:
    """Return the ratio of the noise with time-correlated errors to the noise of successive lists.

    The result is 1 where the difference is small. Triples of a longer duration contain these errors. They
    contain accelerations, too, whose variance grows with the fourth power of the
    duration.
    """
    from scipy.optimize import nnls

    halves_s = []
    ratios = []
    for each in rows:
        half_s = np.ptp(stamps_s[each], axis=1) / 2.0
        if len(each) < _FEWEST or float(np.median(half_s)) > _LONGEST_S:
            break
        errors, ranges_m = errors_of(each)
        if not len(errors):
            break
        halves_s.append(float(np.median(half_s)))
        scale = float(np.median(np.abs(errors) / trend.at(ranges_m))) / MAD
        ratios.append(max(scale**2, _SMALLEST))
    if len(ratios) < 2:
        return 1.0
    last = sum(half_s >= _LASTING_S for half_s in halves_s)
    if last >= 2:
        halves_s, ratios = halves_s[-last:], ratios[-last:]
    A = np.column_stack([np.ones(len(ratios)), np.power(halves_s, 4)])
    ratio = nnls(A / np.array(ratios)[:, None], np.ones(len(ratios)))[0][0]
    factor = math.sqrt(float(ratio))
    return factor if factor > _DIFFERENT else 1.0


def _half_width(errors: FloatArray) -> float:
    """Return half of the 95 % interval of the standard deviation of `errors`, as a share of it, by a jackknife.

    The errors are in the order of the tracklets, so a stretch contains the errors of few objects.
    """
    parts = np.array_split(np.arange(len(errors)), _STRETCHES)
    logs = np.log([_scale(np.delete(errors, part)) for part in parts])
    variance = (1.0 - 1.0 / _STRETCHES) * float(np.square(logs - logs.mean()).sum())
    return _STUDENT * math.sqrt(variance)

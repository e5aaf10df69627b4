"""Several first states of one object, of which only one is right: hypotheses for `fgtrack.estimator`."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import TWO_PI, cartesian, cartesian_gradient, wrap_angle
from fgtrack.core.linalg import congruence, identity, psd_solve, symmetrise
from fgtrack.estimation.base import Start

__all__ = ["distances", "headings", "intersections"]


def headings(start: Start, count: int) -> list[Start]:
    """`count` starts that head for equal sectors of the circle, each as uncertain as its sector is wide.

    The direction holds the sign of the speed, so the speed is that of the absolute value of a normal variable (the
    folded normal distribution). Raises `CallError` for fewer than two.
    """
    if count < 2:
        raise CallError(f"headings: give at least 2, is {count}")
    mean, std = start.speed_mps, max(start.speed_std_mps, np.finfo(np.float64).tiny)
    speed_mps = std * math.sqrt(2.0 / math.pi) * math.exp(-0.5 * (mean / std) ** 2)
    speed_mps += mean * math.erf(mean / (std * math.sqrt(2.0)))
    speed_std_mps = math.sqrt(max(mean**2 + std**2 - speed_mps**2, 0.0))
    sector_rad = TWO_PI / count
    return [
        replace(
            start,
            yaw_rad=wrap_angle(k * sector_rad),
            yaw_std_rad=sector_rad / math.sqrt(12.0),
            speed_mps=speed_mps,
            speed_std_mps=speed_std_mps,
        )
        for k in range(count)
    ]


def distances(
    start: Start,
    sensor_m: Sequence[float],
    bearing_rad: float,
    bearing_std_rad: float,
    nearest_m: float,
    farthest_m: float,
    count: int,
) -> list[Start]:
    """`count` starts along a bearing (in the map) from a sensor at `sensor_m`, from `nearest_m` to `farthest_m`.

    The distances form a geometric series, so that all are equally uncertain in relation to their distance: the
    range-parameterised filter of Peach, Bearings-only tracking using a set of range-parameterised extended Kalman
    filters, IEE Proceedings - Control Theory and Applications 142(1), 1995. Raises `CallError` for a range that is
    empty, and for no start.
    """
    if not (0.0 < nearest_m < farthest_m < math.inf and count >= 1):
        raise CallError(f"distances: give 0 < nearest < farthest and 1 or more, is {nearest_m}, {farthest_m}, {count}")
    edges_m = np.geomspace(nearest_m, farthest_m, count + 1)
    found = []
    for near_m, far_m in zip(edges_m[:-1].tolist(), edges_m[1:].tolist(), strict=True):
        bearing_range = np.array([bearing_rad, 0.5 * (near_m + far_m)])
        R = np.diag([bearing_std_rad**2, (far_m - near_m) ** 2 / 12.0])
        position_m = np.asarray(sensor_m, dtype=np.float64) + cartesian(bearing_range)
        covariance = symmetrise(congruence(cartesian_gradient(bearing_range), R))
        found.append(replace(start, position_m=position_m, position_covariance=covariance))
    return found


def intersections(
    start: Start, sensors_m: Sequence[Sequence[float]], ranges_m: Sequence[float], range_std_m: float
) -> list[Start]:
    """Where the circles of two ranges from two sensor positions meet: two starts, or one where they only touch.

    The covariance is that of the two ranges, to first order; across the line of both sensors it grows without limit as
    the circles come to touch, and is limited to the mean range. Raises `CallError` for one and the same position.
    """
    first, second = (np.asarray(each, dtype=np.float64) for each in sensors_m)
    apart_m = float(np.hypot(*(second - first)))
    if not apart_m > 0.0:
        raise CallError("intersections: the two sensor positions are the same, give two that differ")
    along = (second - first) / apart_m
    across = np.array([-along[1], along[0]])
    near_m, far_m = ranges_m
    foot_m = (near_m**2 - far_m**2 + apart_m**2) / (2.0 * apart_m)
    height_m = math.sqrt(max(near_m**2 - foot_m**2, 0.0))
    found = []
    for side in (1.0, -1.0) if height_m > 0.0 else (1.0,):
        position_m = first + foot_m * along + side * height_m * across
        H = np.array(
            [(position_m - each) / max(float(np.hypot(*(position_m - each))), 1e-9) for each in (first, second)]
        )
        vague = identity(2) / (0.5 * (near_m + far_m)) ** 2
        covariance = symmetrise(psd_solve(H.T @ H / range_std_m**2 + vague, identity(2)))
        found.append(replace(start, position_m=position_m, position_covariance=covariance))
    return found

"""Yaw of the reference sensor in the ego by the traffic: objects stand still, or move along the ego's path.

Let e be the ego's position, and z the position of an object in the axes of the map, but
turned by the unknown yaw d of the sensor. Then the object's velocity in the map is
v(d) = e' + R(d) z'. The yaw is probable at which many objects stand still, or move along
the nearest part of the ego's path, in either direction:

    p(v) = w_still N(v; 0, S) + w_lane N(v_across; 0, s^2) N(v_along; 0, u^2) + w_free N(v; 0, u^2 I)

S and s^2 contain the noise of the sensors. Each object adds the logarithm of its p(v) to
the log-likelihood of d, which has a flat prior on the circle. A single object may cross
the path, so it hardly decides. Objects that agree do.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import rotations, wrap_angle
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.meaning.mounts.pose import Pose2
from fgtrack.meaning.mounts.table import Table
from fgtrack.meaning.tracklets import EgoMotion

__all__ = ["TrafficYaw", "traffic_yaw"]

#: Duration of the windows in which velocities are fitted, and their fewest detections.
_WINDOW_S = 3.0
_SHORTEST_S = 1.0
_FEWEST = 6
#: Weights of objects that stand still, move along the path, or move freely.
_WEIGHTS = (0.3, 0.4, 0.3)
#: Standard deviations: of the velocity of an object that stands still, of the velocity across a lane, of the
#: direction of a lane, of this direction for each metre beyond the ego's path, and the smallest one of velocities.
_STILL_MPS = 0.2
_ACROSS_MPS = 0.3
_LANE_RAD = 0.03
_BEYOND_RAD = 0.003
_LEAST_SPEED_MPS = 8.0
#: Distance between the points of the ego's path.
_PATH_M = 5.0
#: Slowest ego, as a mean speed.
_SLOWEST_MPS = 1.0
#: Smallest speed of an object that passes the ego, as a share of the ego's speed.
_PASSING = 0.1
#: Step of the yaw.
_STEP_RAD = math.radians(0.5)
#: Yaws within this angle of the best yaw are the same mount.
_NEAR_RAD = 0.06


class TrafficYaw(NamedTuple):
    """Yaw of the reference that the traffic shows."""

    yaw_rad: float
    std_rad: float
    yaws_rad: FloatArray
    """Yaws on the circle, shape (n,)."""
    density: FloatArray
    """Their probabilities, shape (n,)."""
    num_objects: int
    """Number of objects that pass the ego, and stand still or move along its path."""

    def near(self, yaw_rad: float) -> float:
        """Return the probability of the yaws near `yaw_rad`."""
        near = np.cos(self.yaws_rad - yaw_rad) > math.cos(_NEAR_RAD)
        return float(self.density[near].sum())

    def factor(self, yaw_rad: float) -> float:
        """Return how many times as probable as an average yaw the yaws near `yaw_rad` are."""
        return self.near(yaw_rad) * math.pi / _NEAR_RAD

    @property
    def probability(self) -> float:
        """Probability of the yaws near `yaw_rad`."""
        return self.near(self.yaw_rad)


class _Windows(NamedTuple):
    """Mean motions of objects in windows of time, in the axes of the map."""

    objects: IntArray
    ego_m: FloatArray
    """Mean positions of the ego, shape (n, 2)."""
    ego_mps: FloatArray
    at_m: FloatArray
    """Mean positions z of the objects, shape (n, 2)."""
    rates_mps: FloatArray
    """Mean derivatives of z, shape (n, 2)."""
    variances: FloatArray
    """Variances of the velocities along and across the sight, shape (n, 2)."""


def traffic_yaw(
    table: Table, poses: Sequence[Pose2], motion: EgoMotion
) -> TrafficYaw | None:
    """Return the yaw of the reference that the traffic shows; None if the ego hardly moves.

    All yaws are equally probable if no object is observed for a second.
    """
    lengths_m = np.hypot(*np.diff(motion.rows[:, 1:3], axis=0).T)
    if lengths_m.sum() < _SLOWEST_MPS * np.ptp(motion.rows[:, 0]):
        return None
    yaws_rad = np.arange(-math.pi, math.pi, _STEP_RAD)
    windows = _windows(table, poses)
    if windows is None:
        flat = np.full(len(yaws_rad), 1.0 / len(yaws_rad))
        return TrafficYaw(0.0, math.pi, yaws_rad, flat, 0)
    speeds_mps = np.hypot(*windows.ego_mps.T)
    path = _path(motion)
    scale_mps = max(_LEAST_SPEED_MPS, float(speeds_mps.max()))
    shares = [_shares(windows, path, yaw, scale_mps) for yaw in yaws_rad.tolist()]
    logs = np.log(np.array([each.sum(axis=0) for each in shares]))
    _names, inverse = np.unique(windows.objects, return_inverse=True)
    # The windows of one object have common errors, so they count as fewer.
    weights = 1.0 / np.sqrt(np.bincount(inverse))[inverse]
    total = logs @ weights
    density = np.exp(total - total.max())
    density /= density.sum()
    best = int(density.argmax())
    turns = np.angle(np.exp(1j * (yaws_rad - yaws_rad[best])))
    near = np.abs(turns) < _NEAR_RAD
    mass = float(density[near].sum())
    mean = float(density[near] @ turns[near]) / mass
    std = math.sqrt(float(density[near] @ np.square(turns[near] - mean)) / mass)
    still, lane, free = shares[best]
    agree = still + lane > free
    passing = np.hypot(*windows.rates_mps.T) > _PASSING * speeds_mps
    return TrafficYaw(
        wrap_angle(float(yaws_rad[best]) + mean),
        math.hypot(std, _STEP_RAD / math.sqrt(12.0)),
        yaws_rad,
        density,
        len(np.unique(windows.objects[agree & passing])),
    )


def _windows(table: Table, poses: Sequence[Pose2]) -> _Windows | None:
    """Return the mean motions of the objects; None without motions."""
    yaws = np.array([pose.yaw_rad for pose in poses])[table.sensors]
    shifts_m = np.array([pose.shift_m for pose in poses])[table.sensors]
    own_m = np.einsum("nij,nj->ni", rotations(yaws), table.points_m) + shifts_m
    z_m = np.einsum("nij,nj->ni", rotations(table.poses[:, 2]), own_m)
    numbers = np.floor((table.times_s - table.times_s.min()) / _WINDOW_S).astype(int)
    order = np.lexsort((table.times_s, numbers, table.objects))
    keys = np.column_stack([table.objects, numbers])[order]
    parts = np.split(order, np.flatnonzero(np.diff(keys, axis=0).any(axis=1)) + 1)
    rows = []
    for part in parts:
        times_s = table.times_s[part]
        if len(part) < _FEWEST or np.ptp(times_s) < _SHORTEST_S:
            continue
        centred_s = times_s - times_s.mean()
        gain = centred_s / (centred_s @ centred_s)
        both = np.column_stack([table.poses[part, :2], z_m[part]])
        ranges_m = np.hypot(*table.points_m[part].T)[:, None]
        noise = np.square(table.noise[part])
        variances = noise[:, :, 0] + noise[:, :, 1] * np.square(ranges_m)
        rows.append(
            [
                float(table.objects[part[0]]),
                *both.mean(axis=0),
                *(gain @ both),
                *(np.square(gain) @ variances),
            ]
        )
    if not rows:
        return None
    values = np.array(rows)
    return _Windows(
        values[:, 0].astype(int),
        values[:, 1:3],
        values[:, 5:7],
        values[:, 3:5],
        values[:, 7:9],
        values[:, 9:11],
    )


def _path(motion: EgoMotion) -> FloatArray:
    """Return points of the ego's path at least `_PATH_M` apart, with its direction, shape (n, 3)."""
    kept = [motion.rows[0, 1:3]]
    for at_m in motion.rows[1:, 1:3]:
        if np.hypot(*(at_m - kept[-1])) >= _PATH_M:
            kept.append(at_m)
    points_m = np.array(kept)
    if len(points_m) < 2:
        return np.array([[*points_m[0], 0.0]])
    steps_m = np.gradient(points_m, axis=0)
    return np.column_stack([points_m, np.arctan2(steps_m[:, 1], steps_m[:, 0])])


def _shares(
    windows: _Windows, path: FloatArray, yaw_rad: float, scale_mps: float
) -> FloatArray:
    """Return the three parts of the density p(v) of each window at a yaw, shape (3, n)."""
    c = math.cos(yaw_rad)
    s = math.sin(yaw_rad)
    turn = np.array([[c, s], [-s, c]])
    sights_m = windows.at_m @ turn
    v_mps = windows.ego_mps + windows.rates_mps @ turn
    at_m = windows.ego_m + sights_m
    offsets_m2 = np.square(at_m[:, None, :] - path[:, :2]).sum(axis=2)
    nearest = offsets_m2.argmin(axis=1)
    lane_rad = path[nearest, 2]
    ahead = np.column_stack([np.cos(lane_rad), np.sin(lane_rad)])
    at_end = (nearest == 0) | (nearest == len(path) - 1)
    beyond_m = np.where(
        at_end, np.abs(np.sum((at_m - path[nearest, :2]) * ahead, axis=1)), 0.0
    )
    along = np.sum(v_mps * ahead, axis=1)
    across = ahead[:, 0] * v_mps[:, 1] - ahead[:, 1] * v_mps[:, 0]
    ranges_m = np.maximum(np.hypot(*sights_m.T), 1e-6)
    u = sights_m / ranges_m[:, None]
    along_sight, across_sight = windows.variances.T
    # Variance of the velocity across the lane.
    cosine = np.square(u[:, 0] * ahead[:, 1] - u[:, 1] * ahead[:, 0])
    noise = along_sight * cosine + across_sight * (1.0 - cosine)
    lane = _ACROSS_MPS**2 + noise
    lane += np.square((_LANE_RAD + _BEYOND_RAD * beyond_m) * along)
    radial = np.sum(u * v_mps, axis=1)
    tangential = u[:, 0] * v_mps[:, 1] - u[:, 1] * v_mps[:, 0]
    wide = scale_mps**2
    return np.array(
        [
            _WEIGHTS[0]
            * _normal(radial, along_sight + _STILL_MPS**2)
            * _normal(tangential, across_sight + _STILL_MPS**2),
            _WEIGHTS[1] * _normal(across, lane) * _normal(along, wide),
            _WEIGHTS[2] * _normal(radial, wide) * _normal(tangential, wide),
        ]
    )


def _normal(x: FloatArray, variance: FloatArray | float) -> FloatArray:
    """Return the density of the normal distribution with mean 0."""
    return np.asarray(
        np.exp(-0.5 * np.square(x) / variance) / np.sqrt(2.0 * math.pi * variance)
    )

"""Frame of a sensor's positions by evidence: objects move smoothly in the right frame, and are near the sensor."""

import math
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import rotation, rotations
from fgtrack.core.types import FloatArray
from fgtrack.meaning.tracklets import EgoMotion, Points, tracklets

__all__ = ["FrameTest", "frame_of", "is_optical"]

#: Half of the time over which an object is expected to keep its velocity.
_HALF_S = 1.0
#: Time in which positions are averaged at the ends and in the middle.
_MEAN_S = 0.2
#: Fewest windows, smallest ratio of the deviations, and significance in standard deviations.
_FEWEST_WINDOWS = 12
_RATIO = 1.3
_SURE_STDS = 4.0
#: Ratio and difference of the distances from the ego and from the origin that decide.
_NEARER = 0.5
_FARTHER_M = 50.0
#: Largest ratio of the deviations that counts less than distances with a smaller ratio than the second number.
_WEAK_RATIO = 2.0
_CLEARLY_NEARER = 0.25
#: Fewest detections.
_FEWEST = 30
#: The vertical axis varies by less than this share of the horizontal axes.
_FLAT = 0.2


class FrameTest(NamedTuple):
    """Result of a test whether positions are in the frame `map` or `ego`; `ego` also stands for the sensor's frame."""

    in_map: bool | None
    """True for the map, False for the ego or the sensor; None if the test does not decide."""
    is_contradictory: bool
    """True if the motion of the objects and their distances show different frames."""
    reason: str
    """Test and its numbers in words."""


def frame_of(points: Points, motion: EgoMotion) -> FrameTest:
    """Test whether positions are in the map frame, or in the frame of the ego or of a sensor on it.

    In the right frame objects keep their velocity for seconds. In the wrong frame they
    turn and accelerate with the ego. An ego on a straight road at constant speed
    decides nothing. Then the distances count: sensors detect objects near themselves.
    Clear distances also count against a small difference of the motions.
    """
    if not motion or len(points.points_m) < _FEWEST:
        return FrameTest(None, False, "there is no ego, or there are few detections")
    smooth = _by_motion(points)
    near = _by_distance(points)
    is_weak = smooth.ratio < _WEAK_RATIO and near.ratio > 1.0 / _CLEARLY_NEARER
    if smooth.in_map is None or (near.in_map is not None and is_weak):
        reason = near.reason
        if near.in_map is None:
            reason = f"{smooth.reason}; {near.reason}"
        return FrameTest(near.in_map, False, reason)
    if near.in_map in (None, smooth.in_map):
        return FrameTest(smooth.in_map, False, smooth.reason)
    return FrameTest(None, True, f"{smooth.reason}; {near.reason}")


class _Evidence(NamedTuple):
    """Result of one test."""

    in_map: bool | None
    """True for the map, False for the ego or the sensor; None if the test does not decide."""
    reason: str
    """The numbers in words."""
    ratio: float = 1.0
    """Ratio of the larger and the smaller number."""


def _by_distance(points: Points) -> _Evidence:
    """Test whether the detections are near the ego in the map, or in the ego's frame."""
    body_m = float(np.quantile(np.hypot(*points.points_m.T), 0.9))
    offsets_m = points.points_m - points.poses[:, :2]
    map_m = float(np.quantile(np.hypot(*offsets_m.T), 0.9))
    reason = (
        f"90 % of the detections are within {body_m:.0f} m of the ego if they are in its frame, "
        f"{map_m:.0f} m if they are in the map"
    )
    ratio = max(body_m, map_m) / max(min(body_m, map_m), 1e-6)
    if abs(body_m - map_m) < _FARTHER_M or ratio < 1.0 / _NEARER:
        return _Evidence(None, reason, ratio)
    return _Evidence(map_m < body_m, reason, ratio)


def _by_motion(points: Points) -> _Evidence:
    """Test whether objects keep their velocity in the map, or in the ego's frame.

    The numbers are the deviations from constant velocity in both frames.
    """
    gaps: list[FloatArray] = []
    for in_map in (False, True):
        read = points.read_in_map(in_map)
        chains, _ = tracklets(read)
        gaps += [_deviations_m(points, rows) for rows in _parts(chains)]
    table = np.concatenate(gaps) if gaps else np.empty((0, 6))
    if len(table) < _FEWEST_WINDOWS:
        return _Evidence(None, "few objects are detected for seconds")
    in_map_m = np.hypot(*table[:, 0:2].T)
    in_body_m = np.hypot(*_least_turned(table).T)
    map_m, body_m = float(np.median(in_map_m)), float(np.median(in_body_m))
    d = np.clip(in_map_m - in_body_m, -5.0, 5.0)
    t = float(d.mean() / max(d.std() / math.sqrt(len(d)), 1e-9))
    reason = (
        f"objects depart from constant velocity by {body_m:.2f} m in a second in the ego's frame, "
        f"by {map_m:.2f} m in the map"
    )
    ratio = max(map_m, body_m) / max(min(map_m, body_m), 1e-6)
    if abs(t) < _SURE_STDS or ratio < _RATIO:
        return _Evidence(None, reason, ratio)
    return _Evidence(body_m > map_m, reason, ratio)


def _parts(chains: np.ndarray) -> list[np.ndarray]:
    """Return the rows of each chain. `chains` are the numbers of the chains by row."""
    return [
        np.flatnonzero(chains == number)
        for number in range(int(chains.max(initial=-1)) + 1)
    ]


def _deviations_m(points: Points, rows: np.ndarray) -> FloatArray:
    """Return deviations from constant velocity in windows along one chain, shape (n, 6).

    The columns are those of the raw positions, of the positions turned by the ego's
    yaw, and of the ego.
    """
    times_s = points.stamps_s[rows]
    rows = rows[np.argsort(times_s, kind="stable")]
    times_s = points.stamps_s[rows]
    turned_m = np.einsum(
        "nij,nj->ni", rotations(points.poses[rows, 2]), points.points_m[rows]
    )
    values = np.column_stack([points.points_m[rows], turned_m, points.poses[rows, :2]])
    period_s = float(np.median(np.diff(times_s)))
    half_s = max(_HALF_S, 2.0 * period_s)
    width_s = max(_MEAN_S, 0.6 * period_s)
    result = []
    for middle_s in np.arange(times_s[0] + half_s, times_s[-1] - half_s + 1e-9, half_s):
        means = [
            _mean(times_s, values, middle_s + shift, width_s)
            for shift in (-half_s, 0.0, half_s)
        ]
        if all(mean is not None for mean in means):
            (ta, a), (tb, b), (tc, c) = means  # type: ignore[misc]
            share = (tb - ta) / (tc - ta)
            result.append((b - (1.0 - share) * a - share * c) * (2.0 / half_s**2))
    return np.array(result).reshape(-1, 6)


def _mean(
    times_s: FloatArray, values: FloatArray, at_s: float, width_s: float
) -> tuple[float, FloatArray] | None:
    """Return the mean time and the mean values within `width_s` around a time; None if there are no values."""
    near = np.abs(times_s - at_s) <= width_s
    return (
        (float(times_s[near].mean()), values[near].mean(axis=0)) if near.any() else None
    )


def _least_turned(table: FloatArray) -> FloatArray:
    """Return deviations of positions in the map, shape (n, 2), if the frame of the positions is a sensor's.

    The yaw of the sensor is 0, or the yaw with the smallest deviations.
    """
    turned = table[:, 2] + 1j * table[:, 3]
    ego = table[:, 4] + 1j * table[:, 5]
    usual = np.median(np.abs(turned)) + np.median(np.abs(ego)) + 1e-9
    weights = (np.abs(turned) < 3.0 * usual) & (np.abs(ego) < 3.0 * usual)
    yaw_rad = float(np.angle(-np.sum(ego[weights] * turned[weights].conj())))
    candidates = [
        table[:, 4:6] + table[:, 2:4] @ rotation(yaw).T for yaw in (0.0, yaw_rad)
    ]
    return min(candidates, key=lambda each: float(np.median(np.hypot(*each.T))))


def is_optical(positions_m: FloatArray) -> bool | None:
    """True if y is the vertical axis of `positions_m` (n, 3), as in optical frames; False if z is; None if unclear.

    Objects on the ground hardly change their height.
    """
    if len(positions_m) < _FEWEST:
        return None
    low, high = np.quantile(positions_m, [0.1, 0.9], axis=0)
    x_m, y_m, z_m = (high - low).tolist()
    if y_m < _FLAT * min(x_m, z_m):
        return True
    return False if z_m < _FLAT * min(x_m, y_m) else None

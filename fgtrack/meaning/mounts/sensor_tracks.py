"""Tracklets of one sensor, and simultaneous positions of the tracklets of two sensors."""

from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import rotations
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.meaning.tracklets import Noise, Points, sights_m, tracklets

__all__ = ["Common", "SensorTracks", "Track", "common_positions", "sensor_tracks"]

#: Longest gap in which a position is interpolated, and most samples of the second sensor.
_GAP_S = 1.0
_MOST_SAMPLES = 2000


class Track(NamedTuple):
    """A tracklet of one sensor."""

    sensor: str
    rows: IntArray
    """Rows of its detections, in the order of time."""
    times_s: FloatArray
    turned_m: FloatArray
    """Positions, turned by the ego's yaw; in the map for a sensor in the map."""

    def at(self, times_s: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return interpolated positions (n, 2) at `times_s`, and the mask of the times between near detections."""
        k = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        inside = (times_s >= self.times_s[0]) & (times_s <= self.times_s[-1])
        gap_s = self.times_s[k] - self.times_s[k - 1]
        share = ((times_s - self.times_s[k - 1]) / gap_s)[:, None]
        at_m = self.turned_m[k - 1] * (1.0 - share) + self.turned_m[k] * share
        return at_m, inside & (gap_s < _GAP_S + 2.0 * np.median(np.diff(self.times_s)))


class SensorTracks(NamedTuple):
    """Detections of one sensor in tracklets."""

    points: Points
    noise: Noise
    tracks: list[Track]

    @property
    def std_m(self) -> float:
        """Standard deviation of a detection on each axis, at the median range."""
        ranges_m = np.hypot(*sights_m(self.points).T)
        return float(np.sqrt(self.noise.variances(np.median(ranges_m)).mean()))


def sensor_tracks(points: Points) -> SensorTracks:
    """Return the tracklets of one sensor."""
    chains, noise = tracklets(points)
    order = np.lexsort((points.stamps_s, chains))
    order = order[chains[order] >= 0]
    parts = np.split(order, np.flatnonzero(np.diff(chains[order])) + 1)
    turned_m = points.turned_m
    tracks = [
        Track(points.sensor, rows, points.stamps_s[rows], turned_m[rows])
        for rows in parts
        if len(rows)
    ]
    return SensorTracks(points, noise, tracks)


def in_body(sensor: SensorTracks, at_m: FloatArray, poses: FloatArray) -> FloatArray:
    """Return positions in the axes of tracklets, shape (n, 2), in the ego or sensor frame."""
    if sensor.points.in_map:
        at_m = at_m - poses[:, :2]
    return np.asarray(np.einsum("nij,nj->ni", rotations(-poses[:, 2]), at_m))


class Common(NamedTuple):
    """Simultaneous positions of tracklets of two sensors."""

    first_m: FloatArray
    """Positions in the ego or sensor frame of the first sensor, shape (n, 2)."""
    second_m: FloatArray
    pairs: IntArray
    """Numbers of the tracklets of both sensors, shape (n, 2)."""
    R: tuple[FloatArray, FloatArray]
    """Covariances in the frames of both sensors, each of shape (n, 2, 2)."""


def common_positions(first: SensorTracks, second: SensorTracks) -> Common | None:
    """Return the positions of both sensors at the stamps of the second one; None if no stamps are common."""
    parts: list[tuple[FloatArray, FloatArray, FloatArray, tuple[int, int]]] = []
    total = sum(len(track.rows) for track in second.tracks)
    step = max(1, total // _MOST_SAMPLES)
    for n, other in enumerate(second.tracks):
        times_s = other.times_s[::step]
        for m, track in enumerate(first.tracks):
            if track.times_s[0] > times_s[-1] or track.times_s[-1] < times_s[0]:
                continue
            at_m, known = track.at(times_s)
            if known.any():
                rows = other.rows[::step][known]
                parts.append(
                    (
                        at_m[known],
                        other.turned_m[::step][known],
                        second.points.poses[rows],
                        (m, n),
                    )
                )
    if not parts:
        return None
    first_m, second_m, poses = (
        np.concatenate([part[k] for part in parts]) for k in range(3)
    )
    pairs = np.repeat(
        [part[3] for part in parts], [len(part[0]) for part in parts], axis=0
    )
    u_m = in_body(first, first_m, poses)
    v_m = in_body(second, second_m, poses)
    return Common(
        u_m, v_m, pairs, (first.noise.covariances(u_m), second.noise.covariances(v_m))
    )

"""Scans of a sensor from the messages of a sample, with the pose of their frame."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from fgtrack.core.geometry import rotation
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, EgoState, FloatArray, Message
from fgtrack.meaning.motions import Scans
from fgtrack.models.sensors import Mount

__all__ = ["scans_of"]

#: Most lists of a sensor that are evaluated.
_MOST_LISTS = 2_000
#: A list is without a pose if the ego reports none within this time.
_NEAR_S = 1.0


def scans_of(
    messages: Iterable[Message],
    sensor: str,
    values: Callable[[Detection], Sequence[float | None]],
    mount: Mount | None = None,
    around_ego: bool = False,
) -> Scans | None:
    """Return the scans of `sensor`, with the raw `values` of each detection; None if they cannot be evaluated.

    Positions are x and y, or range and bearing. The pose is the ego's, the `mount` on the
    ego for lists in the frame of the sensor, or the map's. With `around_ego`, lists in the
    map are converted to the frame of the ego, if it is known. Lists without an ego state
    near them are left out. Lists of one stamp are joined.
    """
    lists: dict[int, list[DetectionList]] = {}
    ego: list[tuple[float, float, float, float]] = []
    first_ns: int | None = None
    for message in messages:
        if isinstance(message, EgoState):
            first_ns = message.stamp_ns if first_ns is None else first_ns
            seconds = (message.stamp_ns - first_ns) / NS_PER_S
            ego.append((seconds, message.x_m, message.y_m, message.yaw_rad))
        elif isinstance(message, DetectionList) and message.sensor == sensor:
            first_ns = message.stamp_ns if first_ns is None else first_ns
            lists.setdefault(message.stamp_ns, []).append(message)
    if first_ns is None or not lists:
        return None
    frames = {each.frame for same in lists.values() for each in same if each.objects}
    stamps_ns = sorted(lists)[:_MOST_LISTS]
    stamps_s = np.array([(stamp_ns - first_ns) / NS_PER_S for stamp_ns in stamps_ns])
    poses = np.zeros((len(stamps_s), 3))
    path = _path(np.array(ego).reshape(-1, 4))
    in_map = frames == {"map"}
    if not in_map and (len(frames) != 1 or path is None):
        return None
    if path is not None and (around_ego or not in_map):
        poses = np.column_stack(
            [np.interp(stamps_s, path[:, 0], column) for column in path.T[1:]]
        )
        if frames == {"sensor"} and mount is not None:
            poses = _mounted(poses, mount)
        after = np.searchsorted(path[:, 0], stamps_s).clip(1, len(path) - 1)
        gaps_s = np.minimum(
            np.abs(path[after, 0] - stamps_s), np.abs(path[after - 1, 0] - stamps_s)
        )
        kept = np.flatnonzero(gaps_s <= _NEAR_S)
        stamps_ns = [stamps_ns[k] for k in kept]
        stamps_s = stamps_s[kept]
        poses = poses[kept]
    positions = []
    raw = []
    width = len(values(Detection()))
    for stamp_ns in stamps_ns:
        rows = [
            (*at, *[np.nan if one is None else one for one in values(item)])
            for each in lists[stamp_ns]
            for item in each.objects
            if (at := _position_m(item)) is not None
        ]
        table = np.array(rows, dtype=np.float64).reshape(len(rows), 2 + width)
        positions.append(table[:, :2])
        raw.append(table[:, 2:])
    if in_map:
        positions = [
            (points_m - pose[:2]) @ rotation(pose[2])
            for points_m, pose in zip(positions, poses, strict=True)
        ]
    return Scans(stamps_s, positions, raw, poses)


def _mounted(poses: FloatArray, mount: Mount) -> FloatArray:
    """Return the poses of the sensor in the map, shape (n, 3), for `poses` of the ego."""
    c = np.cos(poses[:, 2])
    s = np.sin(poses[:, 2])
    return np.column_stack(
        [
            poses[:, 0] + c * mount.x_m - s * mount.y_m,
            poses[:, 1] + s * mount.x_m + c * mount.y_m,
            poses[:, 2] + mount.yaw_rad,
        ]
    )


def _path(ego: FloatArray) -> FloatArray | None:
    """Return seconds, x, y and unwrapped yaw of the ego in the order of stamps, shape (n, 4); None for fewer than
    two.
    """
    ego = ego[np.isfinite(ego).all(axis=1)]
    _, first = np.unique(ego[:, 0], return_index=True)
    ego = ego[first]
    if len(ego) < 2:
        return None
    ego[:, 3] = np.unwrap(ego[:, 3])
    return ego


def _position_m(item: Detection) -> tuple[float, float] | None:
    x_m, y_m = item.x_m, item.y_m
    if x_m is None or y_m is None:
        if item.range_m is None or item.bearing_rad is None:
            return None
        x_m = item.range_m * np.cos(item.bearing_rad)
        y_m = item.range_m * np.sin(item.bearing_rad)
    return (x_m, y_m) if np.isfinite(x_m) and np.isfinite(y_m) else None

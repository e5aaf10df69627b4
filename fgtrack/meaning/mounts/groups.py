"""Groups of sensors with common objects, and the objects of a group."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from fgtrack.meaning.mounts.alignment import GATES, YawRange, aligned, matched, refined
from fgtrack.meaning.mounts.pose import Pose2, inverse
from fgtrack.meaning.mounts.sensor_tracks import Common, SensorTracks, common_positions

__all__ = ["FEWEST_COMMON", "Group", "groups_of", "num_detections", "objects_of"]

#: Fewest common detections of two sensors, and smallest share of the detections that could be common.
FEWEST_COMMON = 60
_LEAST_COMMON = 0.3
#: The support of other yaws must be smaller by this factor.
_UNIQUE = 1.3


@dataclass
class Group:
    """Sensors with known mounts relative to a reference sensor, through common objects."""

    reference: str
    poses: dict[str, Pose2]
    """Mount of each sensor in the frame of the reference."""
    commons: dict[tuple[str, str], Common]
    support: dict[str, int] = field(default_factory=dict)
    """Number of detections of each sensor that another sensor of the group has in common."""


def groups_of(
    sensors: Mapping[str, SensorTracks],
    preferred: Sequence[str],
    yaws: Callable[[str], YawRange | None],
) -> list[Group]:
    """Return the groups of sensors with common objects; sensors in `preferred` come first as references.

    `yaws` returns the yaw of a single sensor in the ego; None if it is unknown.
    """
    commons: dict[tuple[str, str], Common] = {}
    links: list[tuple[float, str, str, Pose2]] = []
    for first, second in combinations(sensors, 2):
        common = common_positions(sensors[first], sensors[second])
        if common is None:
            continue
        commons[first, second] = common
        if sensors[first].points.in_map and sensors[second].points.in_map:
            links.append((float(FEWEST_COMMON), first, second, Pose2()))
            continue
        link = _link(common) or _link_by_yaws(common, yaws(first), yaws(second))
        if link is not None:
            links.append((*link[:1], first, second, link[1]))
    groups: list[Group] = []
    rest = sorted(
        sensors,
        key=lambda name: (_rank(name, preferred), -num_detections(sensors[name]), name),
    )
    while rest:
        group = Group(rest[0], {rest[0]: Pose2()}, commons)
        for _ in range(len(rest)):
            _extend(group, links)
        groups.append(group)
        rest = [name for name in rest if name not in group.poses]
    return groups


def _link(common: Common) -> tuple[float, Pose2] | None:
    """Return the number of common detections of two sensors, and the mount of the second one in the first.

    None if the mount is not unique.
    """
    start = aligned(common)
    pose, pairs = refined(common, start.pose)
    count = sum(pairs.values())
    # The sensor that detects less limits the number of common detections.
    possible = min(
        len(np.unique(each, axis=0)) for each in (common.first_m, common.second_m)
    )
    is_unique = start.support >= _UNIQUE * start.runner_up
    if is_unique and count >= max(FEWEST_COMMON, _LEAST_COMMON * possible):
        return float(count), pose
    return None


def _link_by_yaws(
    common: Common, first: YawRange | None, second: YawRange | None
) -> tuple[float, Pose2] | None:
    """Return the link of two sensors whose yaws in the ego are known; their views may hardly overlap."""
    if first is None or second is None:
        return None
    known = YawRange(second.yaw_rad - first.yaw_rad, first.error_rad + second.error_rad)
    start = aligned(common, known)
    pose, pairs = refined(common, start.pose)
    count = sum(pairs.values())
    is_near = math.cos(pose.yaw_rad - known.yaw_rad) >= math.cos(known.error_rad)
    is_unique = start.support >= _UNIQUE * start.runner_up
    if is_near and is_unique and count >= FEWEST_COMMON:
        return float(count), pose
    return None


def _rank(name: str, preferred: Sequence[str]) -> int:
    return preferred.index(name) if name in preferred else len(preferred)


def num_detections(sensor: SensorTracks) -> int:
    """Return the number of detections in tracklets."""
    return sum(len(track.rows) for track in sensor.tracks)


def _extend(group: Group, links: Sequence[tuple[float, str, str, Pose2]]) -> None:
    """Add the sensor with most support to the group; nothing changes if no link leads out of the group."""
    out = [
        link for link in links if (link[1] in group.poses) != (link[2] in group.poses)
    ]
    if not out:
        return
    _, first, second, pose = max(out, key=lambda link: (link[0], link[1:3]))
    if first in group.poses:
        group.poses[second] = pose.after(group.poses[first])
    else:
        group.poses[first] = inverse(pose).after(group.poses[second])


def objects_of(
    sensors: Mapping[str, SensorTracks], group: Group
) -> dict[tuple[str, int], int]:
    """Return the number of the object of each tracklet, given by its sensor and its index."""
    links: list[tuple[int, tuple[str, int], tuple[str, int]]] = []
    group.support = dict.fromkeys(group.poses, 0)
    for (first, second), common in group.commons.items():
        if first in group.poses and second in group.poses:
            pose = group.poses[second].after(inverse(group.poses[first]))
            for (m, n), count in matched(common, pose, GATES[-1]).items():
                links.append((count, (first, m), (second, n)))
                for name in (first, second):
                    group.support[name] += count
    names = [
        (name, k) for name in group.poses for k in range(len(sensors[name].tracks))
    ]
    owner = {name: number for number, name in enumerate(names)}
    members = {number: [name] for name, number in owner.items()}
    for _, one, other in sorted(links, key=lambda link: (-link[0], link[1:])):
        a, b = owner[one], owner[other]
        if a == b or any(
            _overlap(sensors, p, q) for p in members[a] for q in members[b]
        ):
            continue
        for member in members[b]:
            owner[member] = a
        members[a] += members.pop(b)
    return owner


def _overlap(
    sensors: Mapping[str, SensorTracks], one: tuple[str, int], other: tuple[str, int]
) -> bool:
    """True if two tracklets of one sensor exist at the same time: they belong to different objects."""
    if one[0] != other[0]:
        return False
    first, second = (sensors[name].tracks[k].times_s for name, k in (one, other))
    return bool(first[0] <= second[-1] and second[0] <= first[-1])

"""Mounts of sensors: yaw and lever arm, estimated from the detections of common objects and from the ego's motion.

Tracklets of two sensors are aligned coarsely (`alignment`). Aligned tracklets are the
paths of objects (`groups`). Generalised least squares over these paths (`fit`) estimates
the mounts of all sensors relative to a reference sensor. Objects that stand still show
the mount of the reference sensor in the ego (`reference`).

The standard deviations are a jackknife over stretches of time, as in
`fgtrack.clocks.offsets`: it includes time-correlated errors.
"""

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from fgtrack.meaning.mounts.estimate import (
    IN_MAP,
    UNKNOWN,
    MountEstimate,
    Mounts,
    Traffic,
)
from fgtrack.meaning.mounts.fit import Free, sight_errors, solved
from fgtrack.meaning.mounts.groups import (
    FEWEST_COMMON,
    Group,
    groups_of,
    num_detections,
)
from fgtrack.meaning.mounts.pose import Pose2
from fgtrack.meaning.mounts.reference import Reference, with_reference, yaw_of_sensor
from fgtrack.meaning.mounts.sensor_tracks import SensorTracks, sensor_tracks
from fgtrack.meaning.mounts.table import table_of
from fgtrack.meaning.tracklets import EgoMotion, Points

__all__ = ["MountEstimate", "Mounts", "Pose2", "estimated_mounts"]


def estimated_mounts(
    points: Mapping[str, Points],
    motion: EgoMotion,
    assumed: Mapping[str, Pose2] | None = None,
    preferred: Sequence[str] = (),
) -> Mounts:
    """Estimate the mounts of all sensors in `points`.

    `assumed` contains the assumed mounts by sensor; the others are 0. The reference of a
    group of sensors is in the map, or else the first of `preferred`, or else the sensor
    with most detections. Its assumed mount stays, unless objects that stand still show
    another one.
    """
    assumed = assumed or {}
    sensors = {
        name: sensor_tracks(item)
        for name, item in points.items()
        if len(item.points_m) >= FEWEST_COMMON
        and (item.in_map or motion)
        and np.isfinite(item.poses).all()
    }
    sensors = {name: item for name, item in sensors.items() if item.tracks}
    in_map = [name for name in sorted(sensors) if sensors[name].points.in_map]
    yaws = cache(lambda name: yaw_of_sensor(name, sensors[name], motion))
    found: dict[str, MountEstimate] = {}
    references: dict[str, str] = {}
    for group in groups_of(sensors, [*in_map, *preferred], yaws):
        for item in _group_estimates(sensors, group, motion, assumed):
            found[item.sensor] = item
            references[item.sensor] = group.reference
    for name in points:
        if name not in found:
            at = assumed.get(name, Pose2())
            why = "too few of its detections recur, or the ego's pose is unknown"
            found[name] = MountEstimate(name, *at, UNKNOWN, (0.0,) * 3, 0, why)
    return Mounts(
        tuple(found[name] for name in sorted(found)),
        references,
        frozenset([*in_map, *preferred]),
        frozenset(name for name, item in points.items() if item.in_map),
    )


def _group_estimates(
    sensors: Mapping[str, SensorTracks],
    group: Group,
    motion: EgoMotion,
    assumed: Mapping[str, Pose2],
) -> list[MountEstimate]:
    """Return the estimates for the sensors of a group."""
    names = list(group.poses)
    table = table_of(sensors, group)
    is_map = sensors[group.reference].points.in_map
    root = Pose2() if is_map else assumed.get(group.reference, Pose2())
    poses = list(group.poses.values())
    base = solved(table, poses, root, Free())
    poses = base.poses
    radial = sight_errors(table, poses, root)
    best = solved(table, poses, root, Free(radial=radial)) if radial else base
    reference = Reference(IN_MAP, "none")
    if not is_map:
        best, reference = with_reference(table, best, root, radial, motion)
    result = []
    for k, name in enumerate(names):
        if sensors[name].points.in_map:
            result.append(
                MountEstimate(name, 0.0, 0.0, 0.0, (0.0,) * 3, (0.0,) * 3, 0, IN_MAP)
            )
            continue
        pose = best.poses[k].after(best.root)
        count = group.support[name]
        why = f"{count} detections in common with other sensors"
        if k == 0:
            why = reference.why
        elif radial:
            why += ", with an error along the sight"
        stds = tuple(best.stds[3 * k : 3 * k + 3].tolist())
        dof = tuple(best.dof[3 * k : 3 * k + 3].tolist())
        traffic: Traffic = "none" if k else reference.traffic
        item = MountEstimate(
            name,
            *pose,
            stds,
            dof,
            count,
            why,
            traffic=traffic,
            detection_std_m=sensors[name].std_m,
            num_in_tracklets=num_detections(sensors[name]),
        )
        result.append(item.judged(assumed.get(name, Pose2())))
    return result

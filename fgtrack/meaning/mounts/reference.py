"""Mount of the reference sensor in the ego: its yaw by the traffic, and more by objects that stand still."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.geometry import rotation, wrap_angle
from fgtrack.core.jackknife import dof_of_sum
from fgtrack.core.types import FloatArray
from fgtrack.meaning.mounts.alignment import YawRange
from fgtrack.meaning.mounts.estimate import FEWEST_DOF, Traffic, is_significant
from fgtrack.meaning.mounts.fit import Free, Solution, solved
from fgtrack.meaning.mounts.groups import Group
from fgtrack.meaning.mounts.pose import QUARTER, Pose2
from fgtrack.meaning.mounts.sensor_tracks import SensorTracks
from fgtrack.meaning.mounts.table import Table, table_of
from fgtrack.meaning.mounts.traffic import TrafficYaw, traffic_yaw
from fgtrack.meaning.tracklets import EgoMotion

__all__ = ["Reference", "with_reference", "yaw_of_sensor"]

#: Probability at which the traffic shows a yaw, confirms the assumed one, and contradicts the assumed one.
_SHOWN = 0.98
_CONFIRMED = 0.9
_CONTRARY = 0.5
#: Factor of the probability of the assumed yaw at which it is likely: half of the lone sensors look ahead.
_ALLOWED = 5.0
#: Largest error of the yaw of a single sensor: in standard deviations, and an error beside them.
_ERROR_STDS = 3.0
_EXTRA_RAD = 0.02
#: Degrees of freedom of a yaw that the traffic shows: its standard deviation follows from a model, not from data.
_MODEL_DOF = 100.0


@dataclass(frozen=True)
class Reference:
    """Evidence on the mount of the reference sensor, in the ego."""

    why: str
    """A line on the evidence."""
    traffic: Traffic


def yaw_of_sensor(
    name: str, sensor: SensorTracks, motion: EgoMotion
) -> YawRange | None:
    """Return the yaw of a single sensor in the ego that the traffic shows; None if it is unknown."""
    if sensor.points.in_map:
        return YawRange(0.0, _EXTRA_RAD)
    table = table_of({name: sensor}, Group(name, {name: Pose2()}, {}))
    seen = traffic_yaw(table, [Pose2()], motion)
    if seen is None or seen.probability < _SHOWN:
        return None
    return YawRange(seen.yaw_rad, _EXTRA_RAD + _ERROR_STDS * seen.std_rad)


def with_reference(
    table: Table,
    base: Solution,
    root: Pose2,
    radial: tuple[int, ...],
    motion: EgoMotion,
) -> tuple[Solution, Reference]:
    """Return the solution with the mount of the reference, as far as the recording shows it, and the evidence."""
    seen = traffic_yaw(table, base.poses, motion)
    if seen is None:
        return base, Reference("the ego hardly moves", "none")
    is_assumed = seen.near(root.yaw_rad) >= _CONFIRMED
    if not is_assumed and seen.probability < _SHOWN:
        is_contrary = seen.probability >= _CONTRARY
        yaw_deg = np.degrees(seen.yaw_rad)
        factor = seen.factor(root.yaw_rad)
        if not is_contrary and factor >= _ALLOWED:
            why = (
                f"the traffic is {factor:.0f} times as probable as for an average axis, "
                "but few objects pass the ego"
            )
            return base, Reference(why, "allows")
        why = (
            f"its axis is at {yaw_deg:.0f} degrees with a probability of {seen.probability:.0%}, "
            "by objects that stand still or move along the ego's path"
            if is_contrary
            else "too few objects stand still or move along the ego's path"
        )
        return base, Reference(why, "contradicts" if is_contrary else "undecided")
    why = f"{seen.num_objects} objects stand still or move along the ego's path"
    result = _turned(base, root, seen)
    for which in ((True, False, False), (True, True, True)):
        fit = solved(table, base.poses, result.root, Free(which, radial))
        d = np.array(fit.root) - np.array(root)
        d[0] = wrap_angle(float(d[0]))
        sure = is_significant(d, fit.stds[:3], fit.dof[:3])
        is_known = fit.dof[0] >= FEWEST_DOF and seen.near(fit.root.yaw_rad) > _CONTRARY
        is_better = is_known and fit.stds[0] < result.stds[0]
        if is_better and (sure[1:].any() if which[1] else sure[0]):
            result = fit
            why = f"{fit.still} objects stand still"
        elif is_better and not which[1]:
            result = result._replace(
                stds=np.concatenate([fit.stds[:1], result.stds[1:]]),
                dof=np.concatenate([fit.dof[:1], result.dof[1:]]),
            )
    return result, Reference(why, "shows")


def _turned(base: Solution, root: Pose2, seen: TrafficYaw) -> Solution:
    """Return the solution with the yaw of the traffic, or with the assumed yaw if both hardly differ.

    The standard deviation of a yaw of the traffic counts for all sensors.
    """
    d = np.array([wrap_angle(seen.yaw_rad - root.yaw_rad), 0.0, 0.0])
    unknown = np.array([seen.std_rad, np.inf, np.inf])
    stds = base.stds.copy()
    dof = base.dof.copy()
    if is_significant(d, unknown, np.full(3, _MODEL_DOF))[0]:
        root = Pose2(seen.yaw_rad, root.x_m, root.y_m)
        moves = _moves_by_yaw(base.poses, root)
        moved = slice(3, len(moves))
        own = np.square(stds[moved])
        common = np.square(seen.std_rad * moves[moved])
        stds[moved] = np.sqrt(own + common)
        dof[moved] = dof_of_sum(own, dof[moved], common, _MODEL_DOF)
    stds[0] = seen.std_rad
    dof[0] = _MODEL_DOF
    return base._replace(root=root, stds=stds, dof=dof)


def _moves_by_yaw(poses: Sequence[Pose2], root: Pose2) -> FloatArray:
    """Return the derivatives of yaw, x and y of all sensors by the yaw of the reference, shape (3 n,)."""
    rows = [
        (1.0, *np.abs(rotation(root.yaw_rad) @ QUARTER @ pose.shift_m))
        for pose in poses
    ]
    return np.array(rows).ravel()

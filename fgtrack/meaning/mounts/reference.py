"""Mount of the reference sensor in the ego, which objects that stand still show."""

import math

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import FloatArray
from fgtrack.meaning.mounts.alignment import STEP_RAD, YAWS_RAD
from fgtrack.meaning.mounts.estimate import FEWEST_DOF, is_significant
from fgtrack.meaning.mounts.fit import (
    SHORTEST_STILL_S,
    STILL_MPS,
    Free,
    Solution,
    solved,
)
from fgtrack.meaning.mounts.pose import Pose2
from fgtrack.meaning.mounts.table import Table, rows_of
from fgtrack.meaning.object_fit import filtered
from fgtrack.meaning.tracklets import EgoMotion

__all__ = ["with_reference"]

#: The slowest ego that shows objects that stand still.
_SLOWEST_EGO_MPS = 3.0
#: Difference from the assumed yaw from which few still objects speak against it.
_CONTRARY_RAD = 0.1


def turn_of_still(table: Table, velocities_mps: FloatArray, motion: EgoMotion) -> float:
    """Return the yaw by which the reference must turn so that most detections are of objects that stand still.

    `velocities_mps` are those of the runs in the map, for the assumed mount. Short runs
    do not count, because they hardly show a velocity.
    """
    starts = np.flatnonzero(np.diff(table.runs, prepend=-1))
    ends = np.append(starts[1:], len(table.runs)) - 1
    times_s = table.times_s[ends]
    counts = ends - starts + 1
    span = np.array([-0.5, 0.5])
    at_m = [motion.poses(times_s + shift)[:, :2] for shift in span]
    ego_mps = (at_m[1] - at_m[0]) / np.ptp(span)
    relative_mps = velocities_mps - ego_mps
    speeds_mps = np.hypot(*ego_mps.T)
    gaps_mps = np.abs(np.hypot(*relative_mps.T) - speeds_mps)
    usable = (speeds_mps > _SLOWEST_EGO_MPS) & (gaps_mps < STILL_MPS)
    usable &= times_s - table.times_s[starts] > SHORTEST_STILL_S
    if not usable.any():
        return 0.0
    counts = counts[usable]
    turn = np.arctan2(*-ego_mps[usable].T[::-1]) - np.arctan2(
        *relative_mps[usable].T[::-1]
    )
    near = np.cos(turn[:, None] - YAWS_RAD) > math.cos(2.0 * STEP_RAD)
    votes = counts @ near
    zero = int(counts[np.cos(turn) > math.cos(2.0 * STEP_RAD)].sum())
    if 2 * zero >= votes.max():
        return 0.0
    chosen = near[:, int(votes.argmax())]
    x, y = counts[chosen] @ np.cos(turn[chosen]), counts[chosen] @ np.sin(turn[chosen])
    return math.atan2(float(y), float(x))


def with_reference(
    table: Table,
    base: Solution,
    root: Pose2,
    radial: tuple[int, ...],
    motion: EgoMotion,
) -> Solution:
    """Return the solution with the mount of the reference that still objects show, as far as it is significant."""
    rows = rows_of(table, base.poses, root, np.zeros(len(table.runs), dtype=bool), ())
    velocities_mps = filtered(rows).velocities_mps
    turn_rad = turn_of_still(table, velocities_mps, motion)
    turned = Pose2(wrap_angle(root.yaw_rad + turn_rad), root.x_m, root.y_m)
    result = base
    is_shown = False
    still = 0
    for which in ((True, False, False), (True, True, True)):
        fit = solved(table, base.poses, turned, Free(which, radial))
        d = np.array(
            [
                wrap_angle(fit.root.yaw_rad - root.yaw_rad),
                fit.root.x_m - root.x_m,
                fit.root.y_m - root.y_m,
            ]
        )
        sure = is_significant(d, fit.stds[:3], fit.dof[:3])
        if which[1] and not sure[1:].any():
            continue
        still = max(still, fit.still)
        if sure.any():
            result = fit
            is_shown = True
        elif not which[1] and fit.dof[0] >= FEWEST_DOF:
            result = result._replace(
                still=fit.still,
                stds=np.concatenate([fit.stds[:1], base.stds[1:]]),
                dof=np.concatenate([fit.dof[:1], base.dof[1:]]),
            )
    is_contrary = not is_shown and still > 0 and abs(turn_rad) > _CONTRARY_RAD
    return result._replace(contrary_yaw_rad=turned.yaw_rad if is_contrary else None)

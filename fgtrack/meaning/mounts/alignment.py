"""Alignment of two sensors: the pose of the second sensor in the first at which their tracklets coincide.

A search over all yaws counts common offsets. Then gates that become narrower choose the
tracklets of common objects, and robust least squares refines the pose.
"""

import math
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import rotation
from fgtrack.core.linalg import psd_solve
from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.meaning.mounts.pose import QUARTER, Pose2
from fgtrack.meaning.mounts.sensor_tracks import Common

__all__ = [
    "GATES",
    "ANY_YAW",
    "Alignment",
    "YawRange",
    "aligned",
    "matched",
    "refined",
]

#: Step of the yaw, size of the cells of offsets, and largest and usual lever arm between two sensors.
_STEP_RAD = math.radians(2.0)
_YAWS_RAD = np.arange(-math.pi, math.pi, _STEP_RAD)
_CELL_M = 1.0
_REACH_M = 12.0
_USUAL_ARM_M = 5.0
_CELLS = round(2.0 * _REACH_M / _CELL_M)
#: Yaws and offsets that differ by more are rivals.
_OTHER_RAD = 0.3
_OTHER_M = 3.0
#: Gates of two tracklets of one object, in standard deviations, and the usual error of the alignment before each.
GATES = ((4.0, 1.0, 0.03), (4.0, 0.4, 0.01), (4.0, 0.2, 0.005))
#: Weak prior of the lever arm, as a standard deviation: vehicles are shorter.
_PRIOR_M = 20.0


class YawRange(NamedTuple):
    """Yaw in rad, and the largest error that it may have."""

    yaw_rad: float
    error_rad: float


ANY_YAW = YawRange(0.0, math.pi)


class Alignment(NamedTuple):
    """Mount of a sensor relative to another one."""

    pose: Pose2
    support: float
    """Number of common detections, less for long lever arms."""
    runner_up: float = 0.0
    """Largest support of a rival."""


def aligned(common: Common, known: YawRange = ANY_YAW) -> Alignment:
    """Return the mount of the second sensor in the frame of the first, by a search over yaws and offsets.

    The search is restricted to the yaws in `known`. Then a rival has another offset;
    otherwise it has another yaw.
    """
    turns = np.cos(_YAWS_RAD - known.yaw_rad) >= math.cos(known.error_rad)
    yaws_rad = _YAWS_RAD[turns]
    centres_m = (np.arange(_CELLS) + 0.5) * _CELL_M - _REACH_M
    arms_m2 = np.square(centres_m)[:, None] + np.square(centres_m)
    prior = np.exp(-0.5 * arms_m2 / _USUAL_ARM_M**2)
    support = np.array([_counts(common, yaw) * prior for yaw in yaws_rad.tolist()])
    best, row, column = np.unravel_index(int(np.argmax(support)), support.shape)
    pose = Pose2(float(yaws_rad[best]), float(centres_m[row]), float(centres_m[column]))
    if turns.all():
        rivals = support[np.cos(yaws_rad - pose.yaw_rad) < math.cos(_OTHER_RAD)]
    else:
        away_m = np.hypot(centres_m[:, None] - pose.x_m, centres_m - pose.y_m)
        rivals = support[:, away_m > _OTHER_M]
    return Alignment(
        pose, float(support[best, row, column]), float(rivals.max(initial=0.0))
    )


def _counts(common: Common, yaw_rad: float) -> FloatArray:
    """Return the numbers of common positions at offsets x, y near the centre of each cell."""
    offsets_m = common.first_m - common.second_m @ rotation(yaw_rad).T
    cells = (offsets_m + _REACH_M) // _CELL_M
    inside = ((cells >= 0) & (cells < _CELLS)).all(axis=1)
    x, y = cells[inside].astype(np.int64).T
    counts = np.bincount(x * _CELLS + y, minlength=_CELLS**2).astype(float)
    padded = np.pad(counts.reshape(_CELLS, _CELLS), 1)
    near = [padded[i : i + _CELLS, j : j + _CELLS] for i in range(3) for j in range(3)]
    return np.asarray(sum(near))


def matched(
    common: Common, pose: Pose2, gate: tuple[float, float, float]
) -> dict[tuple[int, int], int]:
    """Return the pairs of tracklets of one object, with their numbers of common detections."""
    limit, error_m, error_rad = gate
    turn = rotation(pose.yaw_rad)
    gap_m = common.first_m - pose.moved(common.second_m)
    C = common.R[0] + turn @ common.R[1] @ turn.T
    ranges_m = np.hypot(*common.second_m.T)
    C = C + (error_m**2 + (error_rad * ranges_m) ** 2)[:, None, None] * np.eye(2)
    d = np.sqrt(np.einsum("ni,ni->n", gap_m, psd_solve(C, gap_m[:, :, None])[:, :, 0]))
    size = int(common.pairs[:, 1].max()) + 1
    keys, inverse = np.unique(
        common.pairs[:, 0] * size + common.pairs[:, 1], return_inverse=True
    )
    medians = np.array(
        [
            np.median(part)
            for part in np.split(
                d[np.argsort(inverse, kind="stable")],
                np.cumsum(np.bincount(inverse))[:-1],
            )
        ]
    )
    counts = np.bincount(inverse)
    result: dict[tuple[int, int], int] = {}
    for row in np.argsort(
        medians - 0.02 * np.minimum(counts, 50), kind="stable"
    ).tolist():
        if medians[row] < limit and counts[row] >= 3:
            m, n = divmod(int(keys[row]), size)
            result[m, n] = int(counts[row])
    return result


def refined(common: Common, pose: Pose2) -> tuple[Pose2, dict[tuple[int, int], int]]:
    """Return the mount and the matched tracklets, with gates that become narrower."""
    links: dict[tuple[int, int], int] = {}
    size = int(common.pairs[:, 1].max()) + 1
    keys = common.pairs[:, 0] * size + common.pairs[:, 1]
    for gate in GATES:
        links = matched(common, pose, gate)
        rows = np.isin(keys, [m * size + n for m, n in links])
        if rows.sum() < 10:
            break
        pose = _rigid(common, rows, pose)
    return pose, links


def _rigid(common: Common, rows: BoolArray, pose: Pose2) -> Pose2:
    """Return the pose by robust least squares over the common positions in `rows`."""
    u_m, v_m = common.first_m[rows], common.second_m[rows]
    for _ in range(5):
        turn = rotation(pose.yaw_rad)
        C = common.R[0][rows] + turn @ common.R[1][rows] @ turn.T
        r = u_m - pose.moved(v_m)
        A = np.zeros((len(r), 2, 3))
        A[:, :, 0] = v_m @ (turn @ QUARTER).T
        A[:, 0, 1] = A[:, 1, 2] = 1.0
        whitened = psd_solve(C, np.concatenate([A, r[:, :, None]], axis=2))
        nis = np.einsum("ni,ni->n", r, whitened[:, :, 3])
        weights = 1.0 / np.maximum(1.0, np.sqrt(nis) / 2.0)
        H = np.einsum("n,nki,nkj->ij", weights, A, whitened[:, :, :3])
        H += np.diag([1e-6, 1.0 / _PRIOR_M**2, 1.0 / _PRIOR_M**2])
        g = np.einsum("n,nki,nk->i", weights, A, whitened[:, :, 3])
        pose = pose.shifted(psd_solve(H, g))
    return pose

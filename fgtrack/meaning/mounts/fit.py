"""Generalised least squares for the mounts of a group of sensors, with standard deviations by a jackknife."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import rotation
from fgtrack.core.jackknife import Information, dof_of_sum, jackknife
from fgtrack.core.linalg import psd_solve
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.meaning.mounts.estimate import FEWEST_DOF, SMALLEST_M, SURE, t_quantile
from fgtrack.meaning.mounts.pose import QUARTER, Pose2
from fgtrack.meaning.mounts.table import Table, rows_of
from fgtrack.meaning.object_fit import filtered

__all__ = [
    "SHORTEST_STILL_S",
    "STILL_MPS",
    "Free",
    "Solution",
    "sight_errors",
    "solved",
]

_ROUNDS = 5
#: Weak prior, as standard deviations: lever arms on vehicles, and errors along the sight, which hulls cause.
_PRIOR_M = 5.0
_PRIOR_SIGHT_M = 3.0
_PRIOR_RAD = 100.0
_CONVERGED = 1e-3
#: Standard deviation of the detected points of a hull, and degrees of freedom of objects that show that they differ.
_HULL_M = 1.0
_FEWEST_OBJECTS_DOF = 1.5
#: Degrees of freedom of this standard deviation, which is known from experience.
_HULL_DOF = 20.0
#: Degrees of freedom of the model of the noise, and largest chance at which a jackknife counts as larger.
_MODEL_DOF = 6.0
_LARGER = 0.05
#: Speed of an object that may stand still, and its shortest observation.
STILL_MPS = 0.5
SHORTEST_STILL_S = 1.0


class Solution(NamedTuple):
    """Mounts of a group, and their uncertainty."""

    root: Pose2
    """Mount of the reference in the ego."""
    poses: list[Pose2]
    """Mount of each sensor in the reference."""
    radial_m: FloatArray
    """Errors along the sight."""
    stds: FloatArray
    """Standard deviations of the mounts in the ego, shape (count, 3), then of the errors along the sight."""
    dof: FloatArray
    still: int
    """Number of objects that stand still."""


class Free(NamedTuple):
    """Free parameters of a fit: of the reference's mount, and sensors with an error along the sight."""

    root: tuple[bool, bool, bool] = (False, False, False)
    radial: tuple[int, ...] = ()


def solved(table: Table, poses: Sequence[Pose2], root: Pose2, free: Free) -> Solution:
    """Return the mounts with which the objects move most smoothly, or stand still."""
    poses = list(poses)
    count = len(poses)
    size = 3 * count + len(free.radial)
    radial_m = np.zeros(len(free.radial))
    prior = np.full(size, _PRIOR_M**-2.0)
    prior[: 3 * count : 3] = _PRIOR_RAD**-2.0
    prior[3 * count :] = _PRIOR_SIGHT_M**-2.0
    still = np.zeros(len(table.runs), dtype=bool)
    used = np.zeros(size, dtype=bool)
    used[:3] = free.root
    used[3:] = True
    for number in range(_ROUNDS):
        rows = rows_of(table, poses, root, still, free.radial)
        rows.y_m[...] += rows.A[:, :, 3 * count :] @ radial_m
        fit = filtered(rows)
        if any(free.root) and number < 2:
            still = still_mask(table, fit.velocities_mps)
        H = fit.H.sum(axis=0) + np.diag(prior)
        values = np.concatenate([[0.0, *pose[1:]] for pose in (root, *poses[1:])])
        g = fit.g.sum(axis=0) + prior * np.concatenate([values, radial_m])
        d = np.zeros(size)
        if used.any():
            d[used] = -psd_solve(H[np.ix_(used, used)], g[used])
        root = root.shifted(d[:3])
        poses[1:] = [
            pose.shifted(d[3 * k : 3 * k + 3]) for k, pose in enumerate(poses[1:], 1)
        ]
        radial_m = radial_m + d[3 * count :]
        if number > 1 and np.abs(d).max() < _CONVERGED:
            break
    first = np.flatnonzero(np.diff(table.runs, prepend=-1))
    hulls = np.full(size, _HULL_M)
    hulls[: 3 * count : 3] /= max(float(np.median(np.hypot(*table.points_m.T))), 1.0)
    std, dof = _spread(
        Information(fit.H[:, used][:, :, used], fit.g[:, used], prior[used]),
        _absolute(poses, root, size)[:, used],
        table.stretches[first],
        table.objects[first],
        hulls,
    )
    num_still = len(np.unique(table.objects[still]))
    return Solution(root, poses, radial_m, std, dof, num_still)


def _absolute(poses: Sequence[Pose2], root: Pose2, size: int) -> FloatArray:
    """Return the Jacobian of the mounts in the ego and of the errors along the sight by the parameters, shape
    (size, size).
    """
    L = np.eye(size)
    turn = rotation(root.yaw_rad)
    for k, pose in enumerate(poses[1:], 1):
        rows = slice(3 * k, 3 * k + 3)
        L[rows, :3] = np.eye(3)
        L[3 * k + 1 : 3 * k + 3, 0] = turn @ QUARTER @ pose.shift_m
        L[3 * k + 1 : 3 * k + 3, 3 * k + 1 : 3 * k + 3] = turn
    return L


def _spread(
    data: Information,
    functions: FloatArray,
    stretches: IntArray,
    objects: IntArray,
    hulls: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations and degrees of freedom: a jackknife over stretches, longer stretches, and objects.

    Errors may be correlated over longer times, or along each object. Then the jackknife
    over those clusters is significantly larger, and counts. One or two objects cannot
    show that their hulls are no cause. Then `hulls`, the usual standard deviation of the
    detected points of a hull, is added.
    """
    from scipy.special import fdtrc

    std, dof = jackknife(data, stretches, functions)
    for clusters in (stretches // 3, objects):
        other, other_dof = jackknife(data, clusters, functions)
        known = (other_dof >= FEWEST_DOF) & (dof > 0.0)
        ratio = np.square(np.where(known, other, 0.0) / np.where(known, std, 1.0))
        chance = fdtrc(np.maximum(other_dof, 1e-3), np.maximum(dof, 1e-3), ratio)
        larger = known & (chance < _LARGER)
        std = np.where(larger, other, std)
        dof = np.where(larger, other_dof, dof)
    std, dof = _moderated(data, functions, std, dof)
    few = other_dof < _FEWEST_OBJECTS_DOF
    share = np.square(hulls) / (1.0 + np.maximum(other_dof, 0.0))
    dof = np.where(few, dof_of_sum(np.square(std), dof, share, _HULL_DOF), dof)
    return np.where(few, np.sqrt(np.square(std) + share), std), dof


def _moderated(
    data: Information, functions: FloatArray, std: FloatArray, dof: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations and degrees of freedom, moderated by those of the model of the noise.

    The jackknife is unbiased but has few degrees of freedom. Its variance and the
    variance of the model are averaged with their degrees of freedom as weights (Smyth,
    Statistical Applications in Genetics and Molecular Biology 3, 2004), unless the
    jackknife is significantly larger: then the model is wrong.
    """
    from scipy.special import fdtrc

    if not data.g.shape[1]:
        return std, dof
    total = data.H.sum(axis=0) + np.diag(data.prior)
    model = np.einsum("ij,ji->i", functions, psd_solve(total, functions.T))
    known = (dof >= FEWEST_DOF) & np.isfinite(std) & (model > 0.0)
    square = np.square(np.where(known, std, 1.0))
    model = np.where(known, model, 1.0)
    chance = fdtrc(np.maximum(dof, 1e-3), _MODEL_DOF, square / model)
    agrees = known & (chance >= _LARGER)
    mean = (_MODEL_DOF * model + dof * square) / (_MODEL_DOF + dof)
    return (
        np.where(agrees, np.sqrt(mean), std),
        np.where(agrees, _MODEL_DOF + dof, dof),
    )


def sight_errors(table: Table, poses: Sequence[Pose2], root: Pose2) -> tuple[int, ...]:
    """Return the indices of the sensors with a significant position error along the line of sight.

    Sensors that show the near sides of hulls are an example.
    """
    count = len(poses)
    candidates = tuple(range(1, count))
    if not candidates:
        return ()
    fit = solved(table, poses, root, Free(radial=candidates))
    stds = fit.stds[3 * count :]
    dof = fit.dof[3 * count :]
    factor = t_quantile(dof, 1.0 - SURE)
    limit = np.where(dof >= FEWEST_DOF, stds, np.inf) * factor
    kept = (np.abs(fit.radial_m) > limit) & (np.abs(fit.radial_m) > SMALLEST_M)
    return tuple(np.array(candidates)[kept].tolist())


def still_mask(table: Table, velocities_mps: FloatArray) -> BoolArray:
    """Return True for each detection in a run of an object that stands still."""
    starts = np.flatnonzero(np.diff(table.runs, prepend=-1))
    ends = np.append(starts[1:], len(table.runs)) - 1
    lengths_s = table.times_s[ends] - table.times_s[starts]
    slow = np.hypot(*velocities_mps.T) < STILL_MPS
    return np.asarray((slow & (lengths_s > SHORTEST_STILL_S))[table.runs])

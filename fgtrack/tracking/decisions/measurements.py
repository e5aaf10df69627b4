"""Measurements of candidates: densities of pairs with states, and corrections of states."""

import math
from collections.abc import Sequence

import numpy as np

from fgtrack.core.linalg import kernels, stacked
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.models.robust import compiled_form
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.preprocess import Group

_KALMAN = "fgtrack.estimation.kernels.kalman"


def log_densities(
    entry: Entry,
    rows: IntArray,
    columns: IntArray,
    means: FloatArray,
    covariances: FloatArray,
) -> FloatArray:
    """Return the log-densities of pairs of states and candidates, shape (p,); NaN if S is not definite."""
    result = np.empty(len(rows))
    for group, members, here in split(entry.groups, columns):
        result[here] = _of_group(group, members, rows.take(here), means, covariances)
    return result


def _of_group(
    group: Group,
    members: IntArray,
    of: IntArray,
    means: FloatArray,
    covariances: FloatArray,
) -> FloatArray:
    """Return log N(z; h(x), S) of pairs of members of a group and states, shape (p,); NaN if S is not definite."""
    own = group.stack
    x = means.take(of, axis=0)
    y, H = own.model.linearised(own.z.take(members, axis=0), x, own.pose)
    R = group.noise(members, x, covariances, of)
    every = np.arange(y.shape[1])
    _, nis, logdet = kernels(_KALMAN).innovations(
        y, stacked(H), np.ascontiguousarray(covariances), of, R, every
    )
    return np.asarray(-0.5 * (nis + logdet + y.shape[1] * math.log(math.tau)))


def split(
    groups: Sequence[Group], columns: IntArray
) -> list[tuple[Group, IntArray, IntArray]]:
    """Return each group with candidates of `columns`, their indices in the group, and their indices in `columns`."""
    if len(groups) == 1:
        return [(groups[0], columns, np.arange(len(columns)))]
    parts = []
    for group in groups:
        members = np.searchsorted(group.rows, columns)
        here = np.flatnonzero(group.rows.take(members, mode="clip") == columns)
        if len(here):
            parts.append((group, members[here], here))
    return parts


def correct(
    group: Group, members: IntArray, means: FloatArray, covariances: FloatArray
) -> None:
    """Fuse members of a group into the states (p, n), (p, n, n), which are overwritten."""
    own = group.stack
    y, H = own.model.linearised(own.z.take(members, axis=0), means, own.pose)
    p, k = y.shape
    R = group.noise(members, means, covariances, np.arange(p))
    loss, width = compiled_form(own.loss, k)
    kernels(_KALMAN).correct(
        means,
        covariances,
        np.ascontiguousarray(y),
        stacked(H),
        np.ascontiguousarray(R),
        np.arange(k),
        loss,
        width,
        np.empty((p, k, k)),
        np.empty(p),
        np.empty(p),
    )


def renewed(
    means: FloatArray, covariances: FloatArray, entry: Entry
) -> tuple[FloatArray, FloatArray] | None:
    """Return states whose errors of the sensor are new; None if errors do not jump."""
    if not (entry.jump_probability and entry.errors):
        return None
    x, P = means.copy(), covariances.copy()
    x[:, entry.errors] = 0.0
    P[:, entry.errors] = P[:, :, entry.errors] = 0.0
    P[:, entry.errors, entry.errors] = 1.0
    return x, P

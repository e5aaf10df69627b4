"""True objects as functions of time."""

from dataclasses import dataclass

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import EGO_ID, FloatArray, IntArray
from fgtrack.io.run import Table

#: What is interpolated, in the order of the columns of `TruePath.at`.
TRUE_STATE = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")

_SHORTEST_GAP_NS = NS_PER_S
_GAP_PERIODS = 5


@dataclass(frozen=True)
class TruePath:
    """Truth of one object: distinct stamps in rising order and the states there."""

    object_id: int
    stamps_ns: IntArray
    """Shape (n,)."""
    states: FloatArray
    """x, y, yaw, speed, yaw rate, shape (n, 5); NaN where the truth has no value."""

    def at(self, stamps_ns: IntArray) -> FloatArray:
        """States at `stamps_ns`, shape (m,); shape (m, 5), NaN where there is no truth.

        The position is a cubic Hermite curve where both neighbours have yaw and speed, else linear. Yaw goes
        the shorter way round, the rest is linear. There is no truth before the first stamp, after the last one,
        and in a gap: neighbours more than a second and more than five usual periods apart (the object was
        away).
        """
        if len(self.stamps_ns) == 1:
            return np.where((stamps_ns == self.stamps_ns[0])[:, None], self.states[0], np.nan)
        periods_ns = np.diff(self.stamps_ns)
        left = np.clip(np.searchsorted(self.stamps_ns, stamps_ns, side="right") - 1, 0, len(periods_ns) - 1)
        h_ns = periods_ns[left]
        u = (stamps_ns - self.stamps_ns[left]) / h_ns
        a, b = self.states[left], self.states[left + 1]
        states = a + u[:, None] * (b - a)
        both = np.isfinite(states[:, 2])
        turned_rad = u[both] * wrap_angles(b[both, 2] - a[both, 2])
        states[both, 2] = wrap_angles(a[both, 2] + turned_rad)
        curve = _hermite(a, b, u, h_ns / NS_PER_S)
        states[:, :2] = np.where(np.isfinite(curve), curve, states[:, :2])
        away = h_ns > max(_SHORTEST_GAP_NS, _GAP_PERIODS * float(np.median(periods_ns)))
        outside = (u < 0.0) | (u > 1.0) | (away & (u > 0.0) & (u < 1.0))
        states[outside] = np.nan
        # At a truth stamp the state is the recorded one: a neighbour without a value must not blank it.
        for end, where in ((a, u == 0.0), (b, u == 1.0)):
            states[where] = end[where]
        return states


def true_paths(truth: Table) -> list[TruePath]:
    """Every true object but the ego, by rising id.

    Of several rows with one stamp the last counts. A value beyond `LARGEST`, as of a detection, is none; rows without a
    position are no truth.
    """
    rows = np.stack([truth[name] for name in TRUE_STATE], axis=-1)
    rows[~(np.abs(rows) <= LARGEST)] = np.nan
    usable = np.isfinite(rows[:, :2]).all(axis=1)
    paths = []
    for object_id in np.unique(truth["object_id"][usable]).tolist():
        if object_id == EGO_ID:
            continue
        mine = np.flatnonzero(usable & (truth["object_id"] == object_id))[::-1]
        stamps_ns, newest = np.unique(truth["stamp_ns"][mine], return_index=True)
        paths.append(TruePath(object_id, stamps_ns, rows[mine[newest]]))
    return paths


def _hermite(a: FloatArray, b: FloatArray, u: FloatArray, h_s: FloatArray) -> FloatArray:
    """Positions, shape (m, 2), at the share `u` of the way from `a` to `b`, `h_s` seconds apart."""
    u, h_s = u[:, None], h_s[:, None]
    from_a = (1 + 2 * u) * (1 - u) ** 2 * a[:, :2] + u * (1 - u) ** 2 * h_s * _velocity(a)
    from_b = u**2 * (3 - 2 * u) * b[:, :2] - u**2 * (1 - u) * h_s * _velocity(b)
    return np.asarray(from_a + from_b)


def _velocity(states: FloatArray) -> FloatArray:
    yaw_rad, speed_mps = states[:, 2], states[:, 3]
    return np.stack([speed_mps * np.cos(yaw_rad), speed_mps * np.sin(yaw_rad)], axis=-1)

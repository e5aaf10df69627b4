"""Truth of a run: paths of true objects, their visibility to the sensors, and ignored objects and regions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import TypeAdapter

from fgtrack.core.checks import LARGEST
from fgtrack.core.geometry import cartesian, in_polygon, wrap_angles
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import EGO_ID, BoolArray, FloatArray, IntArray
from fgtrack.models.sensors import SensorModel
from fgtrack.runs import Columns, Run

#: Interpolated quantities, in the order of the columns of `TruePath.at`.
TRUE_STATE = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
_SHORTEST_GAP_NS = NS_PER_S
_GAP_PERIODS = 5
_AROUND_NS = 60 * NS_PER_S
# Number of states that are interpolated together.
_BLOCK_ROWS = 1 << 15
# Number of ticks at which all objects are interpolated together.
_BLOCK_TICKS = 1 << 13


@dataclass(frozen=True)
class TruePath:
    """Truth of one object over time."""

    object_id: int
    stamps_ns: IntArray
    """Distinct stamps in ascending order, shape (n,)."""
    states: FloatArray
    """x, y, yaw, speed and yaw rate at the stamps, shape (n, 5); NaN where the truth has no value."""

    @cached_property
    def _longest_gap_ns(self) -> float:
        median_ns = float(np.median(np.diff(self.stamps_ns)))
        return max(_SHORTEST_GAP_NS, _GAP_PERIODS * median_ns)

    def at(self, stamps_ns: IntArray) -> FloatArray:
        """Return the states at `stamps_ns` (m,), shape (m, 5); NaN without truth.

        The position is a cubic Hermite curve if both neighbours have yaw and speed,
        else linear. All other entries are linear. There is no truth before the first
        and after the last stamp, nor in long gaps. A gap is long if it exceeds both a
        second and five median periods.
        """
        if len(self.stamps_ns) == 1:
            return np.where(
                (stamps_ns == self.stamps_ns[0])[:, None], self.states[0], np.nan
            )
        left = np.clip(
            np.searchsorted(self.stamps_ns, stamps_ns, side="right") - 1,
            0,
            len(self.stamps_ns) - 2,
        )
        h_ns = self.stamps_ns[left + 1] - self.stamps_ns[left]
        u = (stamps_ns - self.stamps_ns[left]) / h_ns
        a = self.states[left]
        b = self.states[left + 1]
        states = a + u[:, None] * (b - a)
        states[:, 2] = wrap_angles(a[:, 2] + u * wrap_angles(b[:, 2] - a[:, 2]))
        v = u[:, None]
        h_s = h_ns[:, None] / NS_PER_S
        way_a, way_b = (h_s * cartesian(each[:, 2:4]) for each in (a, b))
        from_a = (1 + 2 * v) * (1 - v) ** 2 * a[:, :2] + v * (1 - v) ** 2 * way_a
        curve = from_a + v**2 * (3 - 2 * v) * b[:, :2] - v**2 * (1 - v) * way_b
        states[:, :2] = np.where(np.isfinite(curve), curve, states[:, :2])
        away = h_ns > self._longest_gap_ns
        states[(u < 0.0) | (u > 1.0) | (away & (u > 0.0) & (u < 1.0))] = np.nan
        # At a truth stamp the result is the recorded state, even if a neighbour has no value.
        for end, mine in ((a, u == 0.0), (b, u == 1.0)):
            states[mine] = end[mine]
        return states


def true_paths(truth: Columns) -> list[TruePath]:
    """Return the path of every true object except the ego, by ascending id.

    If several rows have one stamp the last one counts. Rows without a position are
    ignored.
    """
    ids = truth["object_id"]
    usable = ids != EGO_ID
    for name in TRUE_STATE[:2]:
        usable &= np.abs(truth[name]) <= LARGEST
    stamps_ns = truth["stamp_ns"]
    rows_of = {}
    paths = []
    for object_id in np.unique(ids[usable]).tolist():
        mine = np.flatnonzero(usable & (ids == object_id))[::-1]
        distinct_ns, newest = np.unique(stamps_ns[mine], return_index=True)
        rows_of[object_id] = mine[newest]
        states = np.empty((len(newest), len(TRUE_STATE)))
        paths.append(TruePath(object_id, distinct_ns, states))
    # One column of a long table is in memory at a time.
    for index, name in enumerate(TRUE_STATE):
        values = truth[name]
        for path in paths:
            mine = values[rows_of[path.object_id]]
            mine[~(np.abs(mine) <= LARGEST)] = np.nan
            path.states[:, index] = mine
    return paths


def paths_around(run: Run, times_ns: IntArray) -> list[TruePath]:
    """Return the paths of the true objects of `run` from a minute before `times_ns` (n,) to a minute after them."""
    truth = run.tables["truth"]
    if not len(times_ns):
        return []
    stamps_ns = truth["stamp_ns"]
    near = stamps_ns >= times_ns.min() - _AROUND_NS
    near &= stamps_ns <= times_ns.max() + _AROUND_NS
    return true_paths(truth.where(near))


def states_of(
    paths: Sequence[TruePath], object_index: IntArray, stamps_ns: IntArray
) -> FloatArray:
    """Return the true states at `stamps_ns` (n,), shape (n, 5).

    `object_index` (n,) are indices into `paths`. NaN without truth, and for an index
    without a path. The states are interpolated in blocks.
    """
    states = np.full((len(stamps_ns), len(TRUE_STATE)), np.nan)
    for index, path in enumerate(paths):
        mine = np.flatnonzero(object_index == index)
        for first in range(0, len(mine), _BLOCK_ROWS):
            block = mine[first : first + _BLOCK_ROWS]
            states[block] = path.at(stamps_ns[block])
    return states


def in_ignored_regions(
    run: Run, stamps_ns: IntArray, points_m: FloatArray
) -> BoolArray:
    """Mask of `points_m` (n, 2) in an ignored region at the truth stamp nearest to `stamps_ns` (n,)."""
    ignored = run.tables["ignored"]
    inside = np.zeros(len(stamps_ns), dtype=np.bool_)
    regions = ignored.where(ignored["outline_m"] != "")
    known_ns = np.union1d(run.tables["truth"]["stamp_ns"], ignored["stamp_ns"])
    nearest_ns = known_ns[
        np.searchsorted(known_ns[:-1] + np.diff(known_ns) // 2, stamps_ns)
    ]
    for stamp_ns, text in zip(regions["stamp_ns"], regions["outline_m"], strict=True):
        rows = np.flatnonzero((nearest_ns == stamp_ns) & ~inside)
        inside[rows] = in_polygon(
            points_m[rows], np.array(text.split(), dtype=np.float64).reshape(-1, 2)
        )
    return inside


def visible(run: Run, paths: Sequence[TruePath], now_ns: IntArray) -> BoolArray:
    """Mask of the times at which an object of `paths` is in some sensor's field of view, shape (n, objects).

    Only sensors with detections count. Occlusion is not modelled. Without ego poses
    (ego.csv), or without a configured sensor, an object is visible whenever it has
    truth.
    """
    sensors = run.config.get("sensors") or {}
    poses = ego_states(run.tables["ego"], now_ns)[:, :3]
    names = np.unique(run.tables["updates"]["sensor"]).tolist()
    if np.isnan(poses).all() or not names or not sensors.keys() >= set(names):
        return present_objects(paths, now_ns)
    models = TypeAdapter(dict[str, SensorModel]).validate_python(
        {name: sensors[name] for name in names}
    )
    ego = run.config.get("ego") or {}
    origin_m = (
        float(ego.get("detection_origin_x_m", 0.0)),
        float(ego.get("detection_origin_y_m", 0.0)),
    )
    seen = np.zeros((len(now_ns), len(paths)), dtype=np.bool_)
    for first in range(0, len(now_ns), _BLOCK_TICKS):
        block = slice(first, first + _BLOCK_TICKS)
        positions_m = np.stack(
            [path.at(now_ns[block])[:, :2] for path in paths], axis=1
        )
        present = np.isfinite(positions_m).all(axis=-1)
        positions_m[~present] = 0.0
        at = np.broadcast_to(poses[block, None], (*present.shape, 3))
        covered = [model.sees(positions_m, at, origin_m) for model in models.values()]
        seen[block] = present & np.any(covered, axis=0)
    return seen


def present_objects(paths: Sequence[TruePath], now_ns: IntArray) -> BoolArray:
    """Mask of the times at which an object of `paths` has truth, shape (n, objects)."""
    present = np.empty((len(now_ns), len(paths)), dtype=np.bool_)
    for first in range(0, len(now_ns), _BLOCK_TICKS):
        block = slice(first, first + _BLOCK_TICKS)
        for index, path in enumerate(paths):
            present[block, index] = np.isfinite(path.at(now_ns[block])[:, 0])
    return present


def ego_states(ego: Columns, stamps_ns: IntArray) -> FloatArray:
    """x, y, yaw (not wrapped) and speed of the ego at `stamps_ns`, shape (n, 4).

    States are constant before the first and after the last row. NaN if the ego has no
    valid row.
    """
    rows = np.stack(
        [ego[name] for name in ("x_m", "y_m", "yaw_rad", "speed_mps")], axis=-1
    )
    known = np.flatnonzero(np.isfinite(rows[:, :3]).all(axis=1))
    if not len(known):
        return np.full((len(stamps_ns), 4), np.nan)
    at_ns, first = np.unique(ego["stamp_ns"][known], return_index=True)
    rows = rows[known[first]]
    rows[:, 2] = np.unwrap(rows[:, 2])
    times, wanted = ((ns - at_ns[0]).astype(np.float64) for ns in (at_ns, stamps_ns))
    return np.stack([np.interp(wanted, times, column) for column in rows.T], axis=-1)

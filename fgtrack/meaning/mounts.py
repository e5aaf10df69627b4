"""Mounts of sensors: yaw and lever arm, estimated from the detections of common objects and from the ego's motion.

Tracklets of two sensors are aligned coarsely: a search over all yaws counts common
offsets. Aligned tracklets are the paths of objects. Generalised least squares over
these paths (`object_fit`) estimates the mounts of all sensors relative to a reference
sensor. Objects that stand still show the mount of the reference sensor in the ego.

The standard deviations are a jackknife over stretches of time, as in
`fgtrack.clocks.offsets`: it includes time-correlated errors.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import rotation, rotations, wrap_angle
from fgtrack.core.linalg import psd_solve
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.meaning.object_fit import Rows, filtered
from fgtrack.meaning.tracklets import EgoMotion, Noise, Points, tracklets

__all__ = ["MountEstimate", "Mounts", "Pose2", "estimated_mounts"]

#: Search: step of the yaw, size of the cells of offsets, largest lever arm between two sensors, and most samples.
_STEP_RAD = math.radians(2.0)
_YAWS_RAD = np.arange(-math.pi, math.pi, _STEP_RAD)
_CELL_M = 1.0
_REACH_M = 12.0
_USUAL_ARM_M = 5.0
_MOST_SAMPLES = 2000
#: Fewest common detections of two sensors, and smallest share of the detections that could be common.
_FEWEST_COMMON = 60
_LEAST_COMMON = 0.3
#: Yaws that differ by more are other yaws; their support must be smaller by this factor.
_OTHER_RAD = 0.3
_UNIQUE = 1.3
#: Gates of two tracklets of one object, in standard deviations, and the usual error of the alignment before each.
_GATES = ((4.0, 1.0, 0.03), (4.0, 0.4, 0.01), (4.0, 0.2, 0.005))
_GAP_S = 1.0
#: Length of the stretches of the jackknife, and fewest stretches.
_STRETCH_S = 5.0
_FEWEST_STRETCHES = 4
#: Most detections of all sensors in the fit.
_MOST_ROWS = 12_000
_ROUNDS = 5
#: Weak prior of the lever arms, as a standard deviation: vehicles are shorter.
_PRIOR_M = 20.0
_PRIOR_RAD = 100.0
_CONVERGED = 1e-3
#: Fewest degrees of freedom of a standard deviation.
_FEWEST_DOF = 1.0
#: Share of the information that the data must carry.
_CARRIED = 0.5
#: Standard deviation of the detected points of a hull, and degrees of freedom of objects that show that they differ.
_HULL_M = 1.0
_FEWEST_OBJECTS_DOF = 1.5
#: Largest chance at which a jackknife over other clusters counts as larger.
_LARGER = 0.05
#: Speed of an object that may stand still, its shortest observation, and the slowest ego that shows it.
_STILL_MPS = 0.5
_SHORTEST_STILL_S = 1.0
_SLOWEST_EGO_MPS = 3.0
#: Level of significance, and smallest mount that matters.
_SURE = 0.0005
_SMALLEST_RAD = 0.005
_SMALLEST_M = 0.1
_KNOWN_YAW_RAD = 0.05
#: Difference from the assumed yaw from which few still objects speak against it.
_CONTRARY_RAD = 0.1


class Pose2(NamedTuple):
    """A planar pose: yaw, x and y."""

    yaw_rad: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0

    @property
    def shift_m(self) -> FloatArray:
        """The translation, shape (2,)."""
        return np.array([self.x_m, self.y_m])

    def shifted(self, d: FloatArray) -> "Pose2":
        """Return the pose with `d`, shape (3,), added to yaw, x and y."""
        yaw_rad, x_m, y_m = map(float, d)
        return Pose2(wrap_angle(self.yaw_rad + yaw_rad), self.x_m + x_m, self.y_m + y_m)

    def after(self, other: "Pose2") -> "Pose2":
        """Return the pose, given in the frame of `other`, in the parent of `other`."""
        x_m, y_m = rotation(other.yaw_rad) @ self.shift_m + other.shift_m
        return Pose2(wrap_angle(self.yaw_rad + other.yaw_rad), float(x_m), float(y_m))

    def moved(self, points_m: FloatArray) -> FloatArray:
        """Return `points_m` (n, 2), given in this frame, in its parent."""
        return np.asarray(points_m @ rotation(self.yaw_rad).T + self.shift_m)


IN_MAP = "its detections are in the map"
"""Reason of a sensor without a mount."""
_UNKNOWN = (math.inf, math.inf, math.inf)


@dataclass(frozen=True)
class MountEstimate:
    """Mount of one sensor in the ego, with standard deviations."""

    sensor: str
    yaw_rad: float
    x_m: float
    y_m: float
    stds: tuple[float, float, float]
    """Standard deviations of yaw, x and y; infinite where a component is unknown, and has its assumed value."""
    dof: tuple[float, float, float]
    """Degrees of freedom of the standard deviations."""
    num_detections: int
    """Number of detections in common with other sensors."""
    why: str
    """A line on the data behind the estimate, or the reason why there is no estimate."""
    is_off: bool = False
    """True if the mount differs from the assumed one significantly (99.9 %), and enough to matter."""
    contrary_yaw_rad: float | None = None
    """Yaw at which an object stands still, against the assumed yaw; too few objects for an estimate."""

    @property
    def pose(self) -> Pose2:
        """Yaw, x and y."""
        return Pose2(self.yaw_rad, self.x_m, self.y_m)

    @property
    def half_widths(self) -> tuple[float, float, float]:
        """Half widths of the 95 % intervals of yaw, x and y; infinite where unknown."""
        dof = np.array(self.dof)
        half = np.array(self.stds) * _t_quantile(dof, 0.975)
        yaw, x, y = np.where(dof >= _FEWEST_DOF, half, np.inf).tolist()
        return yaw, x, y

    @property
    def is_known(self) -> bool:
        """True if the yaw and the lever arm are estimated."""
        return all(map(math.isfinite, self.half_widths))

    @property
    def is_sure_of_yaw(self) -> bool:
        """True if the yaw is known within 0.05 rad (95 %)."""
        return self.half_widths[0] < _KNOWN_YAW_RAD

    @property
    def significant_pose(self) -> Pose2:
        """Yaw, x and y; a lever arm or a yaw whose interval contains 0 is 0."""
        values = [
            value if abs(value) > half or not math.isfinite(half) else 0.0
            for value, half in zip(self.pose, self.half_widths, strict=True)
        ]
        return Pose2(*values)

    @property
    def words(self) -> str:
        """Yaw and lever arm with their 95 % intervals in words, and the data behind them."""
        yaw, x, y = self.half_widths
        if self.why == IN_MAP:
            return IN_MAP
        return (
            f"yaw {_within(math.degrees(self.yaw_rad), math.degrees(yaw), 'degrees')}, "
            f"x {_within(self.x_m, x, 'm')}, y {_within(self.y_m, y, 'm')} ({self.why})"
        )

    def judged(self, assumed: Pose2) -> "MountEstimate":
        """Return the estimate with `is_off`, compared with the `assumed` mount."""
        d = np.array(self.pose) - np.array(assumed)
        d[0] = wrap_angle(float(d[0]))
        is_off = _is_significant(d, np.array(self.stds), np.array(self.dof)).any()
        return replace(self, is_off=bool(is_off))

    def __str__(self) -> str:
        return f"{self.sensor}: {self.words}"


def _t_quantile(dof: FloatArray, share: float) -> FloatArray:
    """Quantile of Student's t distribution; few degrees of freedom count as `_FEWEST_DOF`."""
    from scipy.special import stdtrit  # the import takes a tenth of a second

    return np.asarray(stdtrit(np.maximum(dof, _FEWEST_DOF), share))


def _within(value: float, half: float, unit: str) -> str:
    """A value with its 95 % interval in words."""
    if not math.isfinite(half):
        return f"{value:.2f} {unit} (assumed)"
    return f"{value:.2f} +- {half:.2f} {unit}"


@dataclass(frozen=True)
class Mounts:
    """Mounts of the sensors of a recording."""

    sensors: tuple[MountEstimate, ...]
    references: Mapping[str, str]
    """Reference of each sensor with an estimate: the sensor whose mount is assumed, unless still objects show it."""

    known: frozenset[str] = frozenset()
    """Sensors whose assumed mount counts as known: in the map, configured, or in the ego frame."""
    in_map: frozenset[str] = frozenset()
    """Sensors with detections in the map; they have no mount."""

    def __contains__(self, sensor: str) -> bool:
        return any(item.sensor == sensor for item in self.sensors)

    def is_placed(self, sensor: str) -> bool:
        """True if the mount of the sensor's reference is known, or still objects show it."""
        reference = self.references.get(sensor, sensor)
        return reference in self.known or self[reference].is_sure_of_yaw

    def __getitem__(self, sensor: str) -> MountEstimate:
        return next(item for item in self.sensors if item.sensor == sensor)

    def __repr__(self) -> str:
        lines = [str(item) for item in self.sensors]
        return "\n".join(["Mounts of the sensors in the ego:", *lines])


class _Track(NamedTuple):
    """A tracklet of one sensor."""

    sensor: str
    rows: IntArray
    """Rows of its detections, in the order of time."""
    times_s: FloatArray
    turned_m: FloatArray
    """Positions, turned by the ego's yaw; in the map for a sensor in the map."""

    def at(self, times_s: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return interpolated positions (n, 2) at `times_s`, and the mask of the times between near detections."""
        k = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        inside = (times_s >= self.times_s[0]) & (times_s <= self.times_s[-1])
        gap_s = self.times_s[k] - self.times_s[k - 1]
        share = ((times_s - self.times_s[k - 1]) / gap_s)[:, None]
        at_m = self.turned_m[k - 1] * (1.0 - share) + self.turned_m[k] * share
        return at_m, inside & (gap_s < _GAP_S + 2.0 * np.median(np.diff(self.times_s)))


class _Sensor(NamedTuple):
    """Detections of one sensor in tracklets."""

    points: Points
    noise: Noise
    tracks: list[_Track]


def _tracked(points: Points) -> _Sensor:
    chains, noise = tracklets(points)
    order = np.lexsort((points.stamps_s, chains))
    order = order[chains[order] >= 0]
    parts = np.split(order, np.flatnonzero(np.diff(chains[order])) + 1)
    turned_m = points.turned_m
    tracks = [
        _Track(points.sensor, rows, points.stamps_s[rows], turned_m[rows])
        for rows in parts
        if len(rows)
    ]
    return _Sensor(points, noise, tracks)


def _in_body(sensor: _Sensor, at_m: FloatArray, poses: FloatArray) -> FloatArray:
    """Return positions in the axes of tracklets, shape (n, 2), in the ego or sensor frame."""
    if sensor.points.in_map:
        at_m = at_m - poses[:, :2]
    return np.asarray(np.einsum("nij,nj->ni", rotations(-poses[:, 2]), at_m))


class _Common(NamedTuple):
    """Simultaneous positions of tracklets of two sensors."""

    first_m: FloatArray
    """Positions in the ego or sensor frame of the first sensor, shape (n, 2)."""
    second_m: FloatArray
    pairs: IntArray
    """Numbers of the tracklets of both sensors, shape (n, 2)."""
    R: tuple[FloatArray, FloatArray]
    """Covariances in the frames of both sensors, each of shape (n, 2, 2)."""


def _common(first: _Sensor, second: _Sensor) -> _Common | None:
    """Return the positions of both sensors at the stamps of the second one; None if no stamps are common."""
    parts: list[tuple[FloatArray, FloatArray, FloatArray, tuple[int, int]]] = []
    total = sum(len(track.rows) for track in second.tracks)
    step = max(1, total // _MOST_SAMPLES)
    for n, other in enumerate(second.tracks):
        times_s = other.times_s[::step]
        for m, track in enumerate(first.tracks):
            if track.times_s[0] > times_s[-1] or track.times_s[-1] < times_s[0]:
                continue
            at_m, known = track.at(times_s)
            if known.any():
                rows = other.rows[::step][known]
                parts.append(
                    (
                        at_m[known],
                        other.turned_m[::step][known],
                        second.points.poses[rows],
                        (m, n),
                    )
                )
    if not parts:
        return None
    first_m, second_m, poses = (
        np.concatenate([part[k] for part in parts]) for k in range(3)
    )
    pairs = np.repeat(
        [part[3] for part in parts], [len(part[0]) for part in parts], axis=0
    )
    u_m = _in_body(first, first_m, poses)
    v_m = _in_body(second, second_m, poses)
    return _Common(
        u_m, v_m, pairs, (first.noise.covariances(u_m), second.noise.covariances(v_m))
    )


class _Alignment(NamedTuple):
    """Mount of a sensor relative to another one."""

    pose: Pose2
    support: float
    """Number of common detections, less for long lever arms."""
    runner_up: float = 0.0
    """Largest support of another yaw."""


def _aligned(common: _Common) -> _Alignment:
    """Return the mount of the second sensor in the frame of the first, by a search over the yaw circle."""
    count = round(2.0 * _REACH_M / _CELL_M)
    centres_m = (np.arange(count) + 0.5) * _CELL_M - _REACH_M
    arms_m2 = np.square(centres_m)[:, None] + np.square(centres_m)
    prior = np.exp(-0.5 * arms_m2 / _USUAL_ARM_M**2)
    best = _Alignment(Pose2(), 0.0)
    supports = list[float]()
    for yaw_rad in _YAWS_RAD.tolist():
        cells = (
            common.first_m - common.second_m @ rotation(yaw_rad).T + _REACH_M
        ) // _CELL_M
        inside = ((cells >= 0) & (cells < count)).all(axis=1)
        x, y = cells[inside].astype(np.int64).T
        counts = (
            np.bincount(x * count + y, minlength=count**2)
            .reshape(count, count)
            .astype(float)
        )
        padded = np.pad(counts, 1)
        near = sum(
            padded[i : i + count, j : j + count] for i in range(3) for j in range(3)
        )
        support = near * prior
        row, column = np.unravel_index(int(np.argmax(support)), support.shape)
        supports.append(float(support[row, column]))
        if support[row, column] > best.support:
            pose = Pose2(yaw_rad, float(centres_m[row]), float(centres_m[column]))
            best = _Alignment(pose, float(support[row, column]))
    yaws_rad = _YAWS_RAD - best.pose.yaw_rad
    others = np.array(supports)[np.cos(yaws_rad) < math.cos(_OTHER_RAD)]
    return best._replace(runner_up=float(others.max()))


def _matched(
    common: _Common, pose: Pose2, gate: tuple[float, float, float]
) -> dict[tuple[int, int], int]:
    """Return the pairs of tracklets of one object, with their numbers of common detections."""
    limit, error_m, error_rad = gate
    turn = rotation(pose.yaw_rad)
    gap_m = common.first_m - pose.moved(common.second_m)
    C = common.R[0] + turn @ common.R[1] @ turn.T
    ranges_m = np.hypot(*common.second_m.T)
    C = C + (error_m**2 + (error_rad * ranges_m) ** 2)[:, None, None] * np.eye(2)
    d = np.sqrt(
        np.einsum("ni,ni->n", gap_m, np.linalg.solve(C, gap_m[:, :, None])[:, :, 0])
    )
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


def _refined(common: _Common, pose: Pose2) -> tuple[Pose2, dict[tuple[int, int], int]]:
    """Return the mount and the matched tracklets, with gates that become narrower."""
    links: dict[tuple[int, int], int] = {}
    size = int(common.pairs[:, 1].max()) + 1
    keys = common.pairs[:, 0] * size + common.pairs[:, 1]
    for gate in _GATES:
        links = _matched(common, pose, gate)
        rows = np.isin(keys, [m * size + n for m, n in links])
        if rows.sum() < 10:
            break
        pose = _rigid(common, rows, pose)
    return pose, links


def _rigid(common: _Common, rows: BoolArray, pose: Pose2) -> Pose2:
    """Return the pose by robust least squares over the common positions in `rows`."""
    u_m, v_m = common.first_m[rows], common.second_m[rows]
    for _ in range(5):
        turn = rotation(pose.yaw_rad)
        C = common.R[0][rows] + turn @ common.R[1][rows] @ turn.T
        r = u_m - pose.moved(v_m)
        W = np.linalg.inv(C)
        nis = np.einsum("ni,nij,nj->n", r, W, r)
        W /= np.maximum(1.0, np.sqrt(nis) / 2.0)[:, None, None]
        A = np.zeros((len(r), 2, 3))
        A[:, :, 0] = v_m @ (turn @ np.array([[0.0, -1.0], [1.0, 0.0]])).T
        A[:, 0, 1] = A[:, 1, 2] = 1.0
        H = np.einsum("nki,nkl,nlj->ij", A, W, A) + np.diag(
            [1e-6, 1.0 / _PRIOR_M**2, 1.0 / _PRIOR_M**2]
        )
        yaw, x, y = np.linalg.solve(H, np.einsum("nki,nkl,nl->i", A, W, r))
        pose = Pose2(
            wrap_angle(pose.yaw_rad + float(yaw)),
            pose.x_m + float(x),
            pose.y_m + float(y),
        )
    return pose


@dataclass
class _Group:
    """Sensors with known mounts relative to a reference sensor, through common objects."""

    reference: str
    poses: dict[str, Pose2]
    """Mount of each sensor in the frame of the reference."""
    commons: dict[tuple[str, str], _Common]
    support: dict[str, int] = field(default_factory=dict)
    """Number of detections of each sensor that another sensor of the group has in common."""


def _groups(sensors: Mapping[str, _Sensor], preferred: Sequence[str]) -> list[_Group]:
    """Return the groups of sensors with common objects; sensors in `preferred` come first as references."""
    commons: dict[tuple[str, str], _Common] = {}
    links: list[tuple[float, str, str, Pose2]] = []
    for first, second in combinations(sensors, 2):
        common = _common(sensors[first], sensors[second])
        if common is None:
            continue
        commons[first, second] = common
        if sensors[first].points.in_map and sensors[second].points.in_map:
            links.append((float(_FEWEST_COMMON), first, second, Pose2()))
            continue
        start = _aligned(common)
        pose, pairs = _refined(common, start.pose)
        count = sum(pairs.values())
        # The sensor that detects less limits the number of common detections.
        possible = min(
            len(np.unique(each, axis=0)) for each in (common.first_m, common.second_m)
        )
        is_unique = start.support >= _UNIQUE * start.runner_up
        if is_unique and count >= max(_FEWEST_COMMON, _LEAST_COMMON * possible):
            links.append((float(count), first, second, pose))
    groups: list[_Group] = []
    rest = sorted(
        sensors, key=lambda name: (_rank(name, preferred), -_size(sensors[name]), name)
    )
    while rest:
        group = _Group(rest[0], {rest[0]: Pose2()}, commons)
        for _ in range(len(rest)):
            _extend(group, links)
        groups.append(group)
        rest = [name for name in rest if name not in group.poses]
    return groups


def _rank(name: str, preferred: Sequence[str]) -> int:
    return preferred.index(name) if name in preferred else len(preferred)


def _size(sensor: _Sensor) -> int:
    return sum(len(track.rows) for track in sensor.tracks)


def _extend(group: _Group, links: Sequence[tuple[float, str, str, Pose2]]) -> None:
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


def inverse(pose: Pose2) -> Pose2:
    """Return the pose of the parent in the frame of `pose`."""
    x_m, y_m = -rotation(-pose.yaw_rad) @ pose.shift_m
    return Pose2(-pose.yaw_rad, float(x_m), float(y_m))


def _objects(
    sensors: Mapping[str, _Sensor], group: _Group
) -> dict[tuple[str, int], int]:
    """Return the number of the object of each tracklet, given by its sensor and its index."""
    links: list[tuple[int, tuple[str, int], tuple[str, int]]] = []
    group.support = dict.fromkeys(group.poses, 0)
    for (first, second), common in group.commons.items():
        if first in group.poses and second in group.poses:
            pose = group.poses[second].after(inverse(group.poses[first]))
            for (m, n), count in _matched(common, pose, _GATES[-1]).items():
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
    sensors: Mapping[str, _Sensor], one: tuple[str, int], other: tuple[str, int]
) -> bool:
    """True if two tracklets of one sensor exist at the same time: they belong to different objects."""
    if one[0] != other[0]:
        return False
    first, second = (sensors[name].tracks[k].times_s for name, k in (one, other))
    return bool(first[0] <= second[-1] and second[0] <= first[-1])


class _Table(NamedTuple):
    """Detections of a group, in the order of object, stretch and time."""

    sensors: IntArray
    """Index of the sensor in the group, shape (n,)."""
    objects: IntArray
    stretches: IntArray
    runs: IntArray
    """Number of the object's stretch, shape (n,)."""
    times_s: FloatArray
    points_m: FloatArray
    poses: FloatArray
    noise: FloatArray
    """Noise of the sensors, shape (n, 2, 2), as in `Rows`."""
    in_map: BoolArray


def _table(sensors: Mapping[str, _Sensor], group: _Group) -> _Table:
    owner = _objects(sensors, group)
    parts: list[tuple[FloatArray, ...]] = []
    total = sum(_size(sensors[name]) for name in group.poses)
    step = max(1, math.ceil(total / _MOST_ROWS))
    for number, name in enumerate(group.poses):
        one = sensors[name]
        for k, track in enumerate(one.tracks):
            rows = track.rows[::step]
            parts.append(
                (
                    np.full(len(rows), number),
                    np.full(len(rows), owner[name, k]),
                    track.times_s[::step],
                    one.points.points_m[rows],
                    one.points.poses[rows],
                    np.tile([one.noise.along, one.noise.across], (len(rows), 1, 1)),
                    np.full(len(rows), one.points.in_map),
                )
            )
    numbers, objects, times_s, at_m, poses, noise, in_map = (
        np.concatenate([part[k] for part in parts]) for k in range(7)
    )
    stretches = ((times_s - times_s.min()) // _STRETCH_S).astype(np.int64)
    order = np.lexsort((times_s, stretches, objects))
    runs = np.unique(
        np.column_stack([objects, stretches])[order], axis=0, return_inverse=True
    )[1]
    return _Table(
        numbers[order],
        objects[order],
        stretches[order],
        runs.ravel(),
        times_s[order],
        at_m[order],
        poses[order],
        noise[order],
        in_map[order],
    )


_QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


def _rows(
    table: _Table,
    poses: Sequence[Pose2],
    root: Pose2,
    still: BoolArray,
    radial: Sequence[int],
) -> Rows:
    """Return the positions in the map for mounts `poses`, and their derivatives.

    The parameters are yaw, x and y of the reference in the ego, then of each other
    sensor in the reference, then the error along the sight of each sensor in `radial`.
    """
    count = len(poses)
    n = len(table.runs)
    yaws = np.array([pose.yaw_rad for pose in poses])[table.sensors]
    shifts_m = np.array([pose.shift_m for pose in poses])[table.sensors]
    turned_m = np.einsum("nij,nj->ni", rotations(yaws), table.points_m)
    u_m = turned_m + shifts_m
    psi = np.where(table.in_map, 0.0, table.poses[:, 2])
    ego_m = np.where(table.in_map[:, None], 0.0, table.poses[:, :2])
    root_turn = np.where(table.in_map, 0.0, root.yaw_rad)
    root_m = np.where(table.in_map[:, None], 0.0, root.shift_m)
    turns = rotations(psi)
    full = rotations(psi + root_turn)
    y_m = (
        ego_m
        + np.einsum("nij,nj->ni", full, u_m)
        + np.einsum("nij,nj->ni", turns, root_m)
    )
    A = np.zeros((n, 2, 3 * count + len(radial)))
    for k in range(1, count):
        mine = (table.sensors == k) & ~table.in_map
        A[mine, :, 3 * k] = np.einsum(
            "nij,nj->ni", full[mine], turned_m[mine] @ _QUARTER.T
        )
        A[mine, :, 3 * k + 1 : 3 * k + 3] = full[mine]
    # Moving objects are left out: on a bend they turn with the ego.
    body = still & ~table.in_map
    A[body, :, 0] = np.einsum("nij,nj->ni", full[body], u_m[body] @ _QUARTER.T)
    A[body, :, 1:3] = turns[body]
    for column, k in enumerate(radial, start=3 * count):
        mine = table.sensors == k
        sight = turned_m[mine] / np.maximum(np.hypot(*turned_m[mine].T), 1e-6)[:, None]
        A[mine, :, column] = np.einsum("nij,nj->ni", full[mine], sight)
    mounts_m = np.einsum("nij,nj->ni", full, shifts_m) + np.einsum(
        "nij,nj->ni", turns, root_m
    )
    origins_m = table.poses[:, :2] + np.where(table.in_map[:, None], 0.0, mounts_m)
    return Rows(table.runs, table.times_s, y_m, A, origins_m, table.noise, still)


class _Solution(NamedTuple):
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
    contrary_yaw_rad: float | None = None
    """Yaw of the reference at which few objects stand still, against its assumed yaw."""


class _Free(NamedTuple):
    """Free parameters of a fit: of the reference's mount, and sensors with an error along the sight."""

    root: tuple[bool, bool, bool] = (False, False, False)
    radial: tuple[int, ...] = ()


def _solved(
    table: _Table, poses: Sequence[Pose2], root: Pose2, free: _Free, motion: EgoMotion
) -> _Solution:
    """Return the mounts with which the objects move most smoothly, or stand still."""
    poses = list(poses)
    count = len(poses)
    size = 3 * count + len(free.radial)
    radial_m = np.zeros(len(free.radial))
    prior = np.full(size, _PRIOR_M**-2.0)
    prior[: 3 * count : 3] = _PRIOR_RAD**-2.0
    still = np.zeros(len(table.runs), dtype=bool)
    used = np.zeros(size, dtype=bool)
    used[:3] = free.root
    used[3:] = True
    for number in range(_ROUNDS):
        rows = _rows(table, poses, root, still, free.radial)
        rows.y_m[...] += rows.A[:, :, 3 * count :] @ radial_m
        fit = filtered(rows)
        if any(free.root) and number < 2:
            still = _still(table, fit.velocities_mps)
        H = fit.H.sum(axis=0) + np.diag(prior)
        d = np.zeros(size)
        if used.any():
            d[used] = -psd_solve(H[np.ix_(used, used)], fit.g.sum(axis=0)[used])
        root = root.shifted(d[:3])
        poses[1:] = [
            pose.shifted(d[3 * k : 3 * k + 3]) for k, pose in enumerate(poses[1:], 1)
        ]
        radial_m = radial_m + d[3 * count :]
        if number > 1 and np.abs(d).max() < _CONVERGED:
            break
    L = _absolute(poses, root, size)[:, used]
    first = np.flatnonzero(np.diff(table.runs, prepend=-1))
    hulls = np.full(size, _HULL_M)
    hulls[: 3 * count : 3] /= max(float(np.median(np.hypot(*table.points_m.T))), 1.0)
    std, dof = _spread(
        (fit.H[:, used][:, :, used], fit.g[:, used], prior[used], L),
        table.stretches[first],
        table.objects[first],
        hulls,
    )
    num_still = len(np.unique(table.objects[still]))
    return _Solution(root, poses, radial_m, std, dof, num_still)


def _absolute(poses: Sequence[Pose2], root: Pose2, size: int) -> FloatArray:
    """Jacobian of the mounts in the ego and of the errors along the sight by the parameters, shape (size, size)."""
    L = np.eye(size)
    turn = rotation(root.yaw_rad)
    for k, pose in enumerate(poses[1:], 1):
        rows = slice(3 * k, 3 * k + 3)
        L[rows, :3] = np.eye(3)
        L[3 * k + 1 : 3 * k + 3, 0] = turn @ _QUARTER @ pose.shift_m
        L[3 * k + 1 : 3 * k + 3, 3 * k + 1 : 3 * k + 3] = turn
    return L


def _still(table: _Table, velocities_mps: FloatArray) -> BoolArray:
    """Mask of the detections in runs of objects that stand still."""
    starts = np.flatnonzero(np.diff(table.runs, prepend=-1))
    ends = np.append(starts[1:], len(table.runs)) - 1
    lengths_s = table.times_s[ends] - table.times_s[starts]
    slow = np.hypot(*velocities_mps.T) < _STILL_MPS
    return np.asarray((slow & (lengths_s > _SHORTEST_STILL_S))[table.runs])


def _turn_of_still(
    table: _Table, velocities_mps: FloatArray, motion: EgoMotion
) -> float:
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
    usable = (speeds_mps > _SLOWEST_EGO_MPS) & (gaps_mps < _STILL_MPS)
    usable &= times_s - table.times_s[starts] > _SHORTEST_STILL_S
    if not usable.any():
        return 0.0
    counts = counts[usable]
    turn = np.arctan2(*-ego_mps[usable].T[::-1]) - np.arctan2(
        *relative_mps[usable].T[::-1]
    )
    near = np.cos(turn[:, None] - _YAWS_RAD) > math.cos(2.0 * _STEP_RAD)
    votes = counts @ near
    zero = int(counts[np.cos(turn) > math.cos(2.0 * _STEP_RAD)].sum())
    if 2 * zero >= votes.max():
        return 0.0
    chosen = near[:, int(votes.argmax())]
    x, y = counts[chosen] @ np.cos(turn[chosen]), counts[chosen] @ np.sin(turn[chosen])
    return math.atan2(float(y), float(x))


_System = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Information and gradients of the runs, information of the prior, and rows of the linear functions to judge."""


def _spread(
    system: _System, stretches: IntArray, objects: IntArray, hulls: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations and degrees of freedom: a jackknife over stretches, longer stretches, and objects.

    Errors may be correlated over longer times, or along each object. Then the jackknife
    over those clusters is significantly larger, and counts. One or two objects cannot
    show that their hulls are no cause. Then `hulls`, the usual standard deviation of the
    detected points of a hull, is added.
    """
    from scipy.special import fdtrc

    std, dof = _jackknife(system, stretches)
    for clusters in (stretches // 3, objects):
        other, other_dof = _jackknife(system, clusters)
        known = (other_dof >= _FEWEST_DOF) & (dof > 0.0)
        ratio = np.square(np.where(known, other, 0.0) / np.where(known, std, 1.0))
        chance = fdtrc(np.maximum(other_dof, 1e-3), np.maximum(dof, 1e-3), ratio)
        larger = known & (chance < _LARGER)
        std = np.where(larger, other, std)
        dof = np.where(larger, other_dof, dof)
    few = other_dof < _FEWEST_OBJECTS_DOF
    share = np.square(hulls) / (1.0 + np.maximum(other_dof, 0.0))
    return np.where(few, np.sqrt(np.square(std) + share), std), dof


def _jackknife(system: _System, clusters: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations of a jackknife over `clusters` of runs, and their degrees of freedom.

    Clusters of unequal information count as fewer (Carter, Schnepel and Steigerwald,
    Review of Economics and Statistics 99, 2017).
    """
    H, g, prior, L = system
    names, inverse = np.unique(clusters, return_inverse=True)
    if len(names) < 2 or not g.shape[1]:
        return np.full(len(L), np.inf), np.zeros(len(L))
    parts = np.zeros((len(names), *H.shape[1:]))
    scores = np.zeros((len(names), H.shape[1]))
    np.add.at(parts, inverse, H)
    np.add.at(scores, inverse, g)
    total = parts.sum(axis=0) + np.diag(prior)
    changes = [
        psd_solve(total - part, score)
        for part, score in zip(parts, scores, strict=True)
    ]
    moves = np.stack(changes) @ L.T
    std = np.sqrt((1.0 - 1.0 / len(names)) * np.square(moves).sum(axis=0))
    columns = psd_solve(total, L.T)
    shares = np.einsum("ji,njk,ki->ni", columns, parts, columns)
    sums = shares.sum(axis=0)
    known = sums > 0.0
    shares = shares / np.where(known, sums, 1.0)
    dof = 1.0 / np.maximum(np.square(shares).sum(axis=0), 1e-12) - 1.0
    # The prior must not carry the information.
    carried = sums / np.maximum(np.einsum("ij,ji->i", L, columns), 1e-300)
    known &= carried > _CARRIED
    return np.where(known, std, np.inf), np.where(known, dof, 0.0)


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
        name: _tracked(item)
        for name, item in points.items()
        if len(item.points_m) >= _FEWEST_COMMON
        and (item.in_map or motion)
        and np.isfinite(item.poses).all()
    }
    sensors = {name: item for name, item in sensors.items() if item.tracks}
    in_map = [name for name in sorted(sensors) if sensors[name].points.in_map]
    found: dict[str, MountEstimate] = {}
    references: dict[str, str] = {}
    for group in _groups(sensors, [*in_map, *preferred]):
        for item in _group_estimates(sensors, group, motion, assumed):
            found[item.sensor] = item
            references[item.sensor] = group.reference
    for name in points:
        if name not in found:
            at = assumed.get(name, Pose2())
            why = "too few of its detections recur, or the ego's pose is unknown"
            found[name] = MountEstimate(name, *at, _UNKNOWN, (0.0,) * 3, 0, why)
    return Mounts(
        tuple(found[name] for name in sorted(found)),
        references,
        frozenset([*in_map, *preferred]),
        frozenset(name for name, item in points.items() if item.in_map),
    )


def _group_estimates(
    sensors: Mapping[str, _Sensor],
    group: _Group,
    motion: EgoMotion,
    assumed: Mapping[str, Pose2],
) -> list[MountEstimate]:
    """Return the estimates for the sensors of a group."""
    names = list(group.poses)
    table = _table(sensors, group)
    is_map = sensors[group.reference].points.in_map
    root = Pose2() if is_map else assumed.get(group.reference, Pose2())
    poses = list(group.poses.values())
    base = _solved(table, poses, root, _Free(), motion)
    poses = base.poses
    radial = _radial(table, poses, root, motion)
    best = _solved(table, poses, root, _Free(radial=radial), motion) if radial else base
    if not is_map:
        best = _with_root(table, best, root, radial, motion)
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
            why = (
                f"{best.still} objects stand still"
                if best.still
                else "no object that stands still shows it"
            )
            if best.contrary_yaw_rad is not None:
                yaw_deg = math.degrees(best.contrary_yaw_rad)
                why = f"an object stands still if its axis is at {yaw_deg:.0f} degrees, not ahead"
        elif radial:
            why += ", with an error along the sight"
        stds = tuple(best.stds[3 * k : 3 * k + 3].tolist())
        dof = tuple(best.dof[3 * k : 3 * k + 3].tolist())
        contrary_rad = None if k else best.contrary_yaw_rad
        item = MountEstimate(
            name, *pose, stds, dof, count, why, contrary_yaw_rad=contrary_rad
        )
        result.append(item.judged(assumed.get(name, Pose2())))
    return result


def _radial(
    table: _Table, poses: Sequence[Pose2], root: Pose2, motion: EgoMotion
) -> tuple[int, ...]:
    """Return the indices of the sensors with a significant position error along the line of sight.

    Sensors that show the near sides of hulls are an example.
    """
    count = len(poses)
    candidates = tuple(range(1, count))
    if not candidates:
        return ()
    fit = _solved(table, poses, root, _Free(radial=candidates), motion)
    stds = fit.stds[3 * count :]
    dof = fit.dof[3 * count :]
    factor = _t_quantile(dof, 1.0 - _SURE)
    limit = np.where(dof >= _FEWEST_DOF, stds, np.inf) * factor
    kept = (np.abs(fit.radial_m) > limit) & (np.abs(fit.radial_m) > _SMALLEST_M)
    return tuple(np.array(candidates)[kept].tolist())


def _with_root(
    table: _Table,
    base: _Solution,
    root: Pose2,
    radial: tuple[int, ...],
    motion: EgoMotion,
) -> _Solution:
    """Return the solution with the mount of the reference that still objects show, as far as it is significant."""
    rows = _rows(table, base.poses, root, np.zeros(len(table.runs), dtype=bool), ())
    velocities_mps = filtered(rows).velocities_mps
    turn_rad = _turn_of_still(table, velocities_mps, motion)
    turned = Pose2(wrap_angle(root.yaw_rad + turn_rad), root.x_m, root.y_m)
    result = base
    is_shown = False
    still = 0
    for which in ((True, False, False), (True, True, True)):
        fit = _solved(table, base.poses, turned, _Free(which, radial), motion)
        d = np.array(
            [
                wrap_angle(fit.root.yaw_rad - root.yaw_rad),
                fit.root.x_m - root.x_m,
                fit.root.y_m - root.y_m,
            ]
        )
        sure = _is_significant(d, fit.stds[:3], fit.dof[:3])
        if which[1] and not sure[1:].any():
            continue
        still = max(still, fit.still)
        if sure.any():
            result = fit
            is_shown = True
        elif not which[1] and fit.dof[0] >= _FEWEST_DOF:
            result = result._replace(
                still=fit.still,
                stds=np.concatenate([fit.stds[:1], base.stds[1:]]),
                dof=np.concatenate([fit.dof[:1], base.dof[1:]]),
            )
    is_contrary = not is_shown and still > 0 and abs(turn_rad) > _CONTRARY_RAD
    return result._replace(contrary_yaw_rad=turned.yaw_rad if is_contrary else None)


def _is_significant(d: FloatArray, stds: FloatArray, dof: FloatArray) -> BoolArray:
    """Mask of the components of a mount that differ from 0 significantly, and enough to matter."""
    known = np.isfinite(stds) & (dof >= _FEWEST_DOF)
    factor = _t_quantile(dof, 1.0 - _SURE)
    limit = np.where(known, stds, np.inf) * factor
    least = np.array([_SMALLEST_RAD, _SMALLEST_M, _SMALLEST_M])
    return np.asarray((np.abs(d) > limit) & (np.abs(d) > least))

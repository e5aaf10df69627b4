"""Simulated drives with known mounts: an ego in traffic, sensors in their own frames, and the information bound."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline

from fgtrack import Detection, DetectionList, EgoState, Message

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

DURATION_S = 60.0
STEP_S = 0.005
KNOT_S = 1.0
"""Distance of the knots of the paths in the information bound."""


@dataclass(frozen=True)
class Sensor:
    """A sensor of the drive. Its detections are polar, or positions in its own frame, in the ego's or in the map."""

    name: str
    yaw_rad: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0
    form: str = "polar"
    """`polar`, `sensor`, `ego` or `map`."""
    half_view_rad: float = 1.0
    range_m: float = 80.0
    rate_hz: float = 13.0
    range_std_m: float = 0.25
    range_std_share: float = 0.0
    bearing_std_rad: float = 0.01
    detection_probability: float = 0.85
    clutter: float = 0.8
    """Mean number of false detections in a list."""

    def stds_m(self, range_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the standard deviations along and across the line of sight."""
        along = np.hypot(self.range_std_m, self.range_std_share * range_m)
        return along, self.bearing_std_rad * range_m


NEWCOMER = (
    Sensor("camera", 0.0, 1.5, 0.0, "ego", 0.6, 90.0, 15.0, 0.0, 0.05, 0.006, 0.9, 0.2),
    Sensor("front", 0.0, 3.6, 0.0),
    Sensor("left", 0.6, 3.2, 0.9, half_view_rad=1.05, range_m=60.0),
)
"""A camera with positions in the ego frame, and two RADARs in their own frames."""


@dataclass(frozen=True)
class Seen:
    """Detections of objects by one sensor, without errors."""

    times_s: FloatArray
    objects: IntArray
    true_m: FloatArray
    """True positions in the map, shape (n, 2)."""
    poses: FloatArray
    """True poses of the ego, shape (n, 3)."""


@dataclass(frozen=True)
class Drive:
    """Messages of a drive, and what is needed for the bound."""

    messages: list[Message]
    sensors: tuple[Sensor, ...]
    seen: dict[str, Seen]


def _smooth(rng: np.random.Generator, times_s: FloatArray, std: float) -> FloatArray:
    """A smooth random function with bends of some ten seconds."""
    total = np.zeros_like(times_s)
    for period_s in (25.0, 14.0, 9.0):
        total += np.sin(2.0 * math.pi * times_s / period_s + rng.uniform(0.0, 6.28))
    return std * total / math.sqrt(1.5)


def drive(
    seed: int,
    sensors: Sequence[Sensor] = NEWCOMER,
    parked: int = 2,
    turning: float = 1.0,
    along: int = 4,
    oncoming: int = 4,
) -> Drive:
    """Simulate a drive of a minute with cars `along` the ego, `oncoming` cars, and `parked` cars at the roadside."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(-5.0, DURATION_S + 5.0, STEP_S)
    speed = 13.0 + _smooth(rng, times_s, 1.5)
    yaw = 0.3 + np.cumsum(_smooth(rng, times_s, 0.04 * turning)) * STEP_S
    step_m = STEP_S * speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    ego = np.column_stack([np.cumsum(step_m, axis=0), yaw])
    arc_m = np.cumsum(speed) * STEP_S

    def on_road(s_m: FloatArray, left_m: FloatArray) -> FloatArray:
        along = [np.interp(s_m, arc_m, ego[:, k]) for k in range(3)]
        over_m = np.where(
            s_m > arc_m[-1], s_m - arc_m[-1], np.minimum(s_m - arc_m[0], 0.0)
        )
        x_m = along[0] + over_m * np.cos(along[2]) - left_m * np.sin(along[2])
        y_m = along[1] + over_m * np.sin(along[2]) + left_m * np.cos(along[2])
        return np.column_stack([x_m, y_m])

    paths = []
    for k in range(along + oncoming):
        lane_m = np.full(len(times_s), rng.choice([0.0, 3.5, 3.5, 7.0]))
        if k < along:  # the ego's direction, near the ego
            gap_m = rng.choice([-1.0, 1.0]) * rng.uniform(12.0, 45.0)
            gap_m = gap_m + rng.uniform(-1.0, 1.0) * times_s
            s_m = arc_m + gap_m + _smooth(rng, times_s, 2.0)
        else:  # oncoming
            lane_m = np.full(len(times_s), rng.uniform(6.5, 8.0))
            start_s = rng.uniform(0.0, DURATION_S)
            at_m = np.interp(start_s, times_s, arc_m)
            s_m = at_m - rng.uniform(9.0, 14.0) * (times_s - start_s)
        paths.append(on_road(s_m, lane_m + _smooth(rng, times_s, 0.1)))
    for _ in range(parked):
        s_m = np.full(len(times_s), rng.uniform(0.1, 0.9) * arc_m[-1])
        paths.append(on_road(s_m, np.full(len(times_s), -rng.uniform(3.0, 6.0))))
    messages: list[Message] = []
    for t in np.arange(0.0, DURATION_S, 0.02).tolist():
        x, y, a = _at(ego, times_s, np.array([t]))[0] + rng.normal(size=3) * [
            0.03,
            0.03,
            0.002,
        ]
        v = float(np.interp(t, times_s, speed))
        messages.append(EgoState(_ns(t), _ns(t + 0.003), x, y, a, v))
    seen = {
        item.name: _sense(item, rng, times_s, ego, paths, messages) for item in sensors
    }
    messages.sort(key=lambda item: item.receipt_ns)
    return Drive(messages, tuple(sensors), seen)


def _ns(time_s: float) -> int:
    return round((time_s + 10.0) * 1e9)


def _at(values: FloatArray, times_s: FloatArray, at_s: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(at_s, times_s, column) for column in values.T])


def _turned(points_m: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y = points_m.T
    return np.column_stack([c * x - s * y, s * x + c * y])


def _sense(
    sensor: Sensor,
    rng: np.random.Generator,
    times_s: FloatArray,
    ego: FloatArray,
    paths: Sequence[FloatArray],
    messages: list[Message],
) -> Seen:
    """Append the lists of `sensor` to `messages`, and return its detections of objects."""
    lists_s = np.arange(rng.uniform(0.0, 0.07), DURATION_S, 1.0 / sensor.rate_hz)
    lists_s = lists_s + rng.uniform(0.0, 0.004, len(lists_s))
    poses = _at(ego, times_s, lists_s)
    arm_m = _turned(np.tile([[sensor.x_m, sensor.y_m]], (len(lists_s), 1)), poses[:, 2])
    at_m = poses[:, :2] + arm_m
    axis_rad = poses[:, 2] + sensor.yaw_rad
    polar: list[list[tuple[float, float]]] = [[] for _ in lists_s]
    rows: list[tuple[int, int]] = []
    true_m = [_at(path, times_s, lists_s) for path in paths]
    for number, path in enumerate(true_m):
        local_m = _turned(path - at_m, -axis_rad)
        r = np.hypot(*local_m.T)
        b = np.arctan2(local_m[:, 1], local_m[:, 0])
        hit = (r < sensor.range_m) & (r > 1.0) & (np.abs(b) < sensor.half_view_rad)
        hit &= rng.random(len(r)) < sensor.detection_probability
        along, _ = sensor.stds_m(r)
        r = r + along * rng.normal(size=len(r))
        b = b + sensor.bearing_std_rad * rng.normal(size=len(b))
        for k in np.flatnonzero(hit).tolist():
            polar[k].append((float(r[k]), float(b[k])))
            rows.append((k, number))
    for k, items in enumerate(polar):
        for _ in range(rng.poisson(sensor.clutter)):
            r_m = sensor.range_m * math.sqrt(rng.random())
            items.append((r_m, rng.uniform(-1.0, 1.0) * sensor.half_view_rad))
        objects = [_detection(sensor, item, poses[k]) for item in items]
        frame = {"polar": "sensor"}.get(sensor.form, sensor.form)
        stamp_ns = _ns(float(lists_s[k]))
        receipt_ns = stamp_ns + round(1e9 * rng.gamma(2.0, 0.03))
        messages.append(
            DetectionList(sensor.name, stamp_ns, receipt_ns, objects, frame)
        )  # type: ignore[arg-type]
    lists, numbers = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    positions = np.array([true_m[n][k] for k, n in rows]).reshape(-1, 2)
    return Seen(lists_s[lists], numbers, positions, poses[lists])


def _detection(
    sensor: Sensor, item: tuple[float, float], pose: FloatArray
) -> Detection:
    r, b = item
    if sensor.form == "polar":
        return Detection(range_m=r, bearing_rad=b)
    at_m = np.array([[r * math.cos(b), r * math.sin(b)]])
    if sensor.form != "sensor":
        at_m = _turned(at_m, np.array([sensor.yaw_rad]))
        at_m = at_m + np.array([sensor.x_m, sensor.y_m])
    if sensor.form == "map":
        at_m = _turned(at_m, pose[2:]) + pose[:2]
    return Detection(x_m=float(at_m[0, 0]), y_m=float(at_m[0, 1]))


def bound(one: Drive) -> FloatArray:
    """Standard deviations of yaw, x and y of each sensor but the first, shape (k, 3), that no estimator can beat.

    The Cramer-Rao bound of unbiased estimators, for known objects and noise. The path
    of each object is an unknown cubic spline with a knot each second.
    """
    size = 3 * (len(one.sensors) - 1)
    total = np.zeros((size, size))
    everyone = np.unique(np.concatenate([item.objects for item in one.seen.values()]))
    for number in everyone.tolist():
        parts = [_jacobian(one, k, number) for k in range(len(one.sensors))]
        times_s = np.concatenate([part[0] for part in parts])
        A = np.concatenate([part[1] for part in parts])
        W = np.concatenate([part[2] for part in parts])
        if len(times_s) < 5:
            continue
        knots = np.arange(
            times_s.min() - 3.5 * KNOT_S, times_s.max() + 4.5 * KNOT_S, KNOT_S
        )
        B = BSpline.design_matrix(times_s, knots, 3).toarray()
        B = B[:, np.abs(B).sum(axis=0) > 1e-9]
        D = np.einsum("nm,ij->nimj", B, np.eye(2)).reshape(2 * len(B), -1)
        WD = np.einsum("nij,njm->nim", W, D.reshape(len(B), 2, -1)).reshape(
            2 * len(B), -1
        )
        WA = np.einsum("nij,njk->nik", W, A).reshape(2 * len(B), -1)
        flat = A.reshape(2 * len(B), -1)
        inner = D.T @ WD
        inner += 1e-9 * np.trace(inner) / len(inner) * np.eye(len(inner))
        total += flat.T @ WA - (D.T @ WA).T @ np.linalg.solve(inner, D.T @ WA)
    stds: FloatArray = np.sqrt(np.diag(np.linalg.inv(total))).reshape(-1, 3)
    return stds


def _jacobian(
    one: Drive, k: int, number: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, derivatives of the positions in the map, and their information, of one sensor and one object."""
    sensor = one.sensors[k]
    seen = one.seen[sensor.name]
    mine = seen.objects == number
    poses = seen.poses[mine]
    mount_m = np.array([sensor.x_m, sensor.y_m])
    local_m = _turned(seen.true_m[mine] - poses[:, :2], -poses[:, 2]) - mount_m
    r = np.hypot(*local_m.T)
    u = local_m / r[:, None]
    along, across = sensor.stds_m(r)
    v = np.column_stack([-u[:, 1], u[:, 0]])
    W = u[:, :, None] * u[:, None, :] / along[:, None, None] ** 2
    W = W + v[:, :, None] * v[:, None, :] / across[:, None, None] ** 2
    turns = np.stack(
        [_turned(np.tile(axis, (len(r), 1)), poses[:, 2]) for axis in np.eye(2)], axis=2
    )
    A = np.zeros((len(r), 2, 3 * (len(one.sensors) - 1)))
    if k:
        columns = slice(3 * k - 2, 3 * k)
        A[:, :, 3 * k - 3] = np.einsum("nij,nj->ni", turns, v * r[:, None])
        A[:, :, columns] = turns
    return seen.times_s[mine], A, turns @ W @ turns.mT

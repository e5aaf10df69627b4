"""Simulates the scans of a sensor: detections of the objects, and clutter."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, overload

import numpy as np

from fgtrack.core.geometry import body_point, cartesian, rotations, wrap_angles
from fgtrack.core.types import (
    SPEED,
    YAW,
    YAW_RATE,
    BoolArray,
    Detection,
    FloatArray,
    IntArray,
    X,
    Y,
)
from fgtrack.models.measurement import ANGULAR, measurement_model
from fgtrack.models.motion import CV
from fgtrack.models.sensors import Mount, in_view
from fgtrack.models.track_map import TrackMap
from fgtrack.sim.sensor import POLAR, SimulatedSensor


class _Detected(NamedTuple):
    """Detections of one sensor, m in number: scan indices, measured values, and random keys that shuffle each scan."""

    scan: IntArray
    z: FloatArray
    key: FloatArray


def _joined(parts: Sequence[_Detected]) -> _Detected:
    """Concatenate `parts`."""
    return _Detected(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class Scans(Sequence[tuple[Detection, ...]]):
    """Detections of n scans; those of a scan are made when it is used."""

    components: tuple[str, ...]
    """Names of the measured values."""
    z: FloatArray
    """Measured values of all detections by ascending scan, shape (m, k)."""
    edges: IntArray
    """First detection of each scan, and the number of detections, shape (n + 1,)."""

    def __len__(self) -> int:
        return len(self.edges) - 1

    @overload
    def __getitem__(self, index: int) -> tuple[Detection, ...]: ...

    @overload
    def __getitem__(self, index: slice) -> list[tuple[Detection, ...]]: ...

    def __getitem__(
        self, index: int | slice
    ) -> tuple[Detection, ...] | list[tuple[Detection, ...]]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        k = range(len(self))[index]
        rows = self.z[self.edges[k] : self.edges[k + 1]].tolist()
        return tuple(
            Detection(**dict(zip(self.components, row, strict=True))) for row in rows
        )


@dataclass(frozen=True, eq=False)
class Scanner:
    """Simulates one sensor on the ego; `ego`, shape (n, 6), contains the ego's states at the sensor's n scans."""

    sensor: SimulatedSensor
    ego: FloatArray
    detection_origin_x_m: float
    """Origin of the detection frame in the ego frame."""

    def scans(
        self,
        rng: np.random.Generator,
        objects: Sequence[FloatArray],
        track: TrackMap | None,
    ) -> Scans:
        """Return the detections of the n scans.

        `objects` contains the states of each object at the scans, shape (n, 6). Every
        object and the clutter have their own random generator.
        """
        clutter_rng, objects_rng = rng.spawn(2)
        children = objects_rng.spawn(len(objects))
        seen = [
            self._see(child, states)
            for child, states in zip(children, objects, strict=True)
        ]
        detected = _joined([self._clutter(clutter_rng, track), *seen])
        order = np.lexsort((detected.key, detected.scan))
        edges = np.searchsorted(detected.scan[order], np.arange(len(self.ego) + 1))
        return Scans(self.sensor.components, detected.z[order], edges)

    def _see(self, rng: np.random.Generator, states: FloatArray) -> _Detected:
        """Detect one object: in each scan none, one or, for a split object, two detections."""
        sensor = self.sensor
        n = len(states)
        everything = np.arange(n)
        # The states of an object are NaN while it is absent; comparisons with NaN are false.
        seen = self._visible(everything, states) & (
            rng.random(n) < sensor.detection_probability
        )
        split = rng.random(n) < sensor.split_probability
        shift_m = np.where(split, rng.uniform(*sensor.split_distance_m, n) / 2.0, 0.0)
        parts = []
        for sign, present in ((1.0, seen), (-1.0, seen & split)):
            moved = states.copy()
            moved[:, X] += sign * shift_m * np.cos(states[:, YAW])
            moved[:, Y] += sign * shift_m * np.sin(states[:, YAW])
            z = self._add_noise(rng, everything, moved)
            parts.append(
                _Detected(everything[present], z[present], rng.random(n)[present])
            )
        return _joined(parts)

    def _clutter(self, rng: np.random.Generator, track: TrackMap | None) -> _Detected:
        """Draw clutter: detections of objects that do not exist, without measurement noise."""
        sensor = self.sensor
        clutter = sensor.clutter
        scan = np.repeat(
            np.arange(len(self.ego)), rng.poisson(clutter.mean_per_scan, len(self.ego))
        )
        m = len(scan)
        ghosts = np.zeros((m, self.ego.shape[1]))
        if clutter.region == "track" and track is not None:
            s = (
                track.frenet(self.ego[scan, :2])[0]
                + rng.uniform(-1.0, 1.0, m) * sensor.max_range_m
            )
            left_m, right_m = track.bounds(s)
            ghosts[:, :2] = track.position(s, rng.uniform(-right_m, left_m))
            ghosts[:, YAW] = track.view(ghosts[:, :2], 0.0, 0.0).yaw_rad
        else:
            # Clutter is uniform over the area of a ring, so the square of the range is uniform.
            distance = np.sqrt(
                rng.uniform(sensor.min_range_m**2, sensor.max_range_m**2, m)
            )
            origin, _, yaw = self._carried(scan, sensor.mount)
            direction = yaw + rng.uniform(
                -sensor.field_of_view_rad / 2.0, sensor.field_of_view_rad / 2.0, m
            )
            ghosts[:, X] = origin[:, X] + distance * np.cos(direction)
            ghosts[:, Y] = origin[:, Y] + distance * np.sin(direction)
            ghosts[:, YAW] = rng.uniform(-math.pi, math.pi, m)
        ghosts[:, SPEED] = rng.uniform(*clutter.speed_mps, m)
        visible = self._visible(scan, ghosts)
        return _Detected(
            scan[visible], self._measure(scan, ghosts)[visible], rng.random(m)[visible]
        )

    def _add_noise(
        self, rng: np.random.Generator, scan: IntArray, states: FloatArray
    ) -> FloatArray:
        """Return noisy measurements of `states` in the scans `scan`, shape (m, k)."""
        sensor = self.sensor
        components = sensor.components
        noise = rng.standard_normal((len(scan), len(components)))
        outlier = rng.random(len(scan)) < sensor.outlier_probability
        noise *= np.where(outlier, sensor.outlier_factor, 1.0)[:, None]
        noise *= [sensor.std[name] for name in components]
        # x_m and y_m come first; their noise is drawn along and across the line of sight.
        if sensor.frame == "ego":
            line_of_sight = self._relative(scan, states)[:, 1] + sensor.mount.yaw_rad
            noise[:, :2] = _rotated(noise[:, :2], line_of_sight)
        z = self._measure(scan, states) + noise
        angles = [name in ANGULAR for name in components]
        z[:, angles] = wrap_angles(z[:, angles])
        return z

    def _measure(self, scan: IntArray, states: FloatArray) -> FloatArray:
        """Return noiseless measurements, shape (m, k), of `states`, shape (m, 6), in the scans `scan`."""
        mount = Mount() if self.sensor.frame == "ego" else self.sensor.mount
        origin, _, yaw = self._carried(scan, mount)
        values = {"yaw_rad": states[:, YAW] - yaw, "speed_mps": states[:, SPEED]}
        values["x_m"], values["y_m"] = _rotated(states[:, :2] - origin, -yaw).T
        values.update(zip(POLAR, self._relative(scan, states).T, strict=True))
        return np.stack([values[name] for name in self.sensor.components], axis=1)

    def _visible(self, scan: IntArray, states: FloatArray) -> BoolArray:
        """Mask (m,) of the `states` inside the field of view and the range of the sensor."""
        sensor = self.sensor
        distance, bearing, _ = self._relative(scan, states).T
        return in_view(
            distance,
            bearing,
            sensor.field_of_view_rad,
            min_range_m=sensor.min_range_m,
            max_range_m=sensor.max_range_m,
            max_range_behind_m=sensor.max_range_behind_m,
        )

    def _relative(self, scan: IntArray, states: FloatArray) -> FloatArray:
        """Return range, bearing and range rate of `states` relative to the moving sensor, shape (m, 3)."""
        origin, velocity, yaw = self._carried(scan, self.sensor.mount)
        relative = np.concatenate(
            [
                _rotated(states[:, :2] - origin, -yaw),
                _rotated(cartesian(states[:, [YAW, SPEED]]) - velocity, -yaw),
            ],
            axis=1,
        )
        return measurement_model(POLAR, CV()).predict(relative)

    def _carried(
        self, scan: IntArray, mount: Mount
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return origin and velocity, (m, 2), and yaw, (m,), in the map, of a frame mounted in the detection frame."""
        x, y, yaw, speed, yaw_rate = self.ego[scan, : YAW_RATE + 1].T
        ahead_m = self.detection_origin_x_m + mount.x_m
        x, y, vx, vy = body_point(x, y, yaw, speed, yaw_rate, ahead_m, mount.y_m)
        return np.stack([x, y], axis=1), np.stack([vx, vy], axis=1), yaw + mount.yaw_rad


def _rotated(vectors: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Return `vectors`, shape (m, 2), each rotated by its angle, shape (m,)."""
    return np.asarray((rotations(angles_rad) @ vectors[:, :, None])[:, :, 0])

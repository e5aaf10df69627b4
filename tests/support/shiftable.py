"""Objects drawn from the motion model and seen by sensors with wrong clocks, from an ego on a circle or at rest."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.geometry import rotation
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.factor_graph.clock_calibration.time_shift import ShiftableMeasurement
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.sim.draw import drawn

START_NS = 1_790_000_000_000_000_000
MOTION = CTRV(yaw_density_rad2ps=0.002, yaw_rate_density_rad2ps3=0.02, speed_density_m2ps3=0.5)
POSITION, POLAR = (measurement_model(names, MOTION) for names in (("x_m", "y_m"), ("range_m", "bearing_rad")))


@dataclass(frozen=True)
class Circle:
    """A path at constant speed on a circle through the origin; at rest at speed 0."""

    speed_mps: float = 0.0
    yaw_rate_radps: float = 0.2

    def __call__(self, time_ns: int) -> SensorPose:
        t = seconds(time_ns - START_NS)
        yaw_rad, radius_m = self.yaw_rate_radps * t, self.speed_mps / self.yaw_rate_radps
        if self.speed_mps == 0.0:
            return SensorPose()
        x_m, y_m = radius_m * math.sin(yaw_rad), radius_m * (1.0 - math.cos(yaw_rad))
        vx, vy = self.speed_mps * math.cos(yaw_rad), self.speed_mps * math.sin(yaw_rad)
        return SensorPose(x_m, y_m, yaw_rad, vx, vy)


@dataclass(frozen=True)
class Eye:
    """A sensor: what is wrong with its clock, and its positions."""

    offset_s: float = 0.0
    std_m: float = 0.2
    rate_hz: float = 10.0
    phase_s: float = 0.0
    polar: bool = False
    outliers: float = 0.0
    """Share of detections with ten times the deviation."""


@dataclass(frozen=True)
class World:
    """What is seen for how long."""

    eyes: Mapping[str, Eye]
    ego: Circle = field(default_factory=Circle)
    start: tuple[float, ...] = (30.0, -40.0, 1.2, 25.0, 0.1)
    duration_s: float = 5.0
    frozen: bool = False
    """The object has no process noise."""

    def measurements(self, rng: np.random.Generator) -> list[ShiftableMeasurement]:
        """One object drawn from the motion model, as all sensors see it."""
        times = sorted(
            (eye.phase_s + k / eye.rate_hz, name)
            for name, eye in self.eyes.items()
            for k in range(round(self.duration_s * eye.rate_hz))
        )
        x, before_s = np.array(self.start), 0.0
        found = []
        for time_s, name in times:
            if self.frozen:
                x = MOTION.predict(x, time_s - before_s)
            elif time_s > before_s:
                x = drawn(MOTION, x, time_s - before_s, rng)
            before_s = time_s
            found.append(self._seen(rng, name, x, START_NS + nanoseconds(time_s)))
        return found

    def _seen(self, rng: np.random.Generator, name: str, x: FloatArray, sensed_ns: int) -> ShiftableMeasurement:
        eye = self.eyes[name]
        pose = self.ego(sensed_ns)
        std_m = eye.std_m * (10.0 if rng.random() < eye.outliers else 1.0)
        z = rotation(-pose.yaw_rad) @ (x[:2] - np.array(pose[:2])) + std_m * rng.standard_normal(2)
        stamp_ns = sensed_ns + nanoseconds(eye.offset_s)
        return ShiftableMeasurement(
            name, stamp_ns, polar(z, self.ego, eye.std_m) if eye.polar else in_ego(z, self.ego, eye.std_m)
        )


def in_ego(z: FloatArray, ego: Callable[[int], SensorPose], std_m: float) -> Callable[[int], Measurement]:
    """A position (2,) in the ego frame, by the time at which it was sensed."""

    def sensed_at(time_ns: int) -> Measurement:
        pose = ego(time_ns)
        in_map = np.array(pose[:2]) + rotation(pose.yaw_rad) @ z
        return Measurement(time_ns, POSITION, in_map, std_m**2 * np.eye(2), pose)

    return sensed_at


def polar(z: FloatArray, ego: Callable[[int], SensorPose], std_m: float) -> Callable[[int], Measurement]:
    """The same as range and bearing."""
    range_m = float(np.hypot(*z))
    ranged = np.array([range_m, math.atan2(z[1], z[0])])
    R = std_m**2 * np.diag([1.0, range_m**-2])
    return lambda time_ns: Measurement(time_ns, POLAR, ranged, R, ego(time_ns))


def shuffled(rng: np.random.Generator, items: Sequence[ShiftableMeasurement]) -> list[ShiftableMeasurement]:
    """`items` in another order."""
    return [items[i] for i in rng.permutation(len(items))]

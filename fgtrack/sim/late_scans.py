"""Scenes of several objects whose scans are late: the model of Garcia-Fernandez and Yi, IEEE TSP 69, 2021."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.motion import CV
from fgtrack.sim.vehicles import draw_states


@dataclass(frozen=True)
class LateScansModel:
    """Model of the scenes: objects, detections, and times."""

    area_m: tuple[float, float] = (800.0, 400.0)
    """Width and height of the area with false detections; one corner is the origin."""
    std_m: float = 2.0
    """Standard deviation of a measured coordinate."""
    detection_probability: float = 0.9
    false_per_scan: float = 10.0
    """Mean number of false detections in a scan."""
    acceleration_density_m2ps3: float = 0.2
    """Density of the white noise of the acceleration."""
    appearances_per_s: float = 0.12
    deaths_per_s: float = 0.02
    birth_mean: tuple[float, float, float, float] = (200.0, 250.0, 3.0, 0.0)
    """Mean x, y in m, and velocity in m/s, of an object that appears."""
    birth_std: tuple[float, float, float, float] = (50.0, 50.0, 1.0, 1.0)

    @property
    def clutter_per_m2(self) -> float:
        """Mean number of false detections of a scan in each m^2."""
        return self.false_per_scan / (self.area_m[0] * self.area_m[1])

    @property
    def motion(self) -> CV:
        """Motion model of the objects."""
        return CV(velocity_density_m2ps3=self.acceleration_density_m2ps3)


LATE_SCANS = LateScansModel()
"""Model of the published scenes."""


@dataclass(frozen=True)
class LateScans:
    """A scene that was drawn. Times are in s after the start."""

    stamps_s: FloatArray
    """Stamps of the scans in order, shape (n,)."""
    points_m: tuple[FloatArray, ...]
    """Detected positions of each scan in the order of the stamps, each of shape (m, 2)."""
    received: tuple[int, ...]
    """Indices of the scans in the order of receipt."""
    paths: tuple[Mapping[float, FloatArray], ...]
    """Position (2,) of each object by time, at the stamps and at the other times that were asked for."""

    @cached_property
    def newest(self) -> tuple[int, ...]:
        """Index of the newest scan at each receipt."""
        return tuple(np.maximum.accumulate(self.received).tolist())


def draw_late_scans(
    rng: np.random.Generator,
    num_scans: int = 120,
    lags_s: Sequence[float] = (),
    model: LateScansModel = LATE_SCANS,
) -> LateScans:
    """Draw a scene: every fifth scan is received later by a number of scans, Poisson-distributed with mean 1.

    The paths also hold the positions at `lags_s` before each stamp.
    """
    stamps_s = np.cumsum(rng.exponential(1.0, num_scans))
    number = rng.poisson(model.appearances_per_s * stamps_s[-1])
    born_s = rng.uniform(0.0, stamps_s[-1], number)
    lives = [
        (each, each + rng.exponential(1.0 / model.deaths_per_s)) for each in born_s
    ]
    before_s = stamps_s[1:, None] - np.asarray(lags_s, dtype=np.float64)
    times_s = np.unique([*stamps_s, *before_s.ravel()])
    paths = tuple(_path(model, life, times_s, rng) for life in lives)
    points_m = tuple(
        _detected(model, paths, time_s, rng) for time_s in stamps_s.tolist()
    )
    order = np.arange(num_scans, dtype=np.float64)
    order[4::5] += rng.poisson(1.0, len(order[4::5])) + 0.5
    received = tuple(np.argsort(order, kind="stable").tolist())
    return LateScans(stamps_s, points_m, received, paths)


def _path(
    model: LateScansModel,
    life_s: tuple[float, float],
    times_s: FloatArray,
    rng: np.random.Generator,
) -> dict[float, FloatArray]:
    """Draw the positions of an object at the times between its birth and its death."""
    state = np.array(model.birth_mean) + model.birth_std * rng.standard_normal(4)
    before_s = life_s[0]
    found = {}
    for time_s in times_s[(times_s > life_s[0]) & (times_s < life_s[1])].tolist():
        state = draw_states(model.motion, state, time_s - before_s, rng)
        found[time_s], before_s = state[:2], time_s
    return found


def _detected(
    model: LateScansModel,
    paths: Sequence[Mapping[float, FloatArray]],
    time_s: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw the measured positions of a scan in random order, shape (m, 2)."""
    seen_m = [
        path[time_s] + model.std_m * rng.standard_normal(2)
        for path in paths
        if time_s in path and rng.random() < model.detection_probability
    ]
    number = rng.poisson(model.false_per_scan)
    false_m = rng.uniform(0.0, model.area_m, (number, 2))
    return rng.permutation(np.concatenate([np.reshape(seen_m, (-1, 2)), false_m]))

"""Settings of a simulated sensor: when it scans, what it measures, and what goes wrong."""

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat

from fgtrack.core.settings import Probability, Rate, require, settings
from fgtrack.core.types import MEASURABLE, BoolArray, FloatArray, Frame
from fgtrack.models.sensors import Mount
from fgtrack.sim.clocks import AnyClock
from fgtrack.sim.delays import AnyDelay, NoDelay

#: Components in the frame of the sensor, relative to it.
POLAR = ("range_m", "bearing_rad", "range_rate_mps")


@settings
class Clutter:
    """Detections of nothing: each scan has a Poisson number of them, uniform over a region."""

    mean_per_scan: NonNegativeFloat = 0.0
    """Between the ranges and bearings of the sensor or, for `track`, on the track up to the maximum range;
    of these a sensor reports the ones that it can see."""
    region: Literal["field_of_view", "track"] = "field_of_view"
    speed_mps: tuple[float, float] = (0.0, 0.0)
    """Range of the speed that clutter seems to have, along the track or in any direction."""

    def __post_init__(self) -> None:
        require(
            self.speed_mps[1] >= self.speed_mps[0],
            "speed_mps",
            "must be (smallest, largest)",
            self.speed_mps,
        )


@settings
class SimulatedSensor:
    """One sensor on the ego vehicle.
    It measures positions and yaw in the ego's detection frame, or range, bearing and range rate in its own.
    Speed is over ground.
    """

    name: Annotated[str, Field(min_length=1)]
    std: Mapping[str, NonNegativeFloat]
    """Standard deviation of each measured component; x_m along, y_m across the line of sight."""
    rate_hz: Rate = 20.0
    phase_s: NonNegativeFloat = 0.0
    """Time of the first scan."""
    jitter_s: NonNegativeFloat = 0.0
    """Each scan is up to this much late, uniformly."""
    delay: AnyDelay = field(default_factory=NoDelay)
    clock: tuple[AnyClock, ...] = ()
    mount: Mount = field(default_factory=Mount)
    field_of_view_rad: Annotated[float, Field(gt=0.0, le=math.tau)] = math.tau
    """Full angle, centred on the axis of the sensor."""
    min_range_m: NonNegativeFloat = 0.0
    max_range_m: float = 100.0
    max_range_behind_m: float | None = None
    """Maximum range in the half behind the sensor, where it is shorter; null is `max_range_m`."""
    detection_probability: Probability = 1.0
    clutter: Clutter = field(default_factory=Clutter)
    split_probability: Probability = 0.0
    """Probability that a detected object gives two detections, one behind the other."""
    split_distance_m: tuple[NonNegativeFloat, NonNegativeFloat] = (2.0, 4.0)
    outlier_probability: Probability = 0.0
    outlier_factor: Annotated[float, Field(ge=1.0)] = 10.0
    """Factor on the standard deviations of an outlier."""
    drop_outs: tuple[tuple[float, float], ...] = ()
    """Intervals [start, end) in seconds in which the sensor is silent."""

    def __post_init__(self) -> None:
        std, behind_m = set(self.std), self.max_range_behind_m
        seen = behind_m is None or self.min_range_m < behind_m <= self.max_range_m
        known = (
            bool(std) and std <= set(MEASURABLE) and ("x_m" in std) == ("y_m" in std)
        )
        require(
            known,
            "std",
            f"x_m with y_m, components out of {', '.join(MEASURABLE)}",
            sorted(std),
        )
        require(
            "x_m" not in std or std.isdisjoint(POLAR),
            "std",
            "positions or range and bearing",
            sorted(std),
        )
        require(
            self.jitter_s < 1.0 / self.rate_hz,
            "jitter_s",
            "must be below a period",
            self.jitter_s,
        )
        require(
            self.max_range_m > self.min_range_m,
            "max_range_m",
            "must exceed min_range_m",
            self.max_range_m,
        )
        apart_m = self.split_distance_m
        require(
            apart_m[1] >= apart_m[0],
            "split_distance_m",
            "must be (smallest, largest)",
            apart_m,
        )
        require(
            seen,
            "max_range_behind_m",
            "must lie in (min_range_m, max_range_m]",
            behind_m,
        )
        require(
            all(a <= b for a, b in self.drop_outs),
            "drop_outs",
            "must be (start, end)",
            self.drop_outs,
        )

    @property
    def components(self) -> tuple[str, ...]:
        """Measured components in the order of `MEASURABLE`."""
        return tuple(name for name in MEASURABLE if name in self.std)

    @property
    def frame(self) -> Frame:
        """Frame of its detections."""
        return "ego" if "x_m" in self.std else "sensor"

    def scan_times(self, rng: np.random.Generator, duration_s: float) -> FloatArray:
        """Times of all scans from 0 to `duration_s`, ascending, drop-outs included."""
        num_scans = max(
            math.floor((duration_s - self.phase_s) * self.rate_hz + 1e-9) + 1, 0
        )
        times = self.phase_s + np.arange(num_scans) / self.rate_hz
        times += rng.uniform(0.0, abs(self.jitter_s), num_scans)  # not -0.0
        return times[times <= duration_s]

    def silent(self, times_s: FloatArray) -> BoolArray:
        """True for those of `times_s` that lie in a drop-out, shape (n,)."""
        starts_s, ends_s = np.reshape(self.drop_outs, (-1, 2)).T[:, :, None]
        return np.asarray(((times_s >= starts_s) & (times_s < ends_s)).any(axis=0))

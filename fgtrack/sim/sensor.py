"""Settings of a simulated sensor: times of its scans, measured components, errors."""

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

#: Components that are relative to the sensor, in the sensor's frame.
POLAR = ("range_m", "bearing_rad", "range_rate_mps")


@settings
class Clutter:
    """False detections: a Poisson number in each scan, uniform over a region."""

    mean_per_scan: NonNegativeFloat = 0.0
    """Mean number of false detections in the region of a scan; only those in view are reported.

    The region is the field of view between the ranges or, for `track`, the track up to
    the maximum range.
    """
    region: Literal["field_of_view", "track"] = "field_of_view"
    """Region of the false detections."""
    speed_mps: tuple[float, float] = (0.0, 0.0)
    """Smallest and largest speed of clutter, along the track or in any direction."""

    def __post_init__(self) -> None:
        require(
            self.speed_mps[1] >= self.speed_mps[0],
            "speed_mps",
            "must be (smallest, largest)",
            self.speed_mps,
        )


@settings
class SimulatedSensor:
    """A sensor on the ego vehicle.

    It measures positions and yaw in the ego's detection frame, or range, bearing and
    range rate in the sensor's frame. Speed is over ground.
    """

    name: Annotated[str, Field(min_length=1)]
    """Name of the sensor in the recording."""
    std: Mapping[str, NonNegativeFloat]
    """Standard deviation of each measured component; x_m is along, y_m across the line of sight."""
    rate_hz: Rate = 20.0
    """Rate of the scans."""
    phase_s: NonNegativeFloat = 0.0
    """Time of the first scan."""
    jitter_s: NonNegativeFloat = 0.0
    """Largest delay of a scan after its nominal time; delays are uniform."""
    delay: AnyDelay = field(default_factory=NoDelay)
    clock: tuple[AnyClock, ...] = ()
    mount: Mount = field(default_factory=Mount)
    field_of_view_rad: Annotated[float, Field(gt=0.0, le=math.tau)] = math.tau
    """Full angle of view, centred on the sensor's axis."""
    min_range_m: NonNegativeFloat = 0.0
    """Range below which the sensor sees nothing."""
    max_range_m: float = 100.0
    """Range beyond which the sensor sees nothing."""
    max_range_behind_m: float | None = None
    """Maximum range in the rear half, if it is shorter; null means `max_range_m`."""
    detection_probability: Probability = 1.0
    """Probability that an object in view is detected in a scan."""
    clutter: Clutter = field(default_factory=Clutter)
    split_probability: Probability = 0.0
    """Probability that a detected object causes two detections, one behind the other."""
    split_distance_m: tuple[NonNegativeFloat, NonNegativeFloat] = (2.0, 4.0)
    """Smallest and largest distance between the two detections of a split object."""
    outlier_probability: Probability = 0.0
    """Probability that a detection is an outlier."""
    outlier_factor: Annotated[float, Field(ge=1.0)] = 10.0
    """Factor on the standard deviations of an outlier."""
    drop_outs: tuple[tuple[float, float], ...] = ()
    """Intervals [start, end) in s without lists from the sensor."""

    def __post_init__(self) -> None:
        std = set(self.std)
        behind_m = self.max_range_behind_m
        is_behind_valid = (
            behind_m is None or self.min_range_m < behind_m <= self.max_range_m
        )
        has_valid_names = (
            bool(std) and std <= set(MEASURABLE) and ("x_m" in std) == ("y_m" in std)
        )
        require(
            has_valid_names,
            "std",
            f"must contain components out of {', '.join(MEASURABLE)}, and x_m only together with y_m",
            sorted(std),
        )
        require(
            "x_m" not in std or std.isdisjoint(POLAR),
            "std",
            f"must contain either positions or {', '.join(POLAR)}",
            sorted(std),
        )
        require(
            self.jitter_s < 1.0 / self.rate_hz,
            "jitter_s",
            "must be shorter than the period",
            self.jitter_s,
        )
        require(
            self.max_range_m > self.min_range_m,
            "max_range_m",
            "must exceed min_range_m",
            self.max_range_m,
        )
        require(
            self.split_distance_m[1] >= self.split_distance_m[0],
            "split_distance_m",
            "must be (smallest, largest)",
            self.split_distance_m,
        )
        require(
            is_behind_valid,
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
        """Frame of the detections."""
        return "ego" if "x_m" in self.std else "sensor"

    def scan_times(self, rng: np.random.Generator, duration_s: float) -> FloatArray:
        """Return the ascending times of all scans from 0 to `duration_s`, drop-outs included."""
        num_scans = max(
            math.floor((duration_s - self.phase_s) * self.rate_hz + 1e-9) + 1, 0
        )
        times = self.phase_s + np.arange(num_scans) / self.rate_hz
        times += rng.uniform(
            0.0, abs(self.jitter_s), num_scans
        )  # `abs` because of -0.0
        return times[times <= duration_s]

    def silent(self, times_s: FloatArray) -> BoolArray:
        """Mask (n,) of the `times_s` inside a drop-out."""
        starts_s, ends_s = np.reshape(self.drop_outs, (-1, 2)).T[:, :, None]
        return np.asarray(((times_s >= starts_s) & (times_s < ends_s)).any(axis=0))

"""Estimated mounts of the sensors of a recording, with intervals and in words."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.meaning.mounts.pose import Pose2

__all__ = [
    "FEWEST_DOF",
    "IN_MAP",
    "SMALLEST_M",
    "SURE",
    "UNKNOWN",
    "MountEstimate",
    "Traffic",
    "Mounts",
    "is_significant",
    "t_quantile",
]

#: Fewest degrees of freedom of a standard deviation.
FEWEST_DOF = 1.0
#: Level of significance, and smallest mount that matters.
SURE = 0.0005
_SMALLEST_RAD = 0.005
SMALLEST_M = 0.1
_KNOWN_YAW_RAD = 0.05
#: Half width from which a lever arm is known roughly; the unknown hulls of a few objects cause less.
_ROUGH_M = 2.0
#: Half width up to which the lever arm of a reference is exact, if its detections are more exact.
_EXACT_M = 0.5


IN_MAP = "its detections are in the map"
"""Reason of a sensor without a mount."""
UNKNOWN = (math.inf, math.inf, math.inf)
"""Standard deviations of an unknown mount."""


Traffic = Literal["shows", "allows", "contradicts", "undecided", "none"]
"""The traffic shows the yaw of the reference, makes the assumed yaw probable or improbable, or does not decide.

`none`: the ego does not move past objects.
"""


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
    traffic: Traffic = "none"
    """What the motion of the objects past the ego shows about the yaw of a reference."""
    detection_std_m: float = 0.0
    """Standard deviation of a detection on each axis, at the median range."""
    num_in_tracklets: int = 0
    """Number of detections that recur from list to list."""

    @property
    def pose(self) -> Pose2:
        """Yaw, x and y."""
        return Pose2(self.yaw_rad, self.x_m, self.y_m)

    @property
    def half_widths(self) -> tuple[float, float, float]:
        """Half widths of the 95 % intervals of yaw, x and y; infinite where unknown."""
        dof = np.array(self.dof)
        half = np.array(self.stds) * t_quantile(dof, 0.975)
        yaw, x, y = np.where(dof >= FEWEST_DOF, half, np.inf).tolist()
        return yaw, x, y

    @property
    def is_known(self) -> bool:
        """True if the yaw and the lever arm are estimated."""
        return all(map(math.isfinite, self.half_widths))

    @property
    def rough_components(self) -> tuple[str, ...]:
        """Components of the lever arm that are estimated, but within more than 2 m (95 %)."""
        widths = zip(("x_m", "y_m"), self.half_widths[1:], strict=True)
        return tuple(name for name, half in widths if _ROUGH_M < half < math.inf)

    @property
    def has_exact_arm(self) -> bool:
        """True if the 95 % interval of the lever arm is at most as wide as the interval of a detection, or 0.5 m."""
        limit_m = max(_EXACT_M, 2.0 * self.detection_std_m)
        return max(self.half_widths[1:]) <= limit_m

    @property
    def is_straight(self) -> bool:
        """True if the axes of the ego are within the 95 % interval of the yaw."""
        return abs(wrap_angle(self.yaw_rad)) <= self.half_widths[0]

    @property
    def is_sure_of_yaw(self) -> bool:
        """True if the yaw is known within 0.05 rad (95 %)."""
        return self.half_widths[0] < _KNOWN_YAW_RAD

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
        is_off = is_significant(d, np.array(self.stds), np.array(self.dof)).any()
        return replace(self, is_off=bool(is_off))

    def __str__(self) -> str:
        return f"{self.sensor}: {self.words}"


def t_quantile(dof: FloatArray, share: float) -> FloatArray:
    """Return the quantile of Student's t distribution; few degrees of freedom count as `FEWEST_DOF`."""
    from scipy.special import stdtrit  # the import takes a tenth of a second

    return np.asarray(stdtrit(np.maximum(dof, FEWEST_DOF), share))


def _within(value: float, half: float, unit: str) -> str:
    """Return a value with its 95 % interval in words."""
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


def is_significant(d: FloatArray, stds: FloatArray, dof: FloatArray) -> BoolArray:
    """Return True for each component of a mount that differs from 0 significantly, and enough to matter."""
    known = np.isfinite(stds) & (dof >= FEWEST_DOF)
    factor = t_quantile(dof, 1.0 - SURE)
    limit = np.where(known, stds, np.inf) * factor
    least = np.array([_SMALLEST_RAD, SMALLEST_M, SMALLEST_M])
    return np.asarray((np.abs(d) > limit) & (np.abs(d) > least))

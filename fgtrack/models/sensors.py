"""What a sensor measures, how well, how late, and how its detections count for the life of a track."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from fgtrack.core.types import MEASURABLE, FloatArray


@dataclass(frozen=True)
class Mount:
    """Pose of the sensor frame in the ego's detection frame."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


@dataclass(frozen=True)
class RobustLoss:
    """A loss that grows slower than the square, so that an outlier pulls less; smoothers use it."""

    kind: Literal["huber", "cauchy", "tukey", "geman_mcclure", "dcs"]
    """`tukey`, `geman_mcclure` and `dcs` are redescending: they can lose a track for good."""
    width: float
    """Where the loss leaves the square, in standard deviations (of the whole measurement)."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.width) and self.width > 0.0):
            raise ValueError(f"width: must be positive and finite, is {self.width}")


@dataclass(frozen=True)
class SensorModel:
    """One modality. Positions have their standard deviations along and across the line of sight."""

    std: Mapping[str, float]
    """Standard deviation of each measured component; the keys say what the sensor measures."""
    yaw_from_map_std_rad: float | None = None
    """Where the sensor measures no yaw: take the map heading as a yaw measurement with this standard deviation."""
    max_delay_s: float | None = None
    """A message that arrives later than this is refused as too old."""
    counter_init: int = 3
    """Status counter of a track that this sensor gave birth to."""
    counter_add: int = 1
    """What a match with this sensor adds to the status counter."""
    ages: Literal["always", "short_range", "long_range", "never"] = "always"
    """At which range a track that this sensor does not see loses one count."""
    stamp_from: Literal["message", "object", "objects_mean"] = "message"
    """A detection's stamp: the list's, its own where it carries one, or the mean of those that do."""
    message_covariance: bool = True
    """Use a detection's own covariance where the message carries one."""
    max_range_m: float | None = None
    """A detection further from the sensor than this is out of bounds: beyond it clutter outweighs objects."""
    births: bool = True
    """Whether an unmatched detection of this sensor starts a track."""
    loss: RobustLoss | None = None
    """Robust loss of its measurement factors; null is the Gaussian. A filter has no use for it."""
    mount: Mount = field(default_factory=Mount)

    def __post_init__(self) -> None:
        unknown = set(self.std) - set(MEASURABLE)
        if unknown:
            raise ValueError(f"std: unknown component {sorted(unknown)[0]!r}, known are {', '.join(MEASURABLE)}")
        if not self.std:
            raise ValueError("std: name at least one measured component")
        for name, value in self.std.items():
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"std.{name}: must be positive and finite, is {value}")
        if ("x_m" in self.std) != ("y_m" in self.std):
            raise ValueError("std: x_m and y_m are measured together")
        for name in ("yaw_from_map_std_rad", "max_delay_s", "max_range_m"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name}: must be positive, is {value}")
        if self.counter_init < 1 or self.counter_add < 0:
            raise ValueError("counter_init must be at least 1 and counter_add not negative")

    @property
    def components(self) -> tuple[str, ...]:
        """Measured components in the order of `MEASURABLE`."""
        return tuple(name for name in MEASURABLE if name in self.std)

    def noise(self, components: tuple[str, ...]) -> FloatArray:
        """Diagonal covariance R of `components`, shape (k, k), in the sensor's own axes; shared and read-only."""
        if components not in self._noises:
            R = np.diag([self.component_std(name) ** 2 for name in components])
            R.flags.writeable = False
            self._noises[components] = R
        return self._noises[components]

    @cached_property
    def _noises(self) -> dict[tuple[str, ...], FloatArray]:
        return {}

    def component_std(self, name: str) -> float:
        """Standard deviation of `name`; a yaw that the sensor does not measure comes from the map."""
        if name == "yaw_rad" and name not in self.std and self.yaw_from_map_std_rad is not None:
            return self.yaw_from_map_std_rad
        return self.std[name]

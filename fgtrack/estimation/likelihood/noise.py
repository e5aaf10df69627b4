"""The standard deviations of a fit, and the motion model with them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.correlated_errors import CorrelatedErrors
from fgtrack.models.motion import MotionModel, WhiteNoise


@dataclass(frozen=True)
class NoiseSpace:
    """The parameters in one vector: noise of the motion, then of each sensor, then the share of its outliers.

    All are positive.
    """

    motion_names: tuple[str, ...]
    motion: Callable[[Mapping[str, float]], MotionModel]
    """The motion model with these parameters, by name of `motion_names`; where its noise is white they are standard
    deviations."""
    sensors: Mapping[str, tuple[str, ...]]
    """Components by sensor."""

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """(sensor, component) of each standard deviation; ("", name) for the motion, (sensor, "") for outliers."""
        motion = [("", name) for name in self.motion_names]
        stds = [(sensor, name) for sensor, components in self.sensors.items() for name in components]
        return (*motion, *stds, *((sensor, "") for sensor in self.sensors))

    @property
    def num_motion(self) -> int:
        """Number of leading parameters that belong to the motion."""
        return len(self.motion_names)

    def motion_model(self, values: Sequence[float] | FloatArray) -> MotionModel:
        """The motion model of `values`, shape (p,)."""
        return self.motion(dict(zip(self.motion_names, map(float, values), strict=False)))

    def noise_parts(self, x: FloatArray, dt_s: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Q at the states `x` (..., n) over `dt_s` (...) in parts, if the noise is white; else None.

        Q = rest + sum of value_i^2 part_i: rest of shape (..., n, n), part of shape (q, ..., n, n).
        """
        model = self.motion_model(np.ones(self.num_motion))
        if not isinstance(model.base if isinstance(model, CorrelatedErrors) else model, WhiteNoise):
            return None
        rest = self.motion_model(np.zeros(self.num_motion)).process_noise(x, dt_s)
        units = np.eye(self.num_motion)
        return rest, np.array([self.motion_model(unit).process_noise(x, dt_s) - rest for unit in units])

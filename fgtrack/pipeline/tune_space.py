"""The standard deviations of a configuration as a vector of parameters, and back."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.likelihood.noise import NoiseSpace
from fgtrack.models.motion import MotionModel
from fgtrack.pipeline.config import Config, MotionConfig

_FIRST_SHARE = 0.01
_DIGITS = 4


@dataclass(frozen=True)
class ConfigNoise:
    """What of a configuration is tuned.

    Process noise, and the standard deviation of every component of every sensor. Of a plug-in's motion model those
    parameters whose name holds `_density_` (a variance grows with it) or `std`. A heading taken from a map
    (`yaw_from_map_std_rad`) is no measurement and is left alone.
    """

    config: Config

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the configuration, in the order of the parameters; empty for the shares of outliers."""
        return tuple(
            f"{self._motion_section}.{name}" if not sensor else f"sensors.{sensor}.std.{name}" if name else ""
            for sensor, name in self.space.names
        )

    @property
    def space(self) -> NoiseSpace:
        """The parameters as the likelihood needs them."""
        sensors = {name: sensor.components for name, sensor in self.config.sensors.items()}
        return NoiseSpace(tuple(self._motion_stds), self._motion_model, sensors)

    @property
    def values(self) -> FloatArray:
        """The configured parameters, shape (p,)."""
        stds = [sensor.std[name] for sensor in self.config.sensors.values() for name in sensor.components]
        return np.array([*self._motion_stds.values(), *stds, *[_FIRST_SHARE] * len(self.config.sensors)])

    @property
    def shown(self) -> list[float]:
        """The configured parameters as the configuration has them, a density as such, in the order of `keys`."""
        return [
            value if sensor or self._built_in else _power(name, value)
            for (sensor, name), value in zip(self.space.names, self.values.tolist(), strict=True)
        ]

    def config_with(self, values: Sequence[float] | FloatArray) -> Config:
        """The configuration with `values`, shape (p,), to four digits; what is as configured stays to the bit."""
        found = {
            name: was if value == was else _rounded(value)
            for name, value, was in zip(self.space.names, map(float, values), self.values.tolist(), strict=True)
        }
        sensors = {
            sensor: replace(model, std={name: found[sensor, name] for name in model.std})
            for sensor, model in self.config.sensors.items()
        }
        motion = self._motion_with({n: found["", n] for n in self._motion_stds})
        return replace(self.config, motion=motion, sensors=sensors)

    @property
    def _built_in(self) -> bool:
        return not self.config.motion.is_plug_in

    @property
    def _motion_section(self) -> str:
        return "motion.std_per_s" if self._built_in else "motion.parameters"

    @property
    def _motion_stds(self) -> dict[str, float]:
        """Positive noise parameters of the motion model, by name; a density as its root."""
        motion = self.config.motion
        if self._built_in:
            return {name: value for name, value in motion.std_per_s.items() if value > 0.0}
        model = motion.model()
        known: dict[str, float] = {}
        if is_dataclass(model):
            known = {one.name: getattr(model, one.name) for one in fields(model)}
        known |= motion.parameters
        noise = {name: value for name, value in known.items() if "_density_" in name or "std" in name}
        return {name: _root(name, float(value)) for name, value in noise.items() if value > 0.0}

    def _motion_with(self, stds: Mapping[str, float]) -> MotionConfig:
        motion = self.config.motion
        if self._built_in:
            return replace(motion, std_per_s={**motion.std_per_s, **stds})
        return replace(
            motion, parameters={**motion.parameters, **{name: _power(name, std) for name, std in stds.items()}}
        )

    def _motion_model(self, stds: Mapping[str, float]) -> MotionModel:
        return self._motion_with(stds).model()


def _root(name: str, value: float) -> float:
    return math.sqrt(value) if "_density_" in name else value


def _power(name: str, value: float) -> float:
    return value * value if "_density_" in name else value


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")

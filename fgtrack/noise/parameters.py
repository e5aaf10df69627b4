"""Noise of a configuration as a vector of parameters, rules of its fit, and the report of what was fitted."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np

from fgtrack.config.settings import Config, MotionConfig
from fgtrack.config.yaml_file import plain
from fgtrack.core.types import FloatArray
from fgtrack.models.correlated_errors import with_correlated_errors
from fgtrack.models.motion import MotionModel
from fgtrack.noise.likelihood.series import NoiseSpace
from fgtrack.runs import Run

_FIRST_SHARE = 0.01
_DIGITS = 4


@dataclass(frozen=True)
class ConfigNoise:
    """Tuned parameters of a configuration: process noise, and the standard deviations of every sensor."""

    config: Config

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the configuration, in the order of the parameters; empty for the shares of outliers."""
        prefixes = (
            (f"sensors.{sensor}.std" if sensor else "motion.std_per_s", name)
            for sensor, name in self.space.names
        )
        return tuple(f"{prefix}.{name}" if name else "" for prefix, name in prefixes)

    @property
    def space(self) -> NoiseSpace:
        """The parameters as the likelihood needs them."""
        sensors = {
            name: sensor.components for name, sensor in self.config.used_sensors.items()
        }
        return NoiseSpace(tuple(self._motion_stds), self._motion_model, sensors)

    @property
    def values(self) -> FloatArray:
        """The configured parameters, shape (p,)."""
        stds = [
            sensor.std[name]
            for sensor in self.config.used_sensors.values()
            for name in sensor.components
        ]
        return np.array(
            [
                *self._motion_stds.values(),
                *stds,
                *[_FIRST_SHARE] * len(self.config.used_sensors),
            ]
        )

    def config_with(self, values: FloatArray) -> Config:
        """Return the configuration with `values`, shape (p,), to four digits; configured ones stay to the bit."""
        new = {
            name: was if value == was else float(f"{value:.{_DIGITS}g}")
            for name, value, was in zip(
                self.space.names, values.tolist(), self.values.tolist(), strict=True
            )
        }
        sensors = {
            sensor: replace(model, std={name: new[sensor, name] for name in model.std})
            for sensor, model in self.config.used_sensors.items()
        }
        motion = self._motion_with({name: new["", name] for name in self._motion_stds})
        return replace(
            self.config, motion=motion, sensors={**self.config.sensors, **sensors}
        )

    @property
    def stamp_stds(self) -> dict[str, float]:
        """Standard deviations of the stamps of the sensors whose stamps err, by sensor."""
        return {
            name: item.stamp_std_s
            for name, item in self.config.used_sensors.items()
            if item.stamp_std_s
        }

    def with_stamps(self, sensor: str, std_s: float) -> "ConfigNoise":
        """Return that of the configuration with stamps of `sensor` that err by `std_s`."""
        changed = replace(self.config.sensors[sensor], stamp_std_s=std_s)
        return ConfigNoise(
            replace(self.config, sensors={**self.config.sensors, sensor: changed})
        )

    @property
    def _motion_stds(self) -> dict[str, float]:
        """Positive noise parameters of the motion model, by name; none of a plug-in's, which has its own."""
        motion = self.config.motion
        names = motion.noise_names(self.config.used_sensors)
        return {
            name: motion.std_per_s[name]
            for name in names
            if motion.std_per_s[name] > 0.0
        }

    def _motion_with(self, stds: Mapping[str, float]) -> MotionConfig:
        return replace(
            self.config.motion, std_per_s={**self.config.motion.std_per_s, **stds}
        )

    def _motion_model(self, stds: Mapping[str, float]) -> MotionModel:
        return with_correlated_errors(
            self._motion_with(stds).model(self.config.used_sensors),
            self.config.used_sensors,
        )


def stamp_key(sensor: str) -> str:
    """Return the key of the standard deviation of the stamps of `sensor`."""
    return f"sensors.{sensor}.stamp_std_s"


@dataclass(frozen=True)
class TuneRules:
    """Data that are used."""

    keep: tuple[str, ...] = ()
    """Keys of the configuration that stay as they are."""
    train_share: float = 0.7
    """Leading part of each recording that the noise which is judged is fitted to; 1: none is judged."""
    max_rounds: int = 4
    """Largest number of associations."""
    max_observations: int | None = None
    """Longer tracks are cut to so many measurements."""


Known = Literal["yes", "roughly", "limit", "no"]


@dataclass(frozen=True)
class TunedParameter:
    """One standard deviation."""

    key: str
    """Key of the configuration."""
    configured: float
    tuned: float
    """As configured where it is not known."""
    std_error: float | None
    """Standard error as a share of the value; None where there is none."""
    known: Known
    """`yes`: `std_error` is at most 5 %; `roughly`: at most 50 %; `limit`: only a limit is known, which the configured
    value exceeds, and is adopted; `no`: the configured value stays."""
    why: str
    """Why it is not known; empty where it is."""


@dataclass(frozen=True)
class SensorNoise:
    """Measurements and outliers of one sensor."""

    sensor: str
    count: int
    """Innovations that counted."""
    own_covariance: int
    """Innovations with a covariance of their own, or time-correlated errors: the standard deviations do not apply."""
    outlier_share: float | None
    """Share of measurements with larger errors; None where nothing counted."""


@dataclass(frozen=True)
class InnovationFit:
    """Innovations of one component against their covariance, on time held out."""

    sensor: str
    component: str
    count: int
    before: float
    """Mean of the squared innovation over its variance, expected 1, with the configured noise."""
    after: float
    """The same with the noise fitted to the rest of the time."""
    band: float
    """Half-width of the 95 % interval of that mean for independent innovations."""


@dataclass(frozen=True)
class HeldOut:
    """The last part of each recording, to which the noise that is judged was not fitted."""

    share: float
    """Share of the recorded time."""
    count: int
    """Innovations."""
    before: float
    """Log-likelihood per innovation with the configured noise."""
    after: float
    """With the noise fitted to the rest."""
    innovations: tuple[InnovationFit, ...]


@dataclass(frozen=True)
class TuneReport:
    """Noise fitted to recordings."""

    config: Config
    """The tuned configuration."""
    parameters: tuple[TunedParameter, ...]
    sensors: tuple[SensorNoise, ...]
    held_out: HeldOut | None
    """None where too little is left to judge."""
    log_likelihood: float
    """Per innovation, of all of them, with the tuned noise."""
    count: int
    """Innovations that counted in the final fit."""
    num_tracks: int
    """Tracks they belong to."""
    num_mixed: int
    """Measurements left out, as most of those around them are outliers; see `without_mixed`."""
    rounds: int
    """Number of associations."""
    settled: bool
    """True if another association would change nothing."""
    broken: Mapping[str, str]
    """Why a recording broke off, by its name; what came before was used."""
    runs: tuple[Run, ...] = field(repr=False)
    """Runs of the last association, of the estimator `ekf-replay`, one for each recording."""

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON, without the runs."""
        names = [
            item.name for item in fields(self) if item.name not in ("config", "runs")
        ]
        return {name: plain(getattr(self, name)) for name in names}

"""Noise of a configuration as a parameter vector, the rules of its fit, and the report."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np

from fgtrack.config.motion import MotionConfig
from fgtrack.config.settings import Config
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
    """Noise parameters of a configuration: process noise, standard deviations of each sensor, and shares of
    outliers.
    """

    config: Config

    @property
    def keys(self) -> tuple[str, ...]:
        """Configuration key of each parameter, in their order; empty for a share of outliers."""
        prefixes = (
            (f"sensors.{sensor}.std" if sensor else "motion.std_per_s", name)
            for sensor, name in self.space.names
        )
        return tuple(f"{prefix}.{name}" if name else "" for prefix, name in prefixes)

    @property
    def space(self) -> NoiseSpace:
        """Names and order of the parameters for the likelihood."""
        sensors = {
            name: sensor.components for name, sensor in self.config.used_sensors.items()
        }
        return NoiseSpace(tuple(self._motion_stds), self._motion_model, sensors)

    @property
    def values(self) -> FloatArray:
        """Configured parameters, shape (p,); shares of outliers have their first guess."""
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
        """Return the configuration with the parameters `values`, shape (p,), rounded to four digits.

        A parameter that equals its configured value keeps it exactly.
        """
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
        """Configured standard deviations of stamps by sensor. Sensors with exact stamps are left out."""
        return {
            name: item.stamp_std_s
            for name, item in self.config.used_sensors.items()
            if item.stamp_std_s
        }

    def with_stamps(self, sensor: str, std_s: float) -> "ConfigNoise":
        """Return the noise of the configuration in which stamps of `sensor` have the standard deviation `std_s`."""
        changed = replace(self.config.sensors[sensor], stamp_std_s=std_s)
        return ConfigNoise(
            replace(self.config, sensors={**self.config.sensors, sensor: changed})
        )

    @property
    def _motion_stds(self) -> dict[str, float]:
        """Positive noise parameters of the motion model by name; empty for a plug-in's motion model."""
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
    """Return the configuration key of the standard deviation of `sensor`'s stamps."""
    return f"sensors.{sensor}.stamp_std_s"


@dataclass(frozen=True)
class TuneRules:
    """Options of a fit: fixed parameters, and the data that are used."""

    keep: tuple[str, ...] = ()
    """Configuration keys that keep their values."""
    train_share: float = 0.7
    """First part of each recording to which the validated noise is fitted, as a share of its time.

    1: no validation.
    """
    max_rounds: int = 4
    """Largest number of rounds of association and fit."""
    max_observations: int | None = None
    """Longer tracks are cut to this number of measurements; None: no limit."""


Known = Literal["yes", "roughly", "limit", "no"]


@dataclass(frozen=True)
class TunedParameter:
    """Result of the fit of one standard deviation."""

    key: str
    """Configuration key."""
    configured: float
    tuned: float
    """Fitted value; the configured value if the parameter is not identifiable."""
    std_error: float | None
    """Standard error as a share of the value; None if the data do not determine the value."""
    known: Known
    """Identifiability of the parameter.

    `yes`: `std_error` is at most 5 %. `roughly`: at most 50 %. `limit`: the data give
    only a limit, which excludes the configured value; the limit is adopted. `no`: not
    identifiable, the configured value stays.
    """
    why: str
    """Reason why the parameter is not identifiable, or only a limit is known; else empty."""


@dataclass(frozen=True)
class SensorNoise:
    """Numbers of measurements and share of outliers of one sensor."""

    sensor: str
    count: int
    """Number of innovations of the sensor that contributed to the likelihood."""
    own_covariance: int
    """Number of innovations to which the sensor's standard deviations do not apply.

    Their detections report a covariance, or the sensor has time-correlated errors.
    """
    outlier_share: float | None
    """Share of measurements with errors larger than nominal; None without measurements."""


@dataclass(frozen=True)
class InnovationFit:
    """Consistency of the innovations of one component on held-out time."""

    sensor: str
    component: str
    count: int
    before: float
    """Mean of the squared innovation over its variance, expected 1, with the configured noise."""
    after: float
    """Mean of the squared innovation over its variance with the noise fitted to the first part."""
    band: float
    """Half-width of the 95 % interval of the mean for independent innovations."""


@dataclass(frozen=True)
class HeldOut:
    """Validation on the last part of each recording, which was not used for the fit."""

    share: float
    """Held-out share of the recorded time."""
    count: int
    """Number of innovations."""
    before: float
    """Log-likelihood per innovation with the configured noise."""
    after: float
    """Log-likelihood per innovation with the noise fitted to the first part."""
    innovations: tuple[InnovationFit, ...]


@dataclass(frozen=True)
class TuneReport:
    """Noise fitted to recordings."""

    config: Config
    """The tuned configuration."""
    parameters: tuple[TunedParameter, ...]
    sensors: tuple[SensorNoise, ...]
    held_out: HeldOut | None
    """Validation; None if the held-out part has no innovations, or no part was held out."""
    log_likelihood: float
    """Log-likelihood per innovation with the tuned noise, over all recordings."""
    count: int
    """Number of innovations that contributed to the final fit."""
    num_tracks: int
    """Number of tracks in the final fit."""
    num_mixed: int
    """Number of measurements excluded because most of their neighbours are outliers, see `with_mixed_marked`."""
    rounds: int
    """Number of rounds of association and fit."""
    settled: bool
    """True if another round would not change the parameters."""
    broken: Mapping[str, str]
    """Reason why a recording could be read only in part, by its name; the readable part was used."""
    runs: tuple[Run, ...] = field(repr=False)
    """Run of the last association for each recording, with the estimator `ekf-replay`."""

    def as_dict(self) -> dict[str, object]:
        """Return the report as plain values for JSON, without the configuration and the runs."""
        names = [
            item.name for item in fields(self) if item.name not in ("config", "runs")
        ]
        return {name: plain(getattr(self, name)) for name in names}

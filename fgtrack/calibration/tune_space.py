"""Noise of a configuration as a vector of parameters, rules of its fit, and the report of what was fitted."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Literal

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.likelihood.series import NoiseSpace
from fgtrack.io.run import Run
from fgtrack.models.correlated_errors import with_correlated_errors
from fgtrack.models.motion import MotionModel
from fgtrack.pipeline.config import Config, MotionConfig

_FIRST_SHARE = 0.01
_DIGITS = 4
_DENSITY = "_density_"  # in the name of a parameter that a variance grows with


@dataclass(frozen=True)
class ConfigNoise:
    """Tuned parameters of a configuration: process noise, and the standard deviations of every sensor.

    Of a plug-in's motion model those parameters whose name holds `_density_` (a variance grows with it) or `std`.
    """

    config: Config

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the configuration, in the order of the parameters; empty for the shares of outliers."""
        motion = "motion.parameters" if self.config.motion.is_plug_in else "motion.std_per_s"
        prefixes = ((f"sensors.{sensor}.std" if sensor else motion, name) for sensor, name in self.space.names)
        return tuple(f"{prefix}.{name}" if name else "" for prefix, name in prefixes)

    @property
    def space(self) -> NoiseSpace:
        """The parameters as the likelihood needs them."""
        sensors = {name: sensor.components for name, sensor in self.config.used_sensors.items()}
        return NoiseSpace(tuple(self._motion_stds), self._motion_model, sensors)

    @property
    def values(self) -> FloatArray:
        """The configured parameters, shape (p,)."""
        stds = [sensor.std[name] for sensor in self.config.used_sensors.values() for name in sensor.components]
        return np.array([*self._motion_stds.values(), *stds, *[_FIRST_SHARE] * len(self.config.used_sensors)])

    def shown(self, values: FloatArray, log_std: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return parameters as the configuration has them, and standard errors as shares of these, shape (p,).

        `log_std`, shape (p,), are those of the logarithms.
        """
        powers = np.array([2.0 if not sensor and _DENSITY in name else 1.0 for sensor, name in self.space.names])
        return values**powers, powers * log_std

    def config_with(self, values: FloatArray) -> Config:
        """Return the configuration with `values`, shape (p,), to four digits; configured ones stay to the bit."""
        new = {
            name: was if value == was else float(f"{value:.{_DIGITS}g}")
            for name, value, was in zip(self.space.names, values.tolist(), self.values.tolist(), strict=True)
        }
        sensors = {
            sensor: replace(model, std={name: new[sensor, name] for name in model.std})
            for sensor, model in self.config.used_sensors.items()
        }
        motion = self._motion_with({name: new["", name] for name in self._motion_stds})
        return replace(self.config, motion=motion, sensors={**self.config.sensors, **sensors})

    @property
    def _motion_stds(self) -> dict[str, float]:
        """Positive noise parameters of the motion model, by name; a density as its root."""
        motion = self.config.motion
        if not motion.is_plug_in:
            return {name: value for name, value in motion.std_per_s.items() if value > 0.0}
        model, values = motion.model(), dict[str, float]()
        if is_dataclass(model):
            values = {one.name: getattr(model, one.name) for one in fields(model)}
        values |= motion.parameters
        noise = {name: float(value) for name, value in values.items() if _DENSITY in name or "std" in name}
        return {name: math.sqrt(value) if _DENSITY in name else value for name, value in noise.items() if value > 0.0}

    def _motion_with(self, stds: Mapping[str, float]) -> MotionConfig:
        motion = self.config.motion
        if not motion.is_plug_in:
            return replace(motion, std_per_s={**motion.std_per_s, **stds})
        parameters = {name: std * std if _DENSITY in name else std for name, std in stds.items()}
        return replace(motion, parameters={**motion.parameters, **parameters})

    def _motion_model(self, stds: Mapping[str, float]) -> MotionModel:
        return with_correlated_errors(self._motion_with(stds).model(), self.config.used_sensors)


@dataclass(frozen=True)
class TuneRules:
    """Data that are used."""

    keep: tuple[str, ...] = ()
    """Keys of the configuration that stay as they are."""
    train_share: float = 0.7
    """Part of the time of each recording, from its start, that the noise which is judged is fitted to; 1: no part is
    left to judge it by."""
    max_rounds: int = 4
    """Largest number of associations."""
    max_observations: int | None = None
    """Longer tracks are cut to so many measurements; None: none is."""


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
    """`yes`: `std_error` is at most 5 %; `roughly`: at most 50 %, and adopted too; `limit`: only a limit is known, and
    the configured value lies beyond it, so that the limit is adopted; `no`: the configured value stays."""
    why: str
    """Why it is not known; empty where it is."""


@dataclass(frozen=True)
class SensorNoise:
    """Measurements and outliers of one sensor."""

    sensor: str
    count: int
    """Innovations that counted."""
    own_covariance: int
    """Innovations to which the standard deviations do not apply: of detections with a covariance of their own, or of a
    sensor with time-correlated errors."""
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
    runs: tuple[Run, ...] = field(repr=False)
    """Runs with the noise fitted to the rest, of the estimator `ekf-replay`, one for each recording."""


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
    """Measurements that were left out, because most of those around them are outliers; see `without_mixed`."""
    rounds: int
    """Number of associations."""
    settled: bool
    """True if another association would have changed nothing any more."""
    broken: Mapping[str, str]
    """Why a recording broke off, by its name; what came before was used."""

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON, without the runs."""
        names: Sequence[str] = [one.name for one in fields(self) if one.name not in ("config", "held_out")]
        judged = None if self.held_out is None else asdict(replace(self.held_out, runs=()))
        rows = {name: [asdict(one) for one in getattr(self, name)] for name in ("parameters", "sensors")}
        return {**{name: getattr(self, name) for name in names}, **rows, "held_out": judged}

"""Noise of a configuration as a vector of parameters, rules of its fit, and the report of what was fitted."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Literal

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.likelihood.fit import FitSettings
from fgtrack.estimation.likelihood.noise import NoiseSpace
from fgtrack.io.run import Run
from fgtrack.models.correlated_errors import with_correlated_errors
from fgtrack.models.motion import MotionModel
from fgtrack.models.sensors import Correlation
from fgtrack.pipeline.config import Config, MotionConfig
from fgtrack.tracking.association import GatedEuclidean, GatedMahalanobis

_FIRST_SHARE = 0.01
_DIGITS = 4
_MAX_SHARE = 0.9999


@dataclass(frozen=True)
class ConfigNoise:
    """Tuned parameters of a configuration.

    Process noise, and the standard deviation of every component of every sensor; where its errors are correlated in
    time, the share that lasts instead, but not how long. Of a plug-in's motion model those
    parameters whose name holds `_density_` (a variance grows with it) or `std`. A heading taken from a map
    (`yaw_from_map_std_rad`) is no measurement and is left alone.
    """

    config: Config

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the configuration, in the order of the parameters; empty for the shares of outliers."""
        return tuple(self._key(sensor, name) for sensor, name in self.space.names)

    def _key(self, sensor: str, name: str) -> str:
        if not sensor:
            return f"{self._motion_section}.{name}"
        if name == "share":
            return f"sensors.{sensor}.correlation.share"
        return f"sensors.{sensor}.std.{name}" if name else ""

    @property
    def space(self) -> NoiseSpace:
        """The parameters as the likelihood needs them."""
        sensors = {name: sensor.components for name, sensor in self.config.used_sensors.items()}
        return NoiseSpace(tuple(self._motion_stds), self._motion_model, sensors, tuple(self._correlations))

    @property
    def values(self) -> FloatArray:
        """The configured parameters, shape (p,)."""
        lasting = self._correlations.values()
        stds = [sensor.std[name] for sensor in self.config.used_sensors.values() for name in sensor.components]
        odds = [one.share / (1.0 - one.share) for one in lasting]
        return np.array([*self._motion_stds.values(), *stds, *odds, *[_FIRST_SHARE] * len(self.config.used_sensors)])

    def shown(self, values: FloatArray, log_std: FloatArray) -> tuple[list[float], list[float]]:
        """Parameters as the configuration has them, and standard errors as shares of these, in the order of `keys`.

        `log_std`, shape (p,), are those of the logarithms.
        """
        shown, errors = [], []
        for (sensor, name), value, error in zip(self.space.names, values.tolist(), log_std.tolist(), strict=True):
            if name == "share":
                value, error = value / (1.0 + value), error / (1.0 + value)
            elif not sensor and not self._built_in and "_density_" in name:
                value, error = value * value, 2.0 * error
            shown.append(value)
            errors.append(error)
        return shown, errors

    def config_with(self, values: Sequence[float] | FloatArray) -> Config:
        """The configuration with `values`, shape (p,), to four digits; what is as configured stays to the bit."""
        found = {
            name: was if value == was else _rounded(value)
            for name, value, was in zip(self.space.names, map(float, values), self.values.tolist(), strict=True)
        }
        sensors = {
            sensor: replace(model, std={name: found[sensor, name] for name in model.std})
            for sensor, model in self.config.used_sensors.items()
        }
        for sensor, was in self._correlations.items():
            odds = found[sensor, "share"]
            kept = odds == was.share / (1.0 - was.share)
            share = was.share if kept else _rounded(odds / (1.0 + odds))
            sensors[sensor] = replace(sensors[sensor], correlation=replace(was, share=min(share, _MAX_SHARE)))
        motion = self._motion_with({n: found["", n] for n in self._motion_stds})
        return replace(self.config, motion=motion, sensors={**self.config.sensors, **sensors})

    @property
    def _correlations(self) -> dict[str, Correlation]:
        """Time-correlated errors by sensor."""
        found = {name: sensor.correlation for name, sensor in self.config.used_sensors.items()}
        return {name: one for name, one in found.items() if one is not None}

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
        return with_correlated_errors(self._motion_with(stds).model(), self.config.used_sensors)


def _root(name: str, value: float) -> float:
    return math.sqrt(value) if "_density_" in name else value


def _power(name: str, value: float) -> float:
    return value * value if "_density_" in name else value


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


@dataclass(frozen=True)
class TuneRules:
    """Which tracks count, and when a parameter is known."""

    fit: FitSettings = field(default_factory=FitSettings)
    keep: tuple[str, ...] = ()
    """Keys of the configuration that stay as they are."""
    train_share: float = 0.7
    """Part of the time of each recording, from its start, that the noise which is judged is fitted to; 1: no part is
    left to judge it by."""
    max_rounds: int = 4
    """Largest number of associations."""
    settled: float = 0.2
    """Rounds end where no parameter moves by more than this share of its standard deviation."""
    min_observations: int = 20
    """Shorter tracks are left out: most of them are clutter."""
    max_observations: int | None = None
    """Longer tracks are cut to so many measurements; null: none is."""
    min_count: int = 30
    """Measured components that a parameter needs at least."""
    known_std_error: float = 0.05
    """A parameter is known where its standard error is below this share of it: three of them are 15 %, ..."""
    rough_std_error: float = 0.5
    """... and not known where it is above this."""
    rejected: float = 1.92
    """A value is rejected by the data where the log-likelihood is lower by this: a 95 % interval."""
    gate_probability: float = 0.9999
    """A narrower chi-square gate is opened to this: what it cuts off would be missing in the noise."""
    gate_stds: float = 4.0
    """A gate in metres is opened to so many standard deviations, for the same reason."""
    start_factor: float = 5.0
    """Further starts have a motion noise larger, and smaller, by this."""
    start_observations: int = 200
    """Part of a track that is used to compare starts."""
    start_tracks: int = 3
    """The number of these tracks."""


def for_tuning(config: Config, rules: TuneRules) -> Config:
    """The configuration with an estimator that keeps late data, and a gate that does not cut off the noise."""
    association = config.association
    if isinstance(association, GatedMahalanobis):
        probability = max(association.gate_probability, rules.gate_probability)
        association = replace(association, gate_probability=probability)
    return replace(config, estimator="ekf-replay", association=association)


def widened(config: Config, rules: TuneRules) -> Config:
    """The configuration with a gate of so many standard deviations of the position of the least precise sensor."""
    axes = ("x_m", "y_m", "range_m")
    needed_m = rules.gate_stds * max(
        [0.0, *(one.std[name] for one in config.used_sensors.values() for name in axes if name in one.std)]
    )
    association = config.association
    if isinstance(association, GatedEuclidean):
        return replace(config, association=replace(association, gate_m=max(association.gate_m, needed_m)))
    if isinstance(association, GatedMahalanobis):
        limit_m = max(association.max_distance_m, needed_m)
        return replace(config, association=replace(association, max_distance_m=limit_m))
    return config


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
    """`yes`: `std_error` is at most `TuneRules.known_std_error`; `roughly`: at most `rough_std_error`, and adopted too;
    `limit`: only a limit is known, and the configured value lies beyond it, so that the limit is adopted; `no`: the
    configured value stays."""
    why: str
    """Why it is not known; empty where it is."""

    @property
    def identifiable(self) -> bool:
        """True if it is known: `yes`."""
        return self.known == "yes"


@dataclass(frozen=True)
class SensorNoise:
    """Measurements and outliers of one sensor."""

    sensor: str
    count: int
    """Innovations that counted."""
    own_covariance: int
    """Innovations of detections with a covariance of their own, to which the standard deviations do not apply."""
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
    from_ns: tuple[int, ...]
    """Stamp at which it begins in each recording."""
    runs_before: tuple[Run, ...] = field(repr=False)
    """Runs with the configured noise, of the estimator `ekf-replay`, one for each recording."""
    runs_after: tuple[Run, ...] = field(repr=False)
    """Runs with the noise fitted to the rest."""


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
    optima: int
    """Different maxima of the likelihood found from several starts; the highest one is reported."""
    settled: bool
    """True if another association would have changed nothing any more."""
    broken: Mapping[str, str]
    """Why a recording broke off, by its name; what came before was used."""

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON, without the runs."""
        values: dict[str, object] = {
            "parameters": [{**asdict(one), "identifiable": one.identifiable} for one in self.parameters],
            "sensors": [asdict(one) for one in self.sensors],
            "held_out": None,
        }
        names = ("log_likelihood", "count", "num_tracks", "num_mixed", "rounds", "optima", "settled")
        values |= {name: getattr(self, name) for name in names}
        values["broken"] = dict(self.broken)
        if self.held_out is not None:
            kept = ("share", "count", "before", "after", "from_ns")
            values["held_out"] = {name: getattr(self.held_out, name) for name in kept} | {
                "innovations": [asdict(one) for one in self.held_out.innovations]
            }
        return values

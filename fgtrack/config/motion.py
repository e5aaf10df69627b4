"""The motion model of the tracks in the configuration, and the start of tracks without a heading."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from pydantic import NonNegativeFloat, PositiveFloat

from fgtrack.core.settings import settings
from fgtrack.estimation.filters.initiation import DEFAULT, Initiation
from fgtrack.estimation.registry import MOTION_MODELS, motion_model
from fgtrack.models.motion import CT, CTRA, CTRV, CV, MotionModel, WhiteNoise
from fgtrack.models.sensors import SensorModel

__all__ = ["InitiationConfig", "MotionConfig"]


@settings
class InitiationConfig:
    """Start of a track whose heading neither the map nor the sensor reports."""

    method: Initiation = DEFAULT
    """Method by which the first heading is estimated.

    `one-point`: the track starts at the first position, with the heading along x.
    `two-point`: along the line through the first two positions. `regression`: along a
    line through the first positions, until the heading is certain.
    """


#: Frequency of the steps that `motion.std_per_s` refers to, as in the paper.
NOISE_HZ = 100.0
#: Default for traffic: changes of 1.5 m/s and 0.2 rad/s within a second.
_STD_PER_S = {"position": 0.3, "yaw": 0.1, "speed": 15.0, "yaw_rate": 2.0}
#: Kinds whose noise is always `std_per_s`. Another kind is the name of a registered motion model.
_STANDARD: Mapping[str, type[WhiteNoise]] = {
    "auto": CTRV,
    "ctrv_euler": CTRV,
    "ctrv": CTRV,
    "ctra": CTRA,
    "ct": CT,
    "cv": CV,
}


#: Names of the noise of `CT` by the names of `CTRV`'s noise, which `motion.kind: auto` expects.
_OF_CT = {"position": "position", "speed": "velocity", "yaw_rate": "yaw_rate"}


def turns(model: MotionModel) -> bool:
    """True if the state has yaw, speed and yaw rate."""
    return not model.cartesian and "yaw_rate_radps" in model.state_names


def _gives_yaw(sensor: SensorModel) -> bool:
    """True if detections of `sensor` have a yaw: measured, or from the map."""
    return "yaw_rad" in sensor.std or sensor.yaw_from_map_std_rad is not None


@dataclass(frozen=True)
class MotionConfig:
    """Motion model and its process noise."""

    kind: str = "auto"
    """`ctrv`, `ctra`, `ct`, `cv`, `ctrv_euler` (the paper's Euler steps), or the name of any other registered model.

    `auto` is `ctrv` if a sensor measures the yaw or reads it from the map. Otherwise it
    is `ct`, because the heading of an object at rest is then unknown.
    """
    std_per_s: Mapping[str, NonNegativeFloat] = field(default_factory=_STD_PER_S.copy)
    """Process noise as in the paper: each step of 1 / `NOISE_HZ` adds the variance (std_per_s / NOISE_HZ)^2.

    So the density is std_per_s^2 / NOISE_HZ. `ctrv` has `position`, `yaw`, `speed` and
    `yaw_rate`; `ctra` also has `accel`; `ct` has `position`, `velocity` and `yaw_rate`;
    `cv` has `velocity`. `auto` has the names of `ctrv`, and uses `speed` as `velocity`
    for `ct`. In `ctrv_euler`, `accel` is an acceleration that drives the speed but is
    never estimated (Q5).
    """
    yaw_rate_std_radps: PositiveFloat = 0.5
    """Standard deviation of the yaw rate of any object at any time (`ctrv`, `ctra`, `ct`).

    An unmeasured yaw rate relaxes to zero with this uncertainty; `.inf` lets it drift
    without limit.
    """
    slow_mps: PositiveFloat = 1.0
    """Speed below which the yaw has more process noise (`ctrv`, `ctra`), because positions do not show the yaw."""
    resting_yaw_rad2ps: NonNegativeFloat = 6.0
    """Spectral density of this additional noise at rest; at speed v times 1 / (1 + (v / slow_mps)^2)^2."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Keyword parameters of another registered model.

    Its noise results from its defaults and these parameters. If `std_per_s` contains
    its densities instead, they are fitted by `fgtrack advise --tune`.
    """

    def __post_init__(self) -> None:
        if self.parameters and self.kind in _STANDARD:
            raise ValueError(
                f"parameters: kind {self.kind} has no parameters, set std_per_s and the other keys of motion"
            )
        self.model()

    @property
    def is_driven(self) -> bool:
        """True if an acceleration that is never estimated drives the speed."""
        return self.kind == "ctrv_euler" and "accel" in self.std_per_s

    @property
    def _has_stds(self) -> bool:
        """True if `std_per_s` determines the noise."""
        return self.kind in _STANDARD or dict(self.std_per_s) != _STD_PER_S

    def _is_cartesian(self, sensors: Mapping[str, SensorModel] | None) -> bool:
        """True if `auto` is `ct` with these `sensors`."""
        return (
            self.kind == "auto"
            and bool(sensors)
            and not any(map(_gives_yaw, (sensors or {}).values()))
        )

    def noise_names(
        self, sensors: Mapping[str, SensorModel] | None = None
    ) -> tuple[str, ...]:
        """Names in `std_per_s` that the model has with these `sensors`; see `model`."""
        if not self._has_stds:
            return ()
        return tuple(
            name
            for name in self.std_per_s
            if name in _OF_CT or not self._is_cartesian(sensors)
        )

    def model(self, sensors: Mapping[str, SensorModel] | None = None) -> MotionModel:
        """Return the motion model with its densities; raises `ValueError` if `std_per_s` does not fit the model.

        `sensors` determine the meaning of `auto`; without sensors it is `ctrv`.
        """
        if self.kind not in _STANDARD:
            return motion_model(self.kind, {**self._densities(), **self.parameters})
        if self._is_cartesian(sensors):
            std = {
                _OF_CT[name]: self.std_per_s[name] for name in self.noise_names(sensors)
            }
            return CT.from_std_per_step(std, NOISE_HZ, **self._keys_of(CT))
        model = CTRA if self.is_driven else _STANDARD[self.kind]
        others = self._keys_of(model)
        if self.kind == "ctrv_euler":
            others = {"yaw_rate_std_radps": math.inf, "resting_yaw_rad2ps": 0.0}
        return model.from_std_per_step(self.std_per_s, NOISE_HZ, **others)

    def _densities(self) -> dict[str, float]:
        """Densities from `std_per_s` for the registered model of this kind; empty if `std_per_s` is not set.

        Raises `ValueError` if the model is a function: `std_per_s` has no meaning then.
        """
        if not self._has_stds:
            return {}
        model = MOTION_MODELS.load(self.kind)
        if not (isinstance(model, type) and issubclass(model, MotionModel)):
            raise ValueError(
                f"std_per_s: the model {self.kind} is a function, set parameters instead"
            )
        return model.densities_of(self.std_per_s, NOISE_HZ)

    def _keys_of(self, model: type[WhiteNoise]) -> dict[str, float]:
        """Parameters of the model that are keys of this section, without the densities."""
        keys = ("yaw_rate_std_radps", "slow_mps", "resting_yaw_rad2ps")
        taken = [each.name for each in fields(model)]
        return {key: getattr(self, key) for key in keys if key in taken}

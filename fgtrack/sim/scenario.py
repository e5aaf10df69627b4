"""A scenario: the world, the ego vehicle, its sensors, and the delays of all messages."""

from dataclasses import field
from typing import Annotated

from pydantic import Field, NonNegativeFloat, NonNegativeInt

from fgtrack.core.settings import Rate, require, settings
from fgtrack.models.oval import OVAL
from fgtrack.sim.delays import AnyDelay, ConstantDelay
from fgtrack.sim.roads import AnyVehicle
from fgtrack.sim.sensor import SimulatedSensor
from fgtrack.sim.vehicles import TrackVehicle

#: Value of `Scenario.map` that stands for `oval` or open space.
_AUTO = "auto"


@settings
class EgoMessages:
    """Settings of the ego's localisation messages."""

    rate_hz: Rate = 100.0
    """Rate of the messages."""
    position_std_m: NonNegativeFloat = 0.02
    """Standard deviation of x and of y."""
    yaw_std_rad: NonNegativeFloat = 0.001
    """Standard deviation of the yaw."""
    speed_std_mps: NonNegativeFloat = 0.05
    """Standard deviation of the speed."""
    yaw_rate_std_radps: NonNegativeFloat = 0.002
    """Standard deviation of the yaw rate."""
    accel_std_mps2: NonNegativeFloat = 0.05
    """Standard deviation of the acceleration."""
    delay: AnyDelay = field(default_factory=lambda: ConstantDelay(0.002))


@settings
class Scenario:
    """Settings of a simulation; only a random generator is needed besides. Object i of the truth is opponent i."""

    ego: AnyVehicle
    opponents: tuple[AnyVehicle, ...] = ()
    sensors: tuple[SimulatedSensor, ...] = ()
    map: str | None = _AUTO
    """Path of a map file, `oval` for the built-in track, or null for open space.

    `auto`: `oval` if a vehicle follows the track or clutter lies on it, otherwise open
    space.
    """
    duration_s: Annotated[float, Field(gt=0.0, le=86_400.0)] = 60.0
    """Length of the simulation."""
    ego_messages: EgoMessages = field(default_factory=EgoMessages)
    truth_rate_hz: Rate = 100.0
    """Rate of the true states."""
    detection_origin_x_m: float = 0.0
    """Origin of the detection frame in the ego frame, as `ego.detection_origin_x_m` of a configuration."""
    start_ns: NonNegativeInt = 1_000_000_000_000
    """Stamp at the start."""

    def __post_init__(self) -> None:
        names = [sensor.name for sensor in self.sensors]
        require(len(set(names)) == len(names), "sensors", "names must differ", names)
        on_track = any(
            isinstance(vehicle, TrackVehicle) for vehicle in (self.ego, *self.opponents)
        )
        on_track |= any(sensor.clutter.region == "track" for sensor in self.sensors)
        if self.map == _AUTO:
            object.__setattr__(self, "map", OVAL if on_track else None)
        require(
            self.map is not None or not on_track,
            "map",
            "a vehicle or clutter on the track needs a map",
            self.map,
        )

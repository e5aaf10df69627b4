"""A scenario: the world, the ego vehicle, its sensors, and the delays of all messages."""

from dataclasses import field
from typing import Annotated

from pydantic import Field, NonNegativeFloat, NonNegativeInt

from fgtrack.core.settings import Rate, require, settings
from fgtrack.models.oval import OVAL
from fgtrack.sim.delays import AnyDelay, ConstantDelay
from fgtrack.sim.sensor import SimulatedSensor
from fgtrack.sim.vehicles import AnyVehicle, TrackVehicle


@settings
class EgoMessages:
    """Settings of the ego's localisation messages."""

    rate_hz: Rate = 100.0
    position_std_m: NonNegativeFloat = 0.02
    """Standard deviation of x and of y."""
    yaw_std_rad: NonNegativeFloat = 0.001
    speed_std_mps: NonNegativeFloat = 0.05
    yaw_rate_std_radps: NonNegativeFloat = 0.002
    accel_std_mps2: NonNegativeFloat = 0.05
    delay: AnyDelay = field(default_factory=lambda: ConstantDelay(0.002))


@settings
class Scenario:
    """Settings of a simulation; only a random generator is needed besides. Object i of the truth is opponent i."""

    ego: AnyVehicle
    opponents: tuple[AnyVehicle, ...] = ()
    sensors: tuple[SimulatedSensor, ...] = ()
    map: str | None = OVAL
    """Path of a map file, `oval` for the built-in track, or None for open space."""
    duration_s: Annotated[float, Field(gt=0.0, le=86_400.0)] = 60.0
    ego_messages: EgoMessages = field(default_factory=EgoMessages)
    truth_rate_hz: Rate = 100.0
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
        require(
            self.map is not None or not on_track,
            "map",
            "a vehicle or clutter on the track needs a map",
            self.map,
        )

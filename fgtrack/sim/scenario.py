"""A scenario: the world, the ego vehicle, its sensors, and how late everything arrives."""

from dataclasses import dataclass, field

from fgtrack.models.oval import OVAL
from fgtrack.sim.delays import AnyDelay, ConstantDelay
from fgtrack.sim.require import require
from fgtrack.sim.sensor import SimulatedSensor
from fgtrack.sim.vehicles import AnyVehicle, TrackVehicle


@dataclass(frozen=True)
class EgoMessages:
    """What the localisation of the ego vehicle reports."""

    rate_hz: float = 100.0
    position_std_m: float = 0.02
    """Of x and of y."""
    yaw_std_rad: float = 0.001
    speed_std_mps: float = 0.05
    yaw_rate_std_radps: float = 0.002
    accel_std_mps2: float = 0.05
    delay: AnyDelay = field(default_factory=lambda: ConstantDelay(0.002))

    def __post_init__(self) -> None:
        require(self.rate_hz > 0.0, "rate_hz", "must be positive", self.rate_hz)
        for name in (
            "position_std_m",
            "yaw_std_rad",
            "speed_std_mps",
            "yaw_rate_std_radps",
            "accel_std_mps2",
        ):
            require(getattr(self, name) >= 0.0, name, "must not be negative", getattr(self, name))


@dataclass(frozen=True)
class Scenario:
    """All that `simulate` needs beside a random generator. Object i of the truth is opponent i."""

    ego: AnyVehicle
    opponents: tuple[AnyVehicle, ...] = ()
    sensors: tuple[SimulatedSensor, ...] = ()
    map: str | None = OVAL
    """Path of a map file, `oval` for the built-in track, or None for open space."""
    duration_s: float = 60.0
    ego_messages: EgoMessages = field(default_factory=EgoMessages)
    truth_rate_hz: float = 100.0
    detection_origin_x_m: float = -1.74
    """Origin of the detection frame in the ego frame; by default the rear axle of the paper's vehicle."""
    start_ns: int = 1_000_000_000_000
    """Stamp of the start."""

    def __post_init__(self) -> None:
        require(0.0 < self.duration_s <= 86_400.0, "duration_s", "must lie in (0, 86400]", self.duration_s)
        require(self.truth_rate_hz > 0.0, "truth_rate_hz", "must be positive", self.truth_rate_hz)
        require(True, "detection_origin_x_m", "must be finite", self.detection_origin_x_m)
        require(self.start_ns >= 0, "start_ns", "must not be negative", self.start_ns)
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) < len(names):
            raise ValueError(f"sensors: names must differ, are {', '.join(names)}")
        if self.map is None:
            if any(isinstance(vehicle, TrackVehicle) for vehicle in (self.ego, *self.opponents)):
                raise ValueError("map: a vehicle of kind track needs one")
            if any(sensor.clutter.region == "track" for sensor in self.sensors):
                raise ValueError("map: clutter on the track needs one")
